"""Reflectance of scans: whether they have it, and the value that is full reflectance."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError, warn_odd
from r2flow.lidar.estimation import FULL_REFLECTANCE, OUTLIERS, SURE, full_reflectance
from r2flow.lidar.scan_files import NoPointsError, Points, read_points, read_range_image

_FAINT = 0.1  # of full reflectance: below it the scale is probably wrong
_DARKEST = 0.01  # likewise of the median; that of bytes is 0.03 or more
DIVIDED = (
    "reflectance is divided by %g; --reflectance-scale (of r2flow.read reflectance_scale) "
    "names another value"
)
DARK = (
    "reflectance stays below a tenth of full reflectance, or half of it below a hundredth: the "
    "estimate of full reflectance may be wrong; give its value as --reflectance-scale, in training "
    "as data.reading.reflectance_scale, in a sensor's file as reflectance_scale"
)


def no_reflectance(path: str | Path) -> InputError:
    return InputError(
        f"{path} has no reflectance, and other scans, a metric or the model need it. Give scans "
        "with it, metrics of "
        "range or a model of range alone (in training encoding.reflectance=false without a "
        "stage.parent that has it)."
    )


def estimated_scale(path: str | Path, scans: Iterable[Points]) -> float:
    """The largest estimate of full reflectance of scans, 1 without any; warns of a value that
    others may exceed.
    """
    scale = max((full_reflectance([points]) or 0.0 for points in scans), default=0.0) or 1.0
    if scale not in SURE:
        warn_odd(Path(path), DIVIDED % scale)
    return scale


def is_dark(reflectance: np.ndarray, scale: float) -> bool:
    """Whether values above 0 are so far below full reflectance that it is probably another one."""
    return bool(reflectance.max() < _FAINT * scale or np.median(reflectance) < _DARKEST * scale)


def scaled_reflectance(
    path: str | Path, points: Points, scale: float | None, strict: bool = True
) -> tuple[np.ndarray, float]:
    """The reflectance of points, scaled to [0, 1], and the scale; None estimates it. Unless
    `strict`, all beyond is clipped.
    """
    if points.reflectance is None:
        raise no_reflectance(path)
    path = Path(path)
    stored = points.reflectance
    seen = stored[stored > 0]
    if scale is None:
        scale = estimated_scale(path, [points])
    if len(seen):
        fractions = np.mean(seen > 1) <= OUTLIERS and (seen % 1).any()
        if scale in FULL_REFLECTANCE[1:] and fractions:
            kind = f"reflectance already lies in 0 to 1, and is not divided by {scale:g}"
            warn_odd(path, kind)
            scale = 1.0
        if is_dark(seen, scale):
            warn_odd(path, DARK)
    beyond = int(np.count_nonzero(stored > 1.001 * scale))
    if strict and stored.min(initial=0) < 0:
        raise InputError(
            f"{path}: reflectance must not be negative, found {stored.min():g}; correct the file."
        )
    if strict and beyond > OUTLIERS * len(stored):
        full = max(full_reflectance([points]) or 0, 255)
        raise InputError(
            f"{path}: reflectance must lie in [0, {scale:g}], found up to {stored.max():g}. "
            f"Give the value of full reflectance, often {full:g}: "
            f"data.reading.reflectance_scale={full:g}, that of "
            f"its part of data.parts, or --reflectance-scale {full:g}."
        )
    if beyond:
        warn_odd(path, f"reflectance beyond {scale:g} is clipped", beyond)
    return (stored / np.float32(scale)).clip(0, 1), scale


def lacks_reflectance(
    paths: Iterable[str | Path], on_bad_scan: str | None, columns: Sequence[str] | None
) -> str | None:
    """Reason why scan files count as files without reflectance; None if they have reflectance.

    Training, metrics and pictures share this rule: the first scan with a return decides, and
    reflectance of only 0 counts as missing, because a KITTI .bin always has a column for it.
    Unreadable scans are skipped with `on_bad_scan="skip"`, scans without a point also with "empty".
    """
    for path in paths:
        try:
            image = read_range_image(path)
            if image is None:
                reflectance = read_points(path, columns).reflectance
            else:
                reflectance = image[1][image[0] > 0] if len(image) > 1 else None
        except InputError as error:
            usable = on_bad_scan == "empty" and isinstance(error, NoPointsError)
            if on_bad_scan != "skip" and not usable:
                raise
            continue
        if reflectance is None:
            return f"{path} has no reflectance"
        if reflectance.size:
            return None if reflectance.any() else f"the reflectance in {path} is 0 throughout"
    return "no scan has a return"
