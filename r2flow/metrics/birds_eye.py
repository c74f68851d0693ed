"""Bird's-eye histograms, for JSD and MMD."""

import math

import numpy as np
import torch
from scipy.special import rel_entr

BINS, EXTENT, NEAR, FAR = 100, 80, 3, 70  # bins per side over +-80 m, returns of 3 m < r < 70 m
PROTOCOL = {"bins": BINS, "metres": [-EXTENT, EXTENT], "range": [NEAR, FAR]}


def birds_eye_histogram(xyz: np.ndarray) -> np.ndarray:
    """Histogram of points (N, 3) in the horizontal plane: 100 x 100 bins over +-80 m, 3 m < r < 70 m, (100, 100).

    Uses torch's function in float32, as published: its edge between the middle bins lies at -1.2e-6 m, which decides
    the bin of points on rays along the axes.
    """
    points = torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32))
    r = points.norm(dim=1)
    inside = points[(r > NEAR) & (r < FAR), :2]
    ends = [-float(EXTENT), float(EXTENT)] * 2
    return torch.histogramdd(inside, bins=[BINS, BINS], range=ends).hist.double().numpy()


def js_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Square root of the Jensen-Shannon divergence (natural logarithm): 0 if equal, sqrt(ln 2) = 0.833 if disjoint.

    An empty histogram (a set without returns) has the maximum distance to any other.
    """
    if a.sum() == 0 or b.sum() == 0:
        return 0.0 if a.sum() == b.sum() else math.sqrt(math.log(2))
    p, q = a.ravel() / a.sum(), b.ravel() / b.sum()
    m = (p + q) / 2
    divergence = float(rel_entr(p, m).sum() + rel_entr(q, m).sum()) / 2
    return math.sqrt(max(divergence, 0.0))
