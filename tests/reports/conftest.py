"""Pictures that are drawn in a fraction of the time."""

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from r2flow.reports.pictures import save_figure


@pytest.fixture
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of fewer pixels and without the PDF, which test_pages.py has whole."""

    def save(figure: Figure, path: Path, **about: Any) -> Path:
        if path.suffix == ".pdf":
            path.touch()
            return path
        return save_figure(figure, path, dpi=100, **about)

    monkeypatch.setattr("r2flow.reports.pages.save_figure", save)
