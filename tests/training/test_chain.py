"""1-RF, pairs, 2-RF, pairs, k-TD, report: as one command, and link by link."""

import json
import shutil
import signal
from pathlib import Path

import pytest
import torch
import yaml

from r2flow.base.errors import InputError
from r2flow.base.signals import LATER
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import PAIRS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.paths import checkpoints_of
from r2flow.model.saving import weights_hash
from r2flow.model.shipped import DEFAULT
from r2flow.model.tensor_files import read_checkpoint
from r2flow.reports.chain import _conclusion, _scan_sets, _with_distances, report_chain
from r2flow.runs.chain import links_of
from r2flow.runs.composing import compose
from r2flow.runs.folder import has_ended
from r2flow.training import Result, Run, build
from tests.conftest import CONFIG, write_checkpoint
from tests.training.conftest import (
    TINY,
    hold_at,
    in_process,
    let_go,
    run_train,
    start,
    tiny,
    wait_for,
)

HELD = Path("held")  # in the folder that a chain is started from
CHAIN = ["experiment=demo", "preview=null", "chain.rf2.data.pairs.num=8", "chain.td2.data.pairs.num=8",
         "data.pairs.batch_size=4", "trainer.max_steps=8", "samples.num=0", *hold_at(6, HELD)]  # fmt: skip
LINKS = ("rf1", "rf2", "td2")
STOPPED = Result({}, None, Path(), 0, finished=False)  # of `fit`


def test_a_preview_is_drawn_once_and_before_the_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    model = write_checkpoint(tmp_path / "street.ckpt", CONFIG)
    monkeypatch.setattr("r2flow.model.shipped.find_model", {"street": model}.__getitem__)
    picture = tmp_path / "runs" / "demo" / "preview" / "samples.png"
    drawn: list[int] = []
    monkeypatch.setattr(
        "r2flow.runs.chain.fit", lambda _: drawn.append(picture.stat().st_mtime_ns) or STOPPED
    )
    for _ in range(2):
        done = in_process(tmp_path, ["experiment=demo", "trainer.accelerator=cpu"], check=False)
        assert "scans of the included model street, runs/demo/preview/samples.png" in done.stdout
    assert drawn[0] == drawn[1]


def of_a_child(*overrides: str) -> list[str]:
    """The tiny run's overrides without what a child takes from its parent."""
    return [
        one for one in TINY if not one.startswith(("data=", "sensor", "backbone", "data.root"))
    ] + list(overrides)


@pytest.fixture(scope="session")
def chained(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """(folder, what it printed) of the tiny chain that nobody disturbed."""
    cwd = tmp_path_factory.mktemp("chained")
    let_go(cwd / HELD)
    return cwd / "runs" / "demo", run_train(cwd, scans, *CHAIN).stdout


def state(run: Path) -> dict[str, object]:
    """Everything that a chain is to end with: weights, raw and averaged, and the pairs' bytes."""
    found: dict[str, object] = {}
    for link in LINKS:
        content = read_checkpoint(checkpoints_of(run / link)[0])
        for kind in ("current_model_state", "state_dict"):
            found |= {f"{link} {kind} {name}": value for name, value in content[kind].items()}
        for path in sorted((run / link / "pairs").glob("*.safetensors")):
            found[f"{link} {path.name}"] = path.read_bytes()
    return found


def assert_alike(first: Path, second: Path) -> None:
    a, b = state(first), state(second)
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert (
            torch.equal(value, b[name]) if isinstance(value, torch.Tensor) else value == b[name]
        ), name


def test_the_chain_ends_with_every_flow_and_a_report(chained: tuple[Path, str]):
    run, said = chained
    for name in (
        "report/steps.png",
        "report/compare.md",
        "report/compare.json",
        "report/000000.ply",
    ):
        assert (run / name).is_file(), name
    for words in (
        "[1/3] rf1",
        "[2/3] rf2",
        "[3/3] td2",
        "8 pairs",
        "evaluations a pair",
        "pairs/s",
        "[2/3] rf2 (straightened): ",
        "rf1 (trained on scans), rf2 (straightened), td2 (distilled)",
        "needs no network",
        " are clearly better than ",
        "r2flow sample",
    ):
        assert words in said
    first, second, third = (load_checkpoint(run / link) for link in LINKS)
    assert [flow.config.stage.name for flow in (first, second, third)] == [
        "rectify",
        "reflow",
        "distill",
    ]
    assert second.config.stage.parent.weights == weights_hash(first)
    assert third.config.stage.parent.weights == weights_hash(second)
    assert second.config.model["backbone"] == first.config.model["backbone"]
    assert [(f.generator.sampler.steps, f.generator.fixed) for f in (first, third)] == [
        (2, False),
        (2, True),
    ]
    # The noise that 2-TD learns from is none of that which 2-RF has learned from.
    assert (second.config.data.pairs.first, third.config.data.pairs.first) == (
        0,
        8,
    )


def test_the_report_s_distance_of_the_held_out_scans_themselves_is_0(chained: tuple[Path, str]):
    first, second = (load_checkpoint(chained[0] / link) for link in LINKS[:2])
    groups = {key: first.config.stored[key] for key in ("sensor", "encoding", "seed")}
    data = ScanDataModule(**vars(first.config.data), **groups)
    data.read()
    held_out = data.validation_source.batch(range(len(data.validation_source))).numpy()
    unseen, training = _scan_sets(first)
    drawn = [({}, held_out), ({}, held_out * 0.5), ({}, training[:].numpy())]
    rows = _with_distances(drawn, unseen, training)
    exact, halved, trained, baseline = (row["distance"] for row in rows)
    assert exact == 0 < trained < baseline
    assert halved > 0.1
    assert _scan_sets(second) is None  # on pairs


def test_the_conclusion_follows_the_distances():
    def row(scans: str, distance: float, calls: float = 1.0) -> dict[str, object]:
        return {
            "scans": scans,
            "title": f"{scans} in {calls:g}",
            "distance": distance,
            "calls": calls,
        }

    rows = [row("a", 0.3), row("a", 0.2, 2.0), row("b", 0.1), row("b", 0.205, 2.0)]
    baseline = {"scans": "noise", "distance": 0.21}
    said = _conclusion([*rows, row(DEFAULT, 0.01), baseline], 2400)
    told = "After 2,400 images 1 of 4 are clearly better than noise (b in 1). "
    assert said == f"{told}Longer training helps."
    said = _conclusion([*rows, baseline | {"distance": 0.1}], 2400)
    assert "0 of 4 are clearly better than noise. " in said


def test_a_finished_chain_is_not_run_again(chained: tuple[Path, str], scans: Path, tmp_path: Path):
    run = Path(shutil.copytree(chained[0], tmp_path / "runs" / "it's"))
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*.ckpt")}
    # the report too
    assert run_train(tmp_path, scans, *CHAIN, 'name="it\'s"').stdout.count("finished before") == 4
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*.ckpt")} == before


@pytest.mark.slow
def test_a_chain_told_to_stop_passes_it_on_and_its_last_link_is_not_finished(
    chained, scans, tmp_path
):
    shutil.copytree(chained[0], tmp_path / "runs" / "demo")
    run = tmp_path / "runs" / "demo"
    shutil.rmtree(run / "td2")
    shutil.rmtree(run / "report")
    process = start(tmp_path, tiny(scans, *CHAIN))
    wait_for(tmp_path / HELD, process)
    process.send_signal(signal.SIGTERM)  # to the chain alone
    said, _ = process.communicate(timeout=100)
    assert process.returncode == 143, said
    assert "stopped at step 6; the same command resumes from the last checkpoint" in said
    assert "the chain stopped in td2; the same command resumes there" in said
    assert not has_ended(run / "td2")
    assert not (run / "report").exists()
    let_go(tmp_path / HELD)
    run_train(tmp_path, scans, *CHAIN)
    assert_alike(chained[0], run)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["experiment=reflow"], "data=pairs are drawn by a trained run: give stage.parent=RUN"),
        (["experiment=reflow", "stage.parent=RF1", "sensor=vlp16"], "the sensor is the parent's"),
        (
            ["experiment=reflow", "stage.parent=RF1", "data.augment.flip=true"],
            "data.augment changes scans",
        ),
        (["experiment=reflow", "stage.parent=RF1"], "holds other pairs"),
    ],
)
def test_a_child_that_cannot_be_is_refused_in_one_line(chained, tmp_path, overrides, message):
    options = of_a_child(*(one.replace("RF1", str(chained[0] / "rf1")) for one in overrides))
    assert message in in_process(tmp_path, options, check=False).refusal
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_parent_is_refused_and_its_checkpoint_taken(
    chained: tuple[Path, str], tmp_path: Path
):
    parent = Path(shutil.copytree(chained[0] / "rf1", tmp_path / "2011"))
    shutil.rmtree(parent / "pairs")
    last, before = checkpoints_of(parent)
    last.unlink()
    options = [
        "experiment=reflow",
        "data.pairs.num=4",
        "data.pairs.batch_size=4",
        "trainer.max_steps=2",
    ]
    done = in_process(tmp_path, of_a_child(*options, "stage.parent=2011"), check=False)
    assert "has stopped at step 6 of 8: finish it, or name the checkpoint" in done.refusal
    in_process(tmp_path, of_a_child(*options, f"stage.parent={before}"))
    assert (parent / "pairs" / "manifest.json").is_file()


def test_pairs_of_a_flow_map_can_be_its_jumps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    sampler = ("data.pairs.sampler.name=jump", "data.pairs.sampler.steps=4")
    run = build(
        compose(
            ["experiment=reflow", "stage.parent=street", "data.root=pairs", "trainer=cpu", *sampler]
        )
    )
    assert run.data.pair_store.sampler.name == "jump"


@pytest.mark.slow
def test_two_devices_make_the_pairs_that_one_makes(chained: tuple[Path, str], tmp_path: Path):
    # Lightning starts the second device by the process's own command line, which must not be that
    # of these tests.
    options = of_a_child(
        "experiment=reflow", f"stage.parent={chained[0] / 'rf1'}", "trainer.strategy=ddp", "trainer.devices=2",
        f"data.root={tmp_path / 'pairs'}", "data.pairs.num=8", "data.pairs.batch_size=4",
        "data.pairs.sampler.name=midpoint", "data.pairs.sampler.steps=8", "trainer.max_steps=2",
    )  # fmt: skip
    process = start(tmp_path, options)
    said, _ = process.communicate(timeout=200)
    assert process.returncode == 0, said
    for name in ("manifest.json", "pairs-000000.safetensors"):
        assert (tmp_path / "pairs" / name).read_bytes() == (
            chained[0] / "rf1" / "pairs" / name
        ).read_bytes()


ALL_LINKS = ("data.batch_size=2", "data.validation.share=0.1", "trainer.max_steps=7", "seed=3")
OF_SCANS = ("data.augment.flip=true", "sensor=vlp16", "data=folder", "data.root='a b'")


def test_links_take_what_concerns_them_and_at_last_what_is_given_to_them_alone():
    chain = {
        "rf1": {"experiment": None, "trainer": {"max_steps": 5}, "samples": {"num": 0}},
        "rf2": {"experiment": "reflow", "parent": "rf1", "stage": {"loss": "mse"}},
    }
    given = ["experiment=demo", "name=x", "chain.rf1.trainer.max_steps=9", *OF_SCANS, "data.pairs.num=9",
             *ALL_LINKS, "backbone.depths=[1]", "+chain.rf2.seed=2"]  # fmt: skip
    first, second = (link.config for link in links_of(chain, "runs/x", given))
    assert (first.data.name, first.data.root, first.data.augment["flip"]) == ("folder", "a b", True)
    assert (first.trainer.max_steps, first.samples.num, first.seed) == (9, 0, 3)
    assert (first.sensor["name"], first.backbone["depths"]) == ("vlp16", [1])
    assert (first.run_dir, second.run_dir) == ("runs/x/rf1", "runs/x/rf2")
    assert (second.data.name, second.data.root, second.data.augment["flip"]) == (PAIRS, None, False)
    assert (second.data.pairs.num, first.data.pairs.num) == (9, 1000)
    assert (second.trainer.max_steps, second.data.batch_size, second.seed) == (7, 2, 2)
    assert second.stage["parent"] == "runs/x/rf1"
    assert (second.stage["loss"], second.sensor["name"]) == ("mse", "hdl64e")


def test_every_link_of_the_paper_s_chain_is_built_before_the_first_one_runs(
    kitti_360, tmp_path, monkeypatch
):
    ran: list[Run] = []
    monkeypatch.setattr("r2flow.runs.chain.fit", lambda run: ran.append(run) or STOPPED)
    command = [
        "experiment=r2flow",
        f"data.root={kitti_360}",
        "data.augment.flip=true",
        "trainer.accelerator=cpu",
    ]
    assert in_process(tmp_path, command, check=False).returncode == LATER
    (first,) = ran  # the later ones have been built, and are not refused for the flip
    assert first.data.augment.flip
    assert first.config.plain()["trainer"] == {
        **compose(["experiment=r2flow_1rf"])["trainer"],
        "accelerator": "cpu",
        "default_root_dir": "runs/r2flow/rf1",
    }
    assert [path.name for path in tmp_path.iterdir()] == ["data_3d_raw"]  # no runs


def test_scans_in_files_take_the_place_of_a_chain_s_simulated_scenes(
    scans: Path, tmp_path: Path, monkeypatch
):
    ran: list[Run] = []
    monkeypatch.setattr("r2flow.runs.chain.fit", lambda run: ran.append(run) or STOPPED)
    command = [
        "experiment=r2flow",
        "size=small",
        "data=folder",
        f"data.root={scans}",
        "trainer.accelerator=cpu",
    ]
    assert (
        "chain.rf1: scans in files are no"
        in in_process(tmp_path, [*command, "data.scenes=5"], check=False).refusal
    )
    in_process(tmp_path, command, check=False)
    assert len(ran) == 1  # of both
    nine = {"rf1": {"data": {"scenes": 9}}}
    (link,) = links_of(nine, "runs", ["data=simulated"])
    assert (link.config.data.scenes, "data.scenes" in link.asked) == (9, True)
    more = {
        "more": {"parent": "rf1", "data": {"scenes": 9}},
        "rf2": {"experiment": "reflow", "parent": "more"},
    }
    usual = compose()["data"]["scenes"]
    assert links_of(nine, "runs", ["data=mixed"])[0].config.data.scenes == usual
    links = links_of({"rf1": {"data": {"scenes": 8}}, **more}, "runs", ["data=folder"])
    # rf2 learns from pairs
    assert [link.config.data.name for link in links] == ["folder", "folder", PAIRS]
    assert [link.config.data.scenes for link in links] == [usual] * 3
    assert not any("data.scenes" in link.asked for link in links)


def test_a_chain_s_report_draws_what_each_system_can(chained: tuple[Path, str], tmp_path: Path):
    judge, first = (
        {"name": "dcgan", "halvings": 2},
        {"name": "autoencoder", "discriminator": {"layers": 1}},
    )
    others = {
        "ae": {"stage": first, "generator": {"name": "vq_autoencoder"}},
        "gan": {
            "stage": {"name": "gan", "discriminator": judge},
            "generator": {"name": "dusty2", "doublings": 2},
        },
    }
    runs = {}
    for name, other in others.items():
        config = {**CONFIG, **other}
        runs[name] = write_checkpoint(
            tmp_path / name / "checkpoints" / "step-00000007.ckpt", config
        ).parent.parent
        (runs[name] / "config.yaml").write_text(yaml.safe_dump(config))
    report_chain({"rf1": chained[0] / "rf1"} | runs, tmp_path / "report")
    rows = json.loads((tmp_path / "report" / "compare.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["rf1", "ae", "gan"]
    # of the GAN, the last that makes scans
    assert len(list((tmp_path / "report").glob("0*.ply"))) == 4


def test_a_chain_can_begin_at_a_flow_that_is_there_with_a_stage_of_its_own_options():
    chain = {"td4": {"stage": {"name": "distill", "steps": 4, "parent": "runs/old"}}}
    (link,) = links_of(chain, "runs/x", ["data.pairs.num=5", "data.root=scans"])
    assert (link.config.stage["name"], link.config.stage["steps"]) == ("distill", 4)
    assert (link.config.data.pairs.num, link.config.data.root) == (5, None)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["trainer.fast_dev_run=true"], "fast_dev_run leaves none"),
        (["stage.parent=x"], "stage.parent is each link's own"),
        (
            ["chain.rf2.parent=rf9"],
            "chain.rf2 starts from rf9; give parent=EARLIER or an experiment",
        ),
        (["+chain.fr2.trainer.max_steps=9"], "chain.fr2 starts from nothing; give parent=EARLIER"),
        (["~chain.rf9"], "'chain.rf9' does not exist"),
        (["+chain.td2.stage.loss=l3"], "chain.td2: no loss named 'l3'"),
        (["+chain.rf2.backbone.depths=[1,2]"], "chain.rf2: backbone.depths is [1, 2] here"),
    ],
)
def test_a_chain_that_cannot_run_is_refused_before_its_first_link(
    tmp_path: Path, overrides: list[str], message: str
):
    assert message in in_process(tmp_path, ["experiment=demo", *overrides], check=False).refusal
    assert list(tmp_path.iterdir()) == []


def test_a_link_that_lost_its_last_checkpoint_is_not_finished(
    chained: tuple[Path, str], tmp_path: Path
):
    run = Path(shutil.copytree(chained[0] / "rf1", tmp_path / "rf1"))
    assert has_ended(run)
    checkpoints_of(run)[0].unlink()
    assert not has_ended(run)


@pytest.mark.parametrize("key", ["plugins", "+plugins", "++plugins"])
def test_a_link_in_a_file_names_no_plugins(key: str):
    with pytest.raises(InputError, match="chain.rf1.plugins: .*--plugin"):
        links_of({"rf1": {key: ["theirs.py"]}}, "runs/x", [])
