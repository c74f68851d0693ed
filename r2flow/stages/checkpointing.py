"""Lightning's checkpoints, flushed to the disk before they take the old one's place."""

import os
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.model.checkpoint import read_checkpoint


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoints, flushed to the disk beside the old one before they take its place."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint whole; whatever happens, the ones before it stay."""
        try:
            with atomic_write(Path(path)) as file:
                torch.save(checkpoint, file)
        except (OSError, RuntimeError) as error:
            # torch's writer ends in a RuntimeError of its own when the file's write fails.
            cause = error.__context__ if isinstance(error, RuntimeError) else error
            if not isinstance(cause, OSError):
                raise
            raise InputError(
                f"{path} cannot be written: {cause.strerror or cause}. The checkpoints before it are whole; "
                "mend that and give the same command again."
            ) from None

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None) -> dict[str, Any]:
        # On the CPU, as Lightning's own: a run resumes without the GPU that it began on.
        found = read_checkpoint(path, map_location or "cpu")
        # Lightning's timer would go on where it stopped, with its time spent; trainer.max_time is of each command.
        found["callbacks"] = {k: v for k, v in (found.get("callbacks") or {}).items() if not k.startswith("Timer")}
        return found
