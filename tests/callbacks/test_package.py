import importlib
import sys

import lightning as L
import pytest
from r2flow.callbacks import CALLBACKS, Stopping, build_callbacks

from r2flow.base.errors import InputError
from r2flow.runs.composing import compose
from tests.conftest import ROOT


def test_a_second_copy_is_refused(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    with pytest.raises(ImportError, match="import r2flow.callbacks"):
        importlib.import_module("callbacks")
    assert "callbacks" not in sys.modules


@pytest.mark.parametrize("name", ["r2flow", "tests", "train", "docs"])
def test_the_rest_of_a_checkout_is_not_in_the_package(name):
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(f"r2flow.{name}")


def test_a_plug_in_comes_before_what_saves_its_state(monkeypatch):
    config = compose(["data=simulated", "backbone=hdit_tiny"])
    monkeypatch.setitem(CALLBACKS._entries, "theirs", L.Callback)
    *_, theirs, last = build_callbacks({**config["callbacks"], "theirs": {}})
    # which saves their state after the step
    assert (type(theirs), type(last)) == (L.Callback, Stopping)


@pytest.mark.parametrize("key", ["ema", "theirs"])
def test_callbacks_that_are_unknown_or_contradict_each_other_are_refused(key: str):
    config = compose(["data=simulated", "backbone=hdit_tiny"])["callbacks"]
    with pytest.raises(InputError, match="one average of its weights|no callback named 'theirs'"):
        build_callbacks({**config, "half_life_ema": {}, key: {}})
