"""r2flow pairs, alone and among others."""

import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairSource, PairStore
from r2flow.model.checkpoint import load_checkpoint, weights_hash
from r2flow.reports.pairs import place
from r2flow.runs.lineage import pairs_of

QUICK = ("--sampler", "euler", "--steps", 2, "--batch-size", 4, "--num", 10)


def test_pairs_of_a_run_lie_in_its_folder(r2flow, saved):
    path, _ = saved
    code, said, _ = r2flow("pairs", path, *QUICK)
    assert code == 0
    folder = path.parent.parent / "pairs"
    for words in ("12 pairs", "pairs/s", "2.0 evaluations a pair", f"{folder}: all 10 pairs, 1 shard"):
        assert words in said
    flow = load_checkpoint(path)
    options = {"sampler": {"name": "euler", "steps": 2}, "num": 10, "batch_size": 4}
    recipe = PairOptions(**pairs_of(flow, options, weights_hash(flow))).recipe(flow.encoding.shape)
    assert len(PairSource(PairStore(folder, recipe, 10))) == 10
    code, said, _ = r2flow("pairs", path, *QUICK)
    assert code == 0
    assert "pairs/s" not in said  # nothing was left to make


def test_an_unfinished_run_draws_no_pairs(r2flow, saved):
    from r2flow.model.checkpoint import read_checkpoint
    from r2flow.stages.checkpointing import AtomicCheckpointIO

    path, _ = saved
    content = read_checkpoint(path)
    content["config"] = {**content["config"], "trainer": {"max_steps": content["global_step"] + 1}}
    AtomicCheckpointIO().save_checkpoint(content, path)
    code, _, said = r2flow("pairs", path.parent.parent, *QUICK)
    assert code == 2
    assert "finish it, or name the checkpoint to start from" in said
    assert r2flow("pairs", path, *QUICK)[0] == 0


@pytest.mark.slow
def test_three_processes_of_torchrun_and_a_slurm_array_make_the_shards_of_one(saved, tmp_path: Path):
    path, _ = saved

    def make(out: Path, **environment: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "r2flow.cli", "pairs", path, *QUICK, "--out", out, "--shard-mib", "0.01"]
        full = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
        return subprocess.Popen([str(one) for one in command], env=full, stdout=subprocess.PIPE, text=True)

    jobs = [make(tmp_path / "one")]
    jobs += [make(tmp_path / "torchrun", RANK=str(i), WORLD_SIZE="3", LOCAL_RANK=str(i)) for i in (2, 0, 1)]
    array = {"SLURM_ARRAY_TASK_COUNT": "2", "SLURM_ARRAY_TASK_MIN": "5"}
    jobs += [make(tmp_path / "array", SLURM_ARRAY_TASK_ID=str(i), **array) for i in (5, 6)]
    for job in jobs:
        said, _ = job.communicate(timeout=200)
        assert job.returncode == 0, said
    found = [{p.name: p.read_bytes() for p in (tmp_path / kind).iterdir()} for kind in ("one", "torchrun", "array")]
    assert len(found[0]) >= 3
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, (0, 1, 0)),
        ({"RANK": "5", "WORLD_SIZE": "16", "LOCAL_RANK": "1"}, (5, 16, 1)),
        ({"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8", "SLURM_ARRAY_TASK_MIN": "0"}, (3, 8, 0)),
        ({"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8", "SLURM_ARRAY_TASK_MIN": "1"}, (2, 8, 0)),
        ({"SLURM_PROCID": "3", "SLURM_STEP_NUM_TASKS": "8", "SLURM_LOCALID": "3"}, (3, 8, 3)),
        # A batch script asked for 8 tasks, but this process was not started by srun: it is alone.
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8", "SLURM_STEP_NUM_TASKS": "1"}, (0, 1, 0)),
        # An array of 4 jobs of 2 processes each.
        (
            {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "4", "SLURM_ARRAY_TASK_MIN": "0",
             "SLURM_PROCID": "1", "SLURM_STEP_NUM_TASKS": "2", "SLURM_LOCALID": "1"},
            (5, 8, 1),
        ),
        # torchrun with 2 processes in each job of an array of 3.
        (
            {"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_TASK_COUNT": "3", "SLURM_ARRAY_TASK_MIN": "0",
             "RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"},
            (3, 6, 1),
        ),
        # --array=0-6:2
        ({"SLURM_ARRAY_TASK_ID": "4", "SLURM_ARRAY_TASK_COUNT": "4", "SLURM_ARRAY_TASK_STEP": "2"}, (2, 4, 0)),
    ],
)  # fmt: skip
def test_where_a_process_stands(environment: dict[str, str], expected: tuple[int, int, int]):
    assert place(environment) == expected


def test_the_defaults_are_those_of_the_config():
    import inspect

    import yaml

    from r2flow.cli.train import pairs

    written = yaml.safe_load((Path(__file__).parents[1] / "conf/data/base.yaml").read_text())["pairs"]
    asked = {name: one.default for name, one in inspect.signature(pairs).parameters.items() if one.default is not None}
    assert "solver" not in asked
    defaults = asdict(PairOptions()) | asked
    written["sampler"] = {key: value for key, value in written["sampler"].items() if value is not None}
    assert written == {key: defaults[key] for key in written}
