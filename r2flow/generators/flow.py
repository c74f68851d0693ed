"""Flows, generators by the ODE dx/dt = v(t, x) from noise at t = 0 to data at t = 1, and flow maps."""

from collections.abc import Mapping
from copy import copy
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from r2flow.backbones import build_backbone
from r2flow.errors import InputError, check
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.solvers import Solution, Velocity, solve
from r2flow.generators.base import Condition, Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.region import Region
from r2flow.noise import Draws
from r2flow.samplers import MMPS, FixedSteps, Jump, ODESampler, Sampler

USUAL = FixedSteps(method="adams3", steps=16, grid="power:1.5", finish=1 / 32)  # default of a new flow


class Flow(Generator):
    """A generator by an ODE. A subclass defines `velocity`."""

    # Samplers that complete scans, with their default settings; the first one is the default.
    completers: ClassVar[tuple[Sampler, ...]] = (MMPS(),)
    singular: ClassVar[bool] = False  # whether v grows without limit towards t = 1

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        """v(t, x), (B, C, H, W), at times t of shape () or (B,); a flow map without it is drawn by jumps alone."""
        raise NotImplementedError

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """u(t, x, s), (B, C, H, W), the mean velocity from t to s, () or (B,); v(t, x) unless it is a flow map."""
        return self.velocity(t, x, condition)

    def field(self, condition: Condition | None = None) -> Velocity:
        """v(t, x) under a condition, as passed to solvers."""
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
        **options: Any,
    ) -> Solution:
        """Solve the ODE from x at t_0, (B, ...), to t_1, without `finish`; options: `r2flow.flow.solvers.solve`."""
        how = sampler or self.sampler
        how.check(self)
        if not isinstance(how, ODESampler):
            raise InputError(f"sampler {how.name} does not follow the flow's paths: give a solver, such as adams3.")
        return solve(self.field(condition), x.to(self.device), t_0, t_1, **(how.options() | options))


class NetworkFlow(Flow):
    """A flow whose velocity is computed from a backbone's output, by the subclass.

    Args:
        backbone: Name and options, as in conf/backbone.
    """

    answer: str = "v(t, x)"  # the quantity that the network predicts
    region: Region | None = None  # region of the image that is generated; None: all of it
    condition_channels: int = 0  # additional input channels of the backbone, for a condition
    second_time: ClassVar[bool] = False  # whether the backbone takes a second time, for flow maps

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space)
        channels = space.shape[0]
        self.backbone = build_backbone(
            backbone, space.rays, channels + self.condition_channels, channels, self.second_time
        )

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        """Noise of step j, cropped to the region."""
        noise = draws.step(self.noise_shape, j)
        return noise if self.region is None else self.region.crop(noise)

    def start_from(self, parent: Generator) -> None:
        """Copy a flow's weights; layers for a second time are kept and start as a no-op.

        Only the velocity u(x, t, t) of a flow map is copied. Ray coordinates are not copied if the rays differ.
        """
        theirs = getattr(parent, "answer", self.answer)
        check(theirs == self.answer, f"the parent's network tells {theirs}, and this one learns {self.answer}.")
        state = self.state_dict()
        added = parent.backbone.second_time_names() if isinstance(parent, NetworkFlow) else frozenset[str]()
        inherited = {
            name: value
            for name, value in parent.state_dict().items()
            if name in state or (name.startswith("backbone.") and name.removeprefix("backbone.") not in added)
        }
        new = {name: value for name, value in state.items() if not name.startswith("backbone.")}
        new |= {name: state[name] for name in (f"backbone.{name}" for name in self.backbone.second_time_names())}
        if not torch.equal(self.space.rays, parent.space.rays):
            inherited |= {name: value for name, value in state.items() if name.endswith(".coords")}
            sized = [name for name, value in inherited.items() if name in state and value.shape != state[name].shape]
            if sized:
                size, parent_size = ("x".join(map(str, flow.space.shape)) for flow in (self, parent))
                raise InputError(
                    f"the parent has weights for images of {parent_size} ('{sized[0]}'), found {size}: leave "
                    f"sensor out, or give sensor.rows={parent.space.shape[1]} sensor.columns={parent.space.shape[2]}."
                )
        self._take(parent, {**new, **inherited})

    @property
    def unit(self) -> tuple[int, int]:
        return self.backbone.unit

    @property
    def learns_directions(self) -> bool:  # type: ignore[override]
        return self.backbone.learns_directions

    def part(self, region: Region) -> Self:
        """The flow on a region; the network does not see the rest of the image."""
        if region.share == 1:
            return self
        part = copy(self)
        part._modules = {"backbone": self.backbone.cropped(region.rows, region.columns)}
        part.region = region
        return part


class RectifiedFlow(NetworkFlow):
    """v(t, x) by a backbone. 1-RF, k-RF and k-TD differ only in training and sampler."""

    usual: ClassVar[Sampler] = USUAL

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        assert condition is None
        return self.backbone(t, x)


class Conditioned:
    """v(t, x) or u(t, x, s) of a flow under a condition; `select` takes the condition of some scenes."""

    def __init__(self, flow: Flow, condition: Condition) -> None:
        self.flow, self.condition = flow, condition
        kinds = [p.dtype for p in flow.parameters() if p.is_floating_point()] or [torch.float64]  # without weights
        self.precision = max(kinds, key=lambda kind: torch.finfo(kind).eps)

    def __call__(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        if s is None:
            return self.flow.velocity(t, x, self.condition)
        return self.flow.mean_velocity(t, x, s, self.condition)

    def select(self, scenes: Tensor) -> "Conditioned":
        return Conditioned(self.flow, {name: value[scenes.to(value.device)] for name, value in self.condition.items()})


class FlowMap(RectifiedFlow):
    """X_{t->s}(x) = x + (s - t) u(x, t, s) with u by a backbone of two times.

    Samplers: those of `r2flow.samplers.maps`, and a flow's samplers with v(t, x) = u(x, t, t).
    """

    second_time: ClassVar[bool] = True
    usual = Jump()
    goes_on_as = "rectified_flow"  # a velocity loss would leave the jumps to those of the old flow

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        assert condition is None
        return self.backbone(t, x, s)

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition."""
        return self.mean_velocity if condition is None else Conditioned(self, condition)


def ode_sampler(flow: Flow) -> Sampler:
    """The flow's default sampler if it is an ODE sampler, else `USUAL`."""
    return flow.sampler if isinstance(flow.sampler, ODESampler) else USUAL


def as_flow(generator: Generator, what: str, distilled: bool = False) -> Flow:
    """The generator, if it is a flow; one distilled for the times of its steps only if `distilled`."""
    if not isinstance(generator, Flow) or not generator.draws:
        raise InputError(f"{what} needs the velocity of a flow from noise; a {type(generator).__name__} has none.")
    check(distilled or not generator.fixed, f"{what} needs all times; this flow is distilled for {generator.sampler}.")
    return generator
