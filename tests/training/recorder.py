"""train.py with somebody looking on: each rank writes down its losses, its average, and what it
writes.

A script of its own because the ranks of a DDP run are processes that start the same script again.
"""

import hashlib
import json
import os
import sys
from pathlib import Path

import lightning as L
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from r2flow.callbacks import CALLBACKS
from r2flow.callbacks.checkpoints import AtomicCheckpointIO
from r2flow.callbacks.ema import averaged_weights

from r2flow.cli import main
from r2flow.data.loader import FlowDataset

FOLDER = Path(os.environ["R2FLOW_RECORD"])
BROKEN = set(json.loads(os.environ["R2FLOW_BROKEN"]))  # images whose scan is NaN


class Recorder(L.Callback):
    def __init__(self) -> None:
        self.losses: dict[int, float] = {}
        self.parts: list[float] = []

    def on_before_backward(self, trainer, pl_module, loss) -> None:
        self.parts.append(loss.item())  # divided by the number of accumulated batches already

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        if (batch_idx + 1) % trainer.accumulate_grad_batches == 0:
            self.losses[trainer.global_step] = sum(self.parts)
            self.parts = []

    def on_train_epoch_end(self, trainer, pl_module) -> None:
        rank = trainer.global_rank
        digest = hashlib.sha256()
        with averaged_weights(trainer, pl_module):
            for value in pl_module.state_dict().values():
                digest.update(value.numpy().tobytes())
        (FOLDER / f"average-{rank}.json").write_text(json.dumps(digest.hexdigest()))
        (FOLDER / f"losses-{rank}.json").write_text(json.dumps(self.losses))


save, item = AtomicCheckpointIO.save_checkpoint, FlowDataset.__getitem__


def save_recorded(self, checkpoint, path, storage_options=None) -> None:
    (FOLDER / f"wrote-{os.environ.get('LOCAL_RANK', '0')}-{Path(path).name}").touch()
    save(self, checkpoint, path, storage_options)


def item_broken(self, key):
    found = item(self, key)
    if self.purpose == "training" and key[0] in BROKEN:
        found["x_1"] = torch.full_like(found["x_1"], float("nan"))
    return found


AtomicCheckpointIO.save_checkpoint = save_recorded
FlowDataset.__getitem__ = item_broken
CALLBACKS.add("recorder", Recorder)

if __name__ == "__main__":
    main("train", command=[__file__])
