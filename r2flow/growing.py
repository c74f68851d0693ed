"""Larger networks out of trained ones: what they have learned goes on inside."""

from typing import Any

import torch

from r2flow.backbones import Pyramid
from r2flow.backbones.base import CommonOptions
from r2flow.errors import InputError
from r2flow.generators import Generator, RectifiedFlow, build_generator
from r2flow.model.checkpoint import Checkpoint, as_parent, weights_hash
from r2flow.noise import seed_torch
from r2flow.registry import options_of


def grown(checkpoint: Checkpoint, shape: tuple[int, int], **options: Any) -> Checkpoint:
    """A flow, or a flow map, of larger images of the same view, by a `Pyramid` around the network of a trained one.

    The means of what it draws are the images of the trained one. Below them is noise, until it has learned more
    (`stage.init`).

    Args:
        checkpoint: Of a flow or a flow map, without a condition.
        shape: Rows and columns, multiples of the trained ones.
        options: Further options of `Pyramid`.

    Raises:
        InputError: no such flow, or another size.
    """
    flow = checkpoint.generator
    if not isinstance(flow, RectifiedFlow) or flow.condition_channels:
        raise InputError(f"{checkpoint.path} holds a {type(flow).__name__}; only a flow of whole scans can grow.")
    if flow.fixed:
        raise InputError(
            f"{checkpoint.path} was distilled for its own steps and knows no other times: grow the flow that it was "
            "distilled from."
        )
    _refuse_rings(checkpoint)
    rows, columns = checkpoint.sensor.shape
    if shape[0] % rows or shape[1] % columns or shape == (rows, columns):
        raise InputError(
            f"images of {rows}x{columns} cannot grow to {shape[0]}x{shape[1]}: give multiples of both, such as "
            f"{2 * rows}x{4 * columns}."
        )
    inner = flow.backbone
    usual = {key: list(value) if isinstance(value, tuple) else value for key, value in options_of(Pyramid, 1).items()}
    usual = {key: value for key, value in usual.items() if key not in CommonOptions.__annotations__}
    config = {
        "sensor": {**checkpoint.config["sensor"], "rows": shape[0], "columns": shape[1]},
        "encoding": checkpoint.config["encoding"],
        **_reading(checkpoint),
        "generator": checkpoint.config.get("generator") or {"name": "rectified_flow"},
        "backbone": {
            "name": "pyramid",
            **usual,
            "factor": [shape[0] // rows, shape[1] // columns],
            "inner": checkpoint.config["backbone"],
            "ring": checkpoint.config["backbone"].get("ring", True),
            **options,
        },
        "parent": as_parent(checkpoint.config, checkpoint.path, checkpoint.step, weights_hash(checkpoint)),
    }
    larger = _fresh(config)
    assert isinstance(larger, RectifiedFlow)
    assert isinstance(larger.backbone, Pyramid)
    larger.backbone.inner.load_state_dict(inner.state_dict())
    return Checkpoint(larger.eval(), config)


def _fresh(config: dict[str, Any]) -> Generator:
    """With random weights that are the same every time."""
    with torch.random.fork_rng(devices=[]):
        seed_torch(0, "weights")
        return build_generator(config)


def _reading(checkpoint: Checkpoint) -> dict[str, Any]:
    """How its scans became images, which those that it is measured with will become too."""
    reading = (checkpoint.config.get("data") or {}).get("reading")
    return {"data": {"reading": dict(reading)}} if reading else {}


def _refuse_rings(checkpoint: Checkpoint) -> None:
    if "published" in checkpoint.config and checkpoint.config["data"]["reading"]["projection"] == "unfolding":
        raise InputError(
            f"{checkpoint.path} was trained on unfolded scans, whose rings have no rows between them and whose "
            "lasers a new run's sensor does not carry."
        )
