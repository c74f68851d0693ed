"""Score models and latent diffusions in training: what is built, what a run leaves, and how it goes on."""

import shutil
from pathlib import Path

import pytest
import torch

from r2flow.errors import InputError
from r2flow.generators import build_generator
from r2flow.model.checkpoint import checkpoints_of, load_checkpoint
from r2flow.runs.lineage import Parent
from r2flow.training import build, check, compose, fit

TINY = [
    "sensor.rows=16", "sensor.columns=64", "data.scenes=8", "data.batch_size=2", "trainer.accelerator=cpu",
    "trainer.max_steps=4", "trainer.val_check_interval=2", "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false", "callbacks.checkpoint.every=2", "callbacks.pictures=null", "samples.num=0",
    "stage.warmup_images=0", "loggers=[csv]",
]  # fmt: skip
SCORE = ["experiment=lidargen", "size=small", *TINY, "generator.width=4", "generator.levels=4"]
FIRST = [
    "experiment=lidm_autoencoder", "size=small", *TINY, "generator.autoencoder.codes=16", "stage.adversarial_start=2",
]  # fmt: skip
SECOND = ["experiment=lidm_ape", "size=small", *TINY, "generator.autoencoder.codes=16"]
FULL = {"lidargen": 29_694_082, "lidm_autoencoder": 15_070_361}


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
    config = compose([f"experiment={name}", "data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"])
    config = check(config)
    with torch.device("meta"):
        assert sum(p.numel() for p in build_generator({**config}).parameters()) == FULL[name]


def test_the_published_recipe_with_positions_starts_from_its_autoencoder(tmp_path: Path):
    common = ["data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"]
    with pytest.raises(InputError, match=r"give stage\.init=RUN"):
        check(compose(["experiment=lidm", "stage.init=null", *common]))
    parent = Parent(compose(["experiment=lidm_autoencoder", *common]), tmp_path)
    config = check(compose(["experiment=lidm_ape", *common]), parent=parent)
    with torch.device("meta"):
        generator = build_generator(config)
    assert sum(p.numel() for p in generator.parameters()) == 15_070_361 + 257_751_560 + 524_288


@pytest.mark.slow
@pytest.mark.parametrize("options", [SCORE, FIRST], ids=["lidargen", "lidm_autoencoder"])
def test_a_run_goes_on_bit_by_bit(options: list[str], tmp_path: Path):
    whole = run(options, tmp_path / "whole")
    assert load_checkpoint(whole).step == 4
    assert_bit_equal(whole, resumed(whole, tmp_path / "stopped", options))


@pytest.mark.slow
def test_a_latent_diffusion_goes_on_bit_by_bit_and_leaves_its_autoencoder(tmp_path: Path):
    first = run(FIRST, tmp_path / "first")
    options = [*SECOND, f"stage.init={first}"]
    whole = run(options, tmp_path / "whole")
    assert_bit_equal(whole, resumed(whole, tmp_path / "stopped", options))
    before, after = (load_checkpoint(path).generator.first_stage_model.state_dict() for path in (first, whole))
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert load_checkpoint(whole).generator.unet.position.abs().max() > 0
