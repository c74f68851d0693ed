"""r2flow report paper: printed numbers next to evaluated ones, from checkpoints of random weights."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import pytest

from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.saving import weights_hash
from r2flow.reports.paper import (
    COLUMNS,
    _table_i,
    role_of,
)
from r2flow.reports.tables import markdown
from tests.conftest import write_run
from tests.test_sampling import network

pytestmark = pytest.mark.usefixtures("quick_pictures")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("runs")
    stages = {
        "1-RF": {"name": "rectify"},
        "2-RF": {"name": "reflow"},
        "4-TD": {"name": "distill", "steps": 4},
    }
    return {
        # as folders of a sweep
        role: write_run(root / f"role={role}_seed={i}", network(), stage, 0.2 + 0.05 * i)
        for i, (role, stage) in enumerate(stages.items())
    }


def test_every_run_finds_its_role(runs):
    assert {role: role_of(load_checkpoint(run), "label") for role, run in runs.items()} == {
        r: r for r in runs
    }
    checkpoint = load_checkpoint(runs["2-RF"])
    for parent, role in (("rectify", "2-RF"), ("reflow", "label")):  # reflow of a 2-RF is a 3-RF
        stage = {"name": "reflow", "parent": {"stage": parent}}
        config = ModelConfig({**checkpoint.config.stored, "stage": stage})
        assert role_of(replace(checkpoint, config=config), "label") == role


def test_an_evaluated_row_stands_below_the_printed_row_of_its_evaluations_and_a_star_tells_another_protocol():
    rows = [
        {
            "role": "1-RF",
            "flow": "ours",
            "evaluations": n,
            "jsd/jsd": d,
            "protocol": f"paper, 10000 scans of {of}:x",
        }
        for n, d, of in (
            (1, 0.5, "64x1024 against 7 of kitti_360"),
            (4, 0.4, "64x1024 against 7 of a"),
            (64, 0.03, ""),
        )
    ]
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in markdown(*_table_i(rows)[:2]).splitlines()[2:]
    ]
    below = {tuple(a[:3]): b for a, b in itertools.pairwise(lines) if b[1] == "ours"}
    jsd = 3 + list(COLUMNS).index("jsd")
    assert {key: (line[2], line[jsd]) for key, line in below.items()} == {
        ("1-RF", "paper", "256"): ("64", "3*"),
        ("1-RF", "paper", "1"): ("1", "50"),
        ("4-TD", "paper", "4"): ("4", "40*"),  # the last printed row: no 1-RF is printed at 4
    }


def test_the_page_has_the_table_and_the_figure(r2flow, runs, tmp_path):
    figures = {
        "speed": {"evaluations": 64.0, "seconds": 1},
        "jsd": {"jsd": 0.25},
        "frd": {"frd": 200.0},
    }
    metrics = [{"metric": name, "figures": values} for name, values in figures.items()]
    hashes = weights_hash(load_checkpoint(runs["1-RF"])), "another model"
    sets = [
        {"kind": "sampled", "set": "a", "weights": weights, "scans": 10000} for weights in hashes
    ]
    metrics[0]["protocol"] = {"name": "paper", "image": [64, 1024]}
    real = {"set": "kitti_360:x", "scans": 7, "split": "test"}
    comparisons = [
        {"kind": "judged", "real": real, "generated": one, "metrics": metrics} for one in sets
    ]
    last, stage = "checkpoints/step-00000007.ckpt", {"name": "transfer"}
    unnamed = [
        write_run(tmp_path / name, network(), stage, 0.3 + i) / last for i, name in enumerate("ab")
    ]
    own = write_run(
        tmp_path / "own",
        network(backbone=None, generator={"name": "vanilla_gan", "doublings": 2}),
        stage,
    )
    results = tmp_path / "e.json"
    results.write_text(json.dumps({"comparisons": comparisons}))
    options = (f"1-RF={own}", "--results", results)
    command = (
        "report",
        "paper",
        f"9-RF={runs['2-RF']}",
        runs["1-RF"],
        *unnamed,
        *options,
        "-o",
        tmp_path / "out",
    )
    said = r2flow(*command).said
    assert all(f"({name})" in said for name in ("9-RF", f"a/{last}", f"b/{last}"))
    assert (
        "10000 scans of 64x1024 against 7 of test in kitti_360:x."
        in (tmp_path / "out" / "paper.md").read_text()
    )
    content = json.loads((tmp_path / "out" / "paper.json").read_text())
    assert [(row["role"], row["jsd/jsd"]) for row in content["rows"]] == [("1-RF", 0.25)]
    written = {path.stem for path in (tmp_path / "out").glob("*.png")}
    assert written == {"figure_6"}
    results.write_text(json.dumps({"comparisons": comparisons[1:]}))
    assert "the results are of other models" in r2flow(*command).refusal
