"""Projection of points to range images, and back."""

import math
from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.files import save_array
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.scan_files.points import check_xyz
from r2flow.lidar.sensors import Convention, Sensor, named_sensor
from r2flow.lidar.unfolding import unfolded_rows

Projection = Literal["spherical", "unfolding"]
# Of a pixel: points on an edge, as of coarser images, are in the lower row and in the later column.
TIE = 1e-3
_TIES = {"centre": TIE, "reference": 0.0, "lidargen": 0.0, "lidm": 0.0}  # by convention


def project(
    xyz: ndarray,
    reflectance: ndarray | None,
    sensor: Sensor | str,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    ring: ndarray | None = None,
) -> ndarray:
    """The range image of a scan: every pixel has its nearest return.

    The row is that of the elevation asin(z / r) in `spherical`, and that of the laser in
    `unfolding`, from `ring` or the order of the points (`unfolded_rows`). The column is floor(W (1
    - a / pi) / 2) with azimuth a = atan2(y, x): column 0 begins at +180 degrees and azimuth
    decreases with w. In `centre` both include 0.001 of a pixel, so that points on an edge are in
    one pixel whatever their rounding.

    `centre` keeps returns with min_range <= r <= max_range in the field of view. `reference` is the
    convention of the published R2Flow: elevations outside the view are clamped to the edge rows,
    and the range limits are applied after the nearest return is chosen, so that a return nearer
    than min_range empties its pixel. `lidargen` and `lidm` are those of the published LiDARGen and
    LiDM: azimuth -180 degrees is in the last column, of equal ranges the last in NumPy's order is
    chosen, and `lidm` applies the limits first, min_range < r < max_range.

    Args:
        xyz: Points in metres, (N, 3), sensor frame: x ahead, y left, z up. Not finite: a ray
            without return.
        reflectance: (N,), or None.
        sensor: Rows, columns and range limits; or its name or YAML file.
        ring: Ring number of each point, (N,), from 0 or 1, monotonic in elevation or in the
            sensor's firing order.

    Returns:
        Range in metres and reflectance, (2, H, W) float32; 0 without a return.

    Raises:
        InputError: `xyz` or `reflectance` has another shape, or the scan does not unfold into the
            sensor's rings.
    """
    sensor = named_sensor(sensor)
    hit, point, r = project_indices(xyz, sensor, projection, convention, ring)
    strength = np.zeros_like(r) if reflectance is None else reflectance[point]
    return scatter(sensor, hit, [r, strength])


def scatter(sensor: Sensor, pixel: ndarray, values: Sequence[ndarray]) -> ndarray:
    """Scatter C channels of values, (M,) each, to pixels h W + w of an image of zeros.

    The image is (C, H, W) float32.
    """
    image = np.zeros((len(values), math.prod(sensor.shape)), dtype=np.float32)
    image[:, pixel] = values
    return image.reshape(-1, *sensor.shape)


def project_indices(
    xyz: ndarray,
    sensor: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    ring: ndarray | None = None,
) -> tuple[ndarray, ndarray, ndarray]:
    """The return of each pixel, see `project`.

    Returns:
        Pixels with a return, h W + w, ascending; indices of their points in `xyz`; their ranges in
        metres: (M,) each.
    """
    if projection not in get_args(Projection) or convention not in _TIES:
        raise InputError(f"there is no projection {projection!r} with convention {convention!r}.")
    xyz = np.asarray(xyz, dtype=np.float32)
    check_xyz(xyz)
    rows, columns = sensor.shape
    r = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    finite = np.isfinite(r)
    if not finite.all():  # rays without a return: fired in unfolding, but not in any pixel
        xyz = np.where(finite[:, None], xyz, np.float32(0))
        r = np.where(finite, r, np.float32(0))
    if projection == "unfolding":
        row = unfolded_rows(xyz, sensor, convention, ring)
    else:
        row = _rows(xyz, r, sensor, convention)
    pixel = row * columns
    pixel += _columns(xyz, columns, convention)
    within = (r >= sensor.min_range) & (r <= sensor.max_range)
    pixels = rows * columns
    if convention == "centre":
        # Omitted points share an extra pixel after the last: faster than removing them from every
        # array.
        pixel[(row < 0) | (row >= rows) | ~within] = pixels
        hit, point = nearest(pixel, r, pixels)
        return hit, point, r[point]
    if convention == "lidm":
        within = (r > sensor.min_range) & (r < sensor.max_range)
        finite = within
    kept = np.flatnonzero(finite)
    # Points are written from far to near, the nearest last. Under 1 % of KITTI's pixels have two
    # points of equal range, in millimetres. The reference's choice depends on NumPy's unstable
    # sort, so the same sort is used.
    if convention == "reference":
        order = kept[np.argsort(-r[kept])]
    else:
        order = kept[np.argsort(r[kept])[::-1]]
    owner = np.full(pixels, -1)
    owner[pixel[order]] = order
    hit = np.flatnonzero(owner >= 0)
    hit = hit[within[owner[hit]]]
    return hit, owner[hit], r[owner[hit]]


def _rows(xyz: ndarray, r: ndarray, sensor: Sensor, convention: Convention) -> ndarray:
    """Row of every point's elevation, (N,) int64; outside [0, H) for points outside the view."""
    rows = sensor.shape[0]
    elevation = np.arcsin(xyz[:, 2] / np.maximum(r, np.float32(1e-12)))
    edges = np.deg2rad(sensor.row_edges)
    top = edges[0]
    bottom = edges[-1]
    step = np.diff(edges)
    tie = _TIES[convention]
    if not np.allclose(step, step[0], rtol=1e-6):
        shift = tie * float(-step.max()) - elevation
        row = np.searchsorted(-edges, shift, side="right") - 1
    elif convention in ("lidargen", "lidm"):  # their order of operations, in float32
        share = 1 - (elevation - float(bottom)) / float(top - bottom)
        row = np.floor(share * rows).astype(int)
    else:  # an affine map instead of a search
        place = (top - elevation) / (top - bottom) * rows + tie
        row = np.floor(place).astype(int)
    return row if convention == "centre" else row.clip(0, rows - 1)


def _columns(xyz: ndarray, columns: int, convention: Convention) -> ndarray:
    """Column of every point, (N,) int64."""
    x, y, _ = xyz.T
    turn = (1 - np.arctan2(y, x) / np.float32(pi)) / 2  # of [0, 1], 1 at exactly -180 degrees
    column = (turn * np.float32(columns) + np.float32(_TIES[convention])).astype(int)
    if convention == "reference":
        column[turn == 1] = 0
    # float32 may round the last bin up to W.
    column[column == columns] = 0 if convention == "centre" else columns - 1
    return column


def nearest(pixel: ndarray, r: ndarray, pixels: int) -> tuple[ndarray, ndarray]:
    """The occupied pixels below `pixels`, and the index of the nearest point in each.

    Of equally near points it is the first.
    """
    # Positive float32 values order like their bits: with (bits of r, index) in one integer, the
    # nearest point is the minimum, found in one pass without sorting 120,000 points.
    key = r.view(np.uint32).astype(np.uint64)
    key <<= np.uint64(32)
    key |= np.arange(len(r), dtype=np.uint64)
    empty = np.uint64(2**64 - 1)
    best = np.full(pixels + 1, empty, dtype=np.uint64)
    np.minimum.at(best, pixel, key)
    hit = np.flatnonzero(best[:pixels] != empty)
    return hit, (best[hit] & np.uint64(2**32 - 1)).astype(int)


def unproject(r: Tensor, rays: Tensor) -> Tensor:
    """Points along rays, p = r (cos e cos a, cos e sin a, sin e) in metres, (B, 3, H, W).

    x points ahead, y left, z up.
    Ranges, (B, 1, H, W), are 0 for rays without return; rays are elevation e and azimuth a in
    radians, (2, H, W).
    """
    e, a = rays.to(r)
    return r * torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()])


def image_to_points(
    image: ndarray, rays: Tensor | ndarray | Sensor | str, measured: ndarray | None = None
) -> tuple[ndarray, ndarray]:
    """The returns of an image as a point cloud.

    Points are in order of rings from the top, with azimuth increasing from 0.

    Args:
        image: Range in metres and reflectance, (2, H, W); reflectance may be missing, (1, H, W).
        rays: (2, H, W) radians; or a sensor or its name, for rays through the pixels' centres.
        measured: Points of the pixels in metres, (3, H, W), used except at the origin.

    Returns:
        Points in metres, (N, 3), and reflectance, (N,), float32; N is the number of returns.
    """
    xyz, values = image_points(image, rays, measured)
    return xyz, values[0] if len(values) else np.zeros(len(xyz), np.float32)


def image_points(
    image: ndarray, rays: Tensor | ndarray | Sensor | str, measured: ndarray | None = None
) -> tuple[ndarray, ndarray]:
    """The returns of an image, (N, 3), as `image_to_points`, and all its further channels, (C - 1,
    N).
    """
    if isinstance(rays, Sensor | str):
        rays = named_sensor(rays).rays()
    rays = torch.as_tensor(rays)
    r = np.nan_to_num(image[:1], posinf=0)
    xyz = unproject(torch.from_numpy(r)[None], rays)[0].numpy()
    if measured is not None:
        xyz = np.where(measured.any(axis=0), measured, xyz)
    # By azimuth, not from the middle column: a ring of `reference` rays begins one column later.
    order = torch.argsort(rays[1, 0] % (2 * pi)).cpu().numpy()
    returned = r[0][:, order] > 0
    values = np.concatenate([xyz, image[1:]])[..., order][:, returned]
    return values[:3].T, values[3:]


def write_scan(image: ndarray, rays: Tensor, out: Path, name: str, endings: Sequence[str]) -> None:
    """Write a range image as `out/NAME.ENDING`: the image in .npy, points in other formats."""
    xyz, values = image_points(image, rays)
    for ending in endings:
        path = out / f"{name}.{ending}"
        if ending == "npy":
            save_array(path, image)
        else:
            write_points(path, xyz, values[0] if len(values) else None)
