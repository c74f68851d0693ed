"""Generation of missing pairs before training."""

import lightning as L

from r2flow.base.errors import InputError
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.pairs import make_pairs
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.lineage import find_parent


class ReflowPairs(L.Callback):
    """Draws missing or damaged pairs of the run's data at its start, on all devices.

    They are drawn by the flow `pairs.of` of the DataModule, else by the stage's parent.
    """

    def setup(self, trainer, pl_module, stage):
        data = trainer.datamodule
        if not isinstance(data, ScanDataModule) or data.pairs is None:
            return
        record = pl_module.parent
        if data.pairs.of is None and record is None:
            raise InputError(
                "pairs are drawn by a trained flow: give the stage a parent, or pairs={'of': RUN}."
            )
        network = pl_module.backbone if pl_module.own_network else None
        if data.pairs.of:
            record = find_parent(data.pairs.of, network).record()
        data.drawn_by(record)
        store = data.pair_store
        if store.missing_pairs():
            # File locks, not a barrier: collective calls time out after half an hour, and a slow
            # rank may take longer.
            flow = load_checkpoint(record.path, backbone=network).generator
            make_pairs(store, flow.to(trainer.strategy.root_device))
