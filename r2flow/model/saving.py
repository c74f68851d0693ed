"""Trained generators written to files."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors.torch import save

from r2flow.config import learned
from r2flow.errors import check
from r2flow.files import write_file
from r2flow.hashing import state_hash
from r2flow.lidar.encoding import build_space
from r2flow.model.parts import COMPILED, NOTES
from r2flow.model.published import BACKBONE

if TYPE_CHECKING:
    from r2flow.model.checkpoint import Checkpoint

SMALL = 256  # largest matrix, in elements, that `half` leaves in float32, as it does all vectors


def weights_hash(checkpoint: "Checkpoint") -> str:
    """Hash of a generator in 16 hex digits: averaged weights, sensor and encoding, independent of
    the file format.
    """
    meaning = {key: checkpoint.config[key] for key in ("sensor", "encoding")}
    state = {
        name.removeprefix(BACKBONE): value
        for name, value in checkpoint.generator.state_dict().items()
    }
    return state_hash(state, meaning)[:16]


def save_checkpoint(checkpoint: "Checkpoint", path: str | Path, half: bool = False) -> None:
    """Write a generator with its config as a `.safetensors`; `half` rounds large matrices to
    float16.

    The bytes depend on the generator alone: of its config, the file stores the keys of
    `r2flow.config.learned` and the names of plug-ins, without paths of this machine.
    """
    path = Path(path)
    check(path.suffix == ".safetensors", f"{path}: a checkpoint is written as .safetensors.")
    moved = checkpoint.sensor != build_space(checkpoint.config).sensor
    check(
        not moved,
        f"{path}: a file keeps the sensor of training alone: save the model before `through`.",
    )
    state, parameters = checkpoint.generator.state_dict(), checkpoint.generator.named_parameters()
    weights = {
        n.replace(COMPILED, ""): value.detach().cpu().contiguous().clone()
        for n, value in state.items()
    }
    if half:
        large = [
            n.replace(COMPILED, "")
            for n, value in parameters
            if value.ndim > 1 and value.numel() > SMALL
        ]
        weights |= {n: weights[n].half() for n in large}
        finite = all(weights[n].isfinite().all() for n in large)
        check(
            finite, f"{path}: weights beyond 65504 do not fit into float16: save them without half."
        )
    plugins = [Path(name).name for name in checkpoint.config.get("plugins") or ()]
    config = learned(checkpoint.config) | ({"plugins": plugins} if plugins else {})
    notes = {"config": config, "step": checkpoint.step, **checkpoint.generator.drawing()}
    # Under one key, since the order of several metadata keys is not fixed.
    write_file(
        path,
        save(
            weights, metadata={NOTES: json.dumps({**notes, "digest": state_hash(weights, notes)})}
        ),
    )
