"""Methods of completion against posteriors that are known in closed form."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks.completion import (
    Case,
    Correlated,
    bures,
    gaussian,
    map_of,
    moments,
    ring,
    velocity_of,
)
from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.flow.solvers import named_grid
from r2flow.generators import build_generator
from r2flow.samplers import MMPS, Repaint, build_sampler
from r2flow.samplers.posterior import _GROWN, _solved
from tests.fields import CONFIG, Field

WIDTH = 32
ROWS = torch.arange(WIDTH) % 4 == 0
ALL = ["replace", "repaint:repeats=3:jump=2", "mmps"]


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=draws(seed), dtype=torch.float64)


def times(steps: int, grid: str = "uniform") -> Tensor:
    return named_grid(grid)(0.0, 1.0, steps)


def sample_posterior(
    u, x_0: Tensor, y: Tensor, known: Tensor, method: str, times: Tensor, noise=None
) -> Tensor:
    with torch.no_grad():
        return build_sampler(method).run(u, x_0, y, known, times.to(x_0), noise)


def numbered(shape: tuple[int, ...]):
    return lambda j: randn(*shape, seed=100 + j)


def test_the_linear_system_is_solved_by_conjugate_gradients():
    """Against their definition: of all x in the directions, the least of x S x / 2 - r x."""
    spread = ring() + 0.1 * torch.eye(WIDTH).double()
    r = randn(3, WIDTH, seed=7)
    for steps in (1, 2, 3):
        with torch.device("meta"):  # a default device of the user's
            found = _solved(lambda p: (p, p @ spread), r, steps)
        for row, x in zip(r, found, strict=True):
            directions = torch.stack(
                [torch.linalg.matrix_power(spread, k) @ row for k in range(steps)], 1
            )
            inner = directions.T @ spread @ directions
            torch.testing.assert_close(
                x, directions @ torch.linalg.solve(inner, directions.T @ row)
            )


def test_each_scan_whose_residual_grows_tenfold_gets_the_least_one():
    vectors = torch.linalg.qr(randn(WIDTH, WIDTH, seed=5))[0]
    # not quite symmetric, as a network's Jacobian; these are the eigenvectors of its symmetric part
    matrix = vectors * torch.logspace(-4, 0, WIDTH).double() @ vectors.T + 0.002 * randn(
        WIDTH, WIDTH, seed=6
    )
    # most of the first lies where S is least
    r = torch.stack([5 * vectors[:, 0] + vectors[:, -1], vectors[:, -1]])
    found = _solved(lambda p: (p, p @ matrix.T), r, 1)
    moved = r @ matrix.T
    left = r - (r * r).sum(1, keepdim=True) / (r * moved).sum(1, keepdim=True) * moved
    assert ((left * left).sum(1) > _GROWN * (r * r).sum(1)).tolist() == [True, False]
    least = (r * moved).sum(1) / (moved * moved).sum(1)
    gradients = (r * r).sum(1) / (r * moved).sum(1)
    torch.testing.assert_close(found, torch.stack([least[0] * r[0], gradients[1] * r[1]]))


def test_a_system_ends_where_the_matrix_is_not_positive_or_nothing_is_left():
    matrix = torch.diag(torch.tensor([1.0, -1.0, 2.0]).double())
    r = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [1.0, 0, 1.0], [0, 0, 0]]).double()
    found = _solved(lambda p: (p, p @ matrix.T), r, 4)
    torch.testing.assert_close(
        found, torch.tensor([[1.0, 0, 0], [0, 0, 0], [1.0, 0, 0.5], [0, 0, 0]]).double()
    )


def test_behind_a_direction_that_is_not_positive_nothing_is_searched():
    matrix = torch.diag(torch.tensor([1.0, 2.0, -0.5, 3.0]).double())
    r = torch.tensor([[1.0, 1.0, 2.0, 1.0]]).double()
    products = []

    def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
        products.append(float((p * (p @ matrix)).sum()))
        return p, p @ matrix

    found = [_solved(multiply, r, steps) for steps in range(1, 7)]
    first = next(n for n, curvature in enumerate(products[-6:]) if curvature <= 0)
    assert first > 0
    for later in found[first:]:
        torch.testing.assert_close(later, found[first - 1])


@pytest.mark.parametrize("t", [0.2, 0.9])
def test_mmps_has_the_posterior_s_own_velocity_on_any_gaussian(t):
    prior, case = gaussian(), Case(ROWS)
    y = case.measure(prior.sample(1, draws(4)))
    x, end = randn(1, WIDTH), torch.tensor([t, 1.0], dtype=torch.float64)
    posterior = prior.posterior(case.matrix, y[0], 0.0)
    found = MMPS(products=WIDTH).run(
        velocity_of(prior), x, *case.measurement(y), end, numbered((1, WIDTH))
    )
    torch.testing.assert_close(found, x + (1 - t) * posterior(end[0], x), rtol=1e-6, atol=1e-8)


def test_with_an_exact_flow_map_steps_are_jumps():
    prior, x_0 = gaussian(), randn(2, WIDTH)
    jumped = sample_posterior(
        map_of(prior), x_0, x_0, torch.zeros_like(x_0, dtype=torch.bool), "replace", times(3)
    )
    torch.testing.assert_close(jumped, prior.solution(x_0, 1.0))


def test_mmps_takes_a_flow_map_s_velocity():
    prior, measured = gaussian(), Case(ROWS).measurement(randn(2, 8, seed=1))
    by = [sample_posterior(u, randn(2, WIDTH), *measured, "mmps", times(3), numbered((2, WIDTH)))
          for u in (map_of(prior), velocity_of(prior))]  # fmt: skip
    torch.testing.assert_close(*by)


def test_mmps_samples_the_posterior_of_a_gaussian():
    prior, case = gaussian(), Case(ROWS)
    y = case.measure(prior.sample(3, draws(4)))
    means, covariance = moments(
        velocity_of(prior), "mmps:products=12", case, y, times(40, "power:1.5")
    )
    total = 0.0
    for one, mean in zip(y, means, strict=True):
        posterior = prior.posterior(case.matrix, one, 0.0)
        total = float(torch.trace(posterior.covariances[0]))
        assert float((mean - posterior.means[0]).norm()) < 0.01 * math.sqrt(total)
    assert float(bures(covariance, posterior.covariances[0])) < 0.02**2 * total


def test_replacement_s_mean_is_biased_by_what_quadrature_says():
    """Two values of unit variance and correlation c, one known: y = 1, noise 0. The posterior's
    mean is c.
    """
    c = 0.8
    prior = Correlated(torch.zeros(1, 2).double(), torch.tensor([[[1.0, c], [c, 1.0]]]).double())
    t = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    values = torch.tensor([[1 + c], [1 - c]], dtype=torch.float64)
    variance = (1 - t) ** 2 + t**2 * values
    # the ODE x_2' = mean(rate) x_2 + half their difference t y
    rate = (t * values - (1 - t)) / variance
    carried = (values / variance).prod(0) ** 0.25
    expected = float(torch.trapezoid((rate[0] - rate[1]) / 2 * t * carried, t))
    assert expected < 0.75 * c
    x_0 = torch.zeros(1, 2).double()
    y = torch.tensor([[1.0, 0.0]]).double()
    for method in ("replace", "repaint:repeats=1"):
        found = sample_posterior(
            velocity_of(prior), x_0, y, y > 0, method, times(400), lambda j: x_0
        )
        assert float(found[0, 1]) == pytest.approx(expected, abs=5e-3)


def test_repaint_leaves_less_of_replacement_s_bias_the_more_often_it_repeats():
    prior, case = gaussian(), Case(ROWS)
    y = case.measure(prior.sample(4, draws(4)))
    exact = torch.cat([prior.posterior(case.matrix, one, 0.0).means for one in y])
    off = []
    for repeats in (1, 4, 16):
        zeros = torch.zeros(4, WIDTH).double()
        sampler, measured = Repaint(repeats=repeats), case.measurement(y)
        found = sampler.run(velocity_of(prior), zeros, *measured, times(32), lambda j: zeros)  # noqa: B023
        off.append(float((found - exact).norm()))
    assert off[1] < 0.6 * off[0]
    assert off[2] < 0.6 * off[1]


@pytest.mark.parametrize("method", ["replace", "repaint:repeats=3", "mmps"])
def test_with_nothing_measured_it_draws_from_the_prior(method):
    prior, case = Correlated(torch.full((1, 4), 0.3).double(), ring(4)[None]), Case(torch.zeros(4))
    means, covariance = moments(
        velocity_of(prior), method, case, torch.zeros(1, 0).double(), times(100, "power:1.5")
    )
    torch.testing.assert_close(means[0], prior.means[0], rtol=0, atol=1e-3)
    assert float(bures(covariance, ring(4))) < 0.03**2 * float(torch.trace(ring(4)))


@pytest.mark.parametrize("method", ALL)
def test_a_scan_s_answer_does_not_depend_on_its_batch(method):
    flow, y = Field(gaussian(), (WIDTH,)), randn(4, WIDTH).float()
    known = (torch.rand(4, WIDTH, generator=draws(1)) < 0.4).float()
    known[2] = 1
    condition, how = {"image": y, "known": known}, build_sampler(method, steps=4)
    whole = flow(
        Draws(3, range(4)).start((WIDTH,)), condition, sampler=how, draws=Draws(3, range(4))
    )
    assert whole.evaluations.tolist() == [how.evaluations()] * 4
    assert torch.equal(whole.x[2], y[2])
    for i in range(4):
        own = {name: value[i : i + 1] for name, value in condition.items()}
        alone = flow(Draws(3, [i]).start((WIDTH,)), own, sampler=how, draws=Draws(3, [i]))
        torch.testing.assert_close(alone.x[0], whole.x[i])


@pytest.mark.parametrize("family", ["rectified_flow", "flow_map"])
@pytest.mark.parametrize("method", ALL)
def test_every_flow_completes_a_scan(family, method):
    flow, seen = build_generator({**CONFIG, "generator": {"name": family}}).eval(), []
    # the third is 1 in float32
    how, who = build_sampler(method, grid=[0, 0.5, 1 - 1e-8, 1]), Draws(0, range(2))
    x_0 = who.start(flow.noise_shape)
    known = torch.zeros_like(x_0)
    known[:, :, ::2] = 1
    y = torch.rand(x_0.shape, generator=draws(1))
    condition = {"image": y, "known": known}
    made = flow(x_0, condition, sampler=how, draws=who, progress=lambda: seen.append(1))
    assert made.converged.all()
    assert torch.equal(made.x[known > 0], y[known > 0])
    assert len(seen) == how.evaluations()
    with torch.inference_mode():
        assert torch.equal(flow(x_0, condition, sampler=how, draws=who).x, made.x)
    with pytest.raises(InputError, match="condition"):
        flow(x_0, sampler=how, draws=who)
    if how.draws:
        with pytest.raises(InputError, match="give draws"):
            flow(x_0, condition, sampler=how)
    for plain in ("euler", "jump")[: 2 if family == "flow_map" else 1]:
        with pytest.raises(InputError, match="mmps"):
            flow(x_0, condition, sampler=build_sampler(plain, steps=2))
