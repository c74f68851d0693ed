"""The number of floats in the rows of a file without a header."""

import numpy as np
from numpy import ndarray

from r2flow.lidar.scan_files.points import FARTHEST, NEAREST

WIDEST = 12
FEWEST_ROWS = 100  # for a judgement
PAIRS = 2000  # of neighbouring rows, drawn at random, that are compared
MOST = 0.7  # share of them within `TURNED`
TURNED = 15.0  # degrees of azimuth: by that share, real scans of any order have 1 at most


def fitting_widths(values: ndarray) -> list[int]:
    """Widths from 3 to `WIDEST` of which neighbouring rows are neighbouring points, ascending.

    Each is tested by itself: points stored in the order of measurement have nearly the same azimuth
    as the next. Multiples of a smaller width that fits are left out. Points without order fit none.
    """
    fitting: list[int] = []
    for width in range(3, WIDEST + 1):
        known = any(width % smaller == 0 for smaller in fitting)
        whole = not known and len(values) % width == 0
        if whole and fits_width(values, width) and are_metres(values, width):
            fitting.append(width)
    return fitting


def are_metres(values: ndarray, width: int) -> bool:
    """Whether nearly all rows of a width begin with coordinates that a LiDAR may measure; floats of
    another size have random exponents.
    """
    xyz = values[: len(values) // width * width].reshape(-1, width)[:, :3]
    with np.errstate(invalid="ignore"):  # a NaN that signals
        size = abs(xyz.astype(float)).max(axis=1)
    returned = size[size != 0]
    return bool(np.mean((returned > NEAREST) & (returned < FARTHEST)) > 0.95)


def fits_width(values: ndarray, width: int) -> bool:
    """Whether neighbouring rows of a width begin with neighbouring points."""
    rows = len(values) // width
    if rows < FEWEST_ROWS:
        return False
    table = values[: rows * width].reshape(rows, width)
    first = np.random.default_rng(0).integers(rows - 1, size=PAIRS)
    with np.errstate(all="ignore"):  # of rays without return, and of numbers that are no points
        direction = table[:, 0].astype(complex) + 1j * table[:, 1]
        direction /= abs(direction)
        turned = np.angle(direction[first + 1] / direction[first], deg=True)
    known = abs(turned[np.isfinite(turned)])
    return known.size > 0 and bool(np.quantile(known, MOST) < TURNED)
