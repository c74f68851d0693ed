import importlib
import sys

import lightning as L
import pytest
from lightning.pytorch.callbacks import EarlyStopping, GradientAccumulationScheduler

from r2flow.callbacks import CALLBACKS, Stopping, build_callbacks
from r2flow.errors import InputError
from r2flow.runs.composing import compose
from tests.conftest import ROOT


def test_a_second_copy_is_refused(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    with pytest.raises(ImportError, match="import r2flow.callbacks"):
        importlib.import_module("callbacks")
    assert "callbacks" not in sys.modules


@pytest.mark.parametrize(
    ("callback", "option", "message"),
    [
        # The loader reads the number of parts once: images would repeat, in batches of another size.
        (GradientAccumulationScheduler, "scheduling={0: 1, 2: 2}", r"give trainer\.accumulate_grad_batches"),
        (EarlyStopping, "monitor=val/loss", r"runs end at trainer\.max_steps"),
        (lambda some: [L.Callback()] * some, "some=2", r"theirs must make a Lightning callback, found \["),
    ],
)
def test_callbacks_that_a_run_does_not_support_are_refused(monkeypatch, callback, option: str, message: str):
    monkeypatch.setitem(CALLBACKS._entries, "theirs", callback)
    with pytest.raises(InputError, match=message):
        build_callbacks(compose(["data=simulated", "backbone=hdit_tiny", f"+callbacks.theirs.{option}"]))
    monkeypatch.setitem(CALLBACKS._entries, "theirs", L.Callback)
    *_, theirs, _, last = build_callbacks(compose(["data=simulated", "backbone=hdit_tiny", "+callbacks.theirs={}"]))
    assert (type(theirs), type(last)) == (L.Callback, Stopping)  # which saves their state after the step
