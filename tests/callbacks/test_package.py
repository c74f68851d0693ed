import importlib
import sys

import pytest

from tests.conftest import ROOT


def test_a_second_copy_is_refused(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    with pytest.raises(ImportError, match="import r2flow.callbacks"):
        importlib.import_module("callbacks")
    assert "callbacks" not in sys.modules
