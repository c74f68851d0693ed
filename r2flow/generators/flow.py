"""Flows, generators by the ODE dx/dt = v(t, x) from noise at t = 0 to data at t = 1, and maps."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.registry import Config
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.solvers import Solution, Velocity, solve
from r2flow.generators.base import Condition, Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers import MMPS, FixedSteps, Jump, ODESampler, Sampler

# Default of a new flow.
USUAL = FixedSteps(method="adams3", steps=16, grid="power:1.5", finish=1 / 32)


class Flow(Generator):
    """A generator by an ODE. A subclass defines `velocity`."""

    # Samplers that complete scans, with their default settings; the first one is the default.
    completers: ClassVar[tuple[Sampler, ...]] = (MMPS(),)
    singular = False  # whether v grows without limit towards t = 1

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        """v(t, x), (B, C, H, W), at times t of shape () or (B,).

        A flow map without it is drawn by jumps alone.
        """
        raise NotImplementedError

    def mean_velocity(
        self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None
    ) -> Tensor:
        """u(t, x, s), (B, C, H, W), the mean velocity from t to s, () or (B,).

        It is v(t, x), unless the flow is a flow map.
        """
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
        """Solve the ODE from x at t_0, (B, ...), to t_1, without `finish`.

        Options: `r2flow.flow.solvers.solve`.
        """
        how = sampler or self.sampler
        how.check(self)
        if not isinstance(how, ODESampler):
            raise InputError(
                f"sampler {how.name} does not follow the flow's paths: give a solver, as adams3."
            )
        field = self.field(condition)
        return solve(field, x.to(self.device), t_0, t_1, **(how.options() | options))


_BACKBONE = "backbone."
_SECOND_TIME = "backbone.interval_embedding."


class NetworkFlow(Flow):
    """A flow whose velocity is computed from a backbone's output, by the subclass.

    Args:
        backbone: Name and options, as in conf/backbone.
    """

    answer: str = "v(t, x)"  # the quantity that the network predicts
    condition_channels: int = 0  # additional input channels of the backbone, for a condition
    second_time = False  # whether the backbone takes a second time, for flow maps

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space)
        channels = space.shape[0]
        times: Config = (
            {"second_time": True} if self.second_time else {}
        )  # a plug-in may have one only
        self.backbone = BACKBONES.build(
            backbone,
            space.rays,
            in_channels=channels + self.condition_channels,
            out_channels=channels,
            **times,
        )

    def start_from(self, parent: Generator) -> None:
        """Copy a flow's weights; layers for a second time are kept and start as a no-op.

        Only the velocity u(x, t, t) of a flow map is copied. Ray coordinates are not copied if the
        rays differ.
        """
        learned = getattr(parent, "answer", self.answer)
        if learned != self.answer:
            raise InputError(
                f"the parent's network tells {learned}, and this one learns {self.answer}."
            )
        network = getattr(parent, "backbone", self.backbone)
        if network.parametrised != self.backbone.parametrised:
            raise InputError(
                f"the parent's network was trained with backbone.{network.parametrised}; it cannot "
                f"go on with {self.backbone.parametrised}."
            )
        state = self.state_dict()
        theirs = parent.state_dict()
        weights = {name: theirs[name] for name in theirs if name in state or not _optional(name)}
        kept = {name: state[name] for name in state if name not in weights and _optional(name)}
        if not torch.equal(self.space.rays, parent.space.rays):
            kept["backbone.coords"] = self.backbone.coords
        self._take(parent, weights | kept)

    @property
    def learns_directions(self) -> bool:  # type: ignore[override]
        return self.backbone.learns_directions


def _optional(name: str) -> bool:
    """Whether a parent's weights may lack an entry: all but those of a network of one time."""
    return name.startswith(_SECOND_TIME) or not name.startswith(_BACKBONE)


class RectifiedFlow(NetworkFlow):
    """v(t, x) by a backbone. 1-RF, k-RF and k-TD differ only in training and sampler."""

    default_sampler: ClassVar[Sampler] = USUAL

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self.backbone(t, x)


class Conditioned:
    """v(t, x) or u(t, x, s) of a flow under a condition.

    `select` takes the condition of some scenes; `precision` is the coarsest type of the weights.
    """

    def __init__(self, flow: Flow, condition: Condition) -> None:
        self.flow = flow
        self.condition = condition
        kinds = [p.dtype for p in flow.parameters() if p.is_floating_point()]
        self.precision = max(kinds, key=lambda kind: torch.finfo(kind).eps, default=torch.float64)

    def __call__(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        if s is None:
            return self.flow.velocity(t, x, self.condition)
        return self.flow.mean_velocity(t, x, s, self.condition)

    def select(self, scenes: Tensor) -> "Conditioned":
        condition = {name: value[scenes.to(value.device)] for name, value in self.condition.items()}
        return Conditioned(self.flow, condition)


class FlowMap(RectifiedFlow):
    """X_{t->s}(x) = x + (s - t) u(x, t, s) with u by a backbone of two times.

    Samplers: those of `r2flow.samplers.maps`, and a flow's samplers with v(t, x) = u(x, t, t).
    """

    second_time = True
    default_sampler = Jump()
    # A velocity loss would leave the jumps to those of the old flow.
    finetuned_as = "rectified_flow"

    def mean_velocity(
        self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None
    ) -> Tensor:
        return self.backbone(t, x, s)

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition."""
        return self.mean_velocity if condition is None else Conditioned(self, condition)


def ode_sampler(flow: Flow) -> Sampler:
    """The flow's default sampler if it is an ODE sampler, else `USUAL`."""
    return flow.sampler if isinstance(flow.sampler, ODESampler) else USUAL


def as_flow(generator: Generator, what: str, distilled: bool = False) -> Flow:
    """The generator, if it is a flow from noise.

    Raises:
        InputError: If it is none, or if it is distilled for the times of its steps, unless
            `distilled`.
    """
    if not isinstance(generator, Flow) or not generator.unconditional:
        raise InputError(
            f"{what} needs the velocity of a flow from noise; a {type(generator).__name__} has "
            "none."
        )
    if generator.fixed and not distilled:
        raise InputError(f"{what} needs all times; this flow is distilled for {generator.sampler}.")
    return generator
