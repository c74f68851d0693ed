"""Flow map: a network that jumps from any time t to any time s."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from r2flow.flow.maps import MeanVelocity
from r2flow.generators.base import Condition
from r2flow.generators.flow import Conditioned, RectifiedFlow
from r2flow.lidar.space import ModelSpace
from r2flow.samplers import Jump


class FlowMap(RectifiedFlow):
    """X_{t->s}(x) = x + (s - t) u(x, t, s) with u by a backbone of two times.

    Samplers: those of `r2flow.samplers.maps`, and a flow's samplers with v(t, x) = u(x, t, t).
    """

    second_time: ClassVar[bool] = True
    goes_on_as = "rectified_flow"  # a velocity loss would leave the jumps to those of the old flow

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space, backbone)
        self.run_by(Jump())

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """u(x, t, s), (B, C, H, W), the mean velocity from time t to time s, of shape () or (B,)."""
        assert condition is None
        return self.backbone(t, x, s)

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition."""
        return self.mean_velocity if condition is None else Conditioned(self, condition)
