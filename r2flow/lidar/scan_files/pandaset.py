"""Frames of PandaSet: the points of its spinning Pandar64 in the laser's own frame, and labels.

A frame (`NNN/lidar/FF.pkl.gz`) holds points in the world, of a tenth of a second of driving. The
poses beside it are of the vehicle, every tenth of a second, and not of the laser.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation

from r2flow.base.errors import InputError, check
from r2flow.base.files import read_json
from r2flow.lidar.scan_files.cloud import Cloud
from r2flow.lidar.scan_files.pickled import column, read_table
from r2flow.lidar.sensors import SENSORS

# The laser in the vehicle's frame (x right, y ahead, z up): metres, and radians about x and y.
# Medians of fits to 20 frames of drive 002, with one position each: 18 agree to 3 mm, all to 11.
ORIGIN = (0.0, 0.781, 1.860)
TILT = (0.0157, -0.0006)
AHEAD = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # from the vehicle's axes to r2flow's

_KNOTS = 5  # times of a frame at which the vehicle's pose is corrected
_VEHICLE = 3.0  # metres: nearer points are its own, whose elevations a small shift changes most
_FITTED = 8000  # points, evenly spread over the frame
_SCALES = np.radians(np.geomspace(1, 0.005, 8))  # of the residual, from coarse to fine
# Standard deviations of what is fitted: tilts, and the laser's position in metres.
_PRIOR = np.repeat([np.radians(1), np.radians(1), 0.3, 0.3, 0.3], _KNOTS)


def read_frame(path: Path) -> Cloud:
    """x, y, z, intensity (0 to 255) and time (s) of the points of the Pandar64 (`d == 0`)."""
    table = read_table(path)
    spinning = column(table, "d") == 0
    world = np.stack([column(table, axis)[spinning] for axis in "xyz"], axis=1)
    times = column(table, "t")[spinning].astype(float)
    strength = column(table, "i")[spinning]
    xyz = in_laser(world.astype(float), times, path.parent)
    return Cloud(("x", "y", "z", "i", "t"), (*xyz.T, strength, times))


def in_laser(world: ndarray, times: ndarray, folder: Path) -> ndarray:
    """Points of the Pandar64 in its own frame, (N, 3), each at its own time.

    A point p in the world, measured at time t, is R(t)^T (p - T(t)) in the vehicle, by the poses
    next to t: linear in position, a constant rate in rotation. The laser's frame is fixed in the
    vehicle, `ORIGIN` and `TILT`. Poses ten times a second miss how the vehicle rocks between them,
    up to 0.15 degrees and some millimetres, so `_aligned` corrects them by the laser's known
    elevations.

    Args:
        times: Seconds, as in timestamps.json, (N,).
        folder: That of poses.json and timestamps.json.

    Raises:
        InputError: The files are missing, or lack these times.
    """
    if not len(world):
        return world
    vehicle = _in_vehicle(world, times, folder)
    laser = Rotation.from_euler("xyz", [*TILT, 0]).inv().apply(vehicle - ORIGIN)
    return _aligned(laser, times) @ AHEAD.T


def labels_of(path: Path) -> Path:
    """The file of labels of a frame, which may be missing."""
    return path.parent.parent / "annotations" / "semseg" / path.name


def read_classes(labels: Path, frame: Path) -> ndarray:
    """PandaSet's class of each point of `read_frame`, (N,)."""
    classes = column(read_table(labels), "class")
    spinning = column(read_table(frame), "d") == 0
    check(len(classes) == len(spinning), f"it is not of {frame}: they differ in length.")
    return classes[spinning].astype(int)


def _in_vehicle(world: ndarray, times: ndarray, folder: Path) -> ndarray:
    """Points in the vehicle's frame at their times, (N, 3), beyond the first and last pose too."""
    stamps = np.array(_json(folder / "timestamps.json"), dtype=float)
    poses = _json(folder / "poses.json")
    positions, headings = (
        np.array([[pose[key][axis] for axis in axes] for pose in poses], dtype=float)
        for key, axes in (("position", "xyz"), ("heading", "xyzw"))
    )
    check(len(stamps) == len(poses) > 1, f"{folder}: its poses and timestamps differ in number.")
    if not abs(np.clip(times, stamps[0], stamps[-1]) - times).max() <= 0.2:  # also of NaN
        raise InputError(f"its points are not of the time of {folder / 'timestamps.json'}.")
    turns = Rotation.from_quat(headings)
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    before = (np.searchsorted(stamps, times) - 1).clip(0, len(stamps) - 2)
    share = ((times - stamps[before]) / np.diff(stamps)[before])[:, None]
    position = positions[before] + share * np.diff(positions, axis=0)[before]
    turn = turns[before] * Rotation.from_rotvec(share * steps[before])
    return turn.inv().apply(world - position)


def _json(path: Path) -> Any:
    check(path.is_file(), f"it needs {path}, where its poses are read.")
    return read_json(path)


def _aligned(xyz: ndarray, times: ndarray) -> ndarray:
    """Points in the laser's frame, so corrected that their elevations are those of the Pandar64.

    The vehicle's tilt and the laser's position at `_KNOTS` times, linear between them, are fitted
    to the points around the vehicle by iterated least squares. A residual r is the elevation
    of the nearest beam of the maker's table less the point's; it weighs 1 / (1 + (r / s)^2), with s
    from 1 to 0.005 degrees. Beams that are less than 2 s apart, which could be mistaken for each
    other, wait for a smaller s.
    """
    beams = np.radians(np.sort(SENSORS["pandar64"].elevations))
    between = (beams[1:] + beams[:-1]) / 2
    gaps = np.pad(np.diff(beams), 1, constant_values=np.inf)
    apart = np.minimum(gaps[1:], gaps[:-1])
    knots = np.linspace(times.min(), times.max() + 1e-3, _KNOTS)
    near = np.maximum(1 - abs(times[:, None] - knots) / (knots[1] - knots[0]), 0)
    distance = np.linalg.norm(xyz, axis=1)
    far = np.flatnonzero((distance > _VEHICLE) & (distance < np.inf))
    sample = far[np.linspace(0, len(far) - 1, min(_FITTED, len(far))).astype(int)]
    fitted = np.zeros(len(_PRIOR))
    for scale in _SCALES:
        x, y, z = _moved(xyz[sample], near[sample], fitted).T
        level = np.hypot(x, y).clip(1e-3)
        elevation = np.arctan2(z, level)
        beam = np.searchsorted(between, elevation)
        residual = beams[beam] - elevation
        weight = (apart[beam] > 2 * scale) / (1 + (residual / scale) ** 2)
        cos = x / level
        sin = y / level
        square = level**2 + z**2
        each = [sin, -cos, z * cos / square, z * sin / square, -level / square]
        slopes = np.hstack([slope[:, None] * near[sample] for slope in each])
        weighted = slopes.T * weight
        prior = (scale / _PRIOR) ** 2
        fitted += np.linalg.solve(
            weighted @ slopes + np.diag(prior), weighted @ residual - prior * fitted
        )
    return _moved(xyz, near, fitted)


def _moved(xyz: ndarray, near: ndarray, fitted: ndarray) -> ndarray:
    """Points after a shift and a turn by the tilts of their times."""
    tilts, shifts = np.split(near @ fitted.reshape(5, _KNOTS).T, [2], axis=1)
    turn = Rotation.from_rotvec(np.pad(tilts, ((0, 0), (0, 1))))
    return turn.apply(xyz - shifts)
