"""R2DM against the published implementation: network, schedules, objective, samplers, RePaint,
data, checkpoint.
"""

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.generators import build_generator
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.completion import completing
from r2flow.samplers import build_sampler
from r2flow.systems.diffusion.generator import Diffusion
from r2flow.systems.diffusion.process import (
    PREDICTIONS,
    _forward_step,
    alpha_sigma,
    noised,
    repaint,
    step,
    walk,
)
from r2flow.systems.diffusion.schedules import DISCRETE, SCHEDULES, _Cosine
from r2flow.systems.diffusion.stage import LearnDiffusion
from tests.reference import assert_near, assert_norms, assert_published, backbone_of, load_case

CONFIG: dict[str, Any] = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 32},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {
        "name": "efficient_unet",
        "base_channels": 8,
        "channel_multiplier": [1, 2],
        "num_residual_blocks": 1,
    },
    "generator": {"name": "diffusion"},
}


@pytest.mark.parametrize("name", ["r2dm_net_16x64_fourier", "r2dm_net_16x32_polar"])
def test_the_network_and_its_gradients_are_the_published(shared, name):
    case = load_case(shared, f"{name}.pt")
    model = backbone_of("efficient_unet", case)
    assert set(case["grad_inputs"]) == {"x", "t"}
    assert_published(model, case, 2e-5, lambda given: model(given["t"], given["x"]))
    assert sum(p.numel() for p in model.parameters()) == case["num_parameters"]


@pytest.mark.parametrize("name", SCHEDULES)
def test_schedules_are_the_published(shared, name):
    case = load_case(shared, "r2dm_schedules.pt")
    log_snr = SCHEDULES[name](**case[name].get("kwargs", {}))(case["t"])
    alpha, sigma = alpha_sigma(log_snr)
    assert_near(log_snr, case[name]["log_snr"], 1e-6)
    assert_near(alpha, case[name]["alpha"], 1e-5)
    assert_near(sigma, case[name]["sigma"], 1e-5)


def test_schedules_of_steps_are_the_published(shared):
    for name, expected in load_case(shared, "r2dm_schedules.pt")["discrete_40_steps"].items():
        log_snr = DISCRETE[name](40)
        now, before = log_snr.sigmoid(), torch.cat([torch.ones(1), log_snr[:-1].sigmoid()])
        found = {
            "alpha_bar": now,
            "alpha_bar_prev": before,
            "beta": 1 - now / before,
            "snr": log_snr.exp(),
        }
        for key, value in found.items():
            assert_near(value, expected[key], 1e-6)
    # of the published code, which rounds the end to float32
    alpha_bar = DISCRETE["sigmoid"](1000)[-3:].sigmoid()
    assert (1 - alpha_bar[1:] / alpha_bar[:-1]).tolist() == pytest.approx(
        [0.5013504179271411, 0.999], rel=1e-9
    )


def test_loss_weights_are_the_published(shared):
    case = load_case(shared, "r2dm_schedules.pt")
    log_snr = _Cosine()(case["t"])
    for name, theirs in (("eps", "eps"), ("v", "v"), ("x", "x_0")):
        for kind, gamma in (("minsnr", 5.0), ("plain", None)):
            expected = case["loss_weight_cosine"][f"{theirs}_{kind}"]
            torch.testing.assert_close(
                PREDICTIONS[name].weight(log_snr, gamma), expected, rtol=1e-6, atol=0
            )


def test_the_stage_s_loss_is_the_formula_s_or_on_demand_the_published(shared):
    case = load_case(shared, "r2dm_objective.pt")
    cfg, given = case["cfg"], case["cases"]["eps_l2"]
    shape = dict(zip(("rows", "columns"), cfg["resolution"], strict=True))
    config = {
        **CONFIG,
        "sensor": {"name": "hdl64e", **shape, "rays": "reference"},
        "backbone": {
            "name": "efficient_unet", "base_channels": cfg["base_channels"], "num_residual_blocks": 1,
            "channel_multiplier": cfg["channel_multiplier"], "num_heads": cfg["attn_num_heads"],
        },
    }  # fmt: skip
    for paired, key in ((True, "loss_paired"), (False, "loss")):
        stage = LearnDiffusion(generator=build_generator(config), paired=paired)
        stage.generator.backbone.load_state_dict(case["state_dict"])  # type: ignore[union-attr]
        x_1 = given["inputs"]["x_0"].clone().requires_grad_()
        batch = {"x_1": x_1, "x_0": given["inputs"]["noise"]}
        loss = stage.regression_loss(batch, given["inputs"]["t"])  # type: ignore[operator]
        assert loss.item() == pytest.approx(float(given[key]), rel=1e-5)
        loss.backward()
        assert_norms(stage.generator.backbone, given[key.replace("loss", "grad_param_norms")])
    assert_near(x_1.grad, given["grad_x0"], 1e-3)


@torch.no_grad()
def test_samplers_follow_the_published_trajectories(shared):
    case = load_case(shared, "r2dm_sampling.pt")
    generator = build_generator({**CONFIG, "sensor": {"name": "hdl64e", "rows": 16, "columns": 32}})
    generator.backbone = backbone_of("efficient_unet", case).eval()
    for one in case["cases"].values():
        eta, tolerance = (1.0, 1e-3) if one["mode"] == "ddpm" else (one["ddim_eta"], 2e-3)
        start, *draws = one["noise"]
        log_snrs = generator.schedule(torch.linspace(1, 0, one["num_steps"] + 1))
        states = torch.stack(
            [
                start,
                *walk(generator.denoise, start, log_snrs, eta, lambda j, draws=draws: draws[j - 1]),
            ]
        )
        assert_near(states, one["trajectory"], tolerance)
        given = SimpleNamespace(step=lambda shape, j: draws[j - 1])  # noqa: B023
        name = "ddpm" if one["mode"] == "ddpm" else f"ddim:eta={eta}"
        made = generator(start, sampler=build_sampler(name, steps=one["num_steps"]), draws=given)
        assert_near(made.x, one["trajectory"][-1].clamp(-1, 1), tolerance)


def test_a_scan_is_completed_by_the_published_repaint(shared):
    case = load_case(shared, "r2dm_repaint.pt")
    model, (one,) = backbone_of("efficient_unet", case), case["cases"].values()
    generator = build_generator({**CONFIG, "sensor": {"name": "hdl64e", "rows": 16, "columns": 32}})
    generator.backbone = model.eval()
    start, *draws = one["noise"]
    how = build_sampler("repaint", steps=4, repeats=one["num_resample_steps"], grid="uniform")
    evaluated: list[int] = []
    made = generator(
        start, {"image": case["known"], "known": case["mask"]}, sampler=how,
        draws=SimpleNamespace(step=lambda shape, j: draws[j - 1]),
        progress=lambda: evaluated.append(1),
    )  # fmt: skip
    assert_near(
        made.x, torch.where(case["mask"] > 0, case["known"], one["output"].clamp(-1, 1)), 1e-3
    )
    assert made.evaluations.tolist() == [len(evaluated)] * 2 == [7, 7]


def test_repaint_has_the_settings_of_the_published_script():
    generator = build_generator(CONFIG)
    assert completing(generator).name == "mmps"
    assert completing(generator, "repaint").asdict() == {
        "name": "repaint", "steps": 32, "grid": "uniform", "repeats": 16, "jump": 1,
    }  # fmt: skip
    assert completing(generator, "repaint", steps=4).evaluations() == 1 + 16 * 3


def test_repaint_draws_as_often_as_its_steps_parts_and_repeats_say():
    drawn: list[int] = []

    def noise(j: int) -> Tensor:
        drawn.append(j)
        return torch.zeros(1, 1, 2, 2)

    known = torch.ones(1, 1, 2, 2)
    mask = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    log_snrs = _Cosine()(torch.linspace(1, 0, 13, dtype=torch.float64))
    states = list(
        repaint(lambda z, _: torch.zeros_like(z), known, known, mask, log_snrs, noise, 2, 4)
    )
    assert len(states) == 2 + 2 + 1  # the last step is not repeated
    # Known pixels and ancestral step on the way down, one on the way up.
    assert drawn == list(range(1, 1 + 5 * 4 * 2 + 2 * 4))
    torch.testing.assert_close(states[-1][0, 0], mask, rtol=0, atol=1e-6)


FORMATS = {"log_depth": "logscale", "inverse_depth": "inverse", "depth": "metric"}


@pytest.mark.parametrize("name", FORMATS)
def test_metres_and_model_space_are_the_published(shared, name):
    data = load_case(shared, "r2dm_data.pt")
    case = data[f"{name}_1.45_80.0"]
    encoding = Encoding(
        SENSORS["hdl64e"].resized(16, 64), FORMATS[name], reflectance=False, limits="open"
    )
    assert_near(encoding.encode(case["metres"]), case["model_space"], 1e-5)
    assert_near(encoding.decode(2 * case["normalised_in"] - 1), case["reverted"], 1e-5)
    assert_near(encoding.decode(encoding.encode(case["metres"])), case["round_trip"], 1e-5)
    assert torch.equal(encoding.encode(case["metres"]) > -1, case["mask"] > 0)
    assert_near(unproject(case["metres"] * case["mask"], data["ray_angles"][0]), case["xyz"], 1e-5)


def test_rays_are_the_published(shared):
    data, sensor = load_case(shared, "r2dm_data.pt"), SENSORS["hdl64e"]
    assert_near(sensor.resized(16, 64).rays("reference"), data["ray_angles"][0], 1e-5)
    assert_near(
        sensor.rays("reference").double().sum((1, 2)), data["ray_angles_64x1024_sums"], 1e-5
    )


@pytest.mark.parametrize("averaged", [True, False])
@torch.no_grad()
def test_a_published_checkpoint_predicts_what_its_authors_did(shared, averaged):
    expected = load_case(shared, "r2dm_published_io.pt")
    found = load_checkpoint(shared / "oracle_baselines" / "r2dm_published.pth", averaged=averaged)
    diffusion = found.generator
    output = diffusion.predict(expected["x"], expected["t"])
    assert_near(output, expected["output_ema" if averaged else "output_weights"], 2e-5)
    assert sum(p.numel() for p in diffusion.parameters()) == expected["parameters"]
    assert (found.format, found.step, found.sensor.min_range, found.sensor.max_range) == (
        "published",
        3,
        1.45,
        80.0,
    )
    assert found.encoding.limits == "open"
    assert diffusion.sampler == build_sampler("ddpm", steps=256)


def test_unfolded_scans_look_along_the_rings_of_the_weights(shared, tmp_path):
    path = shared / "oracle_baselines" / "r2dm_published.pth"
    content, changed = torch.load(path, weights_only=True), tmp_path / "changed.pth"
    content["cfg"]["data"]["projection"] = "unfolding-64"
    torch.save(content, changed)
    rings = torch.rad2deg(content["ema_weights"]["model.coords"][0, 0, :, 0].double())
    assert load_checkpoint(changed).sensor.elevations == pytest.approx(rings.tolist())


@pytest.mark.parametrize("name", PREDICTIONS)
def test_data_and_noise_follow_from_every_prediction(name):
    x, eps = torch.randn(2, 6, 2, 4, 4, dtype=torch.float64)
    log_snr = torch.linspace(-8, 8, 6, dtype=torch.float64)
    prediction = PREDICTIONS[name]
    found = prediction.split(noised(x, log_snr, eps), prediction.target(x, eps, log_snr), log_snr)
    torch.testing.assert_close(torch.stack(found), torch.stack([x, eps]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", PREDICTIONS)
def test_the_weight_turns_a_prediction_s_error_into_that_of_the_data(name):
    log_snr = torch.linspace(-4, 4, 9, dtype=torch.float64)
    prediction = PREDICTIONS[name]
    x, z = torch.zeros(9, 1, dtype=torch.float64), torch.randn(9, 1, dtype=torch.float64)
    alpha, sigma = (part[:, None] for part in alpha_sigma(log_snr))
    right, wrong = (
        prediction.target(one, (z - alpha * one) / sigma, log_snr) for one in (x, x + 0.1)
    )
    weighted = prediction.weight(log_snr, 5.0) * (wrong - right).square()[:, 0]
    torch.testing.assert_close(weighted, 0.01 * log_snr.exp().clamp(max=5.0))


@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
def test_a_step_keeps_the_distribution_of_gaussian_data(eta):
    """Data x = 0.3: z_t ~ N(0.3 alpha, sigma^2) at every t, whatever the share of new noise."""
    x = torch.full((200_000,), 0.3, dtype=torch.float64)
    here, there = torch.tensor(-2.0), torch.tensor(1.5)
    draws = torch.randn(2, len(x), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = step(noised(x, here, draws[0]), x, here, there, eta, draws[1])
    alpha, sigma = alpha_sigma(there)
    assert found.mean().item() == pytest.approx(
        0.3 * alpha.item(), abs=4 * sigma.item() / len(x) ** 0.5
    )
    assert found.std().item() == pytest.approx(sigma.item(), rel=1e-2)


def test_forward_steps_add_up_to_the_noise_of_their_end():
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    lambdas = [torch.tensor(value, dtype=torch.float64) for value in (4.0, 1.0, -3.0)]
    (alpha, sigma), (last_alpha, last_sigma) = alpha_sigma(lambdas[0]), alpha_sigma(lambdas[-1])
    signal, variance = alpha * one, sigma.square() * one
    for here, there in pairwise(lambdas):
        kept = _forward_step(one, here, there, zero)
        signal, variance = (
            kept * signal,
            kept.square() * variance + _forward_step(zero, here, there, one).square(),
        )
    torch.testing.assert_close(signal, last_alpha * one)
    torch.testing.assert_close(variance, last_sigma.square() * one)


class Exact(Diffusion):
    """Of data ~ N(mean, std^2): E[eps | z] = sigma (z - alpha mean) / (alpha^2 std^2 + sigma^2)."""

    mean, std = 0.2, 0.1

    def predict(self, z: Tensor, log_snr: Tensor) -> Tensor:
        alpha, sigma = (
            part.reshape(-1, 1, 1, 1) for part in alpha_sigma(log_snr.double().reshape(-1))
        )
        return (sigma * (z - alpha * self.mean) / (alpha**2 * self.std**2 + sigma**2)).to(z)


@pytest.fixture
def exact() -> Exact:
    made = build_generator(CONFIG)
    made.__class__ = Exact
    return made.eval()


@torch.no_grad()
def test_a_diffusion_is_the_flow_of_its_own_data(exact):
    """The straight flow of N(m, s^2) carries x_0 to m + s x_0; the schedule ends where sigma is
    6e-4.
    """
    noise = Draws(0, [0]).start(exact.noise_shape)
    for sampler in (build_sampler("dopri5", tolerance=1e-7), build_sampler("ddim", steps=1000)):
        torch.testing.assert_close(
            exact(noise, sampler=sampler).x, exact.mean + exact.std * noise, rtol=0, atol=2e-3
        )


@torch.no_grad()
def test_a_scan_is_completed_with_a_diffusion_as_with_any_flow(exact):
    noise, draws = Draws(0, [0]).start(exact.noise_shape), Draws(0, [0])
    image = torch.full_like(noise, 0.25)
    known = torch.zeros_like(noise)
    known[..., ::2] = 1
    condition = {"image": image * known, "known": known}
    found = exact(noise, condition, sampler=build_sampler("replace", steps=500), draws=draws).x
    torch.testing.assert_close(found * known, image * known, rtol=0, atol=0)
    torch.testing.assert_close(
        found[..., 1::2], (exact.mean + exact.std * noise)[..., 1::2], rtol=0, atol=0.01
    )


def test_what_a_diffusion_cannot_do_is_said(exact):
    flow = build_generator({**CONFIG, "generator": {"name": "rectified_flow"}})
    with pytest.raises(InputError, match=r"tells v\(t, x\), and this one learns eps\(z, log-SNR\)"):
        exact.start_from(flow)
    with pytest.raises(InputError, match="learns a Diffusion"):
        LearnDiffusion(generator=flow)


@pytest.mark.parametrize("farthest", [5.0, 15.0, 20.0])
def test_a_cosine_schedule_has_its_digits_up_to_its_ends(farthest):
    """2 ln cot of the angle in float64, at times of float32; both ends, -farthest and farthest,
    leave the angle q.
    """
    t, q = torch.linspace(0, 1, 33), math.atan(math.exp(-farthest / 2))
    sine, cosine = (
        (q + share * (math.pi / 2 - 2 * q)).sin() for share in (t.double(), 1 - t.double())
    )
    expected = 2 * (cosine.log() - sine.log())
    torch.testing.assert_close(
        _Cosine(-farthest, farthest)(t).double(), expected, rtol=0, atol=0.005
    )


@pytest.mark.parametrize(
    "ends",
    [{"lowest": -2000.0}, {"highest": 21.0}, {"lowest": 3.0, "highest": 2.0}, {"lowest": math.nan}],
)
def test_a_cosine_schedule_whose_ends_are_no_numbers_is_one_line(ends):
    with pytest.raises(
        InputError, match="falls from highest to lowest, both within 20 of 0; found"
    ):
        _Cosine(**ends)
