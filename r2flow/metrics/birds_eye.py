"""Bird's-eye histograms, which the field's JSD and MMD compare."""

import math

import numpy as np
import torch
from scipy.special import rel_entr

BINS, EXTENT, NEAR, FAR = 100, 80, 3, 70  # bins a side, over +-80 m, of returns of 3 m < r < 70 m
PROTOCOL = {"bins": BINS, "metres": [-EXTENT, EXTENT], "range": [NEAR, FAR]}


def birds_eye_histogram(xyz: np.ndarray) -> np.ndarray:
    """Points (N, 3) from above, counted in 100 x 100 bins over +-80 m where 3 m < r < 70 m, (100, 100).

    In float32 and by torch's function, as published: its edge between the middle bins lies at -1.2e-6 m, and points on
    rays along the axes fall to one side of it or the other.
    """
    points = torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32))
    r = points.norm(dim=1)
    seen = points[(r > NEAR) & (r < FAR), :2]
    ends = [-float(EXTENT), float(EXTENT)] * 2
    return torch.histogramdd(seen, bins=[BINS, BINS], range=ends).hist.double().numpy()


def js_distance(a: np.ndarray, b: np.ndarray) -> float:
    """sqrt of the Jensen-Shannon divergence, natural logarithm: 0 for equal, sqrt(ln 2) = 0.833 for disjoint.

    An empty histogram, of a set without any return, has the largest distance from any other.
    """
    if a.sum() == 0 or b.sum() == 0:
        return 0.0 if a.sum() == b.sum() else math.sqrt(math.log(2))
    p, q = a.ravel() / a.sum(), b.ravel() / b.sum()
    m = (p + q) / 2
    divergence = float(rel_entr(p, m).sum() + rel_entr(q, m).sum()) / 2
    return math.sqrt(max(divergence, 0.0))
