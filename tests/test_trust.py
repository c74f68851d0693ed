"""Errors of added points, from the density of the range of each ray."""

import math
import re
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.generators.answers import NEVER, Answers
from r2flow.generators.calibration import fitted, mixture
from r2flow.lidar.known import ray_states
from r2flow.lidar.sensors import SENSORS, read_sensor, write_sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.completion import complete
from r2flow.reports.calibration import TASKS, trust_of
from r2flow.reports.completion import kept_rays
from r2flow.simulator import simulate
from tests.conftest import ROOT
from tests.test_completion import halved, network
from tests.test_sampling import scans


def density(logits: Tensor, ranges: Tensor, scales: Tensor, returns: float = 0.0) -> Answers:
    """Answers of N rays from parameters of the candidates, (7, N)."""
    logits, ranges, scales = (x[None, :, None] for x in (logits, ranges, scales))
    one = logits[:, :1]
    return Answers(
        logits.log_softmax(1), ranges, scales, torch.full_like(one, returns), 0 * logits, one[:, :0]
    )


def test_the_error_of_one_laplace_density_is_its_quantile():
    b = torch.tensor([0.001, 0.03, 0.4])
    never = torch.full((6, 3), NEVER)
    r = torch.tensor([1.0, 5.0, 40.0])
    logits = torch.cat([torch.zeros(1, 3), never])
    answers = density(logits, r.log().expand(7, -1), b.expand(7, -1))
    found = answers.error(r[None, None, None], [0.5, 0.68, 0.95])[:, 0, 0]
    for level, error in zip([0.5, 0.68, 0.95], found, strict=True):
        torch.testing.assert_close(error, -r * b * math.log(1 - level), rtol=1e-4, atol=0)


@pytest.mark.parametrize("level", [0.5, 0.68, 0.95])
def test_the_error_holds_as_much_of_a_mixture_as_it_says(level):
    draws = torch.Generator().manual_seed(0)
    logits = 2 * torch.randn(7, 4000, generator=draws)
    ranges = 2 + 0.2 * torch.randn(7, 4000, generator=draws)
    scales = 10 ** (-2 + 1.5 * torch.rand(7, 4000, generator=draws))
    answers = density(logits, ranges, scales)
    k = answers.least_error()
    center = answers.ranges.gather(1, k)
    w = answers.error(center.exp(), [level])[0, 0] / center.exp()[0, 0]
    z = torch.stack([w[0] - ranges + center[0, 0, 0], -w[0] - ranges + center[0, 0, 0]]) / scales
    shares = torch.where(z < 0, z.exp() / 2, 1 - (-z).exp() / 2)
    inside = (logits.softmax(0) * (shares[0] - shares[1])).sum(0)
    assert inside.mean().item() == pytest.approx(level, abs=0.01)
    assert (inside - level).abs().mean() < 0.05


def test_measured_rays_and_those_without_a_return_have_no_error():
    one = torch.zeros(7, 2)
    measured = density(one, one, one + 0.1, returns=-NEVER)
    assert not measured.error(torch.tensor([[[[3.0, 4.0]]]]), [0.68]).any()
    hidden = density(one, one, one + 0.1)
    found = hidden.error(torch.tensor([[[[3.0, 0.0]]]]), [0.68])
    assert found[0, 0, 0, 0] > 0
    assert found[0, 0, 0, 1] == 0


def test_calibration_leaves_a_density_as_it_is_and_widens_it_as_its_weights_say():
    logits = torch.tensor([[0.0], [-50.0]]).log_softmax(0)
    ranges = torch.tensor([[2.0], [3.0]])
    scales = torch.tensor([[0.1], [0.1]])
    plain = [[0.0] * 3, [-30.0, 0, 0], [-30.0, 0, 0], [0.0] * 3, [0.0] * 3]
    found = mixture(torch.tensor(plain), logits, ranges, scales)
    torch.testing.assert_close(found[0][:2].exp(), logits.exp())
    torch.testing.assert_close(found[2][:2], scales)
    assert found[0][2].exp() < 1e-12
    weights = torch.tensor(plain)
    weights[0, 0] = math.log(3)  # a = 3
    weights[1, 0] = math.log(0.4) + 2  # c / r = 0.4 at log r = 2
    weights[2, 0] = 0.0  # half for the wide candidate
    weights[3, 0] = math.log(2)  # of twice the spread, 0.1
    logits, ranges, scales = mixture(weights, logits, ranges, scales)
    torch.testing.assert_close(scales[:, 0], torch.tensor([0.5, 0.5, 0.2]))
    torch.testing.assert_close(ranges[2], torch.tensor([2.0]))
    torch.testing.assert_close(logits.exp()[:, 0], torch.tensor([0.5, 0.0, 0.5]))


def test_the_fit_finds_how_much_too_narrow_densities_are():
    draws = torch.Generator().manual_seed(0)
    b = 10 ** (-2 + torch.rand(20_000, generator=draws))
    signs = torch.rand(20_000, generator=draws) - 0.5
    log_r = 2.5 - 2 * b * signs.sign() * torch.log1p(-2 * signs.abs())  # of twice the scale
    zeros = torch.zeros(1, 20_000)
    logits = torch.randn(20_000, generator=draws)
    returned = torch.rand(20_000, generator=draws) < (2 * logits + 1).sigmoid()
    found = fitted([(zeros, zeros + 2.5, b[None])], log_r, logits, returned)
    assert found.returns == pytest.approx((2, 1), abs=0.15)
    answers = density(torch.cat([zeros, zeros + NEVER]), zeros.expand(2, -1) + 2.5, b.expand(2, -1))
    r = torch.full((1, 1, 1, 20_000), math.exp(2.5))
    errors = replace(answers, calibration=found).error(r, [0.68, 0.95])[:, 0, 0]
    inside = (log_r.exp() - r.flatten()).abs() <= errors
    assert inside.float().mean(1).tolist() == pytest.approx([0.68, 0.95], abs=0.015)
    drawn = replace(answers, calibration=found).calibrated().quantile(torch.full_like(r, 0.84))
    held = (log_r <= drawn.flatten()).float().mean().item()
    assert held == pytest.approx(0.84, abs=0.015)


def test_factors_of_a_sensor_multiply_the_errors_of_its_scans(tmp_path):
    images = scans(1)
    flow = network()
    jump = {"sampler": "jump", "steps": 1}
    (plain,) = complete(flow, images, halved(images), **jump)
    own = replace(flow.sensor, name="own", error_factors=(2.0, 3.0))
    (other,) = complete(
        flow.through(replace(own, error_factors=None)), images, halved(images), **jump
    )
    (scaled,) = complete(flow.through(own), images, halved(images), **jump)
    expected = torch.tensor([2.0, 3.0])[:, None, None, None] * other.error(0.68, 0.95)
    torch.testing.assert_close(scaled.error(0.68, 0.95), expected)
    write_sensor(own, tmp_path / "own.yaml", "a comment")
    assert read_sensor(tmp_path / "own.yaml").error_factors == (2.0, 3.0)
    with pytest.raises(InputError, match="error_factors must be two positive numbers"):
        replace(own, error_factors=(1.0,))
    (kept,) = complete(flow, images, halved(images), max_error=1.0, **jump)
    error = plain.error(0.68)[0]
    assert 0 < (error > 1).sum() < (error > 0).sum()
    assert torch.equal(kept.images[:, 0] > 0, (plain.images[:, 0] > 0) & (error <= 1))
    with pytest.raises(InputError, match="predicts no errors"):
        list(complete(network("rectified_flow"), images, halved(images), max_error=1.0))


def test_errors_times_the_factors_that_were_found_hold_the_truth_of_these_scans(monkeypatch):
    flow = network()
    truths = [image.numpy() for image in scans(4)]
    monkeypatch.setattr("r2flow.reports.calibration._FEWEST", 100)
    own = flow.through(replace(flow.sensor, error_factors=(5.0, 5.0)))
    found = trust_of(own, truths)
    assert found.factors == trust_of(flow, truths).factors  # old factors do not count
    again = flow.through(replace(flow.sensor, error_factors=found.factors))
    inside = []
    for number, truth in enumerate(truths):
        images = torch.from_numpy(truth)[None]
        for task in TASKS:
            kept = torch.from_numpy(kept_rays(task, flow.sensor, number))
            state = ray_states(images, kept[None])
            (one,) = complete(again, images * kept, state, sampler="jump", steps=1)
            r = one.images[0, 0]
            right = (r > 0) & (images[0, 0] > 0) & ~kept
            error = (r - images[0, 0]).abs()
            inside.append((error <= one.error(0.68, 0.95)[:, 0] * (1 + 1e-5))[:, right])
    shares = torch.cat(inside, 1).float().mean(1)
    assert shares.tolist() == pytest.approx([0.68, 0.95], abs=2 / found.points)
    assert trust_of(again, truths).shares == pytest.approx([0.68, 0.95], abs=2 / found.points)


def test_calibrate_writes_the_factors_into_the_file_of_the_sensor(r2flow, tmp_path, monkeypatch):
    monkeypatch.setattr("r2flow.reports.calibration._FEWEST", 100)
    flow = network()
    flow.save(tmp_path / "tiny.safetensors")
    path = tmp_path / "mine.yaml"
    write_sensor(replace(flow.sensor, name="mine"), path, "of my own")
    for _ in range(2):  # a second time replaces the factors and what is said of them
        said = r2flow(
            "calibrate", "simulated:1", "--sensor", path, "-c", tmp_path / "tiny.safetensors", "--num", 2
        ).said  # fmt: skip
    mine = read_sensor(path)
    factors = mine.error_factors
    assert f"error_factors [{factors[0]:.3f}, {factors[1]:.3f}] in {path}" in said
    images = [one.image for one in (simulate(mine, 1, number) for number in (250, 750))]
    assert factors == trust_of(flow.through(mine), images).factors
    said, about, *_ = path.read_text().splitlines()
    assert (said, about) == ("# of my own", "# error_factors: r2flow calibrate, tiny, 2 scans")


def test_calibrate_takes_a_sensor_by_name_and_writes_it_to_a_new_file(
    r2flow, tmp_path, monkeypatch
):
    monkeypatch.setattr("r2flow.reports.calibration._FEWEST", 100)
    flow = network()
    flow.save(tmp_path / "tiny.safetensors")
    how = ("-c", tmp_path / "tiny.safetensors", "--num", 1)
    refusal = r2flow("calibrate", "simulated:1", "--sensor", "hdl64e_small", *how).refusal
    assert "give --out hdl64e_small_mine.yaml" in refusal
    mine = tmp_path / "mine.yaml"
    said = r2flow("calibrate", "simulated:1", "--sensor", "hdl64e_small", *how, "--out", mine).said
    factors = read_sensor(mine).error_factors
    assert "by hdl64e_small: " in said
    assert f"new error_factors [{factors[0]:.3f}, {factors[1]:.3f}] in {mine}" in said
    assert replace(read_sensor(mine), error_factors=None) == SENSORS["hdl64e"].resized(32, 256)
    once = mine.read_bytes()
    other = tmp_path / "other.yaml"  # its own file stays where another is given
    r2flow("calibrate", "simulated:1", "--sensor", mine, *how, "--out", other)
    assert mine.read_bytes() == once
    assert read_sensor(other).error_factors == factors


def test_the_example_of_the_page_runs_and_its_share_lies_between_those_of_other_levels(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    image = simulate(SENSORS["hdl64e"], 3, 0).image
    (points,) = load_checkpoint("densify").points(torch.from_numpy(image)[None])
    points.astype("<f4").tofile("scan.bin")
    page = (ROOT / "docs/trust.md").read_text()
    found = {}
    exec(re.search(r"^```python\n(.*?)^```", page, re.M | re.S)[1], found)
    half, most = found["half"], found["most"]
    assert half.shape == (1, 64, 1024)
    assert (half[0][found["added"]] < most[0][found["added"]]).all()
    assert found["p"][0][found["mask"] & (found["truth"] > 0)].eq(1).all()
    off = (found["r"] - found["truth"]).abs()[found["added"]]
    below, above = ((off <= one[0][found["added"]]).float().mean() for one in (half, most))
    assert below < found["share"] < above
