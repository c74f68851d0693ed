"""Trained generators written to files."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors.torch import save

from r2flow.base.errors import check
from r2flow.base.files import write_file
from r2flow.base.hashing import state_hash
from r2flow.lidar.encoding import build_space
from r2flow.model.config import learned
from r2flow.model.parts import COMPILED, NOTES
from r2flow.model.published import BACKBONE

if TYPE_CHECKING:
    from r2flow.model.checkpoint import Checkpoint

_SMALL = 256  # largest matrix, in elements, that `half` leaves in float32, as it does all vectors


def weights_hash(checkpoint: "Checkpoint") -> str:
    """Hash of a generator in 16 hex digits: averaged weights, sensor and encoding, independent of
    the file format.
    """
    meaning = {key: checkpoint.config.model[key] for key in ("sensor", "encoding")}
    state = {
        name.removeprefix(BACKBONE): value
        for name, value in checkpoint.generator.state_dict().items()
    }
    return state_hash(state, meaning)[:16]


def save_checkpoint(checkpoint: "Checkpoint", path: str | Path, half: bool = False) -> None:
    """Write a generator with its config as a `.safetensors`; `half` rounds large matrices to
    float16.

    The bytes depend on the generator alone: of its config, the file stores the keys of
    `r2flow.model.config.learned` and the names of plug-ins, without paths of this machine.
    """
    path = Path(path)
    check(path.suffix == ".safetensors", f"{path}: a checkpoint is written as .safetensors.")
    check(
        checkpoint.sensor == build_space(checkpoint.config.model).sensor,
        f"{path}: a file keeps the sensor of training alone: save the model before `through`.",
    )
    weights = {
        name.replace(COMPILED, ""): value.detach().cpu().contiguous().clone()
        for name, value in checkpoint.generator.state_dict().items()
    }
    for name, value in checkpoint.generator.named_parameters() if half else ():
        if value.ndim > 1 and value.numel() > _SMALL:
            name = name.replace(COMPILED, "")
            weights[name] = weights[name].half()
            check(
                weights[name].isfinite().all(),
                f"{path}: weights beyond 65504 do not fit into float16: save them without half.",
            )
    config = learned(checkpoint.config.stored)
    if plugins := checkpoint.config.plugins:
        config["plugins"] = [Path(name).name for name in plugins]
    notes = {"config": config, "step": checkpoint.step, **checkpoint.generator.drawing()}
    notes["digest"] = state_hash(weights, notes)
    # Under one key, since the order of several metadata keys is not fixed.
    write_file(path, save(weights, metadata={NOTES: json.dumps(notes)}))
