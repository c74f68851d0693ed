"""Points to a range image and back."""

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.lidar.sensors import Convention, Sensor

Projection = Literal["spherical", "unfolding"]
PROJECTIONS = ("spherical", "unfolding")
CONVENTIONS = ("centre", "reference")


def project(
    xyz: np.ndarray,
    reflectance: np.ndarray | None,
    sensor: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    ring: np.ndarray | None = None,
) -> np.ndarray:
    """The range image of a scan: in every pixel the nearest return that falls into it.

    `spherical` chooses the row by elevation asin(z / r); `unfolding` by the order in which the sensor
    fired (`rings_from_order`), or by `ring` where the file tells. The column is floor(W (1 - a / pi) / 2)
    of the azimuth a = atan2(y, x): column 0 begins at +180 degrees and azimuth falls with w.

    `centre` keeps a return only where min_range <= r <= max_range and the field of view holds it.
    `reference` is the published R2Flow's: elevations outside the view are clamped into the edge rows, and
    the nearest return is chosen before the range limits are applied, so that a return nearer than
    min_range punches a hole into the pixel behind it.

    Args:
        xyz: Points in metres, (N, 3), sensor frame: x ahead, y left, z up.
        reflectance: (N,), or None where the scan has none.
        sensor: Rows, columns and range limits.
        ring: Ring number of each point, (N,), in any numbering that rises or falls with elevation.

    Returns:
        Range in metres and reflectance, (2, H, W) float32; 0 where no return was kept.

    Raises:
        InputError: an unknown projection or convention; or a scan that does not unfold into the
            sensor's rings.
    """
    if convention not in CONVENTIONS:
        raise InputError(f"no projection convention named {convention!r}; known: {', '.join(CONVENTIONS)}.")
    xyz = np.asarray(xyz, dtype=np.float32)
    rows, columns = sensor.shape
    r = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    row = _rows(xyz, r, sensor, projection, convention, ring)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    column = np.floor(((1 - azimuth / np.float32(math.pi)) / 2 % 1) * columns).astype(np.int64)
    np.minimum(column, columns - 1, out=column)  # float32 may round the last bin up to W

    pixel = row * columns + column
    within = (r >= sensor.min_range) & (r <= sensor.max_range)
    if convention == "reference":
        hit, chosen = _nearest_by_sorting(pixel, r)
        hit, chosen = hit[within[chosen]], chosen[within[chosen]]
    else:
        keep = np.flatnonzero((row >= 0) & (row < rows) & within)
        hit, chosen = _nearest(pixel[keep], r[keep], rows * columns)
        chosen = keep[chosen]

    image = np.zeros((2, rows * columns), dtype=np.float32)
    image[0, hit] = r[chosen]
    if reflectance is not None:
        image[1, hit] = reflectance[chosen]
    return image.reshape(2, rows, columns)


def _rows(
    xyz: np.ndarray,
    r: np.ndarray,
    sensor: Sensor,
    projection: str,
    convention: str,
    ring: np.ndarray | None,
) -> np.ndarray:
    """Row of every point, (N,) int64; outside [0, H) where the view does not hold it."""
    rows = sensor.shape[0]
    if projection == "unfolding":
        order = rings_from_field(xyz, ring) if ring is not None else rings_from_order(xyz)
        # Aligned at the bottom: rings that see only sky are missing at the top.
        row = order - (order.max(initial=0) + 1) + rows
        found = len(np.unique(order[order >= 0]))
        if convention == "centre" and not rows / 2 <= found <= rows + 1:
            raise InputError(
                f"the scan unfolds into {found} rings, but sensor '{sensor.name}' has {rows}. "
                "Are its points in firing order, ring after ring? If not, use the spherical projection."
            )
        return np.maximum(row, 0) if convention == "reference" else row
    if projection != "spherical":
        raise InputError(f"no projection named {projection!r}; known: {', '.join(PROJECTIONS)}.")
    elevation = np.arcsin(xyz[:, 2] / np.maximum(r, np.float32(1e-12)))
    edges = np.deg2rad(sensor.row_edges)
    step = np.diff(edges)
    if np.allclose(step, step[0], rtol=1e-6):  # evenly spaced: an affine map instead of a search
        row = np.floor((edges[0] - elevation) / (edges[0] - edges[-1]) * rows).astype(np.int64)
    else:
        row = np.searchsorted(-edges, -elevation, side="right") - 1
    return np.clip(row, 0, rows - 1) if convention == "reference" else row


def rings_from_order(xyz: np.ndarray) -> np.ndarray:
    """Ring of every point from the firing order, (N,) int64, 0 for the first ring fired.

    A spinning sensor stored ring after ring sweeps azimuth upwards from 0; a new ring starts where it
    passes from the 4th to the 1st quadrant. Points at the origin are rays without return (-1).
    """
    x, y = xyz[:, 0], xyz[:, 1]
    returned = np.flatnonzero((x != 0) | (y != 0))
    ring = np.full(len(xyz), -1, dtype=np.int64)
    if len(returned) == 0:
        return ring
    x, y = x[returned], y[returned]
    first = (x >= 0) & (y >= 0)
    fourth = (x >= 0) & (y < 0)
    starts = first & np.roll(fourth, 1)
    starts[0] = True
    ring[returned] = np.cumsum(starts) - 1
    return ring


def rings_from_field(xyz: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """The file's own ring numbers, turned so that 0 is the highest ring, (N,) int64."""
    ring = np.asarray(ring, dtype=np.int64)
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    rising = np.cov(ring, elevation)[0, 1] > 0
    return ring.max() - ring if rising else ring - ring.min()


def _nearest(pixel: np.ndarray, r: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """The occupied pixels and the index of the nearest point in each; of equals, the first."""
    # A positive float32 orders like its bits: with (bits of r, index) in one integer the nearest point
    # is the minimum, found in one pass without sorting 120,000 points.
    key = (r.view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(len(r), dtype=np.uint64)
    empty = np.uint64(2**64 - 1)
    best = np.full(pixels, empty, dtype=np.uint64)
    np.minimum.at(best, pixel, key)
    hit = np.flatnonzero(best != empty)
    return hit, (best[hit] & np.uint64(2**32 - 1)).astype(np.int64)


def _nearest_by_sorting(pixel: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same as the reference does it: written from far to near, so that the nearest is written last.

    KITTI stores coordinates in millimetres, and under 1 % of the pixels hold two points of one range; which of them
    the reference keeps is decided by numpy's unstable sort, so the same sort is used here.
    """
    order = np.argsort(-r)
    owner = np.full(int(pixel.max(initial=0)) + 1, -1, dtype=np.int64)
    owner[pixel[order]] = order
    hit = np.flatnonzero(owner >= 0)
    return hit, owner[hit]


def unproject(r: Tensor, rays: Tensor) -> Tensor:
    """Points seen along each ray, p = r (cos e cos a, cos e sin a, sin e).

    Args:
        r: Ranges in metres, (B, 1, H, W); 0 marks a ray without return.
        rays: Elevation e and azimuth a in radians, (2, H, W).

    Returns:
        Points in metres, (B, 3, H, W), sensor frame: x ahead, y left, z up.
    """
    e, a = rays.to(r)
    direction = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()])
    return r * direction


def image_to_points(image: np.ndarray, rays: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The returns of one image as a cloud, in firing order: ring after ring from the top, azimuth rising from 0.

    Args:
        image: Range in metres and reflectance, (2, H, W); reflectance may be missing, (1, H, W).
        rays: (2, H, W) radians.

    Returns:
        Points in metres, (N, 3), and reflectance, (N,), float32; N is the number of returns.
    """
    r = torch.from_numpy(np.ascontiguousarray(image[:1]))[None]
    xyz = unproject(r, rays)[0].numpy()
    reflectance = image[1] if len(image) > 1 else np.zeros_like(image[0])
    columns = image.shape[-1]
    # Azimuth falls with w from +180 degrees: read backwards from the middle, it rises from 0.
    order = np.roll(np.arange(columns)[::-1], columns // 2)
    xyz, reflectance, returned = xyz[..., order], reflectance[..., order], image[0][..., order] > 0
    return np.ascontiguousarray(xyz[:, returned].T), np.ascontiguousarray(reflectance[returned])
