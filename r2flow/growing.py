"""Larger networks out of trained ones: what they have learned goes on inside."""

import copy
from typing import Any

import torch

from r2flow.backbones import HDiT, Pyramid
from r2flow.backbones.base import CommonOptions
from r2flow.backbones.encodings import position_name
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
    if flow.sampler.fixed:
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


def widened(checkpoint: Checkpoint, detail: tuple[int, int] | None = None, position: str | None = None) -> Checkpoint:
    """The same generator in a network that can learn more. It draws the same scans.

    Args:
        checkpoint: Of an HDiT or a pyramid around one, whatever it generates.
        detail: Blocks and channels at full resolution (`Detail`), at least as many as it has; None for its own.
        position: A position encoding for an HDiT that has none, which makes all directions alike: where the own car
            stands and where the street runs it can learn with one alone.

    Raises:
        InputError: another network, one that has more already, or a position already.
    """
    _refuse_rings(checkpoint)
    network = getattr(checkpoint.generator, "backbone", None)
    if not isinstance(network, HDiT | Pyramid):
        raise InputError(
            f"{checkpoint.path} holds a network of the kind {checkpoint.config['backbone']['name']}; hdit and pyramid "
            "have convolutions at full resolution."
        )
    backbone = copy.deepcopy(checkpoint.config["backbone"])
    if detail is not None:
        (blocks, channels), before = detail, network.detail and network.detail.size
        if before and (blocks < before[0] or channels < before[1]):
            raise InputError(
                f"{checkpoint.path} has {before[0]} blocks of {before[1]} channels at full resolution and cannot "
                f"shrink to {blocks} of {channels}."
            )
        backbone["detail"] = list(detail)
    if position is not None:
        position = position_name(position, "learnable")
        inner, options = (network.inner, backbone["inner"]) if isinstance(network, Pyramid) else (network, backbone)
        if not isinstance(inner, HDiT) or inner.spatial_pe is not None:
            raise InputError(f"{checkpoint.path} holds no hdit without a position; it keeps its own.")
        options["position"] = position
    config = {
        **{key: checkpoint.config[key] for key in ("sensor", "encoding")},
        **_reading(checkpoint),
        "generator": checkpoint.config.get("generator") or {"name": "rectified_flow"},
        "backbone": backbone,
        "parent": as_parent(checkpoint.config, checkpoint.path, checkpoint.step, weights_hash(checkpoint)),
    }
    wider = _fresh(config)
    grown = wider.get_submodule("backbone")
    assert isinstance(grown, HDiT | Pyramid)
    if position is not None:
        hdit = grown.inner if isinstance(grown, Pyramid) else grown
        assert isinstance(hdit, HDiT)
        hdit.start_without_position()
    kept = checkpoint.generator.state_dict()
    if detail is not None:
        kept = {name: weight for name, weight in kept.items() if not name.startswith("backbone.detail.")}
    wider.load_state_dict({**wider.state_dict(), **kept})
    if detail is not None and network.detail is not None:
        assert grown.detail is not None
        grown.detail.take_over(network.detail)
    wider.sampler = checkpoint.generator.sampler
    return Checkpoint(wider.eval(), config, accuracy=checkpoint.accuracy)


def _fresh(config: dict[str, Any]) -> Generator:
    """With random weights that are the same every time."""
    with torch.random.fork_rng(devices=[]):
        seed_torch(0, "weights")
        return build_generator(config)


def _reading(checkpoint: Checkpoint) -> dict[str, Any]:
    """How its scans became images, which those that it is measured with will become too."""
    data = checkpoint.config.get("data") or {}
    known = {key: data[key] for key in ("projection", "convention", "reflectance_scale") if key in data}
    return {"data": known} if known else {}


def _refuse_rings(checkpoint: Checkpoint) -> None:
    if "published" in checkpoint.config and checkpoint.config["data"]["projection"] == "unfolding":
        raise InputError(
            f"{checkpoint.path} was trained on unfolded scans, whose rings have no rows between them and whose "
            "lasers a new run's sensor does not carry."
        )
