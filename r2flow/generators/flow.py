"""Generators that follow a velocity: dx/dt = v(t, x) from noise at t = 0 to data at t = 1."""

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from r2flow.backbones import build_backbone
from r2flow.errors import InputError
from r2flow.flow.posterior import METHODS, completes, parse_method, sample_posterior
from r2flow.flow.solvers import (
    Solution,
    Velocity,
    adapts,
    check_method,
    check_tolerance,
    fixed_step,
    solve,
)
from r2flow.flow.solvers.grids import build_grid
from r2flow.flow.solvers.solution import finite, stepped, wide
from r2flow.flow.stochastic import SDE, churn_of, sde
from r2flow.generators.base import WAYS, Condition, Generated, Generator, Progress, Sampler, parts_of
from r2flow.lidar.region import Region
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws

USUAL = Sampler("adams3", 16, grid="power:1.5", finish=1 / 32)  # of a new flow: docs/results.md
UNTOLD = f"this flow was trained without a condition; a scan is completed with it by --solver {', '.join(METHODS)}."


class Flow(Generator):
    """A generator by an ODE. A subclass gives its velocity, and names what it is sampled by beside solvers.

    The sampler `sde:C` replaces noise on the way, by C times the reversed diffusion's share (`r2flow.flow.stochastic`).
    """

    other_samplers: ClassVar[tuple[str, ...]] = (SDE,)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        """v(t, x), (B, C, H, W), at times t of shape () or (B,)."""
        raise NotImplementedError

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """u(t, x, s), what is known at time t of the mean velocity from t to s: v(t, x), but for a flow map."""
        return self.velocity(t, x, condition)

    def field(self, condition: Condition | None = None) -> Velocity:
        """v(t, x) under a condition, as solvers take it."""
        return self.velocity if condition is None else Conditioned(self, condition)

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
        """The state at t_1 of the ODE from x at t_0, (B, ...); see `r2flow.flow.solvers.solve` for the options.

        Raises:
            InputError: as `solve` does.
        """
        how = sampler or self.sampler
        if self.draws_noise(how):
            raise InputError(f"{how.method} draws noise on the way: give a solver, as --solver adams3.")
        field, x = self.field(condition), x.to(self.device)

        return solve(field, x, t_0, t_1, how.method, how.steps, how.tolerance, progress, grid=how.times, **options)

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
        if completes(how.method):
            if condition is None:
                raise InputError(f"{how.method} completes a scan of which a part is known; give what is known.")
            return self._completed(noise, condition, how, draws, progress)
        churn = churn_of(how.method)
        if churn is not None:
            return self._stochastic(noise, condition, how, churn, draws, progress)
        options: dict[str, Any] = {}
        if how.finish and how.steps > 1:
            how, options = replace(how, steps=how.steps - 1), {"finish": how.finish}
        end = self.solve(noise, sampler=how, condition=condition, progress=progress, **options)
        return Generated(end.x, end.evaluations, end.converged)

    @torch.no_grad()
    def _stochastic(
        self,
        noise: Tensor,
        condition: Condition | None,
        how: Sampler,
        churn: float,
        draws: Draws | None,
        progress: Progress,
    ) -> Generated:
        if draws is None:
            raise InputError(f"{how.method} draws further noise: give draws.")
        noise = wide(noise.to(self.device))
        x, times = noise, self._stochastic_times(how)
        field, alive = self.field(condition), finite(x)

        def estimate(t: Tensor, x: Tensor) -> Tensor:
            return x + (1 - t) * field(t, x).to(x)

        def fresh(j: int) -> Tensor:
            return self.further_noise(draws, j).to(noise)

        for following in sde(estimate, x, times, churn, fresh):
            x, alive = stepped(x, following, alive)
            if progress is not None:
                progress()
        return Generated.after(x, len(times) - 1, alive)

    def _stochastic_times(self, how: Sampler) -> Tensor:
        if not how.finish or how.steps == 1:
            return self._times(how)
        if how.finish == 1:
            raise InputError("finish must be shorter than the interval from 0 to 1, found 1.")
        times = self._times(replace(how, steps=how.steps - 1), 0.0, 1 - how.finish)
        return torch.cat([times, times.new_ones(1)])

    def draws_noise(self, sampler: Sampler) -> bool:
        """Whether a sampler draws noise on the way, so that a scan is no function of its first noise alone."""
        return churn_of(sampler.method) is not None

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        """The noise of step j."""
        return draws.step(self.noise_shape, j)

    @torch.no_grad()
    def _completed(
        self, noise: Tensor, condition: Condition, how: Sampler, draws: Draws | None, progress: Progress
    ) -> Generated:
        """x_1 given a part of it, by a method of `r2flow.flow.posterior`."""
        x_0 = wide(noise.to(self.device))
        image, known = parts_of(condition, x_0)

        def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
            velocity = self.mean_velocity(t, x, s).to(x)
            if progress is not None:
                progress()
                if velocity.requires_grad:
                    velocity.register_hook(lambda _: progress())  # each product with the Jacobian
            return velocity

        further = None if draws is None else lambda j: self.further_noise(draws, j).to(x_0)
        times = self._times(how)
        x = sample_posterior(u, x_0, image, known > 0, how.method, times, further)
        return Generated.after(x, parse_method(how.method).evaluations(len(times) - 1))

    def _times(self, sampler: Sampler, t_0: float = 0.0, t_1: float = 1.0) -> Tensor:
        return build_grid(sampler.times, t_0, t_1, sampler.steps)

    def check_sampler(self, sampler: Sampler) -> None:
        if completes(sampler.method):
            parse_method(sampler.method)
            if sampler.finish:
                raise InputError(f"{sampler.method} has no finish; leave it out.")
            self._times(sampler)
            return
        if churn_of(sampler.method) is not None:
            self._stochastic_times(sampler)
            return
        if sampler.method.partition(":")[0] in WAYS:
            raise InputError(
                f"{sampler.method} is for flow maps (experiment=flow_map), and this is none: give a solver, as adams3."
            )
        check_method(sampler.method, self.other_samplers)
        check_tolerance(sampler.tolerance)
        self._times(sampler)
        if adapts(sampler.method) and sampler.grid != "uniform":
            raise InputError(f"a time grid is for a solver of fixed steps; {sampler.method} chooses its own.")

    def in_steps(self, steps: int) -> Sampler:
        own = self.sampler  # of a distilled flow the steps that it has learned
        return own if own.fixed and own.steps == steps else Sampler("euler", steps)

    def evaluations_of(self, sampler: Sampler) -> int:
        if completes(sampler.method):
            return parse_method(sampler.method).evaluations(sampler.steps)
        if churn_of(sampler.method) is not None:
            return len(self._stochastic_times(sampler)) - 1
        method = fixed_step(sampler.method)
        return 0 if method is None else method.cost(sampler.steps)


class NetworkFlow(Flow):
    """A flow whose velocity follows from a backbone. A subclass says how.

    Args:
        space: The images it makes.
        backbone: Name and options, as in conf/backbone.

    Attributes:
        answer: What its network tells.
        region: The part of the image that it makes; None for all of it.
    """

    answer: str = "v(t, x)"
    region: Region | None = None
    condition_channels: int = 0  # further input channels of the backbone, for a subclass with a condition
    second_time: ClassVar[bool] = False  # whether the backbone takes a second time, for a subclass that is a flow map

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space)
        channels = space.shape[0]
        self.backbone = build_backbone(
            backbone, space.rays, channels + self.condition_channels, channels, self.second_time
        )

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        """The noise of step j, for the part of the image that is made."""
        noise = draws.step(self.noise_shape, j)
        return noise if self.region is None else self.region.crop(noise)

    def start_from(self, parent: Generator) -> None:
        """Take over a flow's weights; what a second time or a condition adds changes nothing at first.

        A condition of the other flow is forgotten, and of a flow map all but its velocity u(x, t, t). A flow that looks
        elsewhere, as through another sensor, keeps its own rays.

        Raises:
            InputError: other weights; a network that tells something else; one with weights for each place of the
                image, and another size.
        """
        theirs_tell = getattr(parent, "answer", self.answer)
        if theirs_tell != self.answer:
            raise InputError(f"the network to start from tells {theirs_tell}, and this one learns {self.answer}.")
        own = self.state_dict()
        more = self.condition_channels - getattr(parent, "condition_channels", 0)
        apart = parent.backbone.second_time_names() if isinstance(parent, NetworkFlow) else frozenset[str]()
        theirs = {
            name: _with_inputs(value, own[name].shape, self.space.shape[0], more) if name in own else value
            for name, value in parent.state_dict().items()
            if name in own or (name.startswith("backbone.") and name.removeprefix("backbone.") not in apart)
        }
        new = {name: value for name, value in own.items() if not name.startswith("backbone.")}
        new |= {name: own[name] for name in (f"backbone.{name}" for name in self.backbone.second_time_names())}
        if not torch.equal(self.space.rays, parent.space.rays):
            theirs |= {name: value for name, value in own.items() if name.endswith(".coords")}  # of an inner one too
            sized = [name for name, value in theirs.items() if name in own and value.shape != own[name].shape]
            if sized:
                here, there = ("x".join(map(str, one.space.shape)) for one in (self, parent))
                raise InputError(
                    f"the network to start from has weights for images of {there} ('{sized[0]}'), found {here}: leave "
                    f"sensor out, give sensor.rows={parent.space.shape[1]} sensor.columns={parent.space.shape[2]}, "
                    "or first grow it to a multiple of its size (r2flow.growing)."
                )
        self._take(parent, {**new, **theirs})

    @property
    def unit(self) -> tuple[int, int]:
        return self.backbone.unit

    @property
    def learns_directions(self) -> bool:
        return self.backbone.learns_directions

    def part(self, region: Region) -> Self:
        """The flow on a region alone: its network does not see the rest of the image."""
        if region.share == 1:
            return self
        part = copy(self)
        part._modules = {"backbone": self.backbone.cropped(region.rows, region.columns)}
        part.region = region
        return part


class RectifiedFlow(NetworkFlow):
    """v(t, x) by a backbone: 1-RF, k-RF and k-TD alike, which differ in how they are learned and in their sampler.

    Args:
        space: The images it makes.
        backbone: Name and options, as in conf/backbone.
    """

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space, backbone)
        self.sampler = USUAL

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        if condition is not None:
            raise InputError(UNTOLD)
        v: Tensor = self.backbone(t, x)
        return v

    def untold(self) -> "RectifiedFlow":
        """The flow of scans of which nothing is known: itself, where it takes no condition."""
        return self


def _with_inputs(weights: Tensor, wanted: tuple[int, ...], channels: int, more: int) -> Tensor:
    """Weights on an image's channels, and features behind them, with `more` zeros between these, or as many taken out.

    Other weights, which the wanted shape tells, stay as they are.
    """
    if not more or weights.shape == wanted or len(wanted) < 2 or weights.shape[1] + more != wanted[1]:
        return weights
    own, rest = weights[:, :channels], weights[:, channels + max(-more, 0) :]
    return torch.cat([own, weights.new_zeros(len(weights), max(more, 0), *weights.shape[2:]), rest], dim=1)


class Field(Flow):
    """A flow whose velocity is a given function: an exact problem, or a network of another origin.

    Args:
        function: v(t, x) with t of shape () or (B,), as `r2flow.flow.solvers.solve` takes it.
        noise_shape: Of one state.
        space: The images that the states are, where they are images; without one there is nothing to decode.
    """

    def __init__(self, function: Velocity, noise_shape: tuple[int, ...], space: ModelSpace | None = None) -> None:
        nn.Module.__init__(self)
        self.function, self.noise_shape, self.sampler = function, noise_shape, Sampler()
        if space is not None:
            self.space = space

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self.function(t, x)

    def field(self, condition: Condition | None = None) -> Velocity:
        if condition is not None:
            raise InputError(UNTOLD)
        return self.function

    @property
    def device(self) -> torch.device:
        return next((p.device for p in self.parameters()), torch.device("cpu"))


class Conditioned:
    """v(t, x) or u(t, x, s) of a flow under a condition, which follows the scans that are still asked for."""

    def __init__(self, flow: Flow, condition: Condition) -> None:
        self.flow, self.condition = flow, condition
        self.precision = max((p.dtype for p in flow.parameters()), key=lambda kind: torch.finfo(kind).eps)

    def __call__(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        if s is None:
            return self.flow.velocity(t, x, self.condition)
        return self.flow.mean_velocity(t, x, s, self.condition)

    def select(self, scenes: Tensor) -> "Conditioned":
        return Conditioned(self.flow, {name: value[scenes.to(value.device)] for name, value in self.condition.items()})


def ode_sampler(flow: Flow) -> Sampler:
    """A flow's own sampler, or the usual one where its own draws noise on the way."""
    return USUAL if flow.draws_noise(flow.sampler) else flow.sampler


def as_flow(generator: Generator, what: str) -> Flow:
    """The generator as a flow.

    Raises:
        InputError: it follows no velocity, which `what` needs.
    """
    if not isinstance(generator, Flow):
        raise InputError(f"{what} needs the velocity of a flow, which a {type(generator).__name__} does not have.")
    return generator
