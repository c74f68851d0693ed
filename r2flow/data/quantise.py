"""Range images as whole numbers: range in uint16, reflectance in uint8, and what is lost by it."""

import math

import numpy as np

CODES = 2**16  # code 0 is no return; the others climb from min_range to max_range
STEP = 1.9e-3  # metres: half of it, and float32's rounding, stay below a millimetre
KNEE = 65.0  # metres up to which the step is held, where the sensor reaches too far for one step

# Levels that scanners and their data sets report: KITTI-360 n / 256, KITTI n / 100, others a byte n / 255.
KNOWN_LEVELS = (256, 100, 255)
OTHER_LEVELS = 255
ROUNDING = 1e-6  # some KITTI files hold n times 0.01 in float32 instead of n / 100: 0.20000002


class RangeCodes:
    """uint16 codes of the ranges [min_range, max_range], finest where it matters.

    r(0) = 0, no return;
    r(c) = min_range + (c - 1) fine     for 1 <= c <= knee_code;
    r(c) = knee + (c - knee_code) coarse     for knee_code <= c <= 65535.

    One step, fine = (max_range - min_range) / 65534, where that is at most `STEP` (limits up to 124 m apart); else at
    most `STEP` as far as 65 m, and what codes are left share the rest. A range is off by at most half a step. `values`
    is what each code means, (65536,), float32.
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
        """Ranges in metres, 0 where no return, to the codes nearest to them, uint16."""
        returned = r != 0
        if not ((r >= self.near) & (r <= self.far) | ~returned).all():  # NaN is refused too
            raise ValueError(f"ranges must be 0 or lie in [{self.near:g}, {self.far:g}] m.")
        r = r.astype(np.float64)
        code = 1 + (r - self.min_range) / (self.fine or 1)
        if self.coarse:
            code = np.where(r <= self.knee, code, self.knee_code + (r - self.knee) / self.coarse)
        return np.where(returned, np.clip(np.rint(code), 1, CODES - 1), 0).astype(np.uint16)


class ReflectanceCodes:
    """uint8 codes of reflectance, n / levels; a value between two levels becomes the nearer one.

    `values` is what each code means, (256,), float32 in [0, 1].
    """

    dtype = np.uint8

    def __init__(self, levels: int) -> None:
        assert 1 <= levels <= 256
        self.levels = levels
        self.values = np.minimum(np.arange(256, dtype=np.float32) / np.float32(levels), np.float32(1))

    def encode(self, reflectance: np.ndarray) -> np.ndarray:
        """Reflectance in [0, 1] to codes, uint8. With 256 levels the highest is 255 / 256."""
        return np.clip(np.rint(reflectance * np.float32(self.levels)), 0, 255).astype(np.uint8)

    def fits(self, reflectance: np.ndarray) -> bool:
        """Whether every value is one of the levels, but for the rounding of whoever wrote it."""
        return bool(np.abs(self.values[self.encode(reflectance)] - reflectance).max(initial=0) <= ROUNDING)


def find_levels(reflectance: np.ndarray) -> int:
    """The levels that some values of reflectance are whole multiples of; 255 where they fit none."""
    return next((n for n in KNOWN_LEVELS if ReflectanceCodes(n).fits(reflectance)), OTHER_LEVELS)
