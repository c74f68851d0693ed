"""The number of floats in the rows of a file without a header."""

import numpy as np
from numpy import ndarray

from r2flow.lidar.scan_files.points import FARTHEST, NEAREST

_WIDEST = 12
_FEWEST_ROWS = 100  # for a judgement
_PAIRS = 2000  # of neighbouring rows, drawn at random, that are compared
_MOST = 0.7  # share of them within `_TURNED`
_TURNED = 15.0  # degrees of azimuth: by that share, real scans of any order have 1 at most


def fitting_widths(values: ndarray) -> list[int]:
    """Widths from 3 to `_WIDEST` that fit (`fits_width`), ascending, no multiple of another."""
    fitting: list[int] = []
    for width in range(3, _WIDEST + 1):
        known = any(width % smaller == 0 for smaller in fitting)
        if not known and len(values) % width == 0 and fits_width(values, width):
            fitting.append(width)
    return fitting


def fits_width(values: ndarray, width: int) -> bool:
    """Whether rows of a width begin with coordinates in metres, and neighbouring rows with
    neighbouring points.

    Points stored in the order of measurement have nearly the same azimuth as the next, points
    without order fit no width. Floats of another size have random exponents.
    """
    rows = len(values) // width
    if rows < _FEWEST_ROWS:
        return False
    first = np.random.default_rng(0).integers(rows - 1, size=_PAIRS)
    with np.errstate(all="ignore"):  # of rays without return, and of numbers that are no points
        xyz = values[: rows * width].reshape(rows, width)[:, :3].astype(float)
        direction = xyz[:, 0] + 1j * xyz[:, 1]
        turned = np.angle(direction[first + 1] / direction[first], deg=True)
        size = abs(xyz).max(axis=1)
    known = abs(turned[np.isfinite(turned)])
    if not known.size or np.quantile(known, _MOST) >= _TURNED:
        return False
    returned = size[size != 0]
    return bool(np.mean((returned > NEAREST) & (returned < FARTHEST)) > 0.95)
