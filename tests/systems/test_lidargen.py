"""LiDARGen against its published code: network, objective, sampler, data and checkpoints."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.generators import build_generator
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import project_indices
from r2flow.lidar.sensors import build_sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.systems.score.generator import (
    Langevin,
    _annealed_langevin,
    _noise_levels,
    _step_sizes,
    score_loss,
)
from r2flow.systems.score.refinenet import RefineNet, _InstanceNormPlus, _PooledConv2d
from r2flow.systems.score.stage import MatchScore
from tests.reference import (
    assert_near,
    assert_norms,
    assert_published,
    load_case,
    published_names,
    shapes_of,
)

TINY = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 16, "min_range": 0.5, "max_range": 63.0},
    "encoding": {"format": "shifted_log", "limits": "open"},
    "backbone": {"name": "refinenet"},
    "generator": {"name": "score", "width": 4, "levels": 3},
}


def network_of(case: dict) -> RefineNet:
    model = case["cfg"]["model"]
    sigmas = _noise_levels(
        model["sigma_begin"], model["sigma_end"], model["num_classes"], model["sigma_dist"]
    )
    network = RefineNet(sigmas, case["cfg"]["data"]["channels"], model["ngf"])
    network.load_state_dict(case["state_dict"])
    return network


def test_output_and_gradients_are_the_published_network_s(shared: Path):
    case = load_case(shared, "lidargen_net_16x64.pt")
    network = network_of(case)
    assert_published(network, case, 1e-4, lambda given: network(given["x"], given["y"]))


def test_the_full_network_has_the_published_names_and_shapes(shared: Path):
    with torch.device("meta"):
        assert shapes_of(RefineNet(torch.empty(232))) == published_names(shared, "lidargen")


def test_an_image_smaller_than_the_dilation_is_refused():
    with pytest.raises(InputError, match="at least 8, found 6 x 16"):
        build_generator({**TINY, "sensor": {**TINY["sensor"], "rows": 6}})


def test_instance_norm_plus_gives_channels_their_means_back():
    torch.manual_seed(0)
    norm, x = _InstanceNormPlus(4), torch.randn(2, 4, 6, 8) + torch.arange(4.0)[None, :, None, None]
    # what is left of each channel's mean: gamma alpha standardised + beta
    means = norm(x).mean((2, 3))
    for row, of in zip(means, x, strict=True):
        own = of.mean((1, 2))
        expected = (
            norm.gamma * norm.alpha * (own - own.mean()) / (own.var() + 1e-5).sqrt() + norm.beta
        )
        torch.testing.assert_close(row, expected, rtol=0, atol=1e-5)


def test_columns_are_pooled_first_as_published():
    pooled, x = _PooledConv2d(1, 1, 1), torch.tensor([[[[2.0**25, 1.0], [-(2.0**25), 0.0]]]])
    pooled.load_state_dict({"conv.weight": torch.ones(1, 1, 1, 1), "conv.bias": torch.zeros(1)})
    assert pooled(x).item() == 1 / 4  # rows first, float32 loses the 1


def test_noise_levels_and_step_sizes_are_the_published(shared: Path):
    case = load_case(shared, "lidargen_objective.pt")
    sigmas = _noise_levels(50, 0.01, 232)
    assert_near(sigmas, case["sigmas_232"], 1e-6)
    assert_near(_step_sizes(sigmas, 6.2e-6), case["step_sizes_232"], 1e-6)
    assert_near(_noise_levels(50, 0.01, 232, "uniform"), case["sigmas_uniform"], 1e-6)


@pytest.mark.parametrize("name", ["loss_power2", "loss_power1"])
def test_loss_and_gradients_are_the_published(shared: Path, name: str):
    case = load_case(shared, "lidargen_objective.pt")
    network, own = network_of(case), case[name]
    loss = score_loss(
        network, own["x"], own["noise"], own["labels"], own["sigmas"], own["anneal_power"]
    )
    assert_near(loss, own["per_sample"], 1e-5)
    # by the stage, on scans in model space, at the levels of uniform draws
    rows, columns = own["x"].shape[2:]
    sensor = {**TINY["sensor"], "rows": rows, "columns": columns}
    stage = MatchScore(
        generator=build_generator({**TINY, "sensor": sensor}), power=own["anneal_power"]
    )
    stage.generator.network = network
    batch = {"x_1": 2 * own["x"] - 1, "x_0": own["noise"]}
    loss = stage.regression_loss(batch, (own["labels"] + 0.5) / len(own["sigmas"]))
    assert_near(loss, own["loss"], 1e-5)
    loss.backward()
    assert_norms(network, own["grad_param_norms"])


def test_the_score_of_a_gaussian_has_the_least_loss():
    torch.manual_seed(0)
    sigmas, labels = torch.tensor([2.0]), torch.zeros(20_000, dtype=torch.int64)
    x, noise = (torch.randn(20_000, 1, 1, 1) for _ in range(2))
    losses = [
        score_loss(lambda y, _, k=k: -y / k, x, noise, labels, sigmas).mean()
        for k in (4.5, 5.0, 5.5)
    ]
    assert losses[1] == min(losses)  # the noised data have variance 1 + 2^2
    # Var[x | x + 2 n] / (2 * 4) = (4 / 5) / 8
    assert losses[1].item() == pytest.approx(0.5 * 1 / 5, rel=0.05)


def test_annealed_langevin_is_the_published(shared: Path):
    case = load_case(shared, "lidargen_sampling.pt")
    network, own = network_of(case), case["annealed"]
    how = own["sigmas"], lambda k: own["noise"][k - 1], own["step_lr"], own["n_steps_each"]
    with torch.no_grad():
        path = list(_annealed_langevin(network, own["start"], *how))
    for state, expected in zip(
        [*path[4:-1:5], path[-1]], [*own["after_each_level"], own["output"]], strict=True
    ):
        assert_near(state, expected, 5e-6)


def test_langevin_dynamics_draws_from_the_score_s_distribution():
    torch.manual_seed(0)
    sigmas = _noise_levels(2.0, 0.1, 30)
    start = torch.rand(4000, 1, 1, 1)

    def score(x, labels):  # of N(3, 1) and the level's noise
        return (3 - x) / (1 + sigmas[labels][:, None, None, None] ** 2)

    *_, end = _annealed_langevin(
        score, start, sigmas, lambda _: torch.randn_like(start), rate=1e-3, steps=20
    )
    assert end.mean().item() == pytest.approx(3, abs=0.1)
    assert end.std().item() == pytest.approx(1, abs=0.1)


# published: anneal by grad_ref = 1
@pytest.mark.parametrize(("options", "p"), [({}, 1.0), ({"pull": 0.1}, 0.1)])
def test_known_pixels_pull_in_every_step_and_once_more_at_the_end(options: dict, p: float):
    # Without a score and without noise a known pixel's distance to its value shrinks by 1 - p in
    # every step. The last denoising repeats the pull of the step before, p of the distance before
    # it; then it shrinks once more.
    generator = build_generator({**TINY, "generator": {**TINY["generator"], **options}})
    generator.network.forward = lambda x, labels: torch.zeros_like(x)
    start = torch.zeros(1, *generator.noise_shape)  # the middle of the range of images
    known = start.clone()
    known[:, :, ::4] = 1
    still = SimpleNamespace(step=lambda shape, j: torch.zeros(1, *shape))
    made = generator(
        start, {"image": start + 0.5, "known": known}, draws=still, sampler=Langevin(steps=2)
    ).x
    distance = 0.5 * ((1 - p) ** 6 - p * (1 - p) ** 5) * (1 - p)
    torch.testing.assert_close(made, torch.where(known > 0, 0.5 - distance, 0.0))


def test_ranges_and_intensities_are_encoded_and_decoded_as_published(shared: Path):
    case = load_case(shared, "lidargen_data.pt")
    encoding = Encoding(build_sensor("hdl64e", 16, 64, 0.5, 63.0), "shifted_log")
    # The published code encodes ranges beyond the limits too; to ours they are no returns.
    metres = case["metres"]
    inside = (metres >= 0.5) & (metres <= 63)
    encoded = encoding.encode(torch.stack([case["metres"], case["intensity"]]))
    assert_near((encoded + 1) / 2 * inside, case["model_space"] * inside, 1e-6)
    encoding = Encoding(encoding.sensor, "shifted_log", reflectance=False, limits="open")
    decoded = encoding.decode(2 * case["model_space_in"][None] - 1)[0]
    assert torch.equal(decoded > 0, case["valid"])
    assert_near(
        torch.where(case["valid"], decoded, 0),
        torch.where(case["valid"], case["metres_back"], 0),
        1e-6,
    )


def test_points_fall_into_the_published_pixels(shared: Path):
    case = load_case(shared, "lidargen_data.pt")
    sensor = build_sensor("hdl64e", 16, 64, 1e-3, 1e3)  # the published projection knows no limits
    hit, chosen, r = project_indices(case["points"].numpy()[:, :3], sensor, convention="lidargen")
    found = np.full((2, 16 * 64), -1.0)
    found[:, hit] = chosen, r
    index, ranges = torch.from_numpy(found).view(2, 16, 64)
    assert torch.equal(index, case["proj_index"].double())
    assert_near(ranges, case["proj_range"], 1e-6)


@pytest.mark.parametrize("averaged", [True, False])
def test_a_published_checkpoint_gives_its_scores(shared: Path, averaged: bool):
    io = load_case(shared, "lidargen_published_io.pt")
    loaded = load_checkpoint(
        shared / "oracle_baselines" / "lidargen_published.pth", averaged=averaged
    )
    assert loaded.generator.space.shape == (2, 64, 1024)
    with torch.no_grad():
        output = loaded.generator.network(io["x"], io["y"])
    assert_near(output, io["output_ema" if averaged else "output_weights"], 1e-4)
    assert loaded.generator.sampler.evaluations(loaded.generator) == 10 * 5 + 1
