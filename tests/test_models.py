"""Generators that have a name."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

import r2flow
from r2flow.base.errors import InputError
from r2flow.evaluation.sets import is_checkpoint
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import parse_mask, ray_states
from r2flow.lidar.sensors import build_sensor
from r2flow.metrics.completion import errors
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.config import learned
from r2flow.model.paths import find_checkpoint
from r2flow.model.saving import save_checkpoint
from r2flow.model.shipped import MODELS, find_model, name_of
from r2flow.simulator import simulate
from tests.conftest import ROOT


@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_the_package_draws(name):
    found = load_checkpoint(name)
    assert found.path == find_model(name) == find_checkpoint(f"{name}/")
    assert name_of(found.path) == name
    assert all(value.isfinite().all() for value in found.generator.state_dict().values())
    if not found.generator.unconditional:
        with pytest.raises(
            InputError, match="give one of which a ray is known, as r2flow complete"
        ):
            found.sample(1)
        return
    images = found.sample(1, steps=1)
    assert images.shape == (1, *found.generator.space.shape)
    assert images.isfinite().all()
    assert torch.equal(images, found.sample(2, steps=1)[:1])


AHEAD = {"drop_wrong": 0.6, "chamfer_m": 1.0, "mae_all_m": 1.0}  # of interpolation's error, at most


@pytest.mark.parametrize(
    ("name", "size", "task", "most"),
    [
        ("hdl64e", (64, 1024), "rows:4", AHEAD),
        ("hdl64e", (32, 256), "points:0.1", AHEAD),
        ("down", (32, 512), "points:0.3", AHEAD),
        *((name, size, "rows:2", {**AHEAD, "drop_wrong": 1.0})
          for name, size in (("os1_64", (64, 1024)), ("vlp32c", (32, 1800)), ("hdl32e", (32, 1024)))),
    ],
)  # fmt: skip
def test_densify_is_ahead_of_interpolation(
    name: str, size: tuple[int, int], task: str, most: dict[str, float]
):
    sensor = build_sensor(
        name, *size, elevations=np.linspace(-5, -60, 32) if name == "down" else None
    )
    image = simulate(sensor, 77, 0).image
    measured = parse_mask(task)(np.ones(size, bool), np.random.default_rng(0))
    state = ray_states(torch.from_numpy(image)[None], torch.from_numpy(measured))
    lines = errors(image, interpolated(image * measured, measured), ~measured, sensor)
    for model in ("densify", "densify_small"):
        found = load_checkpoint(model).through(sensor, numbered=name == "hdl64e")
        answer = found.complete(torch.from_numpy(image * measured)[None], state)[0, 0].numpy()
        ours = errors(image, answer, ~measured, sensor)
        assert all(ours[key] < share * lines[key] for key, share in most.items())
        assert name != "hdl64e" or ours["iou"] > 1.15 * lines["iou"]


def test_the_wheel_can_bear_the_models():
    files = list(find_model("street").parent.glob("*.safetensors"))
    assert {path.stem for path in files} == set(MODELS)
    assert sum(path.stat().st_size for path in files) <= 21e6


def test_two_lines_of_python_without_a_network_and_a_light_import():
    code = """
import socket
import sys
def refuse(*_, **__):
    raise OSError("no network")

socket.socket.connect = socket.getaddrinfo = refuse
import r2flow
assert "torch" not in sys.modules
assert {"Rectify", "ScanDataModule", "__version__", "load", "read"} <= {*dir(r2flow)}
assert "torch" not in sys.modules
flow = r2flow.load("street")
scans = flow.sample(2, steps=1)
assert scans.shape == (2, *flow.generator.space.shape)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_sample_without_a_checkpoint_draws_from_the_default_model(r2flow, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = r2flow("sample", "--num", 1, "--steps", 1, "--pictures", 0, "--out", "scans").said
    assert said.startswith("the model street: ")
    r2flow("sample", "street", "--num", 1, "--steps", 1, "--pictures", 0, "--out", "named")
    assert Path("scans/000000.ply").read_bytes() == Path("named/000000.ply").read_bytes()


def test_a_run_or_a_file_of_a_models_name_comes_first(saved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert is_checkpoint("street")
    Path("street").mkdir()  # which holds no run
    assert find_checkpoint("street") == find_model("street")
    Path("street").rmdir()
    Path("street").symlink_to("run")
    assert find_checkpoint("street") == Path("street/checkpoints/step-00000007.ckpt")
    assert is_checkpoint("street")
    Path("street").unlink()
    Path("street").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="street is not a checkpoint"):
        load_checkpoint("street")


def test_a_damaged_file_is_not_the_model(tmp_path, monkeypatch):
    data = bytearray(find_model("densify").read_bytes())
    monkeypatch.setattr("r2flow.model.shipped.FOLDER", tmp_path)
    with pytest.raises(InputError, match="the model densify is not here"):
        load_checkpoint("densify")
    data[-1] ^= 1
    (tmp_path / "densify.safetensors").write_bytes(data)
    with pytest.raises(InputError, match="is not the model densify, or damaged"):
        load_checkpoint("densify")


def test_half_precision_rounds_large_weights_alone(saved, tmp_path):
    original = load_checkpoint(saved[0])
    save_checkpoint(original, tmp_path / "half.safetensors", half=True)
    save_checkpoint(original, tmp_path / "again.safetensors", half=True)
    assert (tmp_path / "half.safetensors").read_bytes() == (
        tmp_path / "again.safetensors"
    ).read_bytes()
    with safe_open(tmp_path / "half.safetensors", framework="pt") as file:
        kinds = {name: file.get_tensor(name).dtype for name in file.keys()}  # noqa: SIM118
    large = {
        name
        for name, value in original.generator.named_parameters()
        if value.ndim > 1 and value.numel() > 256
    }
    assert {name for name, kind in kinds.items() if kind == torch.float16} == large != set()
    read = load_checkpoint(tmp_path / "half.safetensors").generator.state_dict()
    for name, value in original.generator.state_dict().items():
        assert read[name].dtype == value.dtype
        # float16 has 11 significant bits, and steps of 2^-24 below 2^-14.
        allowed = (
            (value.abs() * 2.0**-11).clamp(min=2.0**-25)
            if name in large
            else torch.zeros_like(value)
        )
        assert ((read[name] - value).abs() <= allowed).all(), name


def test_a_written_config_says_what_was_learned_and_no_folder():
    parts, scans = [{"name": "folder", "root": "/data/a"}], {"name": "simulated", "root": "/data/b"}
    config = {
        "run_dir": "/home/me/runs/a",
        "stage": {
            "name": "rectify",
            "parent": {"path": "/home/me/runs/b", "pairs": "/home/me/pairs", "step": 7},
        },
        "data": {"name": "mixed", "root": "/data", "parts": parts, "scans": scans},
        "sampler": {},
    }
    assert learned(config) == {
        "stage": {"name": "rectify", "parent": {"step": 7}},
        "data": {"name": "mixed", "parts": [{"name": "folder"}], "scans": {"name": "simulated"}},
    }


def test_torch_hub_gives_the_model_of_the_package():
    before = torch.get_rng_state()
    flow = torch.hub.load(str(ROOT), "street", source="local")
    assert torch.equal(torch.get_rng_state(), before)  # the caller's random numbers stay
    assert torch.equal(flow.sample(1, steps=1), r2flow.load("street").sample(1, steps=1))
