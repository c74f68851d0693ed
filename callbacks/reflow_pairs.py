"""Pairs for a run that learns from pairs, before its first step."""

import lightning as L

from r2flow.data.datamodule import ScanDataModule
from r2flow.model.checkpoint import load_checkpoint
from r2flow.reports.pairs import make_and_tell


class ReflowPairs(L.Callback):
    """When a run begins, makes the pairs that its data name and that are missing or damaged, over all its devices.

    Args:
        of: The flow that draws them (`data.pairs.of`, else `stage.init`); None where the run starts from no other.
    """

    def __init__(self, of: str | None) -> None:
        self.of = of

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, ScanDataModule) or data.pairs is None or self.of is None:
            return
        store, device, flow = data.pair_store, trainer.strategy.root_device, load_checkpoint(self.of)
        # Locks of files, not a barrier: a collective call gives up after half an hour, and a slow rank may take longer.
        make_and_tell(store, flow, trainer.global_rank, trainer.world_size, device)
