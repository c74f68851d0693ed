"""An exported flow gives the flow's own scans, without r2flow."""

import json
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow import __version__
from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion_export import compare_completion, export_completion
from r2flow.model.export import NOTES, compare, export, tableau, traced
from r2flow.samplers import build_sampler
from tests.conftest import ROOT, tiny_options

ONNX = pytest.mark.skipif(
    not (find_spec("onnxscript") and find_spec("onnxruntime")), reason="the extra 'export'"
)
KINDS = ["pt2", pytest.param("onnx", marks=ONNX)]
SHORT = build_sampler("adams3", steps=3, grid="power:1.5", finish=1 / 32)


def flow(name: str, generator: str = "rectified_flow") -> Checkpoint:
    config = {
        "sensor": {"name": "hdl64e", "rows": 16, "columns": 64},
        "encoding": {"format": "logscale", "reflectance": True},
        "backbone": tiny_options(name),
        "generator": {"name": generator},
    }
    made = build_generator(config).eval().requires_grad_(False)
    for parameter in made.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    return Checkpoint(made, config, 7, Path("tiny.ckpt"), "r2flow")


@pytest.mark.parametrize(
    ("sampler", "times", "states"),
    [
        ("euler:steps=2:finish=0.25", [0, 0.75], [[1, 0, 0], [1, 0.75, 0], [1, 0.75, 0.25]]),
        ("euler:grid=[0,0.8,1]", [0, 0.8], [[1, 0, 0], [1, 0.8, 0], [1, 0.8, 0.2]]),
        ("heun2:steps=1", [0, 1], [[1, 0, 0], [1, 1, 0], [1, 0.5, 0.5]]),
        (
            "midpoint:steps=2:finish=0.25",
            [0, 0.375, 0.75],
            [[1, 0, 0, 0], [1, 0.375, 0, 0], [1, 0, 0.75, 0], [1, 0, 0.75, 0.25]],
        ),
        # After Euler's first step, the trapezoidal rule corrects it: h (v_0 + v_1) / 2 + h (3 v_1 -
        # v_0) / 2
        ("adams3:steps=2:grid=uniform:finish=0", [0, 0.5], [[1, 0, 0], [1, 0.5, 0], [1, 0, 1]]),
        (
            "rk4:steps=1",
            [0, 1 / 3, 2 / 3, 1],
            [
                [1, 0, 0, 0, 0],
                [1, 1 / 3, 0, 0, 0],
                [1, -1 / 3, 1, 0, 0],
                [1, 1, -1, 1, 0],
                [1, 1 / 8, 3 / 8, 3 / 8, 1 / 8],
            ],
        ),
    ],
)
def test_a_sampler_is_its_butcher_tableau(sampler, times, states):
    found = tableau(flow("efficient_unet").generator, build_sampler(sampler))
    assert found.times == pytest.approx(times)
    assert found.second is None
    torch.testing.assert_close(
        found.states, torch.tensor(states, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_jumps_have_two_times():
    found = tableau(flow("efficient_unet", "flow_map").generator, build_sampler("jump", steps=2))
    assert found.times == [0, 0.5]
    assert found.second == [0.5, 1]
    torch.testing.assert_close(
        found.states, torch.tensor([[1, 0, 0], [1, 0.5, 0], [1, 0.5, 0.5]]).double()
    )


@pytest.mark.parametrize(
    "sampler", ["dopri5", "torchdiffeq:method=rk4", "sde:steps=2", "mmps:steps=2", "renoise"]
)
def test_a_sampler_that_is_no_fixed_number_of_steps_of_the_ode_is_refused(sampler, tmp_path):
    with pytest.raises(InputError, match="cannot be exported|renoise needs noise"):
        export(flow("efficient_unet", "flow_map"), tmp_path / "flow.pt2", build_sampler(sampler))
    assert not [*tmp_path.iterdir()]


class Clipped(RectifiedFlow):
    def velocity(self, t, x, condition=None):
        return super().velocity(t, x).clamp(-20, 20)


@pytest.mark.parametrize(
    ("network", "words"), [(True, "Clipped is more than its network"), (False, "is not linear")]
)
def test_a_velocity_of_ones_own_is_not_exported_as_the_network(network, words, tmp_path):
    checkpoint = flow("efficient_unet")
    checkpoint.generator.__class__ = Clipped
    with pytest.raises(InputError, match=words):
        export(checkpoint, tmp_path / "flow.pt2", SHORT, network)


def test_a_network_that_torch_cannot_export_is_refused():
    with pytest.raises(InputError, match="torch cannot export this Flatten: "):
        traced(torch.nn.Flatten(5), torch.tensor(0.5))


def test_an_export_leaves_the_model_as_it_was_and_takes_a_samplers_name(tmp_path):
    checkpoint = flow("hdit")
    checkpoint.generator.train()
    assert export(checkpoint, tmp_path / "flow.pt2", "euler:steps=1").notes["evaluations"] == 1
    assert checkpoint.generator.backbone.training


def test_a_missing_package_names_its_extra_before_the_work_begins(
    r2flow, saved, tmp_path, monkeypatch
):
    monkeypatch.setattr("r2flow.base.errors.find_spec", lambda name: None)
    missing = "an .onnx needs the package onnx: python -m pip install 'r2flow[export]'."
    assert r2flow("export", saved[0], "--out", tmp_path / "flow.onnx") == (
        2,
        "",
        f"error: {missing}\n",
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", BACKBONES._entries)
def test_an_exported_sampler_gives_the_same_scans(name, kind, tmp_path):
    checkpoint = flow(name)
    written = export(checkpoint, tmp_path / f"flow.{kind}", SHORT)
    for num in (1, 2, 3):
        apart = compare(checkpoint, written, SHORT, num)
        assert apart.metres < 1e-3
        assert apart.reflectance < 1e-5
        assert apart.rays == 0
    # another sampler is another scan
    assert compare(checkpoint, written, replace(SHORT, steps=9)).metres > 1e-2


@pytest.mark.slow
def test_points_and_notes_come_with_the_scan(tmp_path):
    checkpoint = flow("efficient_unet")
    export(checkpoint, tmp_path / "flow.pt2", SHORT)
    found = {NOTES: ""}
    program = torch.export.load(tmp_path / "flow.pt2", extra_files=found)
    with torch.no_grad():
        scan, points = program.module()(Draws(0, [5]).start(checkpoint.generator.noise_shape))
    torch.testing.assert_close(points.norm(dim=1), scan[:, 0], rtol=1e-5, atol=1e-4)
    up = torch.asin((points[:, 2] / scan[:, 0])[scan[:, 0] > 0]).rad2deg()
    assert -25 < up.min() < up.max() < 3  # HDL-64E: 3 to -25 degrees
    notes = json.loads(found[NOTES])
    assert notes["r2flow"] == __version__
    assert notes["sensor"].items() >= {"name": "hdl64e", "columns": 64}.items()
    assert notes["sampler"]["steps"] == 3
    assert notes["times"] == {
        "t": pytest.approx([0, 1 - ((1 + 32 ** (-2 / 3)) / 2) ** 1.5, 31 / 32]),
        "s": None,
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_network_alone_takes_a_time_for_each_image(kind, tmp_path):
    checkpoint = flow("efficient_unet")
    path = export(checkpoint, tmp_path / f"network.{kind}", network=True).path
    t, x = torch.tensor([0.1, 0.5, 0.9]), torch.randn(3, 2, 16, 64)
    with torch.no_grad():
        expected = checkpoint.generator.backbone(t, x)
        if kind == "pt2":
            v = torch.export.load(path).module()(t, x)
        else:
            session = pytest.importorskip("onnxruntime").InferenceSession(str(path))
            (v,) = map(torch.from_numpy, session.run(["v"], {"t": t.numpy(), "x": x.numpy()}))
    torch.testing.assert_close(v, expected, rtol=1e-4, atol=1e-5)


@ONNX
@pytest.mark.slow
def test_a_flow_map_goes_through_the_loop_and_the_page_s_program_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint, sampler = flow("efficient_unet", "flow_map"), build_sampler("jump", steps=3)
    apart = compare(checkpoint, export(checkpoint, "street.onnx", sampler), sampler)
    assert apart.metres < 1e-3
    assert apart.rays == 0
    names: dict = {}
    snippets = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "sample.md").read_text(), flags=re.DOTALL
    )
    exec(next(code for code in snippets if "InferenceSession" in code), names)
    scan, cloud = names["scan"][0], names["cloud"]
    np.testing.assert_allclose(
        np.linalg.norm(cloud, axis=1), scan[0][scan[0] > 0], rtol=1e-5, atol=1e-4
    )
    assert names["notes"]["evaluations"] == 3


@ONNX
@pytest.mark.parametrize(("turning", "ring", "rows"), [(False, True, 60), (True, False, 132)])
def test_nearest_returns_are_those_of_torch(turning, ring, rows):
    import onnxruntime
    from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

    from r2flow.generators.surroundings import _before
    from r2flow.model.onnx_graphs import BEFORE

    returned = torch.rand(2, rows, 16) < 0.03
    returned[:, rows // 3 : rows // 2] = False
    blocks = 1 if rows == 60 else 11
    parts = returned.unflatten(1, (blocks, -1)).movedim(2, 0).numpy()
    steps = torch.tensor([0.8, 0.6, 0.3, 0.4]).view(2, 2, 1, 1)
    how = {"turning": [int(turning)], "ring": [int(ring)], "domain": BEFORE.domain}
    node = make_node("Before", ["parts", "steps"], ["offsets"], **how)
    shapes = {"parts": (9, parts.shape), "steps": (1, steps.shape)}
    inputs = [make_tensor_value_info(name, *value) for name, value in shapes.items()]
    output = make_tensor_value_info("offsets", 1, None)
    versions = [make_opsetid("", 18), make_opsetid(BEFORE.domain, 1)]
    graph = make_graph([node], "before", inputs, [output])
    model = make_model(graph, opset_imports=versions, functions=[BEFORE], ir_version=10)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    (found,) = session.run(None, {"parts": parts, "steps": steps.numpy()})
    offsets = torch.from_numpy(found).movedim(0, 3).flatten(2, 3)
    assert torch.equal(offsets, _before(returned, steps, turning, ring))


@ONNX
@pytest.mark.slow
def test_an_exported_completion_is_that_of_the_flow(tmp_path):
    import onnxruntime

    checkpoint = flow("local", "transfer_flow")
    source = SENSORS["hdl64e"].resized(8, 128)
    written = export_completion(checkpoint, tmp_path / "flow.onnx", source)
    apart = compare_completion(checkpoint, written, source)
    assert apart.metres < 1e-3
    assert apart.reflectance < 1e-3
    assert apart.rays <= 1
    e, a = source.rays().numpy()
    xyz = 9 * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]).reshape(3, -1)
    points = np.vstack([xyz, np.full_like(xyz[:1], 0.5)]).T
    session = onnxruntime.InferenceSession(written.path)
    scan, completed, measured, _ = session.run(None, {"points": points})
    assert scan.shape == (2, 16, 64)
    assert set(map(tuple, completed[measured])) <= set(map(tuple, points))
    ranges = np.linalg.norm(completed[:, :3], axis=1)
    np.testing.assert_allclose(np.sort(ranges), np.sort(scan[0][scan[0] > 0]), rtol=1e-5)


@pytest.fixture(scope="module")
def completion(tmp_path_factory):
    """A flow, the sensor of its scans, and a session of its export."""
    runtime = pytest.importorskip("onnxruntime", reason="the extra 'export'")
    pytest.importorskip("onnxscript", reason="the extra 'export'")
    checkpoint = flow("local", "transfer_flow")
    source = replace(SENSORS["hdl64e"].resized(8, 128), name="eight")
    written = export_completion(checkpoint, tmp_path_factory.mktemp("onnx") / "f.onnx", source)
    return checkpoint, source, runtime.InferenceSession(written.path)


def spheres(source, *radii: float) -> np.ndarray:
    """Points of all rays of a sensor at the distances, one after another, with reflectance 0.5."""
    e, a = source.rays().double().numpy().reshape(2, -1)
    r = np.resize(radii, e.shape)
    xyz = [r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)]
    return np.stack([*xyz, np.full_like(e, 0.5)], axis=1).astype(np.float32)


NAN = np.full((3, 4), np.nan, np.float32)


@pytest.mark.parametrize(
    "odd",
    [
        lambda scan: scan[:0],
        lambda scan: NAN,
        lambda scan: 0 * scan,  # at the origin: rays without a return
        lambda scan: scan * np.float32([400, 400, 400, 1]),  # beyond the range
        lambda scan: scan * np.float32([1e-2, 1e-2, 1e-2, 1]),  # nearer than it
        lambda scan: np.float32([[0, 0, 5, 1], [0, 0, 9, 1]]),  # outside the view
    ],
)
def test_a_scan_without_a_return_in_view_is_refused_and_in_an_export_stays_empty(odd, completion):
    checkpoint, source, session = completion
    points = odd(spheres(source, 9.0))
    scan, completed, measured, error = session.run(None, {"points": points})
    assert not scan.any()
    assert completed.shape == (0, 4)
    assert measured.shape == error.shape == (0,)
    with pytest.raises(InputError):
        checkpoint.complete(points, sensor=source, precision="32-true")


@pytest.mark.parametrize(
    "odd",
    [
        lambda scan: scan[:1],
        lambda scan: scan[:2],
        lambda scan: np.repeat(scan[:1], 9, axis=0),
        lambda scan: np.concatenate([scan[:99], NAN, 0 * scan[:9], scan[99:]]),
        lambda scan: scan[np.abs(scan[:, 1]) < -0.3 * scan[:, 0]],  # at the turn's seam alone
        lambda scan: scan[::-1],
    ],
)
def test_an_export_completes_odd_scans_as_the_flow_does(odd, completion):
    checkpoint, source, session = completion
    points = np.ascontiguousarray(odd(spheres(source, 9.0, 30.0, 79.0)))
    scan, completed, measured, error = session.run(None, {"points": points})
    (expected,) = checkpoint.complete(points, sensor=source, precision="32-true")[0].numpy()
    np.testing.assert_allclose(scan, expected, atol=2e-3)
    whole = checkpoint.completer(source, precision="32-true")(points)
    errors = whole["error_68"][whole["measured"] == 0]
    assert not error[measured].any()
    np.testing.assert_allclose(np.sort(error[~measured]), np.sort(errors), rtol=1e-3)
    assert len(completed) == np.count_nonzero(expected[0])
    given = points[np.isfinite(points).all(axis=1)]
    assert measured.sum() > 0
    assert set(map(tuple, completed[measured])) <= set(map(tuple, given))


def test_an_exported_completion_says_what_it_takes(completion):
    _, source, session = completion
    said = [*session.get_inputs(), *session.get_outputs()]
    assert [value.name for value in said] == ["points", "scan", "completed", "measured", "error_68"]
    assert [value.shape for value in said] == [["N", 4], [2, 16, 64], ["M", 4], ["M"], ["M"]]
    (beside,) = Path(session._model_path).parent.glob("*.json")
    notes = json.loads(beside.read_text())
    assert notes == json.loads(session.get_modelmeta().custom_metadata_map["r2flow"])
    assert notes["image"] == [2, 16, 64]
    assert notes["source"] == json.loads(json.dumps(source.described()))
    assert (notes["sensor"]["min_range"], notes["sensor"]["max_range"]) == (1.45, 80)


@pytest.mark.parametrize(
    ("name", "words"), [("flow.pt2", "is exported as .onnx"), ("flow.onnx", "have all rows")]
)
def test_a_completion_that_cannot_be_exported_is_refused(name, words, tmp_path):
    with pytest.raises(InputError, match=words):
        export_completion(flow("local", "transfer_flow"), tmp_path / name, SENSORS["hdl64e"])
