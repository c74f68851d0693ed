"""Flows from a scan with hidden rays to the whole scan."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.data.datamodule import ScanDataModule
from r2flow.generators import TransferFlow, build_generator, condition_of, surroundings
from r2flow.generators.answers import TOGETHER, Answers, smoothed
from r2flow.generators.surroundings import Surroundings
from r2flow.lidar.known import Ray, parse_mask, ray_states
from r2flow.lidar.sensors import build_sensor
from r2flow.model.completion import completing
from r2flow.samplers import build_sampler
from r2flow.samplers.maps import Transport
from r2flow.simulator import simulate
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Rectify, Reflow
from r2flow.stages.transfer import Tasks, Transfer, coarser
from tests import fields
from tests.conftest import tiny_options

CONFIG = {**fields.CONFIG, "backbone": {"name": "local", "channels": 16, "dilations": [1, 2]}}


def built(nought: bool = False, **changed) -> TransferFlow:
    torch.manual_seed(1)
    flow = build_generator({**CONFIG, **changed, "generator": {"name": "transfer_flow"}})
    with torch.no_grad():
        for weight in flow.parameters():
            if not (weight.any() or nought):
                weight.normal_(std=0.05)
    return flow.eval()


@pytest.fixture(scope="module")
def flow() -> TransferFlow:
    return built()


@pytest.fixture(scope="module")
def scans() -> torch.Tensor:
    draw = torch.Generator().manual_seed(3)
    images = torch.stack(
        [2 + 70 * torch.rand(3, 8, 32, generator=draw), torch.rand(3, 8, 32, generator=draw)], 1
    )
    return images * (torch.rand(3, 1, 8, 32, generator=draw) > 0.2)


def measured(images: torch.Tensor, text: str = "rows:4") -> torch.Tensor:
    mask = torch.from_numpy(
        parse_mask(text)(np.ones(images.shape[-2:], bool), noise.generator(0, "condition", 0))
    )
    return ray_states(images, mask)


def answered(
    flow: TransferFlow,
    images: torch.Tensor,
    state: torch.Tensor,
    sampler: str = "jump:steps=1",
    **how,
):
    condition = condition_of(flow.space, images, state)
    draws = Draws(0, range(len(images)))
    return flow(
        draws.start(flow.noise_shape), condition, sampler=build_sampler(sampler), draws=draws, **how
    )


@pytest.mark.parametrize(
    "sampler", ["jump:steps=1", "jump:steps=4", "euler:steps=3", "sde:steps=3:churn=0"]
)
@pytest.mark.parametrize("mask", ["rows:4", "points:0.3"])
def test_known_rays_come_back_to_the_bit_and_the_others_within_the_sensor(
    flow, scans, sampler, mask
):
    state = measured(scans, mask)
    known = condition_of(flow.space, scans, state)
    for each in (flow, copy.deepcopy(flow).bfloat16()):
        made = answered(each, scans, state, sampler)
        assert torch.equal(made.x[known["known"] > 0], known["image"][known["known"] > 0])
        r = flow.space.decode(made.x)[:, 0]
        assert made.converged.all()
        assert ((r == 0) | ((r >= 1.45) & (r <= 80))).all()
    assert len(answered(flow, scans[:0], state[:0], sampler).x) == 0


def test_before_it_has_learned_a_plane_comes_back_whole():
    """1 / r is linear in the tangent of elevation on the ground, and so in the rows of a narrow
    view.
    """
    flow = built(nought=True, sensor={"name": "hdl64e", "rows": 64, "columns": 32})
    elevation = flow.space.rays[0]
    r = torch.where(elevation < math.radians(-5), 1.73 / (-elevation).sin().clamp(min=1e-3), 0)
    images = torch.stack([r, torch.full_like(r, 0.4)])[None] * (r > 0)
    state = measured(images, "rows:2")
    answer = flow.space.decode(answered(flow, images, state).x)[0]
    inner = (r > 0) & (r.roll(1, 0) > 0) & (r.roll(-1, 0) > 0) & (state[0] == Ray.UNKNOWN)
    assert inner.sum() > 500
    # a chord's sagitta: step^2 / 2 = 3e-5, and float32
    assert ((answer[0] - r).abs() / r)[inner].max() < 1e-3
    assert answer[1][inner].allclose(torch.tensor(0.4), atol=1e-5)


def test_the_answer_does_not_depend_on_what_is_hidden(flow, scans):
    state = measured(scans)
    other = torch.where((state == Ray.UNKNOWN)[:, None], scans.roll(5, 3), scans)
    assert torch.equal(answered(flow, scans, state).x, answered(flow, other, state).x)


def test_the_intensities_of_another_sensor_may_have_any_scale(flow, scans):
    other, runs = flow.at(flow.space.through(build_sensor("vlp16", 8, 32))), []
    bright, dim = (scans * torch.tensor([1.0, share])[:, None, None] for share in (0.4, 0.1))
    state = measured(scans)
    one, quarter = (
        other.space.decode(answered(other, images, state).x) for images in (bright, dim)
    )
    torch.testing.assert_close(
        quarter, one * torch.tensor([1.0, 0.25])[:, None, None], rtol=1e-4, atol=1e-5
    )
    assert one[:, 1].max() > 0.1
    counted = other.backbone.register_forward_hook(lambda *_: runs.append(1))
    for other.twice in (True, False):
        runs.clear()
        assert answered(other, bright, state).evaluations.tolist() == [len(runs)] * len(scans)
        assert len(runs) == 2 + other.twice
    counted.remove()


@pytest.mark.parametrize("useful", [1.0, 0.3, 0.0])
def test_the_correction_of_reflectance_is_tried_on_measured_rows(useful, monkeypatch):
    """The network adds 0.2 / gain. Of the measured rows every second has `useful` of it."""
    flow = built(nought=True)
    torch.nn.init.constant_(flow.backbone.answer.bias[-1:], 0.2)
    flow = flow.at(flow.space.through(build_sensor("vlp16", 8, 32)))
    images = torch.stack([torch.full((1, 8, 32), 9.0), torch.full((1, 8, 32), 0.3)], 1)
    # v = 0.3 + useful * 0.2 / gain, and gain = 0.265 / ((0.3 + v) / 2)
    k = useful * 0.1 / surroundings._REFLECTANCE
    images[:, 1, 2::4] *= (1 + k) / (1 - k)
    shares = []
    given = flow._estimate
    monkeypatch.setattr(
        flow, "_estimate", lambda *args: shares.append(args[-1]["share"].item()) or given(*args)
    )
    answered(flow, images, measured(images, "rows:2"))
    answered(flow, images[:, :1], measured(images, "rows:2"))
    assert shares == [pytest.approx(useful), 1]  # the second: nothing to try it on


def test_bright_returns_of_another_sensor_are_not_cut_off(flow):
    """Only the network's inputs are limited, to 1 by the gain."""
    flow = copy.deepcopy(flow)
    torch.nn.init.constant_(flow.backbone.answer.bias[-2:-1], 9.0)  # all return
    other = flow.at(flow.space.through(build_sensor("vlp16", 8, 32)))
    images = torch.stack([torch.full((1, 8, 32), 9.0), torch.full((1, 8, 32), 0.02)], 1)
    images[:, 1, :, :4] = 0.9
    state = ray_states(images, torch.ones(8, 32, dtype=torch.bool))
    state[:, 1:4, :4] = Ray.UNKNOWN
    made = other.space.decode(answered(other, images * (state > 0)[:, None], state).x)
    assert made[0, 1, 1:4, 1].mean() > 0.6


def test_the_returns_of_another_sensor_are_those_of_higher_rows(flow, scans):
    other, state = copy.copy(flow), condition_of(flow.space, scans, measured(scans))
    other.foreign, steps = True, torch.full((3, 2), 0.01)
    about, elevations = (
        Surroundings.of(flow.space, state, True, steps),
        flow.elevations.expand(3, -1),
    )
    rows, raised = (
        flow.rows(e, steps, torch.zeros(3) > 0) for e in (elevations, elevations + math.radians(3))
    )
    t, x = torch.zeros(()), about.start
    assert torch.equal(x[state["known"] > 0], state["image"][state["known"] > 0])
    found, same, above = (
        f.answers(t, x, about, r) for f, r in ((other, rows), (flow, rows), (flow, raised))
    )
    torch.testing.assert_close((found.ranges, found.returns), (same.ranges, above.returns))
    assert not torch.equal(same.returns, above.returns)


def test_a_flow_for_another_sensor_starts_as_the_parents_answer_to_any_sensor(flow, scans):
    other, images = (
        built(sensor={"name": "vlp16", "rows": 16, "columns": 64}),
        scans[:, :1].repeat(1, 1, 2, 2),
    )
    torch.nn.init.zeros_(other.backbone.answer.weight)
    other.start_from(flow)
    state = measured(images)
    mine, parents = (
        f.space.decode(answered(f, images, state).x)[:, 0] for f in (other, flow.at(other.space))
    )
    both = (mine > 0) & (parents > 0)
    assert both.float().mean() > 0.5
    assert torch.equal(mine[both], parents[both])


def test_a_turned_scan_has_a_turned_answer(flow, scans):
    state = measured(scans)
    noise_free = TransferFlow(flow.space, CONFIG["backbone"], sigma=0.0).eval()
    noise_free.load_state_dict(flow.state_dict())
    one, turned = (answered(noise_free, scans.roll(by, 3), state.roll(by, 2)).x for by in (0, 7))
    torch.testing.assert_close(turned, one.roll(7, 3), rtol=0, atol=2e-5)


@pytest.fixture
def answers() -> Answers:
    draw = torch.Generator().manual_seed(5)
    ranges, scales, logits = torch.randn(3, 1, 7, 1, 1, generator=draw, dtype=torch.float64)
    nothing = torch.zeros_like(logits)
    scales = scales.abs() / 4 + 0.1
    return Answers(logits.log_softmax(1), ranges, scales, nothing[:, :1], nothing, nothing[:, :0])


def test_reflectance_is_a_mean_of_logarithms_by_the_roots_of_the_probabilities(flow):
    p = torch.tensor([0.2, 0.8, 0, 0, 0, 0, 0])[None, :, None, None]
    strengths = torch.linspace(0.1, 0.7, 7)[None, :, None, None]
    returns = torch.ones(1, 1, 1, 1)
    logits = p.clamp(min=1e-30).log()
    sure = Answers(logits, 2 + 0 * p, 0 * p + 0.1, returns, strengths, p[:, :0])
    made = flow.space.decode(flow._chosen(sure))[0, :, 0, 0]
    # roots 1 : 2, and 0.1 + 0.1 added before the logarithm
    expected = (0.2 * 0.3**2) ** (1 / 3) - 0.1
    torch.testing.assert_close(made, torch.tensor([math.exp(2), expected]))


@pytest.mark.parametrize("scale", [0.002, 0.02, 1.0])
def test_a_return_of_another_sensor_must_be_the_likelier_the_less_its_range_is_known(flow, scale):
    """Wrong ray-drop costs 1, a return more than 0.1 m off a half, within a Laplace density."""
    nothing = torch.zeros(1, 7, 50, 1)
    logits = torch.tensor([0.0, *[-1e4] * 6])[None, :, None, None].expand_as(nothing)
    likely = torch.linspace(0.02, 0.98, 50)[None, None, :, None]
    ranges = nothing + math.log(10)
    scales = nothing + scale
    answers = Answers(logits, ranges, scales, likely.logit(), nothing, nothing[:, :0])
    off = 1 - min(2 * 0.1 / 10 / (2 * scale), 1)  # by the density at the range
    other = flow.at(flow.space.through(build_sensor("vlp16", 50, 32)))
    returned = other.space.decode(other._chosen(answers))[:, :1] > 0
    assert torch.equal(returned, likely * off / 2 + (1 - likely) < likely)


def integral(answers: Answers, end: float, weight=lambda x: 1.0) -> float:
    def weighed(x: float) -> float:
        return weight(x) * float(
            answers.log_density(torch.tensor(x, dtype=torch.float64).reshape(1, 1, 1, 1)).exp()
        )

    kinks = sorted(x for x in answers.ranges.flatten().tolist() if x < end)
    return quad(weighed, -12, end, points=kinks or None, limit=200)[0]


def test_the_density_is_one_and_its_expected_error_that_of_an_integral(answers):
    assert integral(answers, 12) == pytest.approx(1, abs=1e-4)
    off = [
        integral(answers, 12, lambda x, m=m: abs(x - m)) for m in answers.ranges.flatten().tolist()
    ]
    assert int(answers.least_error()) == int(np.argmin(off))


@pytest.mark.parametrize("u", [0.02, 0.3, 0.5, 0.95])
def test_a_quantile_is_where_the_density_has_its_share(answers, u):
    assert integral(answers, float(answers.quantile(torch.full((1, 1, 1, 1), u)))) == pytest.approx(
        u, abs=1e-4
    )


def test_transported_answers_return_as_often_as_expected_and_keep_what_is_known(flow, scans):
    state = measured(scans)
    condition = condition_of(flow.space, scans[:1], state[:1])
    many = {name: value.expand(400, -1, -1, -1) for name, value in condition.items()}
    draws = Draws(0, range(400))
    made = flow(
        draws.start(flow.noise_shape), many, sampler=build_sampler("transport"), draws=draws
    )
    known = many["known"] > 0
    assert torch.equal(made.x[known], many["image"][known])
    assert (made.evaluations == 1).all()
    share = (flow.space.decode(made.x)[:, 0] > 0).float().mean(0)
    seen: list[Answers] = []
    given, flow.answers = flow.answers, lambda *args: seen.append(given(*args)) or seen[-1]
    flow(torch.zeros(1, *flow.noise_shape), condition, sampler=build_sampler("transport"))
    sharp = flow(
        draws.start(flow.noise_shape)[:1], condition, sampler=build_sampler("transport:residual=0")
    )
    del flow.answers
    hidden = (state[0] == Ray.UNKNOWN) & (share > 0)
    off = (share - seen[0].returns.sigmoid()[0, 0])[hidden]
    assert off.abs().max() < 0.15  # six standard errors of 400 draws
    assert off.mean().abs() < 0.01
    r = flow.space.decode(sharp.x)[:, :1]
    near = (seen[1].ranges - r.clamp(min=1e-3).log()).abs().amin(1, keepdim=True)
    # each ray is one of its candidates
    assert near[(r > 0) & (state[:1, None] == Ray.UNKNOWN)].max() < 1e-4


def test_smoothed_noise_is_standard_normal_and_agrees_within_the_correlation_length():
    elevations = torch.linspace(0.05, -0.05, 5)
    hidden = torch.rand(1, 1, 5, 64, generator=torch.Generator().manual_seed(0)) < 0.7
    units = torch.eye(5 * 64).reshape(-1, 1, 5, 64)  # a linear map: these are its columns
    matrix = (
        smoothed(units, hidden.expand(len(units), -1, -1, -1), elevations)
        .reshape(len(units), -1)
        .T.double()
    )
    covariance = matrix @ matrix.T
    rays = torch.cartesian_prod(torch.arange(5), torch.arange(64))[hidden.flatten()]
    covariance = covariance[hidden.flatten()][:, hidden.flatten()]
    assert covariance.diagonal().allclose(torch.ones(len(rays), dtype=torch.float64), atol=1e-5)
    along = (rays[:, None, 1] - rays[:, 1]).abs()
    along = torch.minimum(along, 64 - along) * 2 * math.pi / 64  # ends meet
    down = (rays[:, None, 0] - rays[:, 0]).double() * 0.025
    weights = torch.exp(-(down**2 + along**2) / (2 * TOGETHER**2))  # of every pair, not cut off
    weights /= weights.norm(dim=1, keepdim=True)
    torch.testing.assert_close(covariance, weights @ weights.T, rtol=0, atol=2e-3)


def test_several_answers_are_drawn_by_transport(flow):
    assert completing(flow).name == "jump"
    assert completing(flow, several=True).name == "transport"
    assert completing(flow, "jump", several=True, steps=4).steps == 4


def test_the_velocity_leads_to_the_mean_of_the_answers(flow, scans, monkeypatch):
    seen: list[Answers] = []
    given = flow.answers
    monkeypatch.setattr(flow, "answers", lambda *args: seen.append(given(*args)) or seen[-1])
    state = measured(scans)
    x = answered(flow, scans, state, "euler:steps=1").x
    (answers,) = seen
    p, q = answers.logits.exp().double().numpy(), answers.returns.sigmoid().double().numpy()[:, 0]
    r = np.exp(answers.ranges.double().numpy()).clip(1.45, 80)
    # the paper's eq. 5; -1 is no return
    mean = q * (p * (2 * np.log2(r + 1) / np.log2(81) - 1)).sum(1) - (1 - q)
    # rows beyond the measured ones stay empty
    hidden = (state == Ray.UNKNOWN).numpy() & (x[:, 0] != -1).numpy()
    assert hidden.sum() > 300
    assert np.allclose(x[:, 0].numpy()[hidden], mean[hidden], atol=1e-5)


@pytest.mark.parametrize("sampler", ["jump:steps=1", "transport"])
def test_a_measured_return_without_reflectance_has_one(scans, sampler):
    flow = built(nought=True)
    with torch.no_grad():
        flow.backbone.answer.bias[-2:] = torch.tensor([-9.0, 0.4])  # a hidden ray would not return
    image = flow.space.decode(answered(flow, scans[:, :1], ray_states(scans), sampler).x)
    returned = scans[:, 0] > 0
    assert torch.equal(image[:, 0] > 0, returned)
    assert image[:, 1][returned].allclose(torch.tensor(0.4), atol=1e-5)


def test_rows_far_beyond_the_measured_ones_stay_empty(flow):
    images = torch.full((1, 2, 8, 32), 0.5)
    images[:, 0] = 20
    state = torch.zeros(1, 8, 32, dtype=torch.uint8)
    state[:, [3, 5]] = int(Ray.RETURN)
    r = flow.space.decode(answered(built(nought=True), images, state).x)[0, 0]
    assert (r > 0).all(1).tolist() == [False, False, True, True, True, True, True, False]


@pytest.mark.parametrize("sensor", ["hdl64e", "vlp16"])
def test_rows_and_rays_left_out_change_no_answer(sensor, monkeypatch):
    flow = built()
    flow = flow.at(flow.space.through(build_sensor(sensor, 48, 32)))
    images = 0.1 + 0.8 * torch.rand(2, 2, 48, 32, generator=torch.Generator().manual_seed(2))
    images[:, 0] = 40 * images[:, 0] * (images[:, 1] > 0.3)
    images[:, 1] *= images[:, 0] > 0
    mask = torch.zeros(2, 48, 32, dtype=torch.bool)
    mask[0, 14:20:2] = mask[1, 18:26:4] = True
    seen = []
    network = flow.backbone.forward
    monkeypatch.setattr(flow.backbone, "forward", lambda t, x: seen.append(x) or network(t, x))
    found = answered(flow, images * mask[:, None], ray_states(images, mask)).x
    assert seen[-1].shape[2] < 48
    every = lambda *how: flow._chosen(flow._answered(*how))  # noqa: E731
    monkeypatch.setattr(flow, "_estimate", every)
    expected = answered(flow, images * mask[:, None], ray_states(images, mask)).x
    assert seen[-1].shape[2] == 48
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    assert (found != expected[0, :, 0, 0, None, None]).any(1).sum() > 200  # returns


def test_a_ray_between_two_returns_of_its_row_starts_between_them(flow):
    images = torch.zeros(1, 2, 8, 32)
    images[0, :, 4, [0, 4]] = torch.tensor([[10.0, 30.0], [0.4, 0.8]])
    state = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.UNKNOWN))
    about = Surroundings.of(
        flow.space, condition_of(flow.space, images, state), True, torch.full((1, 2), 0.01)
    )
    # linear in 1 / r
    assert flow.space.decode(about.start)[0, :, 4, 1].tolist() == pytest.approx([12, 0.5], rel=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.002, 0.1])
@pytest.mark.parametrize("ring", [True, False])
def test_nearest_returns_are_the_same_in_blocks_and_column_by_column(share, ring, monkeypatch):
    returned = torch.rand(2, 8, 144, generator=torch.Generator().manual_seed(5)) < share
    steps = torch.tensor([[0.01, 0.004], [0.007, 0.006]])
    found = surroundings.nearest_returns(returned, steps, ring)
    monkeypatch.setattr(surroundings, "_FEW", 144)
    assert torch.equal(found, surroundings.nearest_returns(returned, steps, ring))
    left = found[2]  # rows and columns, (2, B, H, W)
    scan, row, column = left.isfinite().all(0).nonzero().T
    down, across = left[:, scan, row, column].long()
    assert returned[scan, row + down, (column + across) % 144].all()
    assert len(scan) == 0 or share > 0


def test_a_coarser_image_has_the_nearest_return_of_each_block(flow):
    images = torch.zeros(1, 2, 8, 32)
    images[0, :, 3, 5] = torch.tensor([30.0, 0.25])
    images[0, :, 2, 6] = torch.tensor([12.0, 0.75])
    small = flow.space.decode(coarser(flow.space, flow.space.encoding.encode(images)[0])[None])[0]
    assert small.shape == (2, 4, 8)
    assert small[:, 1, 1].tolist() == pytest.approx([12, 0.75], abs=1e-4)
    assert int((small[0] > 0).sum()) == 1


def test_a_part_of_a_scan_and_what_is_known_of_it_depend_on_the_image_alone(flow, scans):
    x_1, tasks = flow.space.encoding.encode(scans[0]), Tasks(rows=4, columns=16)
    parts = [
        [
            tasks(flow.space, x_1, flow.space.sensor, noise.generator(0, "condition", k))
            for k in range(40)
        ]
        for _ in range(2)
    ]
    for one, other in zip(*parts, strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one.keys() | other.keys())
        assert one["x_1"].shape == (2, 4, 16)
        assert torch.equal(one["image"], one["x_1"] * one["known"])
    # of a sensor of few beams one, any of them
    rows = [one["known"][0].mean(1).tolist() for one in parts[0]]
    assert {row.index(1) for row in rows if sum(row) == max(row) == 1} == {0, 1, 2, 3}
    rng = noise.generator(0, "condition", 0)
    silent = Tasks(rows=4, columns=16, silent=0.99)(flow.space, x_1, flow.space.sensor, rng)
    assert silent["known"][0].any()
    assert not silent["known"][1].any()
    often, small = Tasks(rows=4, columns=8, halved=0.99), coarser(flow.space, x_1)
    half = often(flow.space, x_1, flow.space.sensor, rng)
    assert any(torch.equal(half["x_1"], small.roll(k, 2)) for k in range(8))
    pairs = np.reshape(flow.space.sensor.elevations, (4, 2)).mean(1)
    assert half["elevations"].rad2deg().tolist() == pytest.approx(pairs)
    assert half["steps"][1].item() == pytest.approx(2 * math.pi / 8)
    for shape in ((9, 64), (8, 66)):  # not in whole blocks of 2 x 4 pixels
        often, sensor = Tasks(rows=4, columns=16, halved=0.99), build_sensor("hdl64e", *shape)
        assert often(flow.space, torch.zeros(2, *shape), sensor, rng)["x_1"].shape == (2, 4, 16)


def test_what_it_learns_from_lowers_the_loss(scans, monkeypatch):
    learner = Transfer(generator=built(nought=True))
    learner.log = lambda *_, **__: None
    x_1 = learner.generator.space.encoding.encode(scans)
    sensor = learner.generator.space.sensor
    further = learner.item_format.further
    one = [further(x, sensor, noise.generator(0, "condition", k)) for k, x in enumerate(x_1)]
    batch = {name: torch.stack([part[name] for part in one]) for name in one[0]}
    batch |= {"x_0": torch.randn(x_1.shape), "k": torch.arange(3)}
    u, by = torch.tensor([0.2, 0.6, 0.9]), torch.optim.Adam(learner.parameters(), 1e-2)
    learner.eval()  # in validation the scans count alike in any batch
    alone = [
        learner.regression_loss({n: v[[i]] for n, v in batch.items()}, u[[i]]).item()
        for i in range(3)
    ]
    assert learner.regression_loss(batch, u).item() == pytest.approx(sum(alone) / 3, rel=1e-5)
    learner.train()
    losses = []
    for _ in range(30):
        loss = learner.regression_loss(batch, u)
        by.zero_grad()
        loss.backward()
        by.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] - 0.5
    assert all(p.grad is not None and p.grad.isfinite().all() for p in learner.parameters())
    counts: list[torch.Tensor] = []
    monkeypatch.setattr(
        "r2flow.generators.transfer.mean_over_processes",
        lambda count: counts.append(count) or count,
    )
    whole = learner.regression_loss(batch, u).item()
    # the mean over two devices, one with a scan, one with two
    halves = iter([count / 2 for count in counts] * 2)
    monkeypatch.setattr(
        "r2flow.generators.transfer.mean_over_processes", lambda count: next(halves)
    )
    parts = [
        learner.regression_loss({n: v[at] for n, v in batch.items()}, u[at])
        for at in (slice(1), slice(1, 3))
    ]
    assert sum(parts).item() / 2 == pytest.approx(whole, rel=1e-5)


def test_a_batch_has_crops_of_several_sensors():
    learner = Transfer(generator=built(nought=True), tasks={"halved": 0})
    space = learner.generator.space
    parts = [{"name": "simulated", "scenes": 4},
             {"name": "simulated", "scenes": 4, "sensor": {"name": "vlp16", "columns": 64}}]  # fmt: skip
    data = ScanDataModule(
        "mixed", space.sensor, space.encoding, parts=parts, validation={"share": 0.5}
    )
    data.adopt(learner.item_format)
    data.setup()
    [batch] = data.val_dataloader()
    assert batch["x_1"].shape == (4, 2, 8, 32)
    sensors = [space.sensor] * 2 + [build_sensor("vlp16", columns=64)] * 2
    for i, sensor in enumerate(sensors):
        rows = [float(e) for e in sensor.rays()[0, :, 0]]
        top = rows.index(float(batch["elevations"][i, 0]))
        assert batch["elevations"][i].tolist() == rows[top : top + 8]
        steps = (rows[top] - rows[top + 7]) / 7, 2 * math.pi / sensor.columns
        assert batch["steps"][i].tolist() == pytest.approx(steps)
        # each part has its own scenes
        whole = torch.from_numpy(simulate(sensor, 0, (2, 3, 6, 7)[i]).image)
        if sensor != space.sensor:  # intensities of another sensor are scaled to a mean
            whole[1] = (whole[1] * 0.265 / whole[1][whole[0] > 0].mean()).clamp(max=1)
        crop = space.through(sensor).decode(batch["x_1"][i : i + 1])[0]
        there = [j for j in range(sensor.columns) if torch.allclose(
            whole.roll(-j, 2)[:, top : top + 8, :32], crop, rtol=1e-4, atol=1e-4)]  # fmt: skip
        assert len(there) == 1


@pytest.mark.parametrize(
    ("stage", "width", "word"),
    [
        (Rectify, 64, "one sensor"),
        (LearnFlowMap, 64, "one sensor"),
        (Transfer, 16, "crops of 8x32"),
    ],
)
def test_a_part_of_another_sensor_that_cannot_be_learned_from_is_refused(stage, width, word):
    part = {"name": "simulated", "scenes": 4}
    parts = [part, {**part, "sensor": {"name": "vlp16", "columns": width}}]
    data = ScanDataModule("mixed", CONFIG["sensor"], parts=parts)
    backbone = CONFIG["backbone"] if stage is Transfer else tiny_options("hdit")
    with pytest.raises(InputError, match=word):
        data.adopt(stage(backbone, CONFIG["sensor"]).item_format)


@pytest.mark.parametrize("other", [Rectify, Reflow])
def test_a_stage_that_tells_nothing_refuses_it(other):
    with pytest.raises(InputError, match=r"stage=transfer"):
        other(generator=built(nought=True))


def test_it_draws_nothing_from_noise_alone_and_needs_a_backbone_for_any_size(flow):
    with pytest.raises(InputError, match="completes scans"):
        flow(torch.zeros(1, 2, 8, 32))
    # their noise has deviation 1, that of x_0 is sigma
    for sampler in ("sde", "renoise", "refine"):
        with pytest.raises(InputError, match=r"N\(0, 1\).*give jump"):
            build_sampler(sampler).check(flow)
    # a plug-in for this flow
    type("Redrawn", (Transport,), {"draws": True, "name": "redrawn"})().check(flow)
    with pytest.raises(InputError, match="backbone=local"):
        built(backbone=tiny_options("hdit"))
