"""Pairs for a run that learns from pairs, before its first step."""

import lightning as L

from r2flow.checkpoints import load_checkpoint
from r2flow.data.datamodule import ScanDataModule
from r2flow.reports.pairs import make_and_tell, wait_for_others


class ReflowPairs(L.Callback):
    """When a run begins, makes the pairs that its data name and that are missing or damaged, over all its devices.

    Args:
        init: The flow that draws them (`stage.init`).
    """

    def __init__(self, init: str | None) -> None:
        self.init = init

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, ScanDataModule) or data.pairs is None or self.init is None:
            return
        store, num = data.pair_store, data.pairs.num
        device = trainer.strategy.root_device
        make_and_tell(store, load_checkpoint(self.init), num, trainer.global_rank, trainer.world_size, device)
        # Files, not a barrier: a collective call gives up after half an hour, and a slow rank may take longer.
        wait_for_others(store, num)
