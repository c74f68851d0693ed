"""Flows whose noise is known: x_1 = M + S x_0, element by element, and a network with random
weights.
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from torch import nn

import r2flow
from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.base.progress import Bar
from r2flow.evaluation.sets import sampled_set
from r2flow.generators import Generator, Sampler, build_generator
from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import completing
from r2flow.model.inversion import interpolate_scans, invert, metres_apart, rms, slerp
from r2flow.model.sampling import draw, sample
from r2flow.reports.outputs import write_samples
from r2flow.runs.composing import compose
from r2flow.samplers import build_sampler
from tests.conftest import CONFIG, SENSOR
from tests.fields import Field

M, S = 0.2, 0.4
SIZE = ["sensor.rows=16", "sensor.columns=32", "encoding.reflectance=true"]


class GaussianFlow(nn.Module):
    """v of x_0 ~ N(0, 1) and x_1 ~ N(M, S^2), independent: the path of a point is t M + S_t x_0."""

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(scale))

    def forward(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        t = t.view(-1, 1, 1, 1) if t.ndim else t
        return self.scale * (M + (t * S**2 - (1 - t)) / ((1 - t) ** 2 + (t * S) ** 2) * (x - t * M))


def flow(model: nn.Module | None = None, **encoding) -> Checkpoint:
    space = ModelSpace(SENSOR, Encoding(SENSOR, **encoding), SENSOR.rays())
    generator = Field((model or GaussianFlow()).requires_grad_(False), space.shape, space)
    return Checkpoint(generator, {"sensor": {}, "encoding": {}}, 0, Path("none"), "r2flow")


def network(reflectance: bool = True, **changes: Any) -> Checkpoint:
    config = {**CONFIG, "encoding": {"format": "logscale", "reflectance": reflectance}, **changes}
    generator = build_generator(config).eval().requires_grad_(False)
    torch.manual_seed(4)
    for parameter in generator.parameters():
        parameter.copy_(0.2 * torch.randn_like(parameter))
    return Checkpoint(generator, config, 0, Path("none"), "r2flow")


def scans(count: int = 2) -> torch.Tensor:
    """Walls with holes, (B, 2, 8, 64)."""
    draw = torch.Generator().manual_seed(7)
    r = 3 + 60 * torch.rand(count, 1, 8, 64, generator=draw)
    r = r * (torch.rand(r.shape, generator=draw) > 0.2)
    return torch.cat([r, torch.rand(r.shape, generator=draw) * (r > 0)], 1)


def apart_in_metres(found):
    return metres_apart(*map(flow().encoding.decode, (found.x_1, found.again)))


@pytest.mark.parametrize(("method", "apart"), [("dopri5", 1e-4), ("rk4", 1e-4), ("euler", 0.2)])
def test_inversion_finds_the_noise(method, apart):
    how = {"tolerance": 1e-6} if method == "dopri5" else {"steps": 64}
    found = invert(flow(), scans(), build_sampler(method, **how))
    expected = (flow().encoding.encode(scans()) - M) / S
    assert (found.x_0 - expected).abs().max() < apart
    assert found.converged.all()
    assert rms(found.again - found.x_1).max() < apart
    if method != "euler":
        median, _, dropped = apart_in_metres(found)
        assert median.max() < 1e-2
        assert dropped.max() < 0.01


@pytest.mark.parametrize(
    ("finish", "expected"), [(0.0, (1 - 0.25) ** 4), (0.1, (1 - 0.3) ** 3 * (1 - 0.1))]
)
def test_a_sampler_needs_a_field_alone_and_passes_gradients(finish, expected):
    # dx/dt = -x in four Euler steps
    plugin = SimpleNamespace(field=lambda condition: lambda t, x: -x)
    x = torch.ones(1, 2, 4, 8, requires_grad=True)
    end = build_sampler("euler", steps=4, finish=finish)(plugin, x, None, None, lambda: None).x
    (gradient,) = torch.autograd.grad(end.sum(), x)
    torch.testing.assert_close([end, gradient], [torch.full_like(x, expected)] * 2)


def test_errors_in_metres_are_what_they_say():
    images = scans(1)
    changed = images.clone()
    changed[0, :, 0, :16] = 0  # 16 columns of the first row lost
    changed[0, 0, 3:] += 0.5 * (images[0, 0, 3:] > 0)  # most of the others
    changed[0, 0, 2, :] += 9 * (images[0, 0, 2] == 0)  # and what was lost in the third one returns
    median, found, dropped = metres_apart(images, changed)
    other = ((images > 0) != (changed > 0))[0, 0].sum() / (8 * 64)
    moved, kept = (images[0, 0, 3:] > 0).sum(), ((images > 0) & (changed > 0))[0, 0].sum()
    assert dropped.item() == pytest.approx(other.item())
    assert median.item() == pytest.approx(0.5, rel=1e-4)
    assert found.item() == pytest.approx(0.5 * (moved / kept).sqrt().item(), rel=1e-3)


def test_extreme_scans_go_there_and_back():
    images = torch.zeros(5, 2, 8, 64)  # the first all dropped
    images[1, :, 3, 40] = torch.tensor([12.0, 0.5])
    images[2, 0], images[3, 0], images[4, 0] = SENSOR.min_range, SENSOR.max_range, 20.0
    images[2:, 1] = 1
    found = invert(flow(), images, build_sampler("dopri5", tolerance=1e-6))
    median, _, dropped = apart_in_metres(found)
    assert found.converged.all()
    assert rms(found.again - found.x_1).max() < 1e-4
    assert median[0].isnan()  # no ray returns: there is nothing to measure in metres
    assert (median[1:] < 0.05).all()
    # a dropped ray, or one at the very limit, stays what it is only as exactly as the solver goes
    assert not dropped[[0, 1, 4]].any()
    assert found.x_0.isfinite().all()


def test_a_scene_with_nan_is_flagged_and_its_neighbours_are_right():
    images = scans(3)
    images[1, 0, 2, 5] = math.nan
    found, alone = invert(flow(), images), invert(flow(), images[::2])
    assert found.converged.tolist() == [True, False, True]
    assert found.x_0[1].isnan().all()
    assert torch.equal(found.x_0[::2], alone.x_0)
    assert torch.equal(found.again[::2], alone.again)
    for errors in (rms(found.again - found.x_1), apart_in_metres(found)[1]):
        assert errors.isnan().tolist() == [False, True, False]


def test_slerp_follows_the_circle():
    # e_1 to e_2 over 90 degrees: (cos, sin) of the angle, by the definition of a circle
    x, y = torch.tensor([3.0, 0, 0]), torch.tensor([0, 3.0, 0])
    w = torch.linspace(0, 1, 7)
    angle = w * math.pi / 2
    torch.testing.assert_close(
        slerp(x, y, w), 3 * torch.stack([angle.cos(), angle.sin(), 0 * w], 1)
    )
    assert torch.equal(slerp(x, y, w[[0, -1]]), torch.stack([x, y]))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-5])
def test_slerp_between_nearly_parallel_ends_is_the_straight_mean(angle):
    x = torch.tensor([1.0, 0.0], dtype=torch.float64)
    y = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    w = torch.tensor([0.25, 0.5])
    torch.testing.assert_close(slerp(x, y, w)[:, 1], w.double() * angle, rtol=1e-6, atol=1e-18)
    assert slerp(x, x, w).tolist() == [[1, 0], [1, 0]]


def test_frames_lie_between_the_scans():
    a, b = scans(2)
    found = interpolate_scans(
        flow(), torch.stack([a, b]), 5, build_sampler("dopri5", tolerance=1e-6)
    )
    assert found.images.shape == (5, 2, 8, 64)
    for frame, scan in ((found.images[0], a), (found.images[-1], b)):
        both = (frame[0] > 0) & (scan[0] > 0)
        torch.testing.assert_close(frame[0][both], scan[0][both], rtol=1e-2, atol=0)
    x_0 = (flow().encoding.encode(torch.stack([a, b])) - M) / S
    middle = flow().encoding.decode(M + S * slerp(*x_0, torch.tensor([0.5])))
    torch.testing.assert_close(found.images[2], middle[0], rtol=1e-2, atol=1e-2)
    assert (found.evaluations > 0).all()
    arrived = []
    interpolate_scans(
        flow(), torch.stack([a, b]), 5, build_sampler("euler"), arrived=arrived.append
    )
    assert arrived == [2, 3, 4, 5]


class Lost(GaussianFlow):
    def forward(self, t, x):
        lost = torch.arange(len(x)).view(-1, 1, 1, 1) == 1
        return torch.where(lost, math.nan, super().forward(t, x))


def test_a_scan_that_is_not_solved_is_flagged_and_said(tmp_path, caplog):
    (drawn,) = sample(flow(Lost()), 3, steps=4, batch_size=3)
    assert drawn.converged.tolist() == [True, False, True]
    (others,) = sample(flow(), 3, steps=4, batch_size=3)
    assert torch.equal(drawn.images[::2], others.images[::2])
    write_samples(
        flow(Lost()), tmp_path, 3, 0, build_sampler("euler", steps=4), pictures=0, batch_size=3
    )
    assert "not solved, so no scans of this flow: 1" in caplog.text
    caplog.clear()
    flow(Lost()).sample(4, steps=4, batch_size=2)  # the second of each batch is lost
    flow(Lost()).complete(torch.zeros(2, 2, 8, 64), num=2, batch_size=2)
    said = [
        record.getMessage().partition("flow: ")[2].partition(";")[0] for record in caplog.records
    ]
    assert said == ["1", "3", "1 of the answers to scan 0", "1 of the answers to scan 1"]


def test_a_stopped_call_goes_on_and_other_samples_are_replaced_or_kept(tmp_path, monkeypatch):
    def names() -> list[str]:
        return sorted(path.name for path in tmp_path.glob("*.npy"))

    def write(num: int, seed: int = 0, **options) -> list[int]:
        drawn: list[int] = []
        monkeypatch.setattr(
            "r2flow.reports.outputs.draw",
            lambda *asked, **how: drawn.extend(asked[1]) or draw(*asked, **how),
        )
        how = build_sampler("euler", steps=2)
        write_samples(
            checkpoint,
            tmp_path,
            num,
            seed,
            how,
            ["npy", "ply"],
            pictures=0,
            batch_size=2,
            **options,
        )
        return drawn

    checkpoint = flow()
    assert write(4) == [0, 1, 2, 3]
    whole = {name: (tmp_path / name).read_bytes() for name in names()}
    (tmp_path / "000001.npy").unlink()
    monkeypatch.setattr("r2flow.reports.outputs.Bar", bar := mock.Mock(wraps=Bar))
    with mock.patch("r2flow.store.Store.begin", autospec=True) as begun:  # once, not for each batch
        assert (write(5), bar.call_args.args[1], begun.call_count) == ([0, 1, 4], 3, 1)
    assert {name: (tmp_path / name).read_bytes() for name in names()[:4]} == whole
    with pytest.raises(InputError, match="holds other samples: seed=0 there, 1 here"):
        write(2, seed=1)
    assert names() == [f"{number:06d}.npy" for number in range(5)]
    monkeypatch.setattr("r2flow.reports.outputs.draw", mock.Mock(side_effect=MemoryError))
    with pytest.raises(MemoryError):
        write_samples(
            checkpoint, tmp_path, 2, 1, build_sampler("euler", steps=2), ["npy"], replace=True
        )
    assert names() == [f"{number:06d}.npy" for number in range(5)]
    assert write(2, seed=1, replace=True) == [0, 1]
    assert names() == ["000000.npy", "000001.npy"]
    assert write(3, replace=True) == [0, 1, 2]
    assert (tmp_path / "000000.npy").read_bytes() == whole["000000.npy"]
    (tmp_path / "camera").mkdir()
    (tmp_path / "camera" / "000000.png").write_text("")
    with pytest.raises(InputError, match=r"000000.png and no manifest.json"):
        write_samples(checkpoint, tmp_path / "camera", 1, 0)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"\.(npy|ply)\) and no manifest.json"):
        write(3)


def test_numeric_times_decide_the_number_of_steps():
    own = build_sampler("euler", grid=(0.0, 0.3, 1.0))
    assert own.steps == 2
    assert own.changed(steps=4) == build_sampler("euler", steps=4)
    with pytest.raises(InputError, match="2 steps"):
        build_sampler("euler", steps=3, grid=(0.0, 0.3, 1.0))
    with pytest.raises(InputError, match="its own last step: give finish=0"):
        build_sampler("sde", grid=(0.0, 0.3, 1.0))
    (drawn,) = sample(flow(), 1, sampler=build_sampler("sde", grid=(0.0, 0.3, 1.0), finish=0.0))
    assert drawn.evaluations == 2


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"grid": ("a", "b")}, "grid"),
        ({"steps": 1.5}, "steps"),
        ({"sampler": "dopri5", "tolerance": "x"}, "tolerance"),
        ({"sampler": "sde", "finish": 1.5}, "finish"),
        ({"sampler": "sde", "churn": -1.0}, "churn"),
        ({"sampler": "jump"}, "map"),
        ({"precision": "16-mixed"}, "32-true or bf16-mixed, found '16-mixed'"),
        ({"condition": {"known": torch.ones(3, 1, 8, 32)}}, "condition"),
    ],
)
def test_settings_of_another_type_are_refused(changes, word):
    with pytest.raises(InputError, match=word):
        next(sample(flow(), 1, **changes))


def test_the_network_is_computed_in_the_precision_that_is_asked_for():
    one, seen = network(), []
    linear = next(m for m in one.generator.modules() if type(m) is nn.Linear)
    linear.register_forward_hook(lambda module, given, made: seen.append(made.dtype))
    exact, coarse = (
        next(sample(one, 2, steps=3, precision=name)).images for name in ("32-true", "bf16-mixed")
    )
    assert seen == [torch.float32] * 3 + [torch.bfloat16] * 3
    # bfloat16 has 8 bits, of which some products take a few
    assert 0 < (exact - coarse).norm() < 2**-4 * exact.norm()
    with torch.autocast("cpu", torch.bfloat16):  # of the caller
        assert torch.equal(next(sample(one, 2, steps=3)).images, exact)
    assert sampled_set(one, "", 2).about != sampled_set(network(), "", 2).about


def test_a_samplers_name_may_have_fields_as_on_the_command_line():
    short = build_sampler("adams3", steps=2, finish=0.02)
    assert flow().generator.choose("adams3:steps=9:finish=0.02", steps=2) == short
    assert build_sampler("euler:grid=[0,1e-3,1]").grid == (0, 0.001, 1)
    with pytest.raises(InputError, match="cannot be read"):
        flow().generator.choose("adams3:grid=[0")
    assert completing(flow().generator, "repaint:steps=010") == completing(
        flow().generator, "repaint", steps=10
    )


def test_settings_may_be_numpy_s_and_torch_s():
    own = build_sampler("euler", steps=2)
    assert (
        own.changed(steps=np.int64(4))
        == build_sampler("euler", steps=np.int64(4))
        == own.changed(steps=4)
    )
    for grid in (torch.tensor([0.0, 0.25, 1.0]), np.array([0, 0.25, 1])):
        assert (
            own.changed(grid=grid)
            == build_sampler("euler", grid=grid)
            == own.changed(grid=[0, 0.25, 1])
        )


def test_a_seed_is_a_whole_number_of_python_or_numpy():
    assert torch.equal(flow().sample(1, np.uint8(3), steps=1), flow().sample(1, 3, steps=1))
    for seed in (1.9, 1.0, "1", math.nan, -1):
        with pytest.raises(InputError, match="a seed must .* found"):
            flow().sample(1, seed, steps=1)


@pytest.mark.parametrize("method", ["ddim", "ddpm"])
def test_a_diffusion_walks_noise_of_half_precision_in_float32(method):
    walker = build_generator(
        compose(["experiment=r2dm", "size=small", "backbone.base_channels=8", *SIZE])
    ).eval()
    draws, seen = Draws(0, range(2)), []
    noise, how = draws.start(walker.noise_shape).bfloat16(), build_sampler(method, steps=4)
    half, full = (walker(one, sampler=how, draws=draws).x for one in (noise, noise.float()))
    assert torch.equal(half, full)
    walker.double().backbone.register_forward_pre_hook(lambda _, given: seen.append(given[0].dtype))
    walker(noise.double(), sampler=how, draws=draws)
    assert seen == [torch.float64] * 4  # log-SNRs


TINY = ["backbone=hdit_tiny", "backbone.base_channels=16", "backbone.num_heads=[1,2,4]"]


@pytest.mark.parametrize(
    ("words", "sampler"),
    [
        (TINY, build_sampler("euler", steps=2)),
        (TINY, build_sampler("sde", steps=2)),
        ([*TINY, "+generator.name=flow_map"], build_sampler("jump", steps=3)),
        ([*TINY, "+generator.name=flow_map"], build_sampler("renoise", steps=2)),
        (["experiment=r2dm", "size=small"], build_sampler("ddpm", steps=2)),
        (["experiment=r2dm", "size=small"], build_sampler("ddim", eta=0, steps=1)),
        (
            ["experiment=lidargen", "size=small", "generator.levels=2"],
            build_sampler("langevin", steps=1),
        ),
        (
            ["experiment=vanilla_gan", "size=small", "generator.base_channels=4"],
            build_sampler("direct"),
        ),
        (["experiment=dusty2", "size=small", "generator.base_channels=4"], build_sampler("direct")),
    ],
)
def test_a_scan_that_leaves_the_numbers_is_flagged_whatever_is_clamped(
    words: list[str], sampler: Sampler
):
    def without_end(_: nn.Module, __: Any, found: Any) -> Any:
        if isinstance(found, dict):
            return {name: without_end(_, __, value) for name, value in found.items()}
        found = found.clone()
        found[:1] = math.inf
        return found

    generator: Generator = build_generator(compose([*words, *SIZE])).eval()
    (getattr(generator, "backbone", None) or generator.network).register_forward_hook(without_end)
    draws = Draws(0, range(3))
    made = generator(draws.start(generator.noise_shape), sampler=sampler, draws=draws)
    assert made.converged.tolist() == [False, True, True]


def test_a_sampled_set_says_all_that_its_scans_depend_on():
    street = r2flow.load("street")

    def about(**settings: Any) -> dict[str, Any]:
        return dict(sampled_set(street, "street", 2, street.generator.choose(**settings)).about)

    found = [about(), about(name="sde", churn=2), about(steps=8)]
    found += [about(name="dopri5", tolerance=tolerance) for tolerance in (1e-2, 1e-4)]
    assert all(a != b for i, a in enumerate(found) for b in found[:i])
