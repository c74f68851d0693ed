"""A sampler from a user's file: drawn, measured, exported, noted in a checkpoint and read again by the verbs."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.export import tableau
from r2flow.noise import Draws
from r2flow.samplers import build_sampler
from tests.extension.conftest import TINY, Family, loaded, r2flow

SHRUNKEN = Family("sampler", "toy_sampler", ("sampler={name: shrunken, steps: 3, share: 0.25}",))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("sampler") / "run"
    given = ["sampler.name=shrunken", "sampler.steps=3", "+sampler.share=0.25", "trainer.max_steps=2"]
    done = r2flow("train", "data=simulated", "backbone=hdit_tiny", *TINY, *given, SHRUNKEN.plugin, f"run_dir={run}")
    assert done.returncode == 0, done.stderr
    return run


def test_a_checkpoint_notes_it_and_needs_the_plugin(run: Path, tmp_path: Path):
    with loaded(SHRUNKEN):
        generator = load_checkpoint(run).generator
        assert generator.sampler == build_sampler("shrunken", steps=3, share=0.25)
        noise = Draws(0, [0]).start(generator.noise_shape)
        euler = generator(noise, sampler=build_sampler("euler", steps=1)).x
        made = generator(noise, sampler=build_sampler("shrunken", steps=1, share=0.25))
        torch.testing.assert_close(made.x, noise + 0.25 * (euler - noise))
        assert made.evaluations.tolist() == [1]
        found = tableau(generator, build_sampler("shrunken", steps=2, share=0.5))
        torch.testing.assert_close(found.states, torch.tensor([[1, 0, 0], [1, 0.25, 0], [1, 0.25, 0.25]]).double())
        with pytest.raises(InputError, match="share"):
            build_sampler("shrunken", share="x")
    done = r2flow("sample", run, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "--plugin" in done.stderr


def test_verbs_take_it(run: Path, tmp_path: Path):
    given = (SHRUNKEN.plugin, run, "--sampler", "shrunken:share=0.75", "--steps", 2)
    done = r2flow("sample", *given, "--num", 1, "--format", "npy", "--pictures", 0, "-o", tmp_path / "scans")
    assert done.returncode == 0, done.stderr
    assert np.isfinite(np.load(tmp_path / "scans" / "000000.npy")).all()
    note = json.loads((tmp_path / "scans" / "manifest.json").read_text())["recipe"]["sampler"]
    assert note == {"name": "shrunken", "steps": 2, "grid": "uniform", "share": 0.75}
    done = r2flow("pairs", *given, "--num", 2, "--batch-size", 2, "-o", tmp_path / "pairs")
    assert done.returncode == 0, done.stderr
    assert "shrunken" in r2flow("info", run, SHRUNKEN.plugin).stdout
