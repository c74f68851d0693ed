import os
import platform
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from r2flow.callbacks.checkpoints import AtomicCheckpointIO

from r2flow.base.config import check_tree
from r2flow.base.errors import InputError
from r2flow.model.config import contradictions
from r2flow.runs.folder import (
    RESUMED,
    check_run,
    has_ended,
    open_run,
    read_config,
    run_lock,
)
from tests.conftest import small_disk

CONFIG = {
    "seed": 0,
    "data": {"root": "a", "batch_size": 4},
    "trainer": {"devices": 1, "max_steps": 10, "max_epochs": -1},
}


def changed(**new) -> dict:
    return CONFIG | {
        key: {**CONFIG.get(key, {}), **one} if isinstance(one, dict) else one
        for key, one in new.items()
    }


def checkpoint(run: Path, step: int, lacking: str = "", **notes: int) -> Path:
    path = run / "checkpoints" / f"step-{step:08d}.ckpt"
    content = {
        **dict.fromkeys(RESUMED),
        "global_step": step,
        "r2flow": notes,
        "state_dict": {"weights": torch.zeros(100)},
    }
    content.pop(lacking, None)
    AtomicCheckpointIO().save_checkpoint(content, path)
    return path


def test_where_it_computes_may_change_and_what_may_not(tmp_path: Path):
    assert contradictions(CONFIG, changed(trainer={"devices": 4}, data={"root": "moved"})) == {}
    assert contradictions(CONFIG, changed(seed=1)) == {"seed": "seed=0 there, 1 here"}
    open_run(tmp_path, changed(seed=3))
    assert open_run(tmp_path, CONFIG) is None  # a folder in which nothing was learned is free
    newest = checkpoint(tmp_path, 5)
    assert open_run(tmp_path, changed(trainer={"devices": 4})) == newest
    with pytest.raises(InputError, match=r"data.batch_size=4 there, 8 here.*name=OTHER"):
        open_run(tmp_path, changed(data={"batch_size": 8}))
    # of the process that holds the lock
    (part := newest.with_name(".step-00000006.ckpt.0.part")).touch()
    assert open_run(tmp_path, changed(trainer={"devices": 8}), locked=False) == newest
    assert part.exists()
    # what runs now, and not what was refused
    assert read_config(tmp_path) == changed(trainer={"devices": 4})
    with pytest.raises(
        InputError, match=r"max_steps=10 there, 9 here\. Give the same .* to resume it, or name="
    ):
        # of a link, which has a stage.parent of its own
        check_run(tmp_path, changed(trainer={"max_steps": 9}))
    for lacking in (
        "hyper_parameters",
        "r2flow",
        "state_dict",
        "optimizer_states",
        "lr_schedulers",
        "loops",
        "global_step",
    ):
        checkpoint(tmp_path, 6, lacking)
        assert open_run(tmp_path, CONFIG) == newest


def test_the_parent_may_move_and_must_have_the_same_weights():
    def from_parent(path: str, weights: str) -> dict:
        return changed(
            stage={"parent": {"path": path, "weights": weights, "pairs": f"{path}/pairs"}}
        )

    assert contradictions(from_parent("a", "1f"), from_parent("moved", "1f")) == {}
    assert contradictions(from_parent("a", "1f"), from_parent("a", "2e")) == {
        "stage.parent.weights": "stage.parent.weights=1f there, 2e here"
    }


@pytest.mark.parametrize("trainer", [{"max_steps": -1, "max_epochs": 2}, None])
def test_a_run_of_epochs_ends_at_the_step_that_its_checkpoint_notes(tmp_path: Path, trainer):
    open_run(tmp_path, changed(trainer=trainer))  # None: of a config written by hand
    for step, ended in ((5, False), (6, True)):
        checkpoint(tmp_path, step, total_steps=6)
        assert has_ended(tmp_path) == ended


def test_a_finished_run_keeps_its_sampler(tmp_path: Path):
    open_run(tmp_path, changed(sampler={"method": None, "steps": None}))
    other = changed(sampler={"method": "euler", "steps": 3})
    unfinished = checkpoint(tmp_path, 5)
    assert open_run(tmp_path, other) == unfinished
    assert read_config(tmp_path) == other
    finished = checkpoint(tmp_path, 10)
    with pytest.raises(
        InputError, match=r"sampler.steps=3 there, 4 here\..* r2flow sample .* --sampler NAME"
    ):
        open_run(tmp_path, changed(sampler={"method": "euler", "steps": 4}))
    assert read_config(tmp_path) == other
    # a key of today
    moved = changed(sampler={"method": "euler", "steps": 3, "precision": None}, data={"root": "b"})
    assert open_run(tmp_path, moved) == finished
    assert read_config(tmp_path) == moved


def test_each_part_of_a_mixture_may_move_and_must_stay_what_it_is():
    def parts(root: str, weight: float) -> dict:
        return {
            "data": {
                "parts": [
                    {"name": "folder", "root": "a"},
                    {"name": "folder", "root": root, "weight": weight},
                ]
            }
        }

    assert contradictions(parts("b", 1), parts("moved", 1)) == {}
    assert contradictions(parts("b", 1), parts("b", 2)) == {
        "data.parts.1.weight": "data.parts.1.weight=1 there, 2 here"
    }


HOLD = """
import sys, time
from r2flow.model.config import contradictions
from r2flow.runs.folder import run_lock
with run_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_lock_names_its_holder_and_ends_when_that_is_killed(tmp_path: Path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout.readline() == "held\n"
        for _ in range(2):  # who is refused takes nothing away
            named = rf"\(pid {holder.pid} on {platform.node()}\). Wait for it, or give name=OTHER.$"
            with pytest.raises(InputError, match=named), run_lock(tmp_path, patience=0):
                pass
    finally:
        os.kill(holder.pid, signal.SIGKILL)
        holder.wait()
    with run_lock(tmp_path, patience=0):
        assert f"pid {os.getpid()}" in (tmp_path / ".lock.holder").read_text()
    with (
        small_disk(1),
        pytest.raises(OSError, match=r"\.lock\.holder"),
        run_lock(tmp_path, patience=0),
    ):
        pass


def test_a_config_cut_at_any_line_is_refused(tmp_path: Path):
    open_run(tmp_path, CONFIG)
    path = tmp_path / "config.yaml"
    lines = path.read_text().splitlines(keepends=True)
    assert read_config(tmp_path) == CONFIG
    for kept in range(1, len(lines)):
        path.write_text("".join(lines[:kept]))
        with pytest.raises(
            InputError, match=r"config.yaml is damaged .*; the checkpoints are usable"
        ):
            read_config(tmp_path)


def test_nested_anchors_are_refused_unexpanded(tmp_path: Path):
    """Ten lists of ten of the list before: 10^10 values, which no memory holds."""
    lists = [f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]" for n in range(1, 11)]
    (tmp_path / "config.yaml").write_text("\n".join(["l0: &l0 [1]", *lists]))
    with pytest.raises(InputError, match="aliases"):
        read_config(tmp_path)
    nested: list = [1]
    for _ in range(10):
        nested = [nested] * 10
    with pytest.raises(ValueError, match="more than 1,000,000 values"):
        check_tree({"data": {"root": nested}})


def test_one_part_in_two_places_is_written_twice(tmp_path: Path):
    shared = ["a", "b"]
    open_run(tmp_path, CONFIG | {"x": shared, "y": shared})
    assert read_config(tmp_path) == CONFIG | {"x": shared, "y": shared}
