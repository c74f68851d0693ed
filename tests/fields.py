"""A flow whose velocity is a given function: an exact problem, or a small network."""

from torch import Tensor, nn

from r2flow.flow.solvers import Velocity
from r2flow.generators import Flow
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers import FixedSteps

CONFIG = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 32},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {
        "name": "hdit",
        "base_channels": 16,
        "depths": [1, 1],
        "num_heads": [1, 2],
        "time_channels": 16,
    },
}  # of a tiny flow


class Field(Flow):
    """dx/dt = function(t, x) on states of `noise_shape`; without a space there is nothing to
    decode.
    """

    def __init__(
        self, function: Velocity, noise_shape: tuple[int, ...], space: ModelSpace | None = None
    ) -> None:
        nn.Module.__init__(self)
        self.function, self.noise_shape, self.space = function, noise_shape, space
        self.run_by(FixedSteps())

    def velocity(self, t: Tensor, x: Tensor, condition=None) -> Tensor:
        return self.function(t, x)

    def field(self, condition=None) -> Velocity:
        return self.function
