"""Quantisation of range images: range as uint16, reflectance as uint8."""

import math

import numpy as np

CODES = 2**16  # code 0: no return; codes 1 to 65535 increase from min_range to max_range
STEP = 1.9e-3  # metres: half a step plus float32's rounding is below a millimetre
KNEE = 65.0  # metres: limit of the fine step, if the sensor's range is too long for a single step

# Reflectance levels of data sets: KITTI-360 n / 256, KITTI n / 100, others a byte n / 255.
KNOWN_LEVELS = (256, 100, 255)
OTHER_LEVELS = 255
ROUNDING = 1e-6  # some KITTI files store n * 0.01 in float32 instead of n / 100: 0.20000002


class RangeCodes:
    """uint16 codes of ranges in [min_range, max_range], with finer steps at short range.

    r(0) = 0, no return;
    r(c) = min_range + (c - 1) fine     for 1 <= c <= knee_code;
    r(c) = knee + (c - knee_code) coarse     for knee_code <= c <= 65535.

    Single step fine = (max_range - min_range) / 65534 if that is at most `STEP` (max_range - min_range up to 124 m);
    else fine <= `STEP` up to 65 m, and the remaining codes divide the rest. The error is at most half a step. `values`
    are the decoded ranges, (65536,), float32.
    """

    dtype = np.uint16

    def __init__(self, min_range: float, max_range: float) -> None:
        self.near, self.far = np.float32(min_range), np.float32(max_range)
        self.min_range = min_range
        if (max_range - min_range) / (CODES - 2) <= STEP:
            self.knee, self.knee_code = max_range, CODES - 1
        else:
            self.knee = min(max(KNEE, min_range), max_range)
            self.knee_code = 1 + math.ceil((self.knee - min_range) / STEP)
        self.fine = (self.knee - min_range) / max(self.knee_code - 1, 1)
        self.coarse = (max_range - self.knee) / max(CODES - 1 - self.knee_code, 1)
        code = np.arange(CODES)
        beyond = self.knee + (code - self.knee_code) * self.coarse
        r = np.where(code <= self.knee_code, min_range + (code - 1) * self.fine, beyond)
        self.values = np.clip(r.astype(np.float32), self.near, self.far)
        self.values[0] = 0

    def encode(self, r: np.ndarray) -> np.ndarray:
        """The nearest codes, uint16, of ranges in metres, 0 for no return."""
        returned = r != 0
        inside = (r >= self.near) & (r <= self.far) | ~returned  # False for NaN, too
        assert inside.all(), f"ranges must be 0 or lie in [{self.near:g}, {self.far:g}] m"
        r = r.astype(np.float64)
        code = 1 + (r - self.min_range) / (self.fine or 1)
        if self.coarse:
            code = np.where(r <= self.knee, code, self.knee_code + (r - self.knee) / self.coarse)
        return np.where(returned, np.clip(np.rint(code), 1, CODES - 1), 0).astype(np.uint16)


class ReflectanceCodes:
    """uint8 codes of reflectance, n / levels, rounded to the nearest level.

    `values` are the decoded reflectances, (256,), float32 in [0, 1].
    """

    dtype = np.uint8

    def __init__(self, levels: int) -> None:
        assert 1 <= levels <= 256
        self.levels = levels
        self.values = np.minimum(np.arange(256, dtype=np.float32) / np.float32(levels), np.float32(1))

    def encode(self, reflectance: np.ndarray) -> np.ndarray:
        """The codes, uint8, of reflectance in [0, 1]. With 256 levels the maximum is 255 / 256."""
        return np.clip(np.rint(reflectance * np.float32(self.levels)), 0, 255).astype(np.uint8)

    def fits(self, reflectance: np.ndarray) -> bool:
        """Whether every value is a level, up to rounding."""
        return bool(np.abs(self.values[self.encode(reflectance)] - reflectance).max(initial=0) <= ROUNDING)


def find_levels(reflectance: np.ndarray) -> int:
    """The number of levels n for which all values are multiples of 1 / n; 255 if no known n fits."""
    return next((n for n in KNOWN_LEVELS if ReflectanceCodes(n).fits(reflectance)), OTHER_LEVELS)
