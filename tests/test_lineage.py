"""What a run takes over from the flow that it starts from."""

from pathlib import Path

import pytest

from r2flow.checkpoints import load_checkpoint
from r2flow.errors import InputError
from r2flow.generators import build_generator
from r2flow.lineage import find_parent, inherit
from r2flow.stages import build_stage
from r2flow.stages.checkpointing import AtomicCheckpointIO

CONFIG = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 64},
    "encoding": {"format": "logscale", "reflectance": False},
    "backbone": {"name": "hdit", "base_channels": 8, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
    "data": {"name": "simulated", "batch_size": 4, "flip": True},
    "stage": {"name": "rectify"},
    "seed": 0,
}


@pytest.fixture
def parent(tmp_path: Path) -> Path:
    """A checkpoint of range alone, from before `data.augment` had a group of its own."""
    stage = build_stage(CONFIG, build_generator(CONFIG))
    path = tmp_path / "parent.ckpt"
    AtomicCheckpointIO().save_checkpoint({"state_dict": stage.state_dict(), "config": CONFIG, "global_step": 7}, path)
    return path


def child(parent: Path, reflectance) -> dict:
    encoding = {"format": "logscale", "reflectance": reflectance}
    return {**CONFIG, "encoding": encoding, "stage": {"name": "rectify", "init": str(parent)}}


def completed(config: dict, asked: list[str]) -> dict:
    found = find_parent(config)
    assert found is not None
    return inherit(config, asked, found[0])


@pytest.mark.parametrize("asked", [[], ["encoding"], ["encoding.reflectance"]])
def test_auto_is_what_the_parent_is(parent: Path, asked: list[str]):
    config = completed(child(parent, "auto"), asked)
    assert config["encoding"] == {"format": "logscale", "reflectance": False}


def test_a_channel_that_the_parent_lacks_is_refused(parent: Path):
    with pytest.raises(InputError, match="reflectance is True here, but False in"):
        completed(child(parent, True), ["encoding.reflectance=true"])


def test_a_checkpoint_of_before_is_read_in_todays_keys(parent: Path):
    assert load_checkpoint(parent).config["data"]["augment"]["flip"] is True
    assert "flip" not in load_checkpoint(parent).config["data"]
