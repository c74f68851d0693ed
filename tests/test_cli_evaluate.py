"""r2flow evaluate as a user types it."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from r2flow.evaluation import measuring
from r2flow.evaluation.comparing import Comparer
from r2flow.generators import build_generator
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.metrics import METRICS
from r2flow.metrics.base import SumMetric
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.scans import Scans
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.saving import save_checkpoint
from r2flow.reports.paper import read_results
from r2flow.samplers import build_sampler
from tests.conftest import CONFIG, SENSOR, folder, images
from tests.metrics.conftest import Summary

pytestmark = pytest.mark.usefixtures("quick_pictures")
QUICK = ("--metrics", "jsd,mmd", "--size", "8x64", "--workers", 0)


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("R2FLOW_CACHE", str(tmp_path / "cache"))


def test_the_json_holds_everything_about_a_figure(r2flow, real, generated, tmp_path):
    said = r2flow("evaluate", real, generated, *QUICK, "--json", tmp_path / "e.json").said
    content = json.loads((tmp_path / "e.json").read_text(), parse_constant=pytest.fail)
    found = {
        one["comparison"]: (one["kind"], one["generated"]["scans"])
        for one in content["comparisons"]
    }
    baselines = dict.fromkeys(
        ("noise", "flat ground", "mean scan", "shuffled pixels"), ("baseline", 10)
    )
    reference = {"real halves": ("reference", 6), "generated, as many": ("reference", 6)}
    assert found == {"generated": ("judged", 10), **reference, **baselines}
    jsd, mmd = content["comparisons"][0]["metrics"]
    printed = {
        row["printed_as"]: row["printed"] for row in content["rows"] if row["kind"] == "judged"
    }
    assert printed["JSD x 10^2"] == pytest.approx(100 * jsd["figures"]["jsd"])
    assert printed["MMD x 10^4"] == pytest.approx(1e4 * mmd["figures"]["mmd"])
    assert jsd["protocol"]["mask"] == [0.5, 63.0]
    sizes = {
        "real": 12,
        "real_chosen": "all 12",
        "real_empty": 0,
        "generated": 10,
        "generated_empty": 0,
    }
    assert jsd["protocol"]["sizes"] == sizes
    assert content["origin"]["versions"].keys() == {"r2flow", "torch", "python"}
    assert "images 8x64 of hdl64e, " in said  # the sensor that scans are compared under
    for words in ("JSD x 10^2", "MMD x 10^4", f"{100 * jsd['figures']['jsd']:#.4g}", "(10 : 12)"):
        assert words in said


def test_a_scale_of_reflectance_is_asked_for_where_it_matters(r2flow, real, tmp_path):
    for number, image in enumerate(images(3, 1)):
        xyz, reflectance = image_to_points(image, SENSOR.rays())
        for name, scale in (("g", 255), ("one", 1)):
            write_points(tmp_path / name / f"{number}.ply", xyz, scale * reflectance)
    assert r2flow("evaluate", real, tmp_path / "g", *QUICK)[0] == 0
    options = ("--metrics", "frechet_handcrafted", *QUICK[2:], "--json", tmp_path / "e.json")
    assert "--reflectance-scale 255" in r2flow("evaluate", real, tmp_path / "g", *options).refusal
    # the same scans
    for sets in ((tmp_path / "g", tmp_path / "one"), (tmp_path / "one", tmp_path / "g")):
        assert r2flow("evaluate", *sets, *options, "--reflectance-scale", 255)[0] == 0
        (metric,) = json.loads((tmp_path / "e.json").read_text())["comparisons"][0]["metrics"]
        assert metric["figures"]["frechet_handcrafted"] == pytest.approx(0, abs=1e-6)


def test_a_figure_that_does_not_exist_is_null_and_said(r2flow, real, tmp_path):
    empty = folder(tmp_path / "empty", np.zeros((2, 2, 8, 64), np.float32))
    options = (
        "--metrics",
        "mmd",
        *QUICK[2:],
        "--json",
        tmp_path / "e.json",
        "--out",
        tmp_path / "page",
    )
    assert "none of its 2 scans has a return" in r2flow("evaluate", empty, real, *options).refusal
    assert not [*(tmp_path / "page").rglob("*.*")]
    said = r2flow("evaluate", real, empty, *options).said
    (metric,) = json.loads((tmp_path / "e.json").read_text(), parse_constant=pytest.fail)[
        "comparisons"
    ][0]["metrics"]
    assert metric["figures"] == {"mmd": None}
    assert any("2 generated scans" in remark for remark in metric["remarks"])
    assert "none" in said
    assert {path.name for path in (tmp_path / "page").iterdir()} == {
        f"evaluation.{ending}" for ending in ("json", "md", "html")
    }


def test_a_run_is_sampled_through_its_own_sensor(r2flow, saved, real, tmp_path):
    run = saved[0].parent.parent
    options = (
        "--metrics",
        "jsd",
        "--num",
        3,
        "--steps",
        2,
        "--workers",
        0,
        "--json",
        tmp_path / "e.json",
    )
    assert r2flow("evaluate", real, run, *options).said
    about = json.loads((tmp_path / "e.json").read_text())["comparisons"][0]["generated"]
    assert (about["kind"], about["num"], about["sampler"]["steps"], about["noise"]) == (
        "sampled",
        3,
        2,
        "evaluation",
    )
    asked = "evaluate", real, run, *QUICK[:2], "--num", 3, "--size"
    assert "8x64, not of hdl64e 16x64" in r2flow(*asked, "16x64").refusal
    assert "not of vlp16 8x64" in r2flow(*asked, "8x64", "--sensor", "vlp16").refusal


def test_the_order_of_models_changes_no_figure(r2flow, real, tmp_path):
    for name, farthest, convention in (("a", 40.0, "lidm"), ("b", 50.0, "reference")):
        config = {**CONFIG, "sensor": {**CONFIG["sensor"], "max_range": farthest}}
        config["data"] = {"reading": {"convention": convention}}
        save_checkpoint(
            Checkpoint(build_generator(config), config), tmp_path / f"{name}.safetensors"
        )
    for path in real.iterdir():  # points on the rays of bin centres, up to 60 m
        write_points(
            tmp_path / "points" / f"{path.stem}.ply", *image_to_points(np.load(path), SENSOR)
        )
    figures = []
    for scans, *names in (("real", "a"), ("points", "a", "b"), ("points", "b", "a")):
        quick = (
            "--metrics",
            "jsd",
            "--num",
            2,
            "--steps",
            1,
            "--workers",
            0,
            "--json",
            tmp_path / "e.json",
        )
        assert r2flow(
            "evaluate",
            tmp_path / scans,
            *(tmp_path / f"{name}.safetensors" for name in names),
            *quick,
        ).said
        content = json.loads((tmp_path / "e.json").read_text())["comparisons"]
        figures.append({one["comparison"]: one["metrics"][0]["figures"]["jsd"] for one in content})
    assert figures[1] == figures[2]
    # the images that the points were made of
    assert figures[1]["a.safetensors"] == figures[0]["a.safetensors"]


@pytest.fixture
def points(r2flow, real, tmp_path):
    """The sampled sets of an evaluation, as `report paper` reads them, and its Markdown page."""

    def measure(*arguments: object) -> tuple[list[dict[str, Any]], str]:
        options = (
            "--metrics",
            "jsd",
            "--num",
            4,
            "--workers",
            0,
            "--no-reference",
            "--no-baselines",
        )
        assert r2flow("evaluate", real, *arguments, *options, "--out", tmp_path).said
        return read_results(tmp_path / "evaluation.json"), (tmp_path / "evaluation.md").read_text()

    return measure


def test_several_samplers_and_steps_make_a_set_each(points, r2flow, real, saved, tmp_path):
    rows, page = points(saved[0], "--sampler", "euler,heun2", "--steps", "1,2")
    found = [(row["flow"].partition(", ")[2], row["evaluations"]) for row in rows]
    assert found == [("euler", 1), ("euler", 2), ("heun2", 2), ("heun2", 4)]
    assert all(row["jsd/jsd"] > 0 and row["seconds"] > 0 for row in rows)
    assert f"{saved[0].name}, heun2, 2 steps" in page
    assert (
        "no sampler named ''" in r2flow("evaluate", real, saved[0], "--sampler", "euler,").refusal
    )
    assert (tmp_path / "evaluation_speed.png").stat().st_size > 10_000


def test_fields_in_a_sampler_s_text_count_and_make_a_set_each(points, saved):
    rows, page = points(
        saved[0], "--sampler", "sde:steps=3:churn=0,sde:steps=3:churn=1,euler:grid=[0,0.5,1],euler"
    )
    assert [*{row["flow"]: row["evaluations"] for row in rows}.values()] == [3, 3, 2, 16]
    assert all(f"churn={churn}" in page for churn in (0, 1))


def test_each_number_of_steps_takes_the_sampler_that_the_generator_has_for_it(points, tmp_path):
    config = {**CONFIG, "generator": {"name": "flow_map"}}
    generator = build_generator(config).eval()
    generator.run_by(
        build_sampler("adams3", steps=2, grid="power:1.75"), few=build_sampler("jump", steps=1)
    )
    save_checkpoint(Checkpoint(generator, config), tmp_path / "map.safetensors")
    points(tmp_path / "map.safetensors", "--steps", "1,2")
    one, two = json.loads((tmp_path / "evaluation.json").read_text())["comparisons"]
    names = {"map.safetensors, 1 step": "jump", "map.safetensors, 2 steps": "adams3"}
    assert [(c["comparison"], c["generated"]["sampler"]["name"]) for c in (one, two)] == [
        *names.items()
    ]


def test_a_distilled_model_keeps_its_steps(points, r2flow, real, tmp_path):
    generator = build_generator(CONFIG).eval()
    generator.run_by(build_sampler("euler", steps=2), fixed=True)
    td = tmp_path / "td.safetensors"
    save_checkpoint(Checkpoint(generator, CONFIG), td)
    assert [row["evaluations"] for row in points(td, "--steps", "1,2,4")[0]] == [2]
    warned = r2flow("evaluate", real, td, "--num", 2, *QUICK, "--sampler", "heun2")[2]
    assert "td.safetensors is distilled for euler, 2 steps alone" in warned
    for verb, *scans in (["report curvature"], ["report solvers"], ["interpolate", real, real]):
        assert (
            "needs all times; this flow is distilled for euler"
            in r2flow(*verb.split(), td, *scans, "-o", "a.html").refusal
        )


def test_an_adaptive_solver_is_one_set(points, saved):
    rows, _ = points(saved[0], "--sampler", "dopri5,euler", "--steps", "1,2", "--tolerance", 1e-2)
    assert [row["flow"].partition(", ")[2] for row in rows] == ["dopri5", "euler", "euler"]


def test_an_evaluation_resumes(points, saved, monkeypatch):
    first, _ = points(saved[0], "--steps", "1,2", "--batch-size", 2)
    measured: list[int] = []
    measure = Comparer.measure
    monkeypatch.setattr(Comparer, "measure", lambda *a: (measured.append(1), measure(*a))[1])
    second, _ = points(saved[0], "--steps", "4,2,1", "--batch-size", 2)
    assert len(measured) == 1
    assert second[1:] == first[::-1]
    assert [row["evaluations"] for row in second] == [4, 2, 1]
    # of another version, whose figures may differ
    monkeypatch.setattr(measuring, "FORMAT", 0)
    points(saved[0], "--steps", "1", "--batch-size", 2)
    assert len(measured) == 2


class MeanRange(SumMetric):
    name, representation, width, biased = "mine", "range image", 2, True

    def rows(self, scans):
        returns = scans.returned.sum((1, 2, 3)).double()
        rows = torch.stack([scans.images[:, 0].sum((1, 2)).double(), returns], 1)
        return torch.where(returns[:, None] > 0, rows, torch.nan)

    def figures_of(self, *sums):
        means = [total[0] / total[1] if len(total) and total[1] else math.nan for total in sums]
        return {"mine": abs(means[0] - means[1])}


def test_metrics_and_networks_that_a_user_has_added_are_measured(
    r2flow, real, generated, tmp_path, monkeypatch
):
    for table in (METRICS, EXTRACTORS):
        monkeypatch.setattr(table, "_entries", dict(table._entries))
    METRICS.add("mine", MeanRange)
    EXTRACTORS.add("means", SimpleNamespace(trained=partial(Summary, "means")))
    options = ("--metrics", "mine,frechet_means,kid_means,panel", *QUICK[2:])
    said = r2flow("evaluate", real, generated, *options, "--json", tmp_path / "e.json").said
    ranges = [
        scans[:, 0][(scans[:, 0] > 0) & (scans[:, 0] < 63)].mean()
        for scans in (images(12, 1), images(10, 2))
    ]
    both = (Scans(torch.from_numpy(scans), SENSOR) for scans in (images(12, 1), images(10, 2)))
    rows = [Summary().features(scans).double().numpy() for scans in both]
    (a, s), (b, t) = ((x.mean(0), np.cov(x.T)) for x in rows)
    frechet = (
        ((a - b) ** 2).sum()
        + np.trace(s + t)
        - 2 * np.sqrt(np.linalg.eigvals(s @ t).clip(0)).real.sum()
    )
    found = json.loads((tmp_path / "e.json").read_text())["comparisons"][0]["metrics"]
    assert (found[0]["biased"], found[0]["figures"]) == (
        True,
        {"mine": pytest.approx(abs(np.subtract(*ranges)), 1e-4)},
    )
    assert found[1]["figures"] == {"frechet_means": pytest.approx(frechet, rel=1e-4)}
    assert "kid_means" in said


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [2, 3])
def test_processes_of_torchrun_give_the_figures_of_one(real, generated, tmp_path, ranks):
    def run(out: Path, *launcher: str) -> dict[str, float]:
        metrics = "jsd,mmd,frechet_handcrafted,kid_handcrafted"
        options = ("--metrics", metrics, "--size", "8x64", "--batch-size", "2", "--workers", "0")
        command = [
            *launcher,
            "-m",
            "r2flow",
            "evaluate",
            str(real),
            str(generated),
            *options,
            "--json",
            str(out),
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *command], env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        metrics = json.loads(out.read_text())["comparisons"][0]["metrics"]
        return {name: value for metric in metrics for name, value in metric["figures"].items()}

    expected = run(tmp_path / "one.json")
    shared = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks))
    assert run(tmp_path / "many.json", *shared) == pytest.approx(expected, rel=1e-10)


def test_a_judged_set_may_have_the_name_of_a_baseline(r2flow, real, generated, tmp_path):
    shutil.copytree(generated, tmp_path / "noise")
    sets = real, tmp_path / "noise", generated
    said = r2flow("evaluate", *sets, *QUICK, "--no-reference", "--json", tmp_path / "e.json").said
    rows = json.loads((tmp_path / "e.json").read_text())["rows"]
    of = {
        (row["kind"], row["comparison"]): row["printed"] for row in rows if row["metric"] == "jsd"
    }
    lines = said.splitlines()
    columns = [line.split()[1:] for line in lines if re.match(r"\d+  ", line)]
    values = next(line.split()[3:] for line in lines if line.startswith("JSD"))  # x 10^2
    printed = {" ".join(words[:-3]): value for words, value in zip(columns, values, strict=True)}
    assert printed["noise"] == f"{of['judged', 'noise']:#.4g}"
    assert printed["baseline: noise"] == f"{of['baseline', 'noise']:#.4g}"
    assert of["judged", "noise"] != of["baseline", "noise"]
