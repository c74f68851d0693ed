"""`r2flow ablate`: what is trained for how long, what is measured, and when two settings differ."""

import csv
import shutil
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.reports.ablation import TIMES, Judge, _squared_errors
from r2flow.reports.ablation_page import compared, frontier, over_seeds, verdict
from r2flow.reports.tables import Row
from r2flow.runs.ablate import _steps_of
from r2flow.runs.ablation import Ablation, Clock
from r2flow.runs.composing import compose

TINY = [
    *("backbone=hdit", "backbone.base_channels=8", "backbone.depths=[1,1]"),
    *("backbone.num_heads=[1,2]", "backbone.time_channels=16", "sensor.rows=8"),
    *("sensor.columns=32", "data.scenes=10", "data.batch_size=2"),
]


def ablation(*keys: str, out: Path = Path("out"), seeds: int = 2) -> Ablation:
    return Ablation(keys, seeds, 60.0, out)


def test_every_combination_is_trained_and_named_by_its_swept_values():
    found = ablation("backbone.patch=[1,4],[2,4]", "samples.num=1", "stage=rectify,flow_map")
    assert found.variants == {
        f"{patch}, {stage}": [f"backbone.patch={patch}", "samples.num=1", f"stage={stage}"]
        for patch in ("[1,4]", "[2,4]")
        for stage in ("rectify", "flow_map")
    }
    assert found.swept == "backbone.patch, stage"
    assert found.seconds == 60 / 8
    assert len({link.config.run_dir for (link,) in found.runs.values()}) == 8


def test_a_key_that_only_some_backbones_have_is_swept_for_those():
    found = ablation("backbone=hdit_tiny,adm_unet_tiny", "backbone.patch=[1,4],[2,4]")
    assert found.variants == {
        "hdit_tiny, [1,4]": ["backbone=hdit_tiny", "backbone.patch=[1,4]"],
        "hdit_tiny, [2,4]": ["backbone=hdit_tiny", "backbone.patch=[2,4]"],
        "adm_unet_tiny": ["backbone=adm_unet_tiny"],
    }
    misspelled = ablation("backbone=hdit_tiny,adm_unet_tiny", "backbone.patches=[1,4],[2,4]")
    assert len(misspelled.variants) == 4
    with pytest.raises(InputError, match="patches"):
        misspelled.check()


def test_the_last_link_s_row_gives_the_steps_of_all():
    rows = [
        {"combination": "r2flow", "steps": "30"},
        {"combination": "r2flow", "steps": "30+20+4"},
        {"combination": "r2flow", "steps": "30+20"},
        {"combination": "before this column"},
    ]
    assert _steps_of(rows) == {"r2flow": [30, 20, 4]}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (["backbone=hdit"], "nothing to compare"),
        (["seed=1,2"], "sets seed itself"),
        (["stage.learning_rate=1,2", "run_dir=x"], "sets run_dir itself"),
    ],
)
def test_what_an_ablation_cannot_compare_is_refused(keys, message):
    with pytest.raises(InputError, match=message):
        _ = ablation(*keys).variants


def test_scans_of_files_must_be_named():
    with pytest.raises(InputError, match="--real SCANS"):
        ablation("data=folder", "data.root=x", "stage.betas=[0,0],[0,1]").simulated()


def test_the_clock_s_seconds_survive_a_resumption():
    module = SimpleNamespace(device=torch.device("cpu"))
    clock = Clock()
    for images in (7, 2):
        clock.on_train_batch_start(None, module, None, 0)
        clock.on_train_batch_end(None, module, None, {"x_1": torch.ones(images, 1)})
    again = Clock()
    again.load_state_dict(clock.state_dict())
    assert (again.images, again.total) == (9, sum(clock.seconds))


def test_the_error_of_x_1_of_an_exact_flow_is_its_posterior_s_deviation():
    """x_1 ~ N(0, s^2), s = 0.5: E[x_1 | x_t] errs by s (1 - t) / sqrt((t s)^2 + (1 - t)^2), and
    v = (E[x_1 | x_t] - x_t) / (1 - t).
    """

    def velocity(t, x, condition=None):
        share = 0.25 * t / ((0.5 * t) ** 2 + (1 - t) ** 2)
        return (share - 1) * x / (1 - t)

    draws = torch.Generator().manual_seed(0)
    x_0, noise = torch.randn(2, 50, 2, 8, 64, generator=draws)
    squares = _squared_errors(SimpleNamespace(velocity=velocity), x_0, 0.5 * noise) / 50
    t = torch.tensor(TIMES, dtype=torch.float64)
    expected = (0.5 * (1 - t)).square() / ((0.5 * t).square() + (1 - t).square())
    torch.testing.assert_close(squares, expected, rtol=0.02, atol=0)


def row(seconds: float, distance: float, error: float = 0.0, **values) -> Row:
    named = {"combination": "a", "model": "a", "sampler": "euler", "evaluations": 1} | values
    return {"seconds a scan": seconds, "distance of ranges": distance, "error": error, **named}


def test_the_line_of_a_combination_has_what_no_faster_row_beats():
    rows = [row(4, 0.2), row(1, 0.5), row(2, 0.6), row(3, 0.4)]
    assert [r["seconds a scan"] for r in frontier(rows)] == [1, 3, 4]


@pytest.mark.parametrize(
    ("theirs", "expected"), [(0.41, "ahead"), (0.39, "level"), (0.21, "level"), (0.19, "behind")]
)
def test_combinations_differ_if_their_intervals_do_not_overlap(theirs, expected):
    """0.3 ± 0.06 and ± 0.04."""
    assert verdict(row(1, 0.3, 0.03), row(1, theirs, 0.02)) == expected


def test_several_seeds_have_a_mean_and_its_standard_error():
    rows = [row(1, distance, 9.0, cars=n) for distance, n in ((0.1, 1), (0.2, 2), (0.3, 6))]
    (mean,) = over_seeds(rows)
    assert mean["cars"] == 3
    assert mean["error"] == pytest.approx(0.1 / 3**0.5)
    assert mean["shown"] == "0.200 ± 0.115"


def test_the_first_combination_meets_the_best_that_is_as_fast():
    """At 1 s b has 0.4 in 1.05 s, and at 0.5 s nothing as fast."""
    found = compared(
        {
            "a": over_seeds([row(0.5, 0.5), row(1, 0.3, evaluations=2)]),
            "b": [row(0.9, 0.6), row(1.05, 0.4), row(2, 0.1)],
        },
        row(0, 0.4, combination="mean scan"),
    )
    assert [(line["in"], line["b"], line["mean scan"]) for line in found] == [
        ("1", "ahead of 0.600 in 0.9 s", "behind 0.400"),
        ("2", "ahead of 0.400", "ahead of 0.400"),
    ]


def test_an_ablation_ends_with_a_table_and_resumes(tmp_path, r2flow, quick_pictures):
    keys = [*TINY, "backbone.prediction=velocity,data"]
    command = ["ablate", *keys, "--seeds", "1", "--num", "2", "--evaluations", "2"]
    command += ["--out", tmp_path / "out", "--budget"]
    done = r2flow(*command, "1s")
    assert "velocity by network evaluations" in done.said
    assert "[1/2]" in done.said
    table = tmp_path / "out" / "ablation.csv"
    rows = list(csv.DictReader(table.open()))
    runs = [row for row in rows if float(row["budget"]) > 0]
    assert [(row["combination"], row["sampler"]) for row in runs] == [
        (prediction, sampler)
        for prediction in ("velocity", "data")
        for sampler in ("euler", "adams3")
    ]
    assert rows[0]["combination"] == "training scans"
    for row in runs:
        assert float(row["error of x_1, t = 0.5"]) > 0
    # another machine has the table alone
    moved = tmp_path / "moved" / "ablation.csv"
    moved.parent.mkdir()
    table.rename(moved)
    shutil.rmtree(tmp_path / "out")
    again = r2flow(*command, "1s", "--rows", moved)
    assert "[1/2]" not in again.said
    assert "velocity by network evaluations" in again.said
    assert list(csv.DictReader(moved.open())) == rows
    # its steps repeat its runs, here two at once
    repeated = tmp_path / "repeated.csv"
    done = r2flow(*command, "1s", "--rows", repeated, "--steps", moved, "--workers", "2")
    assert "2 of 2 runs" in done.said
    again = [row for row in csv.DictReader(repeated.open()) if float(row["budget"]) > 0]
    again.sort(key=lambda row: [*map(itemgetter("combination"), runs)].index(row["combination"]))
    for row, first in zip(again, runs, strict=True):
        assert (row["combination"], row["steps"]) == (first["combination"], first["steps"])
        for column in ("distance", "jsd", "error of x_1, t = 0.5"):
            assert float(row[column]) == pytest.approx(float(first[column]), rel=1e-3)


def test_systems_end_with_a_table_and_a_figure(tmp_path, r2flow, quick_pictures):
    keys = ["experiment=vanilla_gan,dusty1", "size=equal", "sensor.rows=8", "sensor.columns=32"]
    keys += ["data.scenes=16", "data.batch_size=2", "generator.doublings=1"]
    keys += ["stage.discriminator.halvings=1", "generator.base_channels=4"]
    out = tmp_path / "out"
    command = ["ablate", *keys, "--seeds", "1", "--num", "2", "--out", out, "--budget", "1s"]
    done = r2flow(*command, "--format", "tex")
    assert "Smallest distance by training time; " in done.said
    assert (out / "ablation.png").stat().st_size > 1000
    assert (out / "ablation.pdf").is_file()
    text = (out / "ablation.tex").read_text()
    assert text.startswith("\\begin{tabular}{lll")
    assert "vanilla\\_gan & vanilla\\_gan & direct & 1 & " in text
    first, *_, last = (line for line in text.splitlines() if line.endswith("\\\\"))
    assert first.startswith("combination & model & ")
    assert last.split(" & ")[0] in ("noise", "flat ground", "mean scan", "shuffled pixels")


@pytest.mark.parametrize(
    ("system", "shares"),
    [
        ("r2flow", {"rf1": 3, "rf2": 3, "td1": 1, "td2": 1, "td4": 1}),  # a third for each stage
        ("lidm", {"autoencoder": 1, "diffusion": 2}),  # 200,000 and 400,000 steps as published
        ("lidm_ape", {"autoencoder": 1, "diffusion": 2}),
    ],
)
def test_a_system_s_stages_share_its_seconds(system, shares, monkeypatch):
    found = ablation(f"experiment={system},r2dm", "size=equal", seeds=1)
    given = {}

    def steps(seed, name, number, seconds):
        given[links[number].name] = seconds
        raise StopIteration

    monkeypatch.setattr(found, "_steps", steps)
    links = found.runs[0, system]
    assert [link.name for link in links] == list(shares)
    monkeypatch.setattr("r2flow.runs.ablation.has_ended", lambda folder: Path(folder).name in given)
    for _ in links:
        with pytest.raises(StopIteration):
            found.train(0, system)
    part = 30.0 / sum(shares.values())  # of 60 seconds of two systems
    assert given == pytest.approx({name: part * share for name, share in shares.items()})


def test_the_seconds_of_a_stage_include_its_pairs(monkeypatch):
    """At a second a step and half a second a pair, of which a step of 8 images needs 8 / 2.56."""

    def fit(run):
        clock = run.trainer.callbacks[-1]
        clock.seconds = [1.0] * 12
        clock.drawing = 0.5 * 64

    found = ablation("experiment=r2flow,r2dm", "size=equal", seeds=1)
    trainer = SimpleNamespace(callbacks=[], accumulate_grad_batches=1)
    run = SimpleNamespace(trainer=trainer, data=SimpleNamespace(batch_size=8))
    monkeypatch.setattr(found, "_build", lambda link: run)
    monkeypatch.setattr("r2flow.runs.ablation.fit", fit)
    assert found._measured_steps(0, "r2flow", 0, 300.0) == 300
    assert found._measured_steps(0, "r2flow", 1, 300.0) == round(300 / (1 + 0.5 * 8 / 2.56))


def test_lengths_of_a_recipe_are_shares_of_its_run():
    config = compose(["experiment=dusty1", "size=equal", "trainer.max_steps=1000"])
    assert config["stage"]["warmup"]["images"] == 8000 // 125  # 200,000 of 25 million as published
    assert config["sensor"]["rows"] == 32


def test_the_error_of_a_distance_is_the_jackknife_s(monkeypatch):
    """Of the mean of n numbers it is the standard error of the mean."""
    values = np.array([1.0, 2.0, 4.0, 9.0])
    monkeypatch.setattr(
        "r2flow.reports.ablation.panel",
        lambda images, sensor: np.array([images.sum(), len(images)]),
    )
    monkeypatch.setattr(
        "r2flow.reports.ablation.distances", lambda real, counts: {"a": counts[0] / counts[1]}
    )
    monkeypatch.setattr(
        "r2flow.reports.ablation.find_nearest",
        lambda sets, *_: {"": SimpleNamespace(distances=[0.0])},
    )
    judge = object.__new__(Judge)
    judge.counts, judge.training, judge.device = None, None, "cpu"
    judge.real = SimpleNamespace(sensor=None)
    judge.compare = lambda *_: SimpleNamespace(measured=[])
    figures = judge.figures(torch.from_numpy(values).reshape(4, 1, 1, 1))
    assert figures["distance"] == 4.0
    assert figures["error"] == pytest.approx(values.std(ddof=1) / 2)
