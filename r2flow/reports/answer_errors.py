"""Errors of completed scans at the rays that a mask hides, beside the best interpolation."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from r2flow.base.files import read_json, write_file
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.completion import common_mae, errors
from r2flow.reports.answer_rays import Answered
from r2flow.reports.completion import INTERPOLATIONS

COMPARE = "compare.json"
_DROP = "drop_wrong"
_COMMON = "mae_common_m"  # where the truth, the answer and all interpolations return


class Compared(NamedTuple):
    """A completed scan beside the truth, as images of range and reflectance, (2 or 1, H, W), with
    errors at the hidden rays by keys of `r2flow.metrics.completion.UNITS` and `_COMMON`.
    """

    truth: ndarray
    interpolation: ndarray  # the best one
    name: str  # of it
    errors: dict[str, float]  # of the first answer
    its_errors: dict[str, float]  # of the interpolation


def compared(
    measured: Partial, answered: Answered, sensor: Sensor, max_error: float | None = None
) -> Compared:
    """Compare the first answer with what was measured at the rays that a mask hid.

    Rays that were not measured count nowhere. The best interpolation has the smallest error where
    it, the others, the answer and the truth return. With `max_error` no ray-drop is judged, since
    points left out are not predicted.
    """
    seen = measured.state != Ray.UNKNOWN
    known = answered.known.state != Ray.UNKNOWN
    hidden = seen & ~known
    images = answered.completed.images
    channels = min(2, len(measured.image), images.shape[1])
    truth = measured.image[:channels]
    part = answered.known.image[:channels]
    rules = [interpolated(part, known, rule) * seen for rule in INTERPOLATIONS.values()]
    answer = images[0].numpy()[:channels] * seen
    common = common_mae(truth, [answer, *rules], hidden)
    best = int(np.argmin(common[1:]))
    rows = [
        {_COMMON: off, **errors(truth, image, hidden, sensor)}
        for off, image in ((common[0], answer), (common[1 + best], rules[best]))
    ]
    if max_error:
        rows[0][_DROP] = math.nan
    return Compared(truth, rules[best], list(INTERPOLATIONS)[best], *rows)


def write_errors(out: Path, found: Mapping[str, Compared]) -> None:
    """Add the errors of some scans, by name, to `compare.json`; null: nothing to compare."""
    path = out / COMPARE
    rows = read_json(path) if path.is_file() else {}
    for scan, one in found.items():
        both = {"answer": one.errors, one.name: one.its_errors}
        rows[scan] = {
            name: {key: None if math.isnan(value) else value for key, value in row.items()}
            for name, row in both.items()
        }
    write_file(path, json.dumps(rows, indent=1))


def in_words(found: Sequence[Compared]) -> str:
    """Mean errors of some scans in a line."""

    def mean(rows: Sequence[dict[str, float]], key: str) -> float:
        return float(np.nanmean([row[key] for row in rows]))

    rows = [one.errors for one in found]
    others = [one.its_errors for one in found]
    names = " or ".join(dict.fromkeys(one.name for one in found))
    told = (
        f"at hidden rays: mean error {mean(rows, _COMMON):.3f} m, best interpolation ({names}) "
        f"{mean(others, _COMMON):.3f} m"
    )
    if math.isnan(rows[0][_DROP]):
        return told
    return f"{told}; wrong in ray-drop {mean(rows, _DROP):.1%}, {mean(others, _DROP):.1%}"
