"""Quantisation of range images: range as uint16, reflectance as uint8."""

import math
from collections.abc import Sequence

import numpy as np

_CODES = 2**16  # code 0: no return; codes 1 to 65535 increase from min_range to max_range
_STEP = 1.9e-3  # metres: half a step plus float32's rounding is below a millimetre
_KNEE = 65.0  # metres: limit of the fine step, if the sensor's range is too long for a single step

OTHER_LEVELS = 255  # of reflectance: a byte n / 255
_ROUNDING = 1e-6  # some KITTI files store n * 0.01 in float32 instead of n / 100: 0.20000002


class Codes:
    """Integer codes of values, linear between some values and their codes, both increasing.

    `values` are the decoded values of all codes, float32.
    """

    def __init__(
        self, values: Sequence[float], codes: Sequence[int], dtype: type[np.unsignedinteger]
    ) -> None:
        self._knots = values, codes
        self.dtype = dtype
        every = np.arange(np.iinfo(dtype).max + 1)
        self.values = np.interp(every, codes, values).astype(np.float32)

    def encode(self, x: np.ndarray) -> np.ndarray:
        return np.rint(np.interp(x, *self._knots)).astype(self.dtype)


def range_codes(min_range: float, max_range: float) -> Codes:
    """uint16 codes of ranges in metres, 0 or in [min_range, max_range]; the error is at most half a
    step.

    Code 0 is no return. One step (max_range - min_range) / 65534 if that is at most `_STEP`
    (max_range - min_range up to 124 m); else steps of at most `_STEP` up to 65 m, and the remaining
    codes divide the rest.
    """
    values = [0.0, min_range, max_range]
    codes = [0, 1, _CODES - 1]
    if (max_range - min_range) / (_CODES - 2) > _STEP and min_range < _KNEE:
        values.insert(2, _KNEE)
        codes.insert(2, 1 + math.ceil((_KNEE - min_range) / _STEP))
    return Codes(values, codes, np.uint16)


def reflectance_codes(levels: int) -> Codes:
    """uint8 codes of reflectance in [0, 1], n / levels; 256 levels end at 255 / 256."""
    highest = min(levels, 255)
    return Codes([0, highest / levels], [0, highest], np.uint8)


def find_levels(reflectance: np.ndarray) -> int:
    """The number of levels n for which all values are multiples of 1 / n, up to rounding; 255 if no
    known n fits.
    """
    for levels in (256, 100):  # KITTI-360, KITTI
        codes = reflectance_codes(levels)
        if (
            np.abs(codes.values[codes.encode(reflectance)] - reflectance).max(initial=0)
            <= _ROUNDING
        ):
            return levels
    return OTHER_LEVELS
