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
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Count, Natural, Registry, Share, construct
from r2flow.lidar.interpolation import nearest_known
from r2flow.lidar.scan_files import read_numbers


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
        if measured.shape[-2:] != images.shape[2:]:  # it would be repeated
            raise InputError(f"measured is {(*measured.shape,)}, images {(*images.shape,)}.")
        known = measured.to(images.device, torch.bool).expand_as(returned)
        state[~known] = int(Ray.UNKNOWN)
    return state


def share_in_sectors(state: ndarray, least: float = 5.0) -> float:
    """Share of the unknown rays of a state, (H, W), in sectors without any known ray.

    The sectors are of at least `least` degrees.
    """
    unknown = state == Ray.UNKNOWN
    rows, columns = state.shape
    before, after = nearest_known(np.tile(~unknown.all(0), 3))  # in three turns
    wide = (after - before)[columns : 2 * columns] > math.ceil(least / 360 * columns)
    return float(wide.sum() * rows / max(unknown.sum(), 1))


# Measured rays, (H, W) bool, and draws -> those to keep, (H, W).
Mask = Callable[[ndarray, np.random.Generator], ndarray]


def every_row(step: Count, first: Natural = 0) -> Mask:
    """Measured rows first, first + step, first + 2 step, ..., as of a sensor with fewer beams."""
    return lambda measured, draws: _rows(measured, lambda rows: rows[first::step])


def random_rows(share: Share) -> Mask:
    """A random share of the measured rows."""
    return lambda measured, draws: _rows(
        measured, lambda rows: rows[_chosen(len(rows), share, draws)]
    )


def random_points(share: Share) -> Mask:
    """A random share of the rays."""
    return lambda measured, draws: _chosen(measured.size, share, draws).reshape(measured.shape)


def without_sector(first: float, last: float) -> Mask:
    """All rays except a sector from azimuth `first` counter-clockwise to `last`, in degrees."""
    return lambda rays, draws: (
        np.ones(rays.shape, bool) & ~sector_columns(rays.shape[1], first, last)
    )


def sector_columns(width: int, first: float, last: float) -> ndarray:
    """Columns of a turn that a sector touches, (width,) bool; azimuths in degrees.

    (-45, 45) is the quarter ahead, (135, -135) the quarter behind; ends a full turn apart are the
    full turn.

    Raises:
        InputError: The sector is narrower than a column.
    """
    turn = 360.0 if last - first >= 360 else (last - first) % 360 or 360.0
    inside = max(abs(first), abs(last)) <= 360 and first != last
    if not inside or not turn * width >= 360 * (1 - 1e-9):  # also NaN
        raise InputError(
            f"the sector {first:.15g},{last:.15g} is narrower than a column, {360 / width:g} "
            "degrees, or not within -360 to 360 degrees; -180,180 is the full turn."
        )
    fuzz = 1e-9 * width  # rounding must not add a column if the sector ends between two
    left = math.floor((180 - (first + turn)) / 360 * width + fuzz)
    right = math.ceil((180 - first) / 360 * width - fuzz)
    return np.isin(np.arange(width), np.arange(left, right) % width)


MASKS: Registry[Callable[..., Mask]] = Registry(
    "mask", rows=every_row, random=random_rows, points=random_points, sector=without_sector
)


def parse_mask(text: str) -> Mask:
    """Parse a mask: `NAME:NUMBERS` of `MASKS`, a .npy file, or the intersection of several by +."""
    parts = [_one_mask(part.strip()) for part in text.split("+")]
    return lambda measured, draws: np.logical_and.reduce([part(measured, draws) for part in parts])


def mask_identity(text: str) -> str:
    """A mask's text with a hash of each file in it."""
    parts = []
    for part in text.split("+"):
        part = part.strip()
        if part.lower().endswith(".npy"):
            part += f" ({hashlib.sha256(Path(part).read_bytes()).hexdigest()[:16]})"
        parts.append(part)
    return "+".join(parts)


def _one_mask(text: str) -> Mask:
    if text.lower().endswith(".npy"):
        return _from_file(text)
    name, _, numbers = text.partition(":")
    mask = MASKS[name]
    try:
        values = map(float, numbers.split(","))
        whole = [int(value) if value.is_integer() else value for value in values]
        options = inspect.signature(mask).bind(*whole).arguments
    except (ValueError, TypeError):
        raise InputError(
            f"the mask {text!r} lacks its numbers: give rows:4, rows:4,FIRST, random:0.5, "
            "points:0.1, sector:-30,30 or a .npy of (H, W)."
        ) from None
    return construct(f"the mask {text!r}", mask, options)


def _from_file(path: str) -> Mask:
    kept = read_numbers(path)
    if kept.ndim != 2 or not np.isin(kept, (0, 1)).all():
        found = f"{kept.dtype} of {kept.shape}"
        raise InputError(f"the mask {path} must be an array (H, W) of booleans, found {found}.")

    def mask(measured: ndarray, draws: np.random.Generator) -> ndarray:
        if kept.shape != measured.shape:
            raise InputError(f"the mask {path} is of {kept.shape}, the scans of {measured.shape}.")
        return kept.astype(bool)

    return mask


def _rows(measured: ndarray, choose: Callable[[ndarray], ndarray]) -> ndarray:
    return np.isin(np.indices(measured.shape)[0], choose(np.flatnonzero(measured.any(1))))


def _chosen(count: int, share: float, draws: np.random.Generator) -> ndarray:
    return np.isin(np.arange(count), draws.permutation(count)[: round(share * count)])
