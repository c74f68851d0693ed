"""A flow whose velocity is a given function: an exact problem, or a small network."""

from torch import Tensor, nn

from r2flow.flow.solvers import Velocity
from r2flow.generators import Flow
from r2flow.lidar.space import ModelSpace
from r2flow.samplers import FixedSteps


class Field(Flow):
    """dx/dt = function(t, x) on states of `noise_shape`; without a space there is nothing to decode."""

    def __init__(self, function: Velocity, noise_shape: tuple[int, ...], space: ModelSpace | None = None) -> None:
        nn.Module.__init__(self)
        self.function, self.noise_shape, self.space = function, noise_shape, space
        self.run_by(FixedSteps())

    def velocity(self, t: Tensor, x: Tensor, condition=None) -> Tensor:
        return self.function(t, x)

    def field(self, condition=None) -> Velocity:
        return self.function
