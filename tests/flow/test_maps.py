"""Flow maps as mathematics: jump times, objectives against exact maps."""

import pytest
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.flow.maps import OBJECTIVES, JumpTimes, consistency
from r2flow.flow.path import expand_time
from r2flow.flow.problems import Gaussian, Straight
from r2flow.generators.flow import Conditioned
from tests.fields import Field

X_0 = torch.linspace(-2, 2, 12, dtype=torch.float64).view(3, 2, 2)
T, S = (
    torch.tensor([0.0, 0.37, 0.8], dtype=torch.float64),
    torch.tensor([1.0, 0.37, 0.81], dtype=torch.float64),
)


def exact_map(problem):
    """u(t, x, s) of a problem whose paths are known."""

    def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
        length, shift = expand_time(s - t, x), problem.solution(torch.zeros_like(x), t)
        x_0 = (x - shift) / (problem.solution(torch.ones_like(x), t) - shift)  # x_t = m_t + c_t x_0
        moved = problem.solution(x_0, s) - x
        return torch.where(
            length == 0, problem(t, x), moved / torch.where(length == 0, 1.0, length)
        )

    return u


def test_jump_times_keep_their_shares():
    u = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    t, s = JumpTimes(steps=(1, 1, 4), share=0.6, diagonal=0.25)(u)
    assert abs(float(((t == 0) & (s == 1)).double().mean()) - 0.6 * 2 / 3) < 0.005
    quarter = (s - t - 0.25).abs() < 1e-9
    for begin in (0, 0.25, 0.5, 0.75):
        assert abs(float((quarter & (t == begin)).double().mean()) - 0.6 / 3 / 4) < 0.003
    assert abs(float((s == t).double().mean()) - 0.1) < 0.003
    assert ((t >= 0) & (t <= s) & (s <= 1)).all()


def test_ends_begin_at_times_of_the_density():
    u = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    late = {"name": "logit_normal", "mean": 3.0, "std": 1.6}
    t, s = JumpTimes(steps=(1,), share=0.5, diagonal=0.2, ends=0.6, time=late)(u)
    ends = (s == 1) & (t > 0) & (t < 1)
    assert abs(float(ends.double().mean()) - 0.5 * 0.6) < 0.005
    quantiles = torch.logit(t[ends]).quantile(torch.tensor([0.5, 0.8413], dtype=torch.float64))
    torch.testing.assert_close(
        quantiles, torch.tensor([3.0, 4.6], dtype=torch.float64), atol=0.03, rtol=0
    )


def test_the_last_draw_below_one_is_still_a_jump():
    top = torch.full((1, 3), 1 - 2**-24)
    for share in (0.0, 0.999999):
        t, s = JumpTimes(steps=(1, 2, 16), share=share)(
            torch.cat([top[:, :1] * share, top[:, 1:]], 1)
        )
        assert 0 <= float(t) <= float(s) <= 1


def test_jumps_fall_on_the_grid_that_they_are_drawn_with():
    u = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    t, s = JumpTimes(steps=(1, 2, 3), grid="power:3", share=1.0)(u)
    expected = {
        (1 - (1 - i / k) ** 3, 1 - (1 - (i + 1) / k) ** 3) for k in (1, 2, 3) for i in range(k)
    }
    found = set(zip(t.tolist(), s.tolist(), strict=True))
    assert len(found) == len(expected) == 6
    for pair in expected:
        assert min(abs(a - pair[0]) + abs(b - pair[1]) for a, b in found) < 1e-6


@pytest.mark.parametrize("options", [{"grid": "power:0.5"}, {"steps": (0, 1)}, {"ends": 0.6}])
def test_jump_times_that_cannot_be_are_refused(options):
    with pytest.raises(InputError, match="found"):
        JumpTimes(**options)


@pytest.mark.parametrize("name", list(OBJECTIVES))
@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_the_exact_map_of_a_straight_flow_is_what_every_objective_asks_for(name, rho):
    problem = Straight()
    u = exact_map(problem)
    x_t, target = OBJECTIVES[name](
        u, X_0, problem.solution(X_0, 1.0), T, S, torch.full_like(T, rho)
    )
    torch.testing.assert_close(x_t, problem.solution(X_0, T))
    torch.testing.assert_close(target, u(T, x_t, S))


def test_consistency_ends_at_both_of_its_limits():
    x_1, u = torch.ones_like(X_0), exact_map(Gaussian())
    x_t, target = consistency(u, X_0, x_1, T, S, torch.ones_like(T))
    torch.testing.assert_close(target, 1 - X_0)  # k-TD's
    x_t, target = consistency(u, X_0, x_1, T, S, torch.zeros_like(T))
    torch.testing.assert_close(target, u(T, x_t, S))  # itself


def test_each_scan_is_asked_for_under_its_own_condition():
    """Of three scans whose velocities are 1, 2 and 3 everywhere, the second has s = t and is not
    asked.
    """

    class Speeds(Field):  # without weights
        def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition=None) -> Tensor:
            return expand_time(condition["speed"], x).expand_as(x)

    u = Conditioned(
        Speeds(exact_map, (2, 2)), {"speed": torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)}
    )
    rho = torch.where(T == S, 1.0, torch.zeros_like(T))
    _, target = consistency(u, X_0, X_0 + 7, T, S, rho)
    torch.testing.assert_close(
        target, expand_time(torch.tensor([1.0, 7.0, 3.0]).double(), X_0).expand_as(X_0)
    )


@pytest.mark.parametrize("name", list(OBJECTIVES))
def test_a_target_has_no_gradient(name):
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    aim = OBJECTIVES[name](lambda t, x, s: weight * x, X_0, 1 - X_0, T, S, torch.full_like(T, 0.3))
    assert not any(part.requires_grad for part in aim)
