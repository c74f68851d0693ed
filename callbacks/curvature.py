"""How straight the paths are while a flow is trained."""

import lightning as L

from r2flow.flow.straightness import curvature
from r2flow.generators import Flow
from r2flow.noise import Draws
from r2flow.registry import Count, Natural

from .periodic import Periodic


class Curvature(Periodic):
    """Logs int s(t) dt (paper, eq. 5) of a few scans from fixed noise; of generators that are flows.

    As `curvature/s` and, over the squared length of the path, as `curvature/s_normalised`: an untrained flow is
    straight because it goes nowhere. It takes one pass of `steps` Euler steps; s(t) itself, which takes two, is in
    `r2flow report curvature`.

    Args:
        every: Steps between two measurements; 0 for none.
        num: Scans a measurement.
        steps: Euler steps a scan.
    """

    def __init__(self, seed: int, every: Natural = 500, num: Count = 2, steps: Count = 16) -> None:
        super().__init__(every)
        self.seed, self.num, self.steps = seed, num, steps

    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        flow = pl_module.generator
        if not isinstance(flow, Flow) or not flow.draws:
            return
        x_0 = Draws(self.seed, range(self.num)).start(flow.noise_shape).to(pl_module.device)
        found = curvature(flow.velocity, x_0, self.steps)
        values = {"s": found.total.mean().item(), "s_normalised": found.normalised.mean().item()}
        for logger in trainer.loggers:
            # Lightning counts the step that was being taken
            logger.log_metrics({f"curvature/{name}": value for name, value in values.items()}, trainer.global_step - 1)
