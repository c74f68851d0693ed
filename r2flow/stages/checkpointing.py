"""Atomic writing of Lightning's checkpoints."""

import os
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.model.checkpoint import read_checkpoint


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes Lightning's checkpoints to a temporary file, flushed to disk before it replaces the old checkpoint."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint atomically; earlier checkpoints survive any error."""
        try:
            with atomic_write(Path(path)) as file:
                torch.save(checkpoint, file)
        except (OSError, RuntimeError) as error:
            # torch's writer raises a RuntimeError when the file's write fails.
            cause = error.__context__ if isinstance(error, RuntimeError) else error
            if not isinstance(cause, OSError):
                raise
            kept = "The earlier checkpoints are intact; fix" if any(Path(path).parent.glob("step-*.ckpt")) else "Fix"
            raise InputError(
                f"{path} cannot be written: {cause.strerror or cause}. {kept} this and give the same command again."
            ) from None

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None) -> dict[str, Any]:
        # On the CPU, as in Lightning, so that a run can resume without the GPU that it started on.
        checkpoint = read_checkpoint(path, map_location or "cpu")
        # Lightning's timer would resume with its time used up; trainer.max_time applies to each command.
        checkpoint["callbacks"] = {
            k: v for k, v in (checkpoint.get("callbacks") or {}).items() if not k.startswith("Timer")
        }
        return checkpoint
