"""Machine-independent sines, quantiles and draws against those of the library."""

import math

import numpy as np
import pytest

from r2flow.simulator.draws import (
    ScalarDraws,
    cosine,
    exponentials,
    hypotenuse,
    logistic,
    normals,
    sine,
)

N = 40_000


def test_sine_and_cosine_are_those_of_the_library():
    x = np.linspace(-200, 200, 20001)
    np.testing.assert_allclose(sine(x), np.sin(x), atol=2e-9)
    np.testing.assert_allclose(cosine(x), np.cos(x), atol=2e-9)
    small = np.linspace(-7, 7, 5001, dtype=np.float32)
    assert sine(small).dtype == np.float32
    np.testing.assert_allclose(sine(small), np.sin(small.astype(np.float64)), atol=2e-6)
    np.testing.assert_array_equal(hypotenuse(np.array([3.0, -5.0]), np.array([4.0, 12.0])), [5, 13])


@pytest.mark.parametrize(
    ("draw", "mean", "deviation", "fourth"),
    [(normals, 0.0, 1.0, 3.0), (exponentials, 1.0, 1.0, 9.0)],
)
def test_draws_have_the_moments_of_their_distribution(draw, mean, deviation, fourth):
    x = draw(np.random.default_rng(0), (N,)).astype(np.float64)
    assert x.mean() == pytest.approx(mean, abs=5 * deviation / math.sqrt(N))
    assert x.std() == pytest.approx(deviation, rel=0.02)
    # tails end at the outermost of 8192 quantiles, which takes a few hundredths off the fourth
    # moment
    assert (((x - x.mean()) / x.std()) ** 4).mean() == pytest.approx(fourth, rel=0.15)


def test_the_smooth_step_rises_from_0_to_1_like_a_logistic():
    np.testing.assert_array_equal(logistic(np.array([-3.0, 0.0, 3.0])), [0, 0.5, 1])
    assert ((logistic(np.array([1e-4])) - logistic(np.array([-1e-4]))) / 2e-4)[0] == pytest.approx(
        0.25, abs=1e-6
    )


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
def test_mean_and_deviation(name, arguments, mean, deviation):
    draws = ScalarDraws(np.random.default_rng(0))
    drawn = np.array([getattr(draws, name)(*arguments) for _ in range(N)], dtype=float)
    assert drawn.mean() == pytest.approx(mean, abs=5 * deviation / math.sqrt(N))
    assert drawn.std() == pytest.approx(deviation, rel=0.05)
