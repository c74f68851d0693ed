"""Generation of missing pairs before training."""

import lightning as L

from r2flow.data.datamodule import ScanDataModule
from r2flow.model.checkpoint import load_checkpoint
from r2flow.reports.pairs import make_and_tell


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
        store, device, flow = data.pair_store, trainer.strategy.root_device, load_checkpoint(self.of)
        # File locks, not a barrier: collective calls time out after half an hour, and a slow rank may take longer.
        make_and_tell(store, flow, device)
