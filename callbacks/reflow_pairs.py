"""Generation of missing pairs before training."""

import lightning as L

from r2flow.data.datamodule import ScanDataModule
from r2flow.data.pairs import make_pairs
from r2flow.model.checkpoint import load_checkpoint


class ReflowPairs(L.Callback):
    """Draws missing or damaged pairs of the run's data at its start, on all devices.

    Args:
        of: The flow that draws the pairs (`data.pairs.of`, else `stage.init`); None if the run has no parent.
    """

    def __init__(self, of: str | None) -> None:
        self.of = of

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, ScanDataModule) or data.pairs is None or self.of is None:
            return
        # File locks, not a barrier: collective calls time out after half an hour, and a slow rank may take longer.
        make_pairs(data.pair_store, load_checkpoint(self.of).generator.to(trainer.strategy.root_device))
