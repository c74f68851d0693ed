"""What the tests of every reader of scans compare."""

import numpy as np
from numpy.typing import ArrayLike

from r2flow.lidar.scan_files import Points


def assert_points(
    points: Points,
    xyz: ArrayLike,
    reflectance: ArrayLike | None = None,
    ring: ArrayLike | None = None,
) -> None:
    """Bit for bit, in the types that every reader gives."""
    of = (
        (points.xyz, xyz, np.float32),
        (points.reflectance, reflectance, np.float32),
        (points.ring, ring, np.uint16),
    )
    for found, expected, kind in of:
        if expected is None:
            assert found is None
        else:
            assert found.dtype == kind
            np.testing.assert_array_equal(found, np.asarray(expected, kind))
