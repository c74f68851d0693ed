"""Straightness of a flow's paths during training."""

import lightning as L

from r2flow.base.noise import Draws
from r2flow.base.registry import Count, Natural
from r2flow.flow.straightness import straightness
from r2flow.generators import Flow

from .periodic import Periodic, seed_of


class Curvature(Periodic):
    """Logs int s(t) dt (paper, eq. 6) of a few scans from fixed noise; of flows alone, and not of
    distilled ones.

    The metrics are `curvature/s` and, divided by the squared length of the path, `curvature/bend`:
    an untrained flow is straight because its paths have almost no length. `r2flow report curvature`
    writes s(t) itself.

    Args:
        every: Steps between two measurements; 0 for none.
        num: Scans per measurement.
        steps: Euler steps per scan.
    """

    def __init__(self, every: Natural = 500, num: Count = 2, steps: Count = 16) -> None:
        super().__init__(every)
        self.num = num
        self.steps = steps

    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        flow = pl_module.generator
        if not isinstance(flow, Flow) or not flow.unconditional or flow.fixed:
            return
        x_0 = Draws(seed_of(pl_module), range(self.num)).start(flow.noise_shape)
        result = straightness(flow.velocity, x_0.to(pl_module.device), self.steps)
        values = {
            "curvature/s": result.s.mean().item(),
            "curvature/bend": result.s_normalised.mean().item(),
        }
        for logger in trainer.loggers:
            # The index of the step, as Lightning logs.
            logger.log_metrics(values, trainer.global_step - 1)
