"""A flow map: one network that jumps from any time to any other."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.solvers import Solution
from r2flow.flow.solvers.solution import finite, stepped, wide
from r2flow.flow.stochastic import ahead, back, churn_of
from r2flow.generators.base import CHORD, JUMP, RENOISE, WAYS, Condition, Generated, Progress, Sampler
from r2flow.generators.flow import UNTOLD, Conditioned, RectifiedFlow
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws

QUIET = JUMP, CHORD  # what draws no noise on the way


class FlowMap(RectifiedFlow):
    """X_{t->s}(x) = x + (s - t) u(x, t, s) with u by a backbone of two times: any number of steps, one evaluation each.

    Samplers beside a flow's solvers, which follow v(t, x) = u(x, t, t):

    - `jump`: from each time of the grid to the next;
    - `chord`: from each time t to the next time s on the straight line to the end of a jump,
      x_s = x_t + (s - t) u(x_t, t, 1). The next jump sees that end under what is left of the same noise, and mends it.
      This is DDIM's step (Song et al. 2021) with X_{t->1}(x_t) for the estimate of the scan; with v for u it would be
      Euler's. Exact where paths are straight;
    - `renoise`: from each time t to the end, then back to the next time s along a line to fresh noise,
      x_s = (1 - s) e + s X_{t->1}(x_t): a sample of the same distribution where the map is exact, and not the end of
      this noise's own path (Song et al. 2023, consistency models, algorithm 1);
    - `renoise:C`: from t not to the end but so far beyond s that the way back replaces C times the noise that the
      reversed diffusion would (`r2flow.flow.stochastic.ahead`; Kim et al. 2024, consistency trajectory models, call a
      jump beyond s and back gamma-sampling).

    Args:
        space: The images it makes.
        backbone: Name and options, as in conf/backbone, of one that takes a second time.
    """

    second_time: ClassVar[bool] = True
    goes_on_as = "rectified_flow"  # where velocities alone are learned, the jumps would be those of another flow
    other_samplers = *WAYS, *RectifiedFlow.other_samplers

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space, backbone)
        self.sampler = Sampler(JUMP, 4)

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """u(x, t, s), (B, C, H, W), the mean velocity from time t to time s, of shape () or (B,)."""
        if condition is not None:
            raise InputError(UNTOLD)
        u: Tensor = self.backbone(t, x, s)
        return u

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition, as objectives take it."""
        return self.mean_velocity if condition is None else Conditioned(self, condition)

    @torch.no_grad()
    def solve(
        self,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        *,
        sampler: Sampler | None = None,
        condition: Condition | None = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        how = sampler or self.sampler
        if how.method not in QUIET:
            return super().solve(x, t_0, t_1, sampler=how, condition=condition, progress=progress, **options)
        if t_0 == t_1 or not len(x):  # no jump to take
            return super().solve(x, t_0, t_1, sampler=replace(how, method="euler"), condition=condition)
        given = [name for name, value in options.items() if value]
        if given:
            raise InputError(f"jumps have no {', '.join(given)}; leave that out, or give a solver, as --solver adams3.")
        end = self._jumps(x, self._times(how, t_0, t_1), condition, progress, chord=how.method == CHORD)
        return Solution.build(end.x, end.evaluations.cpu().numpy(), how.steps, 0, False, end.converged.cpu().numpy())

    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        how = sampler or self.sampler
        churn = _churn(how)
        if churn is None or how.method in QUIET:
            return super().generate(noise, condition, sampler=how, draws=draws, progress=progress)
        if draws is None and churn:
            raise InputError(f"{how.method} draws further noise: give draws.")
        with torch.no_grad():
            return self._jumps(noise, self._times(how), condition, progress, churn, draws)

    def _jumps(
        self,
        x: Tensor,
        times: Tensor,
        condition: Condition | None,
        progress: Progress,
        churn: float = 0.0,
        draws: Draws | None = None,
        chord: bool = False,
    ) -> Generated:
        x, u = wide(x.to(self.device)), self.map(condition)
        alive = finite(x)
        for n, (t, s) in enumerate(pairwise(times.tolist()), start=1):
            r = ahead(t, s, churn)
            at, to, aim = torch.tensor([t, r, float(times[-1]) if chord else r], dtype=torch.float64).to(x)
            following = x + (to - at) * u(at, x, aim)
            if draws is not None and r > s:
                following = back(following, r, s, self.further_noise(draws, n).to(x))
            x, alive = stepped(x, following, alive)
            if progress is not None:
                progress()
        return Generated.after(x, len(times) - 1, alive)

    def draws_noise(self, sampler: Sampler) -> bool:
        return super().draws_noise(sampler) or (sampler.method not in QUIET and _churn(sampler) is not None)

    def check_sampler(self, sampler: Sampler) -> None:
        name, colon, _ = sampler.method.partition(":")
        if colon and name in QUIET:
            raise InputError(f"{name} takes no number, found {sampler.method}; renoise:C does.")
        if _churn(sampler) is None:
            super().check_sampler(sampler)
            return
        if sampler.finish:
            raise InputError("jumps have no finish; leave it out, or give a solver.")
        self._times(sampler, 0.0, 1.0)

    def evaluations_of(self, sampler: Sampler) -> int:
        return sampler.steps if _churn(sampler) is not None else super().evaluations_of(sampler)

    def in_steps(self, steps: int) -> Sampler:
        own = self.sampler
        if own.fewer in QUIET:
            return own.changed(method=own.fewer, steps=steps)
        learned = own.grid if _churn(own) is not None else "uniform"
        return Sampler(JUMP, 4, grid=learned).changed(steps=steps)


def _churn(how: Sampler) -> float | None:
    """c of a sampler of jumps, 0 for those that draw no noise; None of another."""
    return 0.0 if how.method in QUIET else churn_of(how.method, RENOISE, math.inf)
