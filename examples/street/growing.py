"""A larger flow out of a trained one, by a `Pyramid` around its network: how `street_full` came from `street`.

python examples/street/growing.py runs/street 64 1024 larger.safetensors
"""

import sys
from typing import Any

import torch

from r2flow.backbones import Pyramid
from r2flow.backbones.base import CommonOptions
from r2flow.errors import InputError
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.model.checkpoint import Checkpoint, as_parent, load_checkpoint, save_checkpoint, weights_hash
from r2flow.noise import seed_torch
from r2flow.registry import options_of


def grown(checkpoint: Checkpoint, shape: tuple[int, int], **options: Any) -> Checkpoint:
    """A flow, or a flow map, of larger images of the same view. The means of what it draws are the smaller images.

    Args:
        checkpoint: Of a flow or a flow map of whole scans.
        shape: Rows and columns, multiples of the trained ones.
        options: Further options of `Pyramid`.

    Raises:
        InputError: another generator, or a size that is not a multiple.
    """
    flow, (rows, columns) = checkpoint.generator, checkpoint.sensor.shape
    if not isinstance(flow, RectifiedFlow) or flow.condition_channels or flow.fixed:
        raise InputError(f"{checkpoint.path} holds a {type(flow).__name__}; only a flow of whole scans can grow.")
    if shape[0] % rows or shape[1] % columns or shape == (rows, columns):
        raise InputError(f"images of {rows}x{columns} cannot grow to {shape[0]}x{shape[1]}: give multiples of both.")
    usual = {key: list(value) if isinstance(value, tuple) else value for key, value in options_of(Pyramid, 1).items()}
    backbone = checkpoint.config["backbone"]
    reading = (checkpoint.config.get("data") or {}).get("reading")
    config = {
        "sensor": {**checkpoint.config["sensor"], "rows": shape[0], "columns": shape[1]},
        "encoding": checkpoint.config["encoding"],
        **({"data": {"reading": dict(reading)}} if reading else {}),
        "generator": checkpoint.config.get("generator") or {"name": "rectified_flow"},
        "backbone": {
            "name": "pyramid",
            **{key: value for key, value in usual.items() if key not in CommonOptions.__annotations__},
            "factor": [shape[0] // rows, shape[1] // columns],
            "inner": backbone,
            "ring": backbone.get("ring", True),
            **options,
        },
        "parent": as_parent(checkpoint.config, checkpoint.path, checkpoint.step, weights_hash(checkpoint)),
    }
    with torch.random.fork_rng(devices=[]):
        seed_torch(0, "weights")
        larger = build_generator(config)
    larger.backbone.inner.load_state_dict(flow.backbone.state_dict())  # type: ignore[union-attr, operator, arg-type]
    return Checkpoint(larger.eval(), config)


if __name__ == "__main__":
    model, rows, columns, out = sys.argv[1:]
    save_checkpoint(grown(load_checkpoint(model), (int(rows), int(columns))), out)
