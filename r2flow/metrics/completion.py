"""How near a completed scan is to the truth, each figure under the name of its protocol.

Images are range in metres and reflectance, (2 or 1, H, W), 0 without a return. `hidden` are the rays that were not
measured, (H, W) bool: figures are of these unless they say otherwise.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor

VOXEL = 0.1  # metres
UNITS: Mapping[str, str] = {
    "mae_all_m": "MAE, all pixels, missing = 0 (m)",
    "mae_m": "MAE where both return (m)",
    "drop_wrong": "rays wrong in ray-drop",
    "iou": "IoU of 0.1 m voxels",
    "chamfer_m": "Chamfer (m)",
    "chamfer_m2": "Chamfer, squared (m^2)",
    "reflectance_mae": "reflectance MAE",
}


def errors(truth: np.ndarray, answer: np.ndarray, hidden: np.ndarray, sensor: Sensor) -> dict[str, float]:
    """The figures of one answer, keys of `UNITS`; NaN where there is nothing to compare.

    `mae_all_m` is that of LiDARGen and RangeLDM: over all pixels of the image, those measured included, with 0 m where
    there is no return. `iou`, `chamfer_m` and `chamfer_m2` are of the points of the whole scan, with what was measured
    pasted in, as TULIP's, but without its points at the origin for missing returns: the mean distance of each point to
    the nearest one of the other scan, both ways added.
    """
    r, s = truth[0], answer[0]
    both = hidden & (r > 0) & (s > 0)
    a, b = (image_to_points(image, sensor.rays())[0] for image in (truth, answer))
    there, back = _distances(a, b)
    return {
        "mae_all_m": float(np.abs(r - s).mean()),
        "mae_m": _mean(np.abs(r - s)[both]),
        "drop_wrong": _mean(((r > 0) != (s > 0))[hidden]),
        "iou": _iou(a, b),
        "chamfer_m": _mean(there) + _mean(back),
        "chamfer_m2": _mean(there**2) + _mean(back**2),
        "reflectance_mae": _mean(np.abs(truth[1] - answer[1])[both]) if len(truth) > 1 < len(answer) else float("nan"),
    }


def common_mae(truth: np.ndarray, answers: Sequence[np.ndarray], hidden: np.ndarray) -> list[float]:
    """Mean absolute error in metres of each answer over the hidden rays where the truth and all answers return.

    A method that leaves out the rays that are hard has the smaller error over its own returns.
    """
    common = hidden & np.logical_and.reduce([image[0] > 0 for image in (truth, *answers)])
    return [_mean(np.abs(truth[0] - answer[0])[common]) for answer in answers]


def spread_errors(truth: np.ndarray, answers: np.ndarray, hidden: np.ndarray) -> dict[str, float]:
    """Whether the spread of several answers, (A, 2 or 1, H, W), tells their error: of ranges, 0 m without a return.

    - `coverage`: share of hidden rays whose range lies between the least and the greatest answer. If the truth is one
      more answer, that is (A - 1) / (A + 1) on average, `nominal`: 90 % for 19 answers, 78 % for 8;
    - `crps_m`: mean |x - r| - mean |x - x'| / 2 over the answers x and pairs of different ones (Gneiting and Raftery
      2007; the fair estimate of Ferro 2014): for one answer the absolute error;
    - `mae_of_median_m`: MAE of the answers' median.
    """
    x, r = np.sort(answers[:, 0][:, hidden], axis=0), truth[0][hidden]
    count = len(x)
    weights = 2 * np.arange(count) - count + 1  # sum over pairs of |x - x'| of sorted values
    apart = (weights[:, None] * x).sum(0) / max(count * (count - 1) / 2, 1)
    return {
        "coverage": _mean((x[0] <= r) & (r <= x[-1])),
        "nominal": (count - 1) / (count + 1),
        "crps_m": _mean(np.abs(x - r).mean(0) - apart / 2),
        "mae_of_median_m": _mean(np.abs(np.median(x, axis=0) - r)),
    }


def _distances(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(a) or not len(b):
        nothing = np.full(1, np.nan)
        return nothing, nothing
    return cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    cells = [{*map(tuple, np.floor(points / VOXEL).astype(np.int64))} for points in (a, b)]
    either = len(cells[0] | cells[1])
    return len(cells[0] & cells[1]) / either if either else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
