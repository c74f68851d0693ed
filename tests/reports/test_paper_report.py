"""r2flow report paper: from run folders to the page, with chains of random weights."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from r2flow.errors import InputError
from r2flow.evaluation.protocols import R2FLOW
from r2flow.generators import build_generator
from r2flow.metrics.birds_eye import js_distance
from r2flow.model.checkpoint import load_checkpoint, weights_hash
from r2flow.reports.paper import cells
from r2flow.reports.paper.figures import marginals, marginals_apart
from r2flow.reports.paper.page import from_above, remarks_of
from r2flow.reports.paper.report import held_out
from r2flow.reports.paper.subjects import find_subjects
from r2flow.reports.paper.tables import beside, differences, over_seeds, same_architecture
from r2flow.reports.speed_quality import BETWEEN
from r2flow.runs.lineage import Parent
from r2flow.stages.checkpointing import AtomicCheckpointIO
from r2flow.training import check, compose
from tests.test_cli import r2flow  # noqa: F401  a fixture
from tests.test_sampling import network

DATA = {"name": "simulated", "scenes": 6, "batch_size": 2, "validation": {"share": 0.5, "scans": 2}}


def make_run(folder: Path, stage: dict, parent: Path | None = None, seed: int = 0) -> Path:
    """A run folder whose flow has small random weights, others for another folder and seed."""
    flow = network()
    scale = 0.3 + 0.01 * len(stage) + 0.02 * seed + 0.05 * (parent is not None)
    config = {**flow.config, "stage": stage, "data": DATA, "seed": seed, "trainer": {"max_steps": 7}}
    if parent is not None:
        above = load_checkpoint(parent)
        config["parent"] = {"path": "moved", "weights": weights_hash(above), "stage": above.config["stage"]["name"]}
    weights = {f"generator.backbone.{name}": scale * value for name, value in flow.model.state_dict().items()}
    content = {"state_dict": weights, "config": config, "global_step": 7}
    AtomicCheckpointIO().save_checkpoint(content, folder / "checkpoints" / "step-00000007.ckpt")
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


@pytest.fixture(scope="module")
def chains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chains")
    for seed in (0, 1):
        first = make_run(root / f"{seed}" / "a", {"name": "rectify"}, seed=seed)
        second = make_run(root / f"{seed}" / "b", {"name": "reflow"}, first, seed)
        make_run(root / f"{seed}" / "c", {"name": "distill", "steps": 2}, second, seed)
    return root


def test_every_run_finds_its_role_and_its_chain(chains):
    found = {one.label: one for one in find_subjects([chains])}
    assert {label: one.role for label, one in found.items()} == {
        f"{seed}/{name}": role for seed in (0, 1) for name, role in (("a", "1-RF"), ("b", "2-RF"), ("c", "2-TD"))
    }
    for seed in (0, 1):
        families = {found[f"{seed}/{name}"].family for name in "abc"}
        assert families == {weights_hash(load_checkpoint(chains / str(seed) / "a"))}


def test_a_child_finds_its_parent_in_any_order_where_the_first_flow_is_not_there(chains, tmp_path):
    first = make_run(tmp_path / "0" / "elsewhere", {"name": "rectify"}, seed=5)
    second = make_run(tmp_path / "1" / "z", {"name": "reflow"}, first, seed=5)
    make_run(tmp_path / "1" / "a", {"name": "distill", "steps": 2}, second, seed=5)
    found = {one.role: one for one in find_subjects([tmp_path / "1", chains / "0" / "a"])}
    assert found["2-TD"].family == found["2-RF"].family == weights_hash(load_checkpoint(second))


def test_a_cell_that_was_kept_belongs_to_the_chain_that_is_known_now(r2flow, chains, tmp_path):  # noqa: F811
    command = paper(chains / "0" / "a", tmp_path, chains / "0" / "c", "--bootstrap", 0, "--curved", 0,
                    "--tolerance", 0)  # fmt: skip
    for more in ((), (chains / "0" / "b",)):
        assert r2flow(*command, *more)[0] == 0
    rows = json.loads((tmp_path / "paper.json").read_text())["rows"]
    assert len({row["family"] for row in rows}) == 1


def test_held_out_scenes_of_another_seed_are_other_scans(chains):
    sets = [held_out(one) for one in find_subjects([chains]) if one.role == "1-RF"]
    assert not np.array_equal(sets[0].source[0], sets[1].source[0])
    assert sets[0].identity != sets[1].identity


def test_seeds_are_those_of_one_kind_of_network():
    rows = [
        {"role": "1-RF", "kind": kind, "steps": 256, "seconds": 1.0, "jsd": d}
        for kind, d in (("adm_unet", 0.4), ("hdit with APE", 0.1), ("hdit with APE", 0.3))
    ]
    merged = {row["kind"]: row for row in over_seeds(rows, ["jsd"])}
    assert merged["hdit with APE"]["jsd"] == pytest.approx(0.2)
    assert merged["hdit with APE"]["n"] == 2
    assert merged["adm_unet"]["jsd"] == 0.4
    assert beside(rows, ["jsd"]).splitlines()[2] == "| 1-RF | 256 | 256 | 2.16 | 20 |"


def test_runs_without_a_first_flow_or_of_two_sensors_are_refused(chains, tmp_path):
    with pytest.raises(InputError, match="no 1-RF among the flows"):
        find_subjects([chains / "0" / "b"])
    other = make_run(tmp_path / "other", {"name": "rectify"})
    config = load_checkpoint(other).config
    path = other / "checkpoints" / "step-00000007.ckpt"
    from r2flow.model.checkpoint import read_checkpoint

    content = {**read_checkpoint(path), "config": {**config, "sensor": {**config["sensor"], "max_range": 70.0}}}
    AtomicCheckpointIO().save_checkpoint(content, path)
    with pytest.raises(InputError, match="another sensor"):
        find_subjects([chains, other])


def paper(runs: Path, out: Path, *options: object) -> tuple[object, ...]:
    return ("report", "paper", runs, "--out", out, "--num", 3, "--steps", "1,2", "--repeats", 0,
            "--metrics", "mmd", "--device", "cpu", *options)  # fmt: skip


def test_the_page_goes_on_where_it_stopped(r2flow, chains, tmp_path, monkeypatch):  # noqa: F811
    command = paper(chains, tmp_path, "--bootstrap", 4, "--curved", 0, "--tolerance", 0)
    code, said, error = r2flow(*command)
    assert code == 0, error
    assert "Of 12 claims of the paper" in said
    content = json.loads((tmp_path / "paper.json").read_text())
    found = {(row["label"], row["steps"]) for row in content["rows"]}
    assert found == {(f"{s}/{n}", k) for s in (0, 1) for n, k in (("a", 1), ("a", 2), ("b", 1), ("b", 2), ("c", 2))}
    assert all(row["jsd_low"] < row["jsd_high"] for row in content["rows"])
    assert {claim["verdict"] for claim in content["claims"]} <= {"holds", "does not hold", "cannot tell"}
    page = (tmp_path / "paper.md").read_text()
    assert "**FRD, FRID, FPD, FPVD, FSVD:** not computed: not asked for" in page
    assert "are not comparable: its bins are those of an image of 64 x 1024." in page
    assert [one["name"] for one in content["protocol"]] == ["r2flow"]

    monkeypatch.setattr(cells, "sampled_set", lambda *_: pytest.fail("a finished cell was measured again"))
    assert r2flow(*command)[0] == 0
    assert json.loads((tmp_path / "paper.json").read_text())["rows"] == content["rows"]


@pytest.mark.slow
def test_every_figure_stands_in_its_place(r2flow, chains, tmp_path):  # noqa: F811
    code, _, error = r2flow(*paper(chains, tmp_path, "--bootstrap", 0, "--curved", 1))
    assert code == 0, error
    page = (tmp_path / "paper.md").read_text()
    for name in ("figure_3", "figure_5", "figure_6", "figure_7", "figure_8a", "figure_8b"):
        assert page.count(f"({name}.png)") == 1
        assert (tmp_path / f"{name}.png").stat().st_size > 1000


def test_marginals_add_up_and_lie_apart_as_their_histograms_do():
    a, b = np.zeros((100, 100)), np.zeros((100, 100))
    a[10, 20], b[10, 30] = 5, 7
    along_x, along_y = marginals(a)
    assert along_x[10] == along_y[20] == 5
    # Equal along x, disjoint along y: the mean of 0 and sqrt(ln 2).
    assert marginals_apart(a, b) == pytest.approx(js_distance(np.eye(2)[0], np.eye(2)[1]) / 2)


def test_printed_and_own_figures_stand_in_one_line():
    rows = [
        {"role": "2-TD", "steps": 2, "seconds": 0.1, "jsd": 0.05},
        {"role": "1-RF", "steps": 32, "seconds": 1, "jsd": 0.02},
    ]
    lines = beside(rows, ["jsd", "frechet_embedded"]).splitlines()
    assert lines[0].split(" | ")[3:] == ["JSD x 10^2, paper", "ours |"]
    assert "| 1-RF | 256 | 32 | 2.16 | 2 |" in lines
    assert "| 2-TD | 2 | 2 | 2.39 | 5 |" in lines


def test_what_differs_is_said_and_nothing_else():
    paper = differences("KITTI-360", 81_106, 10_000, (64, 1024), [80_908_420], [2_560_000], {})
    assert len(paper) == 1
    small = " ".join(
        differences("simulated", 51, 32, (32, 256), [2_000_000], [3600], {"frd": "no weights"}, R2FLOW, "no points")
    )
    for words in (
        "`r2flow`: real points on rays through bin centres",
        "not comparable: no points.",
        "32 generated against 51 real",
        "32 x 256",
        "2,000,000",
        "3,600",
        "FRD:** not computed: no weights",
    ):
        assert words in small
    for words in ("real points as measured", "generated points on rays through bin corners"):  # the paper's
        assert words in small
        assert words not in "".join(paper)
    assert same_architecture(125_246_466).frd == 134.22  # printed as 125.5 M
    assert same_architecture(2_000_000) is None


def test_a_remark_stays_whole_and_is_said_once():
    rows = [{"remarks": BETWEEN.join(["too few; compare with as many", "one is empty"])}, {"remarks": "one is empty"}]
    assert remarks_of(rows) == ["- too few; compare with as many\n- one is empty"]
    assert remarks_of([{"remarks": ""}, {}]) == []


# Of each system a few thousand random weights: options, and the evaluations of a scan where it is asked for 1 and 2.
SYSTEMS = {
    "Vanilla GAN": (["experiment=vanilla_gan_small", "generator.base_channels=4"], {1}),
    "DUSty v2": (["experiment=dusty2_small", "generator.base_channels=4"], {1}),
    "LiDARGen": (["experiment=lidargen_small", "generator.width=4", "generator.levels=2"], {2 * 5 + 1}),
    "LiDM, range": (["experiment=lidm_small"], {1, 2, 50}),
    "LiDM + APE, range": (["experiment=lidm_ape_small"], {1, 2, 50}),
    "R2DM": (
        ["experiment=r2dm_small", "backbone.base_channels=8"],
        {1, 2, 256},
    ),
}


def make_system(folder: Path, options: list[str]) -> Path:
    small = ["sensor.rows=16", "sensor.columns=64", "data.scenes=4", "data.validation.scans=2"]
    small += ["trainer.accelerator=cpu", f"run_dir={folder}"]
    latent = options[0].startswith("experiment=lidm")
    parent = Parent(compose(["experiment=lidm_autoencoder_small", *small]), folder) if latent else None
    config = check(compose([*options, *small]), parent=parent)
    config["encoding"]["reflectance"] = not latent
    torch.manual_seed(0)
    generator = build_generator(config)
    weights = {f"generator.{name}": value for name, value in generator.state_dict().items()}
    sampler = generator.sampler.asdict()
    content = {"state_dict": weights, "config": config, "global_step": 7, "sampler": sampler}
    AtomicCheckpointIO().save_checkpoint(content, folder / "checkpoints" / "step-00000007.ckpt")
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


@pytest.mark.slow
def test_other_systems_stand_in_the_paper_s_order_with_their_own_evaluations(r2flow, tmp_path):  # noqa: F811
    for number, (options, _) in enumerate(reversed(SYSTEMS.values())):
        make_system(tmp_path / "runs" / str(number), options)
    code, said, error = r2flow(*paper(tmp_path / "runs", tmp_path / "out", "--bootstrap", 0, "--workers", 0))
    assert code == 0, error
    content = json.loads((tmp_path / "out" / "paper.json").read_text())
    found: dict[str, set[int]] = {}
    for row in content["rows"]:
        found.setdefault(row["role"], set()).add(row["steps"])
    assert found == {role: evaluations for role, (_, evaluations) in SYSTEMS.items()}
    assert list(found) == list(SYSTEMS)
    assert content["claims"] == []  # which are about the paper's own flows
    page = (tmp_path / "out" / "paper.md").read_text()
    assert "**Ranges:** real scans 1.45 to 80 m; LiDARGen 0.5 to 63 m, LiDM, range 1 to 56 m" in page
    assert "### The paper's figures beside ours" not in page  # under another protocol they are not comparable
    assert (tmp_path / "out" / "figure_6.png").is_file()


def test_figure_5_is_of_lidm_without_and_with_a_position_embedding():
    def cell(role: str, steps: int, at: int) -> cells.Cell:
        counts = np.zeros((100, 100))
        counts[at, at] = 1
        return cells.Cell({"role": role, "kind": "", "steps": steps}, counts, np.zeros((1, 1, 2, 2)))

    made = [cell("LiDM, range", 1, 0), cell("LiDM, range", 50, 1), cell("LiDM, range", 50, 2), cell("R2DM", 256, 3)]
    assert {name: np.argwhere(counts)[:, 0].tolist() for name, counts in from_above(made).items()} == {
        "LiDM, range": [1, 2]
    }
    assert list(from_above(made[3:])) == ["R2DM"]


def test_other_systems_stand_beside_their_printed_figures_at_the_nearest_evaluations():
    rows = [
        {"role": role, "kind": "", "steps": steps, "seconds": 1, "jsd": 0.05}
        for role, steps in (("LiDARGen", 1161), ("LiDM + APE, range", 50), ("LiDM + APE, range", 143), ("R2DM", 1))
    ]
    lines = beside(rows, ["jsd"]).splitlines()[2:]
    assert lines == [
        "| LiDARGen | 1160 | 1161 | 4.04 | 5 |",
        "| LiDM + APE, range | 50 | 50 | 4.5 | 5 |",
        "| LiDM + APE, range | 200 | 143 | 4.3 | 5 |",
        "| R2DM | 1 | 1 | 33.5 | 5 |",
    ]


def test_a_published_file_is_reported_on_and_an_autoencoder_left_out(r2flow, shared, tmp_path):  # noqa: F811
    files = [shared / "oracle_baselines" / f"{name}_published.pth" for name in ("vanilla", "dusty1")]
    if not files[0].exists():
        pytest.skip("the reference checkpoints are not here")
    code, _, error = r2flow(*paper(files[0], tmp_path, files[1], "--bootstrap", 0))
    assert (code, error.count("\n")) == (2, 1)
    assert "give --real SCANS" in error
    found = find_subjects(files)
    assert [one.role for one in found] == ["Vanilla GAN, range", "DUSty v1, range"]
    with pytest.raises(InputError, match="autoencoder alone"):
        find_subjects([files[0].with_name("lidm_ae_published.ckpt")])
