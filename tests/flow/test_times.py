import math
from decimal import Decimal, getcontext

import pytest
import torch

from r2flow.flow import times
from r2flow.flow.times import TIMES, Discrete, Late, LogitNormal, Uniform, UShaped

N = 400_000
U = (torch.arange(N, dtype=torch.float64) + 0.5) / N  # every quantile once: no sampling error


def u_shaped_cdf(t, a=4.0):
    """Integral of the density (e^(at) + e^(a(1-t))) / Z from 0 to t."""
    z = 2 * math.expm1(a) / a
    return ((torch.expm1(a * t) + math.exp(a) * (1 - torch.exp(-a * t))) / a) / z


@pytest.mark.parametrize(
    ("time", "cdf"),
    [
        (Uniform(), lambda t: t),
        (UShaped(), u_shaped_cdf),
        (LogitNormal(), lambda t: torch.special.ndtr(torch.logit(t))),
        (Late(0.3), lambda t: 0.7 * t + 0.3 * torch.special.ndtr((torch.logit(t) - 2.0) / 1.6)),
        (Late(0.0), lambda t: t),
    ],
)
def test_times_follow_their_distribution(time, cdf):
    t = time(U).sort().values
    empirical = torch.arange(1, N + 1, dtype=torch.float64) / N
    assert (cdf(t.clamp(1e-15, 1 - 1e-15)) - empirical).abs().max() < 1e-4


def test_the_discrete_density_takes_each_of_its_times_equally_often():
    for k in (1, 2, 4, 5):
        values, counts = Discrete(k)(U).unique(return_counts=True)
        assert values.tolist() == [i / k for i in range(k)]
        assert (counts / N - 1 / k).abs().max() < 1e-5
    assert Discrete(4, "power:2")(U).unique().tolist() == pytest.approx(
        [0, 7 / 16, 12 / 16, 15 / 16]
    )


@pytest.mark.parametrize(
    "options",
    [{"name": n} for n in ("uniform", "u_shaped", "logit_normal")] + [{"name": "discrete", "k": 4}],
)
def test_times_stay_on_the_path_in_float32(options):
    last = torch.tensor([0.0, 0.5, math.nextafter(0.5, 0), 1 - 2**-24], dtype=torch.float32)
    t = TIMES.build(options)(last)
    assert t.dtype == torch.float32
    assert ((t >= 0) & (t <= 1)).all()
    if options["name"] == "discrete":
        assert (t < 1).all()


def test_the_reference_densities(shared):
    reference = torch.load(shared / "oracle" / "training.pt", weights_only=False)["time"]
    edges = reference["edges"].double()
    share = torch.histogram(UShaped(reference["a"])(U), edges).hist / N / edges.diff()
    assert (share / reference["u_shaped_exact_bin_density"] - 1).abs().max() < 0.01
    share = torch.histogram(LogitNormal()(U), edges).hist / N / edges.diff()
    assert (share[5:-5] / reference["hist"]["logit_normal"]["density"][5:-5] - 1).abs().max() < 0.05


@pytest.mark.parametrize("first", [0, 10**6, 10**8, 2**39])
def test_the_low_discrepancy_sequences_are_exact_and_even_however_late_they_begin(first):
    getcontext().prec, p, k = 60, Decimal(1), torch.arange(first, first + 64)
    for _ in range(100):
        p = (p + 1) ** (1 / Decimal(3))  # whose fixed point is p^3 = p + 1
    ratios = (Decimal(5).sqrt() - 1) / 2, 1 / p, 1 / p**2
    exact = [[float((i + Decimal("0.5")) * ratio % 1) for ratio in ratios] for i in k.tolist()]
    found = torch.column_stack([times.golden_sequence(k), times.plastic_sequence(k)])
    assert found.dtype == torch.float32
    # 24 bits, cut off, of a product that is off by half a bit.
    assert (found.double() - torch.tensor(exact, dtype=torch.float64)).abs().max() < 1.6 * 2**-24
    # By the three-distance theorem 64 points lie at least phi^-9 / sqrt(5) apart.
    assert found[:, 0].sort().values.diff().min() > 0.005
