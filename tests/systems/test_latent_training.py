"""Score models and latent diffusions in training: what is built, what a run leaves, and how it goes on."""

import shutil
from pathlib import Path

import pytest
import torch

from r2flow.checkpoints import checkpoints_of, load_checkpoint
from r2flow.training import build, check, compose, fit

TINY = [
    "sensor.rows=16", "sensor.columns=64", "data.scenes=8", "data.batch_size=2", "trainer.accelerator=cpu",
    "trainer.max_steps=4", "trainer.val_check_interval=2", "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false", "callbacks.checkpoint.every=2", "callbacks.pictures=null", "samples.num=0",
    "stage.warmup_images=0", "loggers=[csv]",
]  # fmt: skip
SCORE = ["experiment=lidargen_small", *TINY, "generator.width=4", "generator.levels=4"]
FULL = ["lidargen"]


def run(options: list[str], folder: Path) -> Path:
    fit(build(compose([*options, f"run_dir={folder}"])))
    return folder


def resumed(folder: Path, copy: Path, options: list[str]) -> Path:
    """The same run, killed after the first of its two checkpoints."""
    shutil.copytree(folder, copy)
    checkpoints_of(copy)[0].unlink()
    return run(options, copy)


def assert_bit_equal(first: Path, second: Path) -> None:
    for averaged in (True, False):
        one, other = (load_checkpoint(path, averaged=averaged).generator.state_dict() for path in (first, second))
        assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("name", FULL)
def test_a_published_recipe_is_built(name: str, tmp_path: Path):
    check(compose([f"experiment={name}", "data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"]))


@pytest.mark.slow
@pytest.mark.parametrize("options", [SCORE], ids=["lidargen"])
def test_a_run_goes_on_bit_by_bit(options: list[str], tmp_path: Path):
    whole = run(options, tmp_path / "whole")
    assert load_checkpoint(whole).step == 4
    assert_bit_equal(whole, resumed(whole, tmp_path / "stopped", options))
