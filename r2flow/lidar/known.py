"""Partially measured scans: the state of each ray, and masks of measured rays.

measured = parse_mask("rows:4")(numpy.ones((64, 1024), bool), numpy.random.default_rng(0))
state = ray_states(images, torch.from_numpy(measured))
"""

import hashlib
import inspect
import math
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError, check
from r2flow.lidar.interpolation import nearest_known
from r2flow.lidar.region import region
from r2flow.lidar.scan_files import read_numbers
from r2flow.registry import Count, Natural, Registry, Share, construct


class Ray(IntEnum):
    """State of a ray. A ray measured without return differs from a ray that was not measured."""

    UNKNOWN = 0  # not measured
    RETURN = 1  # measured, with a return
    EMPTY = 2  # measured, without a return


def ray_states(images: Tensor, measured: Tensor | None = None) -> Tensor:
    """The state of each ray of range images, (B, H, W) uint8.

    Args:
        images: Range in metres and, optionally, reflectance, (B, 2 or 1, H, W); 0 without a return.
        measured: True for measured rays, (H, W) or (B, H, W) bool; None: all rays are measured.
    """
    returned = images[:, 0] > 0
    state = torch.where(returned, int(Ray.RETURN), int(Ray.EMPTY)).to(torch.uint8)
    if measured is not None:
        check(measured.shape[-2:] == images.shape[2:], f"measured is {(*measured.shape,)}, images {(*images.shape,)}.")
        state[~measured.to(images.device, torch.bool).expand_as(returned)] = int(Ray.UNKNOWN)
    return state


def share_in_sectors(state: np.ndarray, least: float = 5.0) -> float:
    """Share of the unknown rays of a state, (H, W), in sectors of at least `least` degrees without any known ray."""
    unknown = state == Ray.UNKNOWN
    columns = state.shape[1]
    before, after = nearest_known(np.tile(~unknown.all(0), 3))  # in three turns
    wide = (after - before)[columns : 2 * columns] > math.ceil(least / 360 * columns)
    return float(wide.sum() * len(state) / max(unknown.sum(), 1))


Mask = Callable[[np.ndarray, np.random.Generator], np.ndarray]  # measured rays, (H, W) bool -> those to keep, (H, W)


def every_row(step: Count, first: Natural = 0) -> Mask:
    """Measured rows first, first + step, first + 2 step, ..., as of a sensor with fewer beams."""
    return lambda measured, draws: _rows(measured, lambda rows: rows[first::step])


def random_rows(share: Share) -> Mask:
    """A random share of the measured rows."""
    return lambda measured, draws: _rows(measured, lambda rows: rows[_chosen(len(rows), share, draws)])


def random_points(share: Share) -> Mask:
    """A random share of the rays."""
    return lambda measured, draws: _chosen(measured.size, share, draws).reshape(measured.shape)


def without_sector(first: float, last: float) -> Mask:
    """All rays except a sector from azimuth `first` counter-clockwise to `last`, in degrees."""
    return lambda rays, draws: ~np.isin(np.indices(rays.shape)[1], region(rays.shape, sector=(first, last)).columns)


MASKS: Registry[Callable[..., Mask]] = Registry(
    "mask", rows=every_row, random=random_rows, points=random_points, sector=without_sector
)
FORMS = "rows:4, rows:4,FIRST, random:0.5, points:0.1, sector:-30,30 or a .npy of (H, W)"


def parse_mask(text: str) -> Mask:
    """Parse a mask: `NAME:NUMBERS` of `MASKS`, a .npy file, or the intersection of several masks joined by +."""
    parts = [_one_mask(part.strip()) for part in text.split("+")]
    return lambda measured, draws: np.logical_and.reduce([part(measured, draws) for part in parts])


def mask_identity(text: str) -> str:
    """A mask's text with a hash of each file in it."""
    parts = [part.strip() for part in text.split("+")]
    return "+".join(
        f"{one} ({hashlib.sha256(Path(one).read_bytes()).hexdigest()[:16]})" if one.lower().endswith(".npy") else one
        for one in parts
    )


def _one_mask(text: str) -> Mask:
    if text.lower().endswith(".npy"):
        return _from_file(Path(text))
    name, _, numbers = text.partition(":")
    mask = MASKS[name]
    try:
        values = [int(x) if (x := float(number)).is_integer() else x for number in numbers.split(",")]
        options = inspect.signature(mask).bind(*values).arguments
    except (ValueError, TypeError):
        raise InputError(f"the mask {text!r} lacks its numbers: give {FORMS}.") from None
    return construct(f"the mask {text!r}", mask, options)


def _from_file(path: Path) -> Mask:
    kept = read_numbers(path)
    if kept.ndim != 2 or not np.isin(kept, (0, 1)).all():
        raise InputError(f"the mask {path} must be an array (H, W) of booleans, found {kept.dtype} of {kept.shape}.")

    def mask(measured: np.ndarray, draws: np.random.Generator) -> np.ndarray:
        if kept.shape != measured.shape:
            raise InputError(f"the mask {path} is of {kept.shape}, the scans are of {measured.shape} rays.")
        return kept.astype(bool)

    return mask


def _rows(measured: np.ndarray, choose: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return np.isin(np.indices(measured.shape)[0], choose(np.flatnonzero(measured.any(1))))


def _chosen(count: int, share: float, draws: np.random.Generator) -> np.ndarray:
    return np.isin(np.arange(count), draws.permutation(count)[: round(share * count)])
