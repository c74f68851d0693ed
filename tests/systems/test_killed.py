"""One system of each family, killed by SIGKILL between two checkpoints, ends with the bits of one left alone."""

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from r2flow.model.checkpoint import checkpoints_of, load_checkpoint, read_checkpoint
from tests.training.conftest import hold_at, in_process, let_go, start, wait_for

TINY = [
    "sensor.rows=16", "sensor.columns=64", "data.scenes=8", "data.batch_size=2", "trainer.accelerator=cpu",
    "trainer.max_steps=6", "trainer.val_check_interval=3", "trainer.log_every_n_steps=1", "callbacks.pictures=null",
    "samples.num=0", "loggers=[csv]",
]  # fmt: skip
FLOW = [*TINY, "callbacks.checkpoint.every=2", "stage.warmup_images=4"]
FAMILIES = {
    "diffusion": ["experiment=r2dm", "size=small", *FLOW, "backbone.base_channels=8"],
    "score": ["experiment=lidargen", "size=small", *FLOW, "generator.width=4", "generator.levels=4"],
    "autoencoder": [
        "experiment=lidm_autoencoder", "size=small", *TINY, "callbacks.checkpoint.every=2",
        "generator.autoencoder.codes=16", "stage.adversarial_start=2",
    ],
    "latent": ["experiment=lidm", "size=small", *FLOW, "generator.autoencoder.codes=16", "stage.init=first"],
    "gan": [
        "experiment=dusty2", "size=small", *TINY, "callbacks.checkpoint.every=2", "generator.base_channels=4",
        "stage.discriminator.base_channels=4", "stage.warmup.images=4", "stage.augment.initial=0.5",
        "stage.augment.kimg=0.1", "stage.augment.every=2", "stage.r1_every=2",
    ],
}  # fmt: skip
FIRST = ["experiment=lidm_autoencoder", "size=small", *TINY, "trainer.max_steps=3", "generator.autoencoder.codes=16"]


def assert_equal(a: Any, b: Any) -> None:
    """Bit-equal, whatever is nested in what."""
    if isinstance(a, Tensor):
        assert torch.equal(a, b)
    elif isinstance(a, Mapping):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, list | tuple):
        for one, other in zip(a, b, strict=True):
            assert_equal(one, other)
    else:
        assert a == b


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_killed_system_ends_as_the_one_left_alone(tmp_path: Path, family: str):
    if family == "latent":
        in_process(tmp_path, [*FIRST, "run_dir=first"])
    options, held = FAMILIES[family], tmp_path / "held"
    in_process(tmp_path, [*options, "run_dir=alone"])
    killed = [*options, "run_dir=killed", *hold_at(5, held)]
    process = start(tmp_path, killed)
    wait_for(held, process)
    os.killpg(process.pid, signal.SIGKILL)
    said, _ = process.communicate(timeout=100)
    assert process.returncode == -signal.SIGKILL, said
    assert checkpoints_of(tmp_path / "killed")[0].name == "step-00000004.ckpt"
    let_go(held)
    done = in_process(tmp_path, killed)
    assert "resuming from" in done.stdout
    one, other = (read_checkpoint(checkpoints_of(tmp_path / name)[0]) for name in ("alone", "killed"))
    assert one["global_step"] == other["global_step"]
    for part in {"state_dict", "current_model_state", "optimizer_states"} & one.keys():  # not all runs have an average
        assert_equal(one[part], other[part])
    if family == "latent":  # its autoencoder stays as it is
        first = load_checkpoint(tmp_path / "first").generator.first_stage_model
        assert_equal(first.state_dict(), load_checkpoint(tmp_path / "alone").generator.first_stage_model.state_dict())
