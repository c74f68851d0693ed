"""Errors of completed scans at the rays that a mask hides, beside the best interpolation."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.base.files import read_json, write_file
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.completion import common_mae, errors
from r2flow.model.completion import Completed
from r2flow.reports.completion import INTERPOLATIONS

COMPARE = "compare.json"
COMMON = "mae_common_m"  # where the truth, the answer and all interpolations return


@dataclass(frozen=True)
class Errors:
    """Errors at the hidden rays, by keys of `r2flow.metrics.completion.UNITS` and `COMMON`."""

    answer: dict[str, float]  # of the first answer
    interpolation: dict[str, float]  # of the best interpolation
    name: str  # of it

    def described(self) -> dict[str, dict[str, float | None]]:
        """The errors as plain values; None: there was nothing to compare."""
        both = {"answer": self.answer, self.name: self.interpolation}
        return {
            name: {key: None if math.isnan(value) else value for key, value in found.items()}
            for name, found in both.items()
        }


@dataclass(frozen=True)
class Compared:
    """A completed scan beside the truth, as images of range and reflectance, (2 or 1, H, W)."""

    truth: ndarray
    interpolation: ndarray  # the best one
    errors: Errors


def compared(measured: Partial, given: Partial, completed: Completed, sensor: Sensor) -> Compared:
    """Compare the first answer with what was measured at the rays that a mask hid.

    Rays that were not measured count nowhere. The best interpolation has the smallest error where
    it, the others, the answer and the truth return.
    """
    seen = measured.state != Ray.UNKNOWN
    known = given.state != Ray.UNKNOWN
    hidden = seen & ~known
    channels = min(2, len(measured.image), completed.images.shape[1])
    truth = measured.image[:channels]
    answer = completed.images[0].numpy()[:channels] * seen
    rules = {
        name: interpolated(given.image[:channels], known, rule) * seen
        for name, rule in INTERPOLATIONS.items()
    }
    common = common_mae(truth, [answer, *rules.values()], hidden)
    best = int(np.argmin(common[1:]))
    name = list(rules)[best]
    found = [errors(truth, image, hidden, sensor) for image in (answer, rules[name])]
    of_answer = {COMMON: common[0], **found[0]}
    return Compared(
        truth, rules[name], Errors(of_answer, {COMMON: common[1 + best], **found[1]}, name)
    )


def write_errors(out: Path, found: dict[str, Errors]) -> None:
    """Add the errors of some scans, by name, to `compare.json`."""
    path = out / COMPARE
    before = read_json(path) if path.is_file() else {}
    new = {name: errors.described() for name, errors in found.items()}
    write_file(path, json.dumps({**before, **new}, indent=1))


def in_words(found: Sequence[Errors]) -> str:
    """Mean errors of some scans in a line."""
    answer, other = (
        {key: float(np.nanmean([row[key] for row in rows])) for key in (COMMON, "drop_wrong")}
        for rows in ([one.answer for one in found], [one.interpolation for one in found])
    )
    names = " or ".join(dict.fromkeys(one.name for one in found))
    return (
        f"at hidden rays: mean error {answer[COMMON]:.3f} m, best interpolation ({names}) "
        f"{other[COMMON]:.3f} m; wrong in ray-drop {answer['drop_wrong']:.1%}, "
        f"{other['drop_wrong']:.1%}"
    )
