"""Completed clouds: the measured points with all their fields, and added points with theirs."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy import ndarray

from r2flow.lidar.added_times import times_of
from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.projection import image_points
from r2flow.lidar.scan_files import Cloud
from r2flow.lidar.scan_files.cloud import as_type
from r2flow.lidar.scan_files.points import OWN
from r2flow.lidar.sensors import Sensor

_MEASURED = "measured"  # uint8: 1 for a point of the scan, 0 for an added one
# Values of fields that added points lack, by the kind of their dtype; 0 of others.
_EMPTY = {"f": np.nan, "c": np.nan, "M": "NaT", "m": "NaT", "O": None}
ROW = "image_row"  # uint16: row of the answer's sensor from the top, of every point
_NO_ROW = 65535  # of a measured point outside the view of the answer's sensor

# By name: the value of each ray, (H, W), for added points, and that of all measured points.
_OfRays = Mapping[str, tuple[ndarray, float]]


def completed_cloud(
    scan: Partial, image: ndarray, sensor: Sensor, of_rays: _OfRays | None = None
) -> Cloud:
    """The measured points of a scan, unchanged and in their order, and then the added points.

    Added points lie on the rays of the answer that were not measured. Their ring is the row of the
    answer's sensor, their time that of the ray (`times_of`), their intensity in the unit of the
    scan. Fields that r2flow does not understand are NaN in floats and 0 in integers
    (`unknown_fields`). After the scan's own fields stand `measured`, `image_row` and those
    `of_rays`, float32.

    Args:
        scan: The scan as the model saw it, with its points and their cloud.
        image: An answer: range in metres, reflectance in [0, 1] if the model has it, (1 or more, H,
            W).
    """
    points = scan.points
    assert points is not None
    assert points.cloud is not None
    assert points.kept is not None
    assert scan.row is not None
    of_rays = of_rays or {}
    cloud = points.cloud.take(points.kept)
    rows, columns = sensor.shape
    row_of_ray = np.repeat(np.arange(rows, dtype=np.float32)[:, None], columns, axis=1)
    strength = image[1] if len(image) > 1 else np.zeros_like(image[0])
    channels = [image[0], strength, row_of_ray, *(values for values, _ in of_rays.values())]
    added = np.stack(channels) * (scan.state != Ray.RETURN)
    xyz, (strength, row, *trust) = image_points(added.astype(np.float32), sensor)
    nothing = np.zeros(len(xyz))
    ring = cloud.column("ring")
    silent = points.reflectance is None or not points.reflectance.any()
    values = dict(zip("xyz", xyz.T, strict=True)) | {
        "ring": row if ring is not None and ring.any() else nothing,
        "reflectance": nothing if silent else strength * scan.scale,
        "time": _times(scan, cloud, xyz, row),
    }
    roles = {cloud.place(role): role for role in values}
    new = [
        as_type(values[roles[place]], column.dtype)
        if place in roles
        else _unknown(column, len(xyz))
        for place, column in enumerate(cloud.columns)
    ]
    whole = replace(
        cloud,
        columns=tuple(
            np.concatenate(pair).astype(pair[0].dtype, copy=False)
            for pair in zip(cloud.columns, new, strict=True)
        ),
    )
    measured = len(cloud)
    more: dict[str, ndarray] = {
        _MEASURED: np.repeat(np.array([1, 0], np.uint8), [measured, len(xyz)]),
        ROW: np.concatenate([np.where(scan.row < 0, _NO_ROW, scan.row), row]).astype(np.uint16),
    }
    for (name, (_, of_measured)), of_added in zip(of_rays.items(), trust, strict=True):
        more[name] = np.concatenate([np.full(measured, of_measured, np.float32), of_added])
    return whole.with_fields(more)


def _times(scan: Partial, cloud: Cloud, xyz: ndarray, row: ndarray) -> ndarray:
    """Times of added points, (K,), in the type of the cloud's; 0 if these are 0 throughout."""
    time = cloud.column("time")
    if time is None or not time.any() or not len(xyz):
        return np.zeros(len(xyz))
    assert scan.points is not None
    assert scan.row is not None
    azimuth = np.arctan2(*scan.points.xyz.T[1::-1].astype(float))
    asked = np.arctan2(*xyz.T[1::-1].astype(float))
    name = cloud.names[cloud.place("time") or 0]
    return times_of(time, scan.row, azimuth, row.astype(int), asked, name)


def unknown_fields(cloud: Cloud) -> list[str]:
    """The fields of a scan that added points cannot have: they are NaN or 0 there."""
    known = {cloud.place(role) for role in ("x", "y", "z", "reflectance", "ring", "time")}
    return [
        name for place, name in enumerate(cloud.names) if place not in known and name not in OWN
    ]


def _unknown(column: ndarray, count: int) -> ndarray:
    """Values of a field, (count,), of points that have none: NaN, 0 or nothing."""
    value = _EMPTY.get(column.dtype.kind, 0)
    return np.full((count, *column.shape[1:]), value, column.dtype)
