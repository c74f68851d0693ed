"""Flows that are told a part of the scan."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from r2flow import noise
from r2flow.backbones import BACKBONES
from r2flow.data.loader import FlowDataset
from r2flow.data.sources import InMemory
from r2flow.errors import InputError
from r2flow.flow.problems import Gaussian
from r2flow.generators import ConditionalFlow, build_generator, condition_of
from r2flow.lidar.known import Ray, parse_mask, ray_states
from r2flow.noise import Draws
from r2flow.samplers import build_sampler
from r2flow.stages import build_stage
from r2flow.stages.conditional import Conditional, Tasks

CONFIG = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 32},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {
        "name": "hdit", "base_channels": 16, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16,
        "position": "none", "detail": [1, 8],
    },
}  # fmt: skip


def _by(method: str, steps: int):
    return build_sampler(method, **({"tolerance": 1e-3} if method == "dopri5" else {"steps": steps}))


def built(name: str, **backbone):
    torch.manual_seed(1)
    found = build_generator({**CONFIG, "backbone": CONFIG["backbone"] | backbone, "generator": {"name": name}})
    with torch.no_grad():
        for weight in found.parameters():
            if not weight.any():
                weight.normal_(std=0.05)
    return found.eval()


@pytest.fixture(scope="module")
def flow() -> ConditionalFlow:
    return built("conditional_flow")


@pytest.fixture(scope="module")
def scans() -> torch.Tensor:
    draw = torch.Generator().manual_seed(3)
    images = torch.stack([2 + 70 * torch.rand(3, 8, 32, generator=draw), torch.rand(3, 8, 32, generator=draw)], 1)
    return images * (torch.rand(3, 1, 8, 32, generator=draw) > 0.2)


def measured(images: torch.Tensor, text: str = "rows:4") -> torch.Tensor:
    mask = torch.from_numpy(parse_mask(text)(images.shape[-2:], noise.generator(0, "condition", 0)))
    return ray_states(images, mask)


@pytest.mark.parametrize("stage", ["rectify", "reflow"])
def test_a_stage_that_tells_nothing_refuses_a_generator_that_is_told(stage):
    config = {"data": {"name": "simulated", "batch_size": 4}, "seed": 0, "stage": {"name": stage}}
    with pytest.raises(InputError, match=r"is told a part of each scan.*stage=conditional"):
        build_stage({**CONFIG, **config}, built("conditional_flow"))


def test_known_values_are_encoded_and_the_rest_is_a_guess(flow, scans):
    state = measured(scans)
    told = condition_of(flow.space, scans, state)
    known = (state != Ray.UNKNOWN)[:, None].expand_as(scans)
    assert torch.equal(told["known"] > 0, known)
    assert torch.equal(told["image"][known], flow.space.encoding.encode(scans)[known])
    other = scans.clone()
    other[~known] = 33.0 / 80  # what lies where nobody measured is not read
    other[:, 0] = torch.where(state == Ray.UNKNOWN, torch.tensor(9.0), other[:, 0])
    assert torch.equal(condition_of(flow.space, other, state)["image"], told["image"])


def test_a_scan_without_reflectance_knows_that_of_its_empty_rays_alone(flow, scans):
    told = condition_of(flow.space, scans[:, :1], measured(scans, "rows:1"))
    assert told["known"][:, 0].all()
    assert torch.equal(told["known"][:, 1] > 0, scans[:, 0] == 0)


def test_states_that_contradict_the_image_are_refused(flow, scans):
    for state in (Ray.RETURN, Ray.EMPTY):
        with pytest.raises(InputError, match="the state of a measured ray"):
            condition_of(flow.space, scans, torch.full((3, 8, 32), int(state), dtype=torch.uint8))
    with pytest.raises(InputError, match=r"\(B, 2 or 1, 8, 32\)"):
        condition_of(flow.space, scans[..., :16], measured(scans[..., :16]))


@pytest.mark.parametrize("steps", [1, 3, 16])
def test_known_values_arrive_as_given_and_on_their_line(flow, scans, steps):
    told = condition_of(flow.space, scans, measured(scans))
    draws = Draws(0, range(3))
    x_0, known = draws.start((2, 8, 32)), told["known"] > 0
    made = flow(x_0, told, sampler=build_sampler("euler", steps=steps))
    assert torch.equal(made.x[known], told["image"][known])
    # half-way the known values are on the straight line between noise and scan
    half = flow.solve(x_0, 0.0, 0.5, sampler=build_sampler("euler", steps=steps), condition=told).x
    assert torch.allclose(half[known], ((x_0 + told["image"]) / 2)[known], atol=1e-5)


@pytest.mark.parametrize("method", ["euler", "dopri5", "sde"])
def test_how_far_the_guess_holds_is_found_once(flow, scans, method, monkeypatch):
    told, draws, calls = condition_of(flow.space, scans, measured(scans)), Draws(0, range(3)), []
    how, x_0 = _by(method, 3), draws.start((2, 8, 32))
    made = flow(x_0, told, sampler=how, draws=draws).x
    forward = flow.trust.forward
    monkeypatch.setattr(flow.trust, "forward", lambda x: calls.append(1) or forward(x))
    assert torch.equal(flow(x_0, told, sampler=how, draws=draws).x, made)
    assert len(calls) == 1
    monkeypatch.setattr(
        flow, "_trusted", lambda condition, x: type(flow)._trusted(flow, {n: condition[n] for n in told}, x)
    )
    again = flow(x_0, told, sampler=how, draws=draws).x
    assert len(calls) > 3  # at every evaluation
    assert torch.equal(again, made)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_noise_of_half_precision_is_completed(flow, scans, kind):
    told, x_0 = condition_of(flow.space, scans, measured(scans)), Draws(0, range(3)).start((2, 8, 32)).to(kind)
    half, single = (flow(x, told, sampler=build_sampler("euler", steps=2)).x for x in (x_0, x_0.float()))
    torch.testing.assert_close(half.float(), single, atol=0.05, rtol=0.05)


@pytest.mark.parametrize("method", ["dopri5", "heun2", "rk4", "adams3"])
def test_solvers_that_look_at_the_end_find_no_infinity_there(flow, scans, method):
    told = condition_of(flow.space, scans, measured(scans))
    made = flow(
        Draws(0, range(3)).start((2, 8, 32)),
        told,
        sampler=_by(method, 4),
    )
    assert made.x.isfinite().all()
    assert made.converged.all()


def test_a_rolled_scan_has_rolled_answers(flow, scans):
    x_0 = Draws(0, range(3)).start((2, 8, 32))
    told = condition_of(flow.space, scans, measured(scans, "rows:2+sector:10,80"))
    turned = {name: value.roll(8, -1) for name, value in told.items()}
    plain = flow(x_0, told, sampler=build_sampler("euler", steps=2)).x
    rolled = flow(x_0.roll(8, -1), turned, sampler=build_sampler("euler", steps=2)).x
    assert torch.allclose(rolled, plain.roll(8, -1), atol=1e-4)


@pytest.mark.parametrize("backbone", [{}, {"detail": None}])
def test_it_starts_as_the_flow_that_it_starts_from(backbone, scans):
    parent, child = built("rectified_flow", **backbone), built("conditional_flow", **backbone)
    child.start_from(parent)
    x, t = torch.randn(3, 2, 8, 32), torch.tensor([0.1, 0.5, 0.9])
    told = condition_of(child.space, scans, measured(scans))
    with torch.no_grad():
        expected, unknown = parent.velocity(t, x), told["known"] == 0
        assert torch.allclose(child.velocity(t, x), expected, atol=1e-6)
        logit, sigma = child.trust(torch.cat([told[name] for name in ("image", "known")], dim=1))
        mixed = torch.empty_like(x)
        for index in np.ndindex(*x.shape):  # value by value: a Gaussian about the guess, or what the network says
            guess, std, p = float(told["image"][index]), float(sigma[index]), float(logit[index].sigmoid())
            at, value, v = float(t[index[0]]), float(x[index]), float(expected[index])
            about = float(Gaussian(mean=guess, std=std)(t[index[0]].double(), x[index].double()))
            near = p * norm.pdf(value, at * guess, math.hypot(at * std, 1 - at))
            far = (1 - p) * norm.pdf(value, 0, math.hypot(at * 0.5, 1 - at))
            mixed[index] = (near * about + far * v) / (near + far)
        assert torch.allclose(child.velocity(t, x, told)[unknown], mixed[unknown], atol=1e-4)
        exact = ((told["image"] - x) / (1 - t[:, None, None, None]))[~unknown]
        assert torch.allclose(child.velocity(t, x, told)[~unknown], exact, rtol=1e-4)


@pytest.mark.parametrize("name", ["pyramid", "efficient_unet"])
def test_another_backbone_too_starts_as_the_flow_that_it_starts_from(name):
    config = {**CONFIG, "backbone": {"name": name, **BACKBONES[name].tiny_options()}}
    parent, child = (
        build_generator({**config, "generator": {"name": n}}) for n in ("rectified_flow", "conditional_flow")
    )
    with torch.no_grad():
        for parameter in parent.parameters():
            parameter.normal_(std=0.2)
        child.start_from(parent)
        x, t = torch.randn(3, 2, 8, 32), torch.tensor(0.5)
        assert torch.allclose(child.velocity(t, x), parent.velocity(t, x), atol=1e-5)


def stage_of(kind, generator, **tasks):
    stage = kind(generator, tasks=tasks, warmup_images=0)
    stage.log = lambda *args, **kwargs: None
    return stage


def batch_of(scans: torch.Tensor, space) -> dict[str, torch.Tensor]:
    x_1 = space.encoding.encode(scans)
    return {"x_1": x_1, "x_0": torch.randn_like(x_1), "u": torch.rand(3), "k": torch.arange(3)}


@pytest.mark.parametrize(("purpose", "seeds_differ"), [("training", True), ("validation", False)])
def test_what_is_known_is_a_function_of_seed_and_number_and_in_validation_of_the_number(
    flow, scans, purpose, seeds_differ
):
    source = InMemory(scans.numpy(), ["a", "b", "c"])

    def told(seed: int, k: int) -> dict[str, torch.Tensor]:
        stage = stage_of(Conditional, flow)
        item = FlowDataset(source, flow.space.encoding, seed, purpose, further=stage.further)[(k, 0)]
        return stage.condition({name: value[None] for name, value in item.items()})

    def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
        return all(torch.equal(one[name], other[name]) for name in one)

    assert same(told(1, 7), told(1, 7))
    assert not all(same(told(1, 7), told(1, k)) for k in range(8, 14))
    assert seeds_differ is not all(same(told(1, k), told(2, k)) for k in range(7, 14))


def test_tasks_have_the_shares_that_they_say(flow, scans, monkeypatch):
    half = np.arange(8)[:, None] % 2 == np.zeros(32)
    monkeypatch.setattr("r2flow.stages.conditional._measured", lambda *_: half)
    tasks, count = Tasks(nothing=0.3, silent=0.25), 600
    x_1 = flow.space.encoding.encode(scans)
    told = [tasks(flow.space, x_1[0], noise.generator(0, "condition", k)) for k in range(count)]
    nothing = sum(not one["known"].any() for one in told) / count
    assert abs(nothing - 0.3) < 4 * math.sqrt(0.3 * 0.7 / count)
    returned = scans[0, 0] > 0
    silent = [
        one for one in told
        if one["known"][0][returned].any() and not one["known"][1][returned].any()
    ]  # fmt: skip
    assert abs(len(silent) / count - 0.25 * 0.7) < 4 * math.sqrt(0.175 * 0.825 / count)


def test_nothing_is_learned_of_what_is_known(flow, scans):
    stage = stage_of(Conditional, flow)
    batch = batch_of(scans, flow.space)
    state = ray_states(scans)
    stage.condition = lambda _: condition_of(flow.space, scans, state)  # type: ignore[method-assign]
    assert stage.regression_loss(batch, torch.tensor([0.0, 0.5, 0.99])) < 1e-6


def test_told_nothing_it_is_a_plain_flow(flow):
    x, t, x_0 = torch.randn(2, 2, 8, 32), torch.tensor([0.2, 0.7]), Draws(0, range(2)).start((2, 8, 32))
    plain = flow.untold()
    assert torch.equal(plain.velocity(t, x), flow.velocity(t, x))
    assert torch.equal(plain(x_0).x, flow(x_0).x)


def test_a_plain_flow_that_starts_from_it_forgets_the_condition(flow):
    plain = built("rectified_flow")
    plain.start_from(flow)
    x, t = torch.randn(2, 2, 8, 32), torch.tensor([0.2, 0.7])
    with torch.no_grad():
        assert torch.allclose(plain.velocity(t, x), flow.velocity(t, x), atol=1e-6)
