"""Scalar draws have the moments of their distributions."""

import math

import numpy as np
import pytest

from r2flow.simulator.scalar_draws import ScalarDraws

N = 20_000


@pytest.fixture
def draws() -> ScalarDraws:
    return ScalarDraws(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "arguments", "mean", "deviation"),
    [
        ("uniform", (2.0, 5.0), 3.5, 3 / math.sqrt(12)),
        ("normal", (1.0, 0.5), 1.0, 0.5),
        ("exponential", (3.0,), 3.0, 3.0),
        ("poisson", (2.5,), 2.5, math.sqrt(2.5)),
        ("chance", (0.3,), 0.3, math.sqrt(0.21)),
        ("whole", (1, 6), 3.5, math.sqrt(35 / 12)),
        ("side", (), 0.0, 1.0),
        ("pick", ((0, 1, 2), (1, 2, 1)), 1.0, math.sqrt(0.5)),
    ],
)
def test_mean_and_deviation(draws, name, arguments, mean, deviation):
    drawn = np.array([getattr(draws, name)(*arguments) for _ in range(N)], dtype=float)
    assert drawn.mean() == pytest.approx(mean, abs=5 * deviation / math.sqrt(N))
    assert drawn.std() == pytest.approx(deviation, rel=0.05)
