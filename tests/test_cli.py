"""r2flow VERB as a user types it."""

import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch.distributed.run
from matplotlib.figure import Figure

from r2flow import load
from r2flow.base.errors import InputError
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import read_points, write_points
from tests.conftest import CONFIG, SENSOR, tiny_options, write_checkpoint, write_run, write_scan
from tests.test_sampling import network, scans


def test_sample_writes_the_same_scans_for_the_same_seed(r2flow, saved, tmp_path):
    path, _ = saved
    out = r2flow(
        "sample", path, "--num", 3, "--steps", 2, "--seed", 8, "--out", tmp_path / "a"
    ).said
    assert str(tmp_path / "a" / "samples.png") in out
    r2flow(
        "sample",
        path.parent.parent,
        "--num",
        1,
        "--steps",
        2,
        "--seed",
        8,
        "-o",
        tmp_path / "b",
        "--pictures",
        0,
    )
    r2flow(
        "sample",
        path,
        "--num",
        3,
        "--steps",
        2,
        "--seed",
        6,
        "-o",
        tmp_path / "c",
        "--format",
        "npy",
    )
    images = {name: np.load(tmp_path / name / "000000.npy") for name in "abc"}
    assert images["a"].shape == (2, 8, 64)
    assert images["a"].dtype == np.float32
    np.testing.assert_array_equal(images["a"], images["b"])
    assert images["a"].any()
    assert (images["a"] != images["c"]).any()
    assert not list((tmp_path / "b").glob("*.png"))
    assert sorted(p.suffix for p in (tmp_path / "c").glob("00000*")) == [".npy"] * 3 + [".png"] * 3


def test_fewer_samples_than_the_folder_has_are_told(r2flow, saved, tmp_path: Path):
    said = [
        r2flow("sample", saved[0], "--num", num, "--pictures", 0, "--steps", 1, "-o", tmp_path).said
        for num in (3, 1, 3)
    ]
    assert [", next to 2 of an earlier command" in one for one in said] == [False, True, False]


def test_pictures_of_one_command_have_one_scale(r2flow, tmp_path: Path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "r2flow.reports.pictures.scan_figure", lambda *given: drawn.append(given[3]) or Figure()
    )
    for number, metres in enumerate((4, 40)):
        xyz, reflectance = image_to_points(np.full((2, 8, 64), metres, np.float32), SENSOR.rays())
        write_points(tmp_path / f"{number}.ply", xyz, reflectance * 0)
    r2flow(
        "show", tmp_path / "0.ply", tmp_path / "1.ply", "--sensor", "hdl64e", "-o", tmp_path / "out"
    )
    assert drawn[0] == drawn[1]
    assert drawn[0].ranges == pytest.approx((0.9 * 4, 1.1 * 40))


def test_pictures_of_files_of_one_name_have_names_of_their_own(r2flow, tmp_path):
    files = [
        tmp_path / drive / "velodyne_points" / "data" / "000000.bin" for drive in ("d1", "d2", "d3")
    ]
    for file in files:
        write_scan(file, 3)
    said = r2flow("show", *files, "--size", "32x256", "--out", tmp_path / "views").said
    names = ["000000.png", "000000_2.png", "000000_3.png"]
    assert said.splitlines() == [str(tmp_path / "views" / name) for name in names]


def test_info_says_what_is_in_a_checkpoint(r2flow, saved):
    said = r2flow("info", saved[0]).said
    for words in ("hdit", "[2, 8, 64]", "hdl64e", "name adams3, steps 16"):
        assert words in said
    assert len(said.splitlines()) < 16
    about = json.loads(r2flow("info", saved[0], "--json").said)
    assert about["step"] == 7
    assert about["config"]["backbone"]["base_channels"] == 8


def test_info_lists_models_and_networks_and_adds_one(r2flow, tmp_path):
    said = r2flow("info").said
    assert all(words in said for words in ("street", "rangenet53", "R2FLOW_WEIGHTS"))
    (tmp_path / "file.txt").write_text("no weights")
    assert "file.txt" in r2flow("info", "--add", "rangenet53", tmp_path / "file.txt").refusal


def test_the_network_and_the_sampler_are_not_written_to_one_file(r2flow, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_checkpoint(tmp_path / "it.ckpt", {**CONFIG, "backbone": tiny_options("local")})
    for options in (["--what", "network"], ["--steps", 1]):
        assert r2flow("export", "it.ckpt", "--to", "pt2", *options)[0] == 0
    assert {path.name for path in tmp_path.glob("*.pt2")} == {"it.pt2", "it-network.pt2"}


def verbs() -> list[str]:
    import typer.main

    from r2flow.cli.verbs import app

    top = typer.main.get_command(app).commands
    return sorted(
        [*(top.keys() - {"report"}), *(f"report {name}" for name in top["report"].commands)]
    )


@pytest.mark.parametrize("verb", verbs())
def test_every_verb_has_help_with_an_example(r2flow, verb, monkeypatch):
    monkeypatch.setenv("COLUMNS", "0")  # as some shells say of no terminal
    example = " ".join(r2flow(*verb.split(), "--help").said.split()).partition("Example: ")[2]
    assert f" {verb} " in example  # torchrun too takes it: --num is a prefix of its --numa-binding
    assert not example.startswith("torchrun ") or torch.distributed.run.parse_args(
        example.split()[1:]
    )


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "out of memory. Give smaller batches"),
        (MemoryError("std::bad_alloc"), "out of memory (std::bad_alloc). Give smaller batches"),
        (
            ImportError("libtorch_cpu.so: failed to map segment from shared object"),
            "object. Give smaller batches",
        ),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has"),
            "20.00 GiB",
        ),
        (
            RuntimeError("can't allocate memory: you tried to allocate 96 bytes.\nx"),
            "96 bytes. Give smaller batches",
        ),
        (
            RuntimeError("not enough memory: you tried to allocate 96 bytes."),
            "96 bytes. Give smaller batches",
        ),
        (
            TypeError(
                "Cannot convert a MPS Tensor to float64, as the MPS framework doesn't support float64."
            ),
            "cpu",
        ),
        (
            RuntimeError("DataLoader worker (pid(s) 7) exited unexpectedly"),
            "unexpectedly. Is there memory for as many",
        ),
    ],
)
def test_what_a_machine_cannot_do_is_one_line(r2flow, monkeypatch, tmp_path, error, words):
    monkeypatch.setattr("r2flow.model.checkpoint.load_checkpoint", Mock(side_effect=error))
    assert words in r2flow("sample", "-o", tmp_path).refusal
    assert words in r2flow("interpolate", "a", "b", "c", "-o", tmp_path).refusal


def test_another_error_of_torch_keeps_its_traceback(r2flow, monkeypatch, tmp_path):
    monkeypatch.setattr(
        "r2flow.model.checkpoint.load_checkpoint", Mock(side_effect=RuntimeError("shapes differ"))
    )
    with pytest.raises(RuntimeError, match="shapes"):
        r2flow("sample", "-o", tmp_path)


@pytest.mark.parametrize("device", ["nope", "meta", "cpu:3", "cuda:99", None])
def test_a_model_is_loaded_on_a_device_that_is_here(saved, device):
    with pytest.raises(InputError, match=f"^device.*{device}"):
        load(saved[0], device)


def test_points_of_a_model_with_rays_through_corners_lie_in_the_middles_of_the_bins(
    r2flow, tmp_path
):
    corners = write_checkpoint(
        tmp_path / "a.ckpt", {**CONFIG, "sensor": {**CONFIG["sensor"], "rays": "reference"}}
    )
    r2flow(
        "sample",
        corners,
        "--num",
        1,
        "--steps",
        1,
        "--pictures",
        0,
        "--format",
        "npy,ply",
        "-o",
        tmp_path,
    )
    assert json.loads((tmp_path / "manifest.json").read_text())["recipe"]["rays"] == "centre"
    middles, _ = image_to_points(np.load(tmp_path / "000000.npy"), SENSOR.rays("centre"))
    np.testing.assert_array_equal(read_points(tmp_path / "000000.ply").xyz, middles)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", network(), {"name": "rectify"}, 0.3)


@pytest.mark.usefixtures("quick_pictures")
def test_interpolate_writes_every_frame(r2flow, run, tmp_path):
    out, files = (
        tmp_path / "between",
        [tmp_path / "scans" / "one.bin", tmp_path / "scans" / "two.ply"],
    )
    for path, image in zip(files, scans(2).numpy(), strict=True):
        write_points(path, *image_to_points(image, SENSOR.rays()))
    said = r2flow(
        "interpolate", run, *files, "-o", out, "--frames", 4, "--sampler", "rk4", "--steps", 8
    ).said
    assert [path.name for path in sorted((out / "frames").glob("*.ply"))] == [
        f"{i:03d}.ply" for i in range(4)
    ]
    rows = json.loads((out / "interpolation.json").read_text())["rows"]
    for index in range(4):
        image = np.load(out / "frames" / f"{index:03d}.npy")
        points = read_points(out / "frames" / f"{index:03d}.ply").xyz
        assert len(points) == rows[index]["returns"] == (image[0] > 0).sum()
    assert [row["weight"] for row in rows] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [row["evaluations"] for row in rows] == [64, 32, 32, 64]  # the ends go there and back
    assert "4 scans" in said
    assert r2flow("interpolate", run, *files, "-o", out, "--frames", 3, "--steps", 5).said
    rows = json.loads((out / "interpolation.json").read_text())["rows"]
    assert [row["evaluations"] for row in rows] == [10, 5, 10]  # of adams3, one a step
