"""Errors of completed scans against the truth, named by protocol.

Images are range in metres and reflectance, (2 or 1, H, W), 0 without a return. `hidden` marks the
unmeasured rays, (H, W) bool, to which errors refer unless stated otherwise.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor

UNITS = {
    "mae_all_m": "MAE, all pixels, missing = 0 (m)",
    "mae_m": "MAE where both return (m)",
    "drop_wrong": "rays wrong in ray-drop",
    "iou": "IoU of 0.1 m voxels",
    "chamfer_m": "Chamfer (m)",
    "chamfer_m2": "Chamfer, squared (m^2)",
    "reflectance_mae": "reflectance MAE",
}


def errors(truth: ndarray, answer: ndarray, hidden: ndarray, sensor: Sensor) -> dict[str, float]:
    """Errors of one completion, by the keys of `UNITS`; NaN if there is nothing to compare.

    `mae_all_m` follows LiDARGen and RangeLDM: all pixels of the image, measured ones included, with
    0 m for missing returns. `iou`, `chamfer_m` and `chamfer_m2` use the points of the whole scan,
    including measured points, as TULIP does, but without its points at the origin for missing
    returns; Chamfer sums the mean distances to the nearest point of the other scan in both
    directions, infinite if one scan is empty.
    """
    r = truth[0]
    s = answer[0]
    both = hidden & (r > 0) & (s > 0)
    a, _ = image_to_points(truth, sensor)
    b, _ = image_to_points(answer, sensor)
    a_to_b = _distances(a, b)
    b_to_a = _distances(b, a)
    cells = _voxels(a)
    others = _voxels(b)
    reflectance = np.abs(truth[1:] - answer[1:])[:, both] if len(truth) == len(answer) else r[:0]
    return {
        "mae_all_m": _mean(np.abs(r - s)),
        "mae_m": _mean(np.abs(r - s)[both]),
        "drop_wrong": _mean(((r > 0) != (s > 0))[hidden]),
        "iou": len(cells & others) / len(cells | others) if cells | others else float("nan"),
        "chamfer_m": _mean(a_to_b) + _mean(b_to_a),
        "chamfer_m2": _mean(a_to_b**2) + _mean(b_to_a**2),
        "reflectance_mae": _mean(reflectance),
    }


def common_mae(truth: ndarray, answers: Sequence[ndarray], hidden: ndarray) -> list[float]:
    """Mean absolute error in metres of each answer where the truth and all answers return.

    Over its own returns, a method that drops difficult rays would have a lower error.
    """
    common = hidden & np.all([image[0] > 0 for image in (truth, *answers)], axis=0)
    return [_mean(np.abs(truth[0] - answer[0])[common]) for answer in answers]


def spread_errors(truth: ndarray, answers: ndarray, hidden: ndarray) -> dict[str, float]:
    """Calibration of the spread of several answers, (A, 2 or 1, H, W): errors of range.

    A missing return has 0 m.

    - `coverage`: share of hidden rays whose range lies between the smallest and largest answer. A
      range equal to E answers, as dropped rays are, counts by the share of its E + 1 possible ranks
      among them. If truth and answers have the same distribution, it is (A - 1) / (A + 1) on
      average, `nominal`: 90 % for 19 answers, 78 % for 8;
    - `crps_m`: mean |x - r| - mean |x - x'| / 2 over answers x and pairs of different answers
      (Gneiting and Raftery 2007; the fair estimate of Ferro 2014): the absolute error for one
      answer;
    - `mae_of_median_m`: MAE of the answers' median.
    """
    x = np.sort(answers[:, 0][:, hidden], axis=0)
    r = truth[0][hidden]
    count = len(x)
    weights = 2 * np.arange(count) - count + 1  # sum over pairs of |x - x'| of sorted values
    spread = (weights[:, None] * x).sum(0) / max(count * (count - 1) / 2, 1)
    below = (x < r).sum(0)
    equal = (x == r).sum(0)
    inside = np.minimum(below + equal, count - 1) - np.maximum(below, 1) + 1  # ranks of 1 to A - 1
    return {
        "coverage": _mean(inside / (equal + 1)),
        "nominal": (count - 1) / (count + 1),
        "crps_m": _mean(np.abs(x - r).mean(0) - spread / 2),
        "mae_of_median_m": _mean(np.abs(np.median(x, axis=0) - r)),
    }


def _distances(a: ndarray, b: ndarray) -> ndarray:
    """Distance of each point of a to the nearest of b; infinite to none, NaN between none."""
    if not len(a):
        return np.full(1, np.inf if len(b) else np.nan)
    return cKDTree(b).query(a)[0]


def _voxels(points: ndarray) -> set[tuple[int, ...]]:
    return set(map(tuple, np.floor(points / 0.1).astype(np.int64).tolist()))


def _mean(values: ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
