import pytest
from tiny_backbones import Plain

from r2flow.backbones import BACKBONES


@pytest.fixture(autouse=True)
def _plain_in_the_table(monkeypatch):
    """The table with one backbone more, which states nothing about itself."""
    monkeypatch.setitem(BACKBONES._entries, "plain", Plain)
