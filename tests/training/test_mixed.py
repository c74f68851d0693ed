"""A run on two data sets, augmented: stopped and resumed it ends as the one that nobody stopped."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.lidar.scan_files import read_points, write_points
from r2flow.model.checkpoint import checkpoints_of, load_checkpoint
from r2flow.runs.folder import read_config
from tests.training.conftest import Run


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(run).model.state_dict()


@pytest.mark.slow
def test_a_mixture_goes_on_where_it_stopped_and_may_move(train: Run, scans: Path, tmp_path: Path):
    for name, frames in (("a", range(0, 5)), ("b", range(5, 12))):
        (tmp_path / name).mkdir()
        for frame in frames:
            points = read_points(scans / f"{frame:06d}.bin")
            write_points(tmp_path / name / f"{frame:06d}.ply", points.xyz)

    def options(root_a: Path, name: str) -> list[str]:
        parts = f"[{{name: folder, root: {root_a}, weight: 3}}, {{name: folder, root: {tmp_path / 'b'}, weight: 1}}]"
        augment = "data.augment={flip: true, roll: true, beam_dropout: 0.1, ray_dropout: 0.1}"
        return ["data=mixed", f"data.parts={parts}", augment, "backbone.position=none", f"name={name}"]

    train(*options(tmp_path / "a", "whole"))
    shutil.copytree(tmp_path / "runs/whole", tmp_path / "runs/stopped")
    checkpoints_of(tmp_path / "runs/stopped")[0].unlink()  # its end: it is left at step 10 of 12
    (tmp_path / "a").rename(tmp_path / "moved")
    done = train(*options(tmp_path / "moved", "stopped"), "data.workers=2")
    assert "resuming from" in done.stdout
    whole, stopped = weights(tmp_path / "runs/whole"), weights(tmp_path / "runs/stopped")
    assert all(torch.equal(whole[name], stopped[name]) for name in whole)
    # The scans have no reflectance: nobody asked for a flow of range alone, and it is one.
    config = read_config(tmp_path / "runs/whole")
    assert config is not None
    assert config["encoding"]["reflectance"] is False
    assert load_checkpoint(tmp_path / "runs/whole").encoding.channels == 1
    sample = next((tmp_path / "runs/whole").rglob("*.npy"))
    assert np.load(sample).shape[0] == 1
