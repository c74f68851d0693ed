"""Adaptive solvers on every exact problem: a failure is flagged, or the global estimate shows it."""

from itertools import product

import pytest
import torch

from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import SOLVERS, solve
from r2flow.noise import Draws

JET = "narrow_jet"  # the known exception: nothing evaluated on either side of it shows it
# The type of the state, and of the network where it differs.
PRECISIONS = [(torch.float64, None)] + [(torch.float32, network) for network in (None, torch.bfloat16, torch.float16)]


def rounded(velocity, dtype):
    """A velocity as a network in half precision gives it; t stays in float32."""
    return velocity if dtype is None else lambda t, x: velocity(t, x.to(dtype).to(x.dtype)).to(dtype)


def verdict(name: str, method: str, tolerance: float, state=torch.float64, network=None) -> str:
    """'silent': more than ten tolerances off, not flagged, and an estimate more than a factor of five off."""
    problem, x_0 = PROBLEMS[name](), Draws(0, range(4)).start((32,)).to(state)
    found = solve(
        rounded(problem, network), x_0, method=method, tolerance=tolerance, global_error=True, max_evaluations=1000
    )
    difference = (found.x.double() - problem.solution(x_0, 1.0).double()).flatten(1)
    largest = difference.abs().amax(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    errors = largest[:, 0] * (difference / largest).square().mean(1).sqrt()  # squares of stiff problems' overflow
    failed, estimate = errors > 10 * tolerance, found.global_error
    flagged = found.stiff | ~found.converged | ~estimate.isfinite()
    honest = (estimate >= errors / 5) & (estimate <= errors * 5)
    if (failed & ~flagged & ~honest).any():
        return "silent"
    return "failed" if failed.any() else "flagged" if flagged.any() else "solved"


@pytest.mark.slow  # every problem by every solver takes minutes on a busy machine
def test_only_failures_on_the_jet_are_silent():
    methods = [name for name in SOLVERS if SOLVERS[name].adapts and name not in ("auto", "exprb43")]
    cells = list(product(PROBLEMS, methods, (1e-3, 1e-5), PRECISIONS))
    found = {cell: verdict(*cell[:3], *cell[3]) for cell in cells}
    assert {name for (name, *_), seen in found.items() if seen == "silent"} == {JET}
    assert sum(seen in ("failed", "silent") for seen in found.values()) > 30  # so that there is something to judge
    smooth = [seen for (name, *_), seen in found.items() if name in ("straight", "gaussian", "two_modes", "rotating")]
    assert "flagged" not in smooth
    assert verdict("stiff_1e4", "auto", 1e-3) == verdict("gaussian", "auto", 1e-3) == "solved"
