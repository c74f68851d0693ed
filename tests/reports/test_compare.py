"""Runs side by side, from folders whose every number is known."""

import copy
import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from r2flow.base.errors import InputError
from r2flow.generators import build_generator
from r2flow.model.config import ModelConfig
from r2flow.reports.compare import _group_rows, cell, compare_page, configuration, group_runs
from r2flow.reports.pages import write_page
from r2flow.reports.runs import _find_runs, read_runs
from r2flow.reports.tables import short_names
from r2flow.reports.training import curves_figure, read_curves, smooth
from tests.conftest import CONFIG as FLOW

CONFIG: dict[str, Any] = {
    **FLOW,
    "name": "small",
    "trainer": {"max_steps": 40},
    "scans": "8 of 8 scans, abc",
}


def make_run(
    folder: Path,
    change: dict[str, Any] | None = None,
    train: list[float] | None = None,
    val: list[float] | None = None,
    curvature: list[float] | None = None,
    checkpoint: int | None = None,
) -> Path:
    """A folder as train.py leaves it: Lightning logs step s under the number s - 1."""
    config = copy.deepcopy(CONFIG)
    for key, value in (change or {}).items():
        group, _, name = key.rpartition(".")
        (config.setdefault(group, {}) if group else config)[name] = value
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    rows = [{"step": i, "train/loss": v} for i, v in enumerate(train or [])]
    rows += [{"step": 10 * i + 9, "val/loss": v} for i, v in enumerate(val or [])]
    rows += [{"step": 20 * i + 19, "curvature/bend": v, "curvature/s": 2 * v} for i, v in
             enumerate(curvature or [])]  # fmt: skip
    if rows:
        logs = folder / "metrics" / "version_0" / "metrics.csv"
        logs.parent.mkdir(parents=True)
        with logs.open("w", newline="") as file:
            writer = csv.DictWriter(
                file, ["step", "train/loss", "val/loss", "curvature/s", "curvature/bend"]
            )
            writer.writeheader()
            writer.writerows(rows)
    if checkpoint is not None:
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / f"step-{checkpoint:08d}.ckpt").touch()
    return folder


def test_every_number_is_the_folder_s(tmp_path):
    folder = make_run(
        tmp_path / "run", train=[1.0] * 36 + [0.5, 0.3, 0.2, 0.2], val=[0.9, 0.4, 0.6], curvature=[0.2, 0.05],
        checkpoint=38,
    )  # fmt: skip
    (run,) = read_runs([folder])
    found = run.values
    assert found["stage"] == "rectify"
    assert found["backbone"] == "hdit"
    assert found["steps"] == 38  # of the newest checkpoint
    assert found["images"] == 38 * 4
    assert found["train_loss"] == pytest.approx((0.5 + 0.3 + 0.2 + 0.2) / 4)  # the last tenth of 40
    assert found["val_best"] == 0.4
    assert found["val_last"] == 0.6
    assert found["bend"] == 0.05
    assert run.label == "run"


@pytest.mark.parametrize("order", [1, -1])
def test_networks_of_other_generators_are_counted_apart(tmp_path, order):
    generators: dict[str, dict[str, Any]] = {
        "rectified_flow": {}, "flow_map": {}, "diffusion": {}, "vanilla_gan": {"base_channels": 4, "doublings": 2},
    }  # fmt: skip
    made = {name: {"generator": {"name": name, **options}} for name, options in generators.items()}
    folders = [make_run(tmp_path / name, change) for name, change in made.items()]
    read = {run.label: run.values for run in read_runs(folders[::order])}
    for name, change in made.items():
        assert read[name]["parameters"] == sum(
            p.numel() for p in build_generator(CONFIG | change).parameters()
        )
    # it embeds a second time
    assert read["flow_map"]["parameters"] > read["rectified_flow"]["parameters"]
    assert read["diffusion"]["gmac"] == read["rectified_flow"]["gmac"] > 0  # the same backbone
    assert read["vanilla_gan"]["gmac"] is None


def test_several_seeds_are_one_line_with_mean_and_spread(tmp_path):
    for seed, value in enumerate([0.2, 0.4, 0.9]):
        make_run(tmp_path / f"net-seed={seed}", {"seed": seed}, val=[value], checkpoint=40)
    make_run(
        tmp_path / "other-seed=0", {"stage.learning_rate": 2e-3}, val=[math.nan, 0.1], checkpoint=40
    )
    # not validated yet
    make_run(tmp_path / "other-seed=1", {"stage.learning_rate": 2e-3, "seed": 1}, checkpoint=40)
    groups = group_runs(read_runs([tmp_path]))
    assert {label: len(runs) for label, runs in groups.items()} == {"net": 3, "other": 2}
    rows = _group_rows(groups)
    assert rows[0]["val_last_spread"] == pytest.approx(math.sqrt((0.09 + 0.01 + 0.16) / 2))
    assert (rows[0]["n"], cell(rows[0], "val_last")) == (3, "0.5 ± 0.361")
    assert cell(rows[1], "val_last") == cell(rows[1], "val_best") == "0.1"
    for seed, value in ((3, math.inf), (4, math.nan)):
        make_run(tmp_path / f"net-seed={seed}", {"seed": seed}, val=[value], checkpoint=40)
        assert cell(_group_rows(group_runs(read_runs([tmp_path])))[0], "val_last") == str(value)


def test_a_group_is_named_by_what_its_runs_share_and_counts_those_that_started(tmp_path):
    for seed, started in ((0, 40), (1, 40), (2, None)):
        make_run(tmp_path / f"net-s{seed}", {"seed": seed}, checkpoint=started)
    ((name, runs),) = group_runs(read_runs([tmp_path])).items()
    assert name == "net-s"
    assert _group_rows({name: runs})[0]["n"] == "2 of 3"


def test_compare_prints_tables_for_papers(r2flow, tmp_path):
    for seed, value in enumerate([0.2, 0.4]):
        make_run(tmp_path / f"net_a-seed={seed}", {"seed": seed}, val=[value], checkpoint=40)
    printed = r2flow("compare", tmp_path, "--group", "--format", "tex").stdout
    assert printed.count(r"\begin{tabular}") == printed.count(r"\end{tabular}") == 2
    # mean 0.3, standard deviation of 0.2 and 0.4: sqrt(0.02)
    assert r"net\_a & " in printed
    assert r"0.3 $\pm$ 0.141" in printed


def test_two_sweeps_are_told_apart_by_what_was_swept(tmp_path):
    for loss, seed in (("mse", 1), ("mse", 2), ("absolute", 1), ("absolute", 2)):
        make_run(
            tmp_path / f"seed={seed}_stage.loss={loss}-abcde{seed}",
            {"seed": seed, "stage.loss": loss},
        )
    groups = group_runs(read_runs([tmp_path]))
    assert {
        label: [run.config.stage.options["loss"] for run in runs] for label, runs in groups.items()
    } == {f"stage.loss={loss}": [loss, loss] for loss in ("absolute", "mse")}


def test_children_of_several_seeds_are_one_configuration_and_of_other_parents_another(tmp_path):
    def child(parent: Path, weights: str, **change: Any) -> dict[str, Any]:
        config = copy.deepcopy(CONFIG)
        config["data"] = {"name": "pairs", "batch_size": 4, "pairs": {"num": 8, "parent": weights}}
        config["stage"]["parent"] = {
            "path": str(parent / "checkpoints" / "step-00000040.ckpt"),
            "weights": weights,
        }
        return config | {"scans": f"8 pairs, {weights}"} | change

    first = child(make_run(tmp_path / "a", {"seed": 0}), "aaa")
    same = child(make_run(tmp_path / "b", {"seed": 1}), "bbb", seed=1)
    other = child(make_run(tmp_path / "c", {"stage.learning_rate": 2e-3}), "ccc", seed=2)
    gone = child(tmp_path / "nowhere", "ddd", seed=3)
    assert configuration(ModelConfig(first)) == configuration(ModelConfig(same))
    others = (other, gone, CONFIG, {**CONFIG, "scans": "8 of 8 scans, another data set"})
    assert len({configuration(ModelConfig(one)) for one in (first, *others)}) == 5


@pytest.mark.parametrize("key", ["trainer.precision", "parent.step", "data.pairs.of"])
def test_what_is_free_on_resumption_still_tells_configurations_apart(tmp_path, key):
    parent = {
        "path": str(make_run(tmp_path / "a") / "checkpoints" / "step-00000040.ckpt"),
        "weights": "aaa",
    }
    drawn = {"data.name": "pairs"} if key.count(".") > 1 and key.startswith("data.") else {}
    make_run(tmp_path / "b", {"parent": parent, **drawn, key: 20})
    make_run(tmp_path / "c", {"parent": parent, **drawn, key: 40, "seed": 1})
    assert len(group_runs(read_runs([tmp_path / "b", tmp_path / "c"]))) == 2


def test_a_sweep_s_files_and_folders_without_a_run_are_passed_over(tmp_path):
    (tmp_path / "latest").symlink_to(make_run(tmp_path / "a"))
    (tmp_path / "multirun.yaml").touch()
    (tmp_path / "logs").mkdir()
    assert [run.resolve() for run in _find_runs(sorted(tmp_path.iterdir()))] == [tmp_path / "a"]
    with pytest.raises(InputError, match="none is not a run"):
        _find_runs([tmp_path / "a", tmp_path / "none"])
    with pytest.raises(InputError, match="logs is not a run"):
        _find_runs([tmp_path / "logs", tmp_path / "multirun.yaml"])


def test_a_sweep_of_chains_stands_for_its_runs(tmp_path):
    for chain in ("0", "1"):
        for stage in ("rf1", "td"):
            make_run(tmp_path / "sweep" / chain / stage)
        (tmp_path / "sweep" / chain / ".hydra").mkdir()
        (tmp_path / "sweep" / chain / ".hydra" / "config.yaml").touch()  # the sweep's, of no run
    found = _find_runs([tmp_path / "sweep", tmp_path / "sweep" / "1" / "td"])
    assert short_names(found) == ["0/rf1", "0/td", "1/rf1", "1/td"]
    assert short_names(found[:2]) == ["rf1", "td"]


def test_a_curve_s_running_mean_of_a_straight_line_is_the_line():
    steps = np.arange(100.0)
    x, y = smooth(steps, 3 * steps + 1)
    np.testing.assert_allclose(y, 3 * x + 1)
    assert len(x) == 96


def test_the_page_is_written_with_its_picture(tmp_path):
    make_run(tmp_path / "runs" / "full", train=list(np.geomspace(2, 0.2, 40)), val=[0.9, 0.4], curvature=[0.1],
             checkpoint=40)  # fmt: skip
    make_run(tmp_path / "runs" / "bare", {"stage.learning_rate": 2e-3})
    groups = group_runs(read_runs([tmp_path / "runs"]))
    written = {path.name: path for path in write_page(compare_page(groups), tmp_path / "out")}
    assert set(written) == {"compare.md", "compare.json", "compare.png", "compare.pdf"}
    said = written["compare.md"].read_text()
    for words in (
        "| bare | 0 of 1 | rectify | simulated | hdit |",
        "| run | train loss, last tenth |",
    ):
        assert words in said, words
    rows = json.loads(written["compare.json"].read_text())["rows"]
    assert [row["name"] for row in rows] == ["bare", "full"]
    unsaid = ("steps", "images", "train_loss", "val_best", "val_last", "bend")
    assert [rows[0][column] for column in unsaid] == [None] * len(unsaid)
    assert rows[1]["val_best"] == 0.4
    assert Image.open(written["compare.png"]).size[0] > 900


def test_a_log_that_a_power_cut_has_damaged_is_read_as_far_as_it_goes(tmp_path):
    run = make_run(tmp_path / "run", train=[2.0, 1.0, 0.5], checkpoint=3)
    log = run / "metrics" / "version_0" / "metrics.csv"
    log.write_bytes(
        log.read_bytes() + b"3,0.2" + b"\0\xff" * 20 + b"\n4,0.x\n5,0.2" + bytes(200_000)
    )
    (run / "metrics" / "version_x").mkdir()
    (run / "metrics" / "version_x" / "metrics.csv").touch()
    steps, values = read_curves(run)["train/loss"]
    assert list(values[:3]) == [2.0, 1.0, 0.5]
    assert list(steps[:3]) == [1, 2, 3]


@pytest.mark.parametrize(
    "content",
    [
        "a: 1",
        "{stage: {name: rectify}, backbone: {name: hdit}, data: {}}",
        "{stage: {name: rectify}, backbone: {name: hdit}, data: {}, sensor: {}, encoding: {}}",
    ],
)
def test_a_folder_that_is_no_run_is_named(tmp_path, content):
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml is not the config of a run"):
        read_runs([tmp_path / "thing"])


@pytest.mark.parametrize(
    ("losses", "runs", "y"), [([5, 6], 1, "linear"), ([1, 9], 10, "log"), ([0, 1], 11, "linear")]
)
def test_losses_have_a_logarithmic_axis_and_a_legend_where_these_say_something(losses, runs, y):
    figure = curves_figure(
        [(f"{i:040}", {"train/loss": (np.array([1, 2]), np.array(losses))}) for i in range(runs)]
    )
    figure.draw_without_rendering()
    assert (figure.axes[0].get_yscale(), not figure.legends) == (y, runs > 10)  # of 10 styles
    assert not any(
        figure.axes[0].bbox.overlaps(legend.get_window_extent()) for legend in figure.legends
    )


@pytest.mark.parametrize(
    ("steps", "roots", "loss"),
    [
        ((40, 40), "xx", "mse"),
        ((40, 20), "xx", "mse"),
        ((40, 40), "xy", "mse"),
        ((40, 40), "xx", "absolute"),
    ],
)
def test_the_verb_tells_runs_of_different_lengths_losses_and_data(
    r2flow, tmp_path, steps, roots, loss
):
    for name, step, root, one in zip("ab", steps, roots, ("mse", loss), strict=True):
        make_run(tmp_path / name, {"data.root": root, "stage.loss": one}, checkpoint=step)
    said = r2flow("compare", tmp_path / "a", tmp_path / "b").said
    differ = [steps[0] != steps[1], loss != "mse", roots[0] != roots[1]]
    names = [name for name, one in zip(("images", "loss", "data"), differ, strict=True) if one]
    assert (f"the runs differ in {', '.join(names)}" in said) == any(differ)
