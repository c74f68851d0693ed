"""JSD and MMD as the LiDAR Diffusion Models' evaluation toolbox defines them: other quantities of the same names.

Ran, Guizilini and Wang (2024). Returns of 1 m < r < 56 m within +-50 m; what counts is which cells of the ground plane
hold a return, not how many. Its MMD is no maximum mean discrepancy but the minimum matching distance of Achlioptas et
al. (2018). There 2000 samples are compared with KITTI-360's drive 0003.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from r2flow.metrics.base import SIDES, ScanMetric, Side, blocks
from r2flow.metrics.birds_eye import js_distance
from r2flow.metrics.scans import Scans

NEAR, FAR, EXTENT = 1.0, 56.0, 50  # metres
FINE, COARSE = 0.05, 0.5  # metres a cell: JSD, MMD
BLOCK = 500  # scans: two blocks of distance maps, and of cells held, take 640 MB


def occupied(points: Tensor, cell: float) -> Tensor:
    """Cells from above that hold a return, as rising numbers (K) of the 2 EXTENT / cell a side."""
    r = points.norm(dim=1)
    inside = (r > NEAR) & (r < FAR) & (points[:, :2].abs() < EXTENT).all(1)
    side = round(2 * EXTENT / cell)
    x, y = (torch.floor(points[inside, :2] / cell).long() + side // 2).T
    return torch.unique(x * side + y)


class JSDLiDM(ScanMetric):
    """Jensen-Shannon distance (root, natural logarithm) between how many scans of each set hold each 5 cm cell.

    Nothing of single scans is kept, of 4 million cells each: there are no intervals.
    """

    name = "jsd_lidm"
    representation = "occupied cells from above"
    mask = (NEAR, FAR)
    settings: ClassVar[Mapping[str, Any]] = {
        "cell": FINE, "metres": [-EXTENT, EXTENT], "logarithm": "natural", "root": True
    }  # fmt: skip
    resamples = False

    def __init__(self, keep: bool = False, **options: Any) -> None:
        super().__init__(keep, **options)
        cells = round(2 * EXTENT / FINE) ** 2
        for side in SIDES:
            self.add_state(f"{side}_cells", torch.zeros(cells, dtype=torch.int32), dist_reduce_fx="sum")

    def take_in(self, scans: Scans, side: Side, first: int) -> None:
        cells: Tensor = getattr(self, f"{side}_cells")
        found = [occupied(points, FINE) for points in scans.points]
        for one in found:
            cells[one.to(cells.device)] += 1
        self.add_scans(side, len(found), sum(not len(one) for one in found))

    def figures(self) -> tuple[dict[str, float], list[str]]:
        real, generated = (getattr(self, f"{side}_cells").cpu().numpy() for side in SIDES)
        known = all(self.given(side) for side in SIDES)
        return {"jsd_lidm": js_distance(real, generated) if known else float("nan")}, []


class MMDLiDM(ScanMetric):
    """Minimum matching distance: mean over real scans of the Chamfer distance to the nearest generated scan.

    A scan is the set A of 0.5 m cells that hold a return, in a square of side 1. With |a - B| the distance of a cell
    from the nearest one of B, the distance is (mean_a |a - B|^2 + mean_b |b - A|^2) / 2. The squared distance map of
    every scan is computed once and kept; the Chamfer distances of all pairs are then two matrix products, exactly.
    """

    name = "mmd_lidm"
    representation = "occupied cells from above"
    mask = (NEAR, FAR)
    settings: ClassVar[Mapping[str, Any]] = {
        "cell": COARSE, "metres": [-EXTENT, EXTENT], "distance": "Chamfer, squared, halved"
    }  # fmt: skip
    keeping = True
    resamples = False  # which scan is nearest is no smooth function of the scans

    def rows(self, scans: Scans) -> Tensor:
        side = round(2 * EXTENT / COARSE)
        maps = torch.empty(len(scans), side * side)
        for own, points in zip(maps, scans.points, strict=True):
            held = np.zeros((side, side), dtype=bool)
            held.flat[occupied(points, COARSE).cpu().numpy()] = True
            own[:] = torch.from_numpy(squared_distance_map(held)).flatten()
        return maps

    def figures(self) -> tuple[dict[str, float], list[str]]:
        if not all(self.count(side) for side in SIDES):
            return {"mmd_lidm": float("nan")}, []
        real, generated = (self.kept(side) for side in SIDES)
        nearest = torch.full((len(real),), torch.inf, dtype=torch.float64)
        for i, x in blocks(real, BLOCK):
            for _, y in blocks(generated, BLOCK):
                nearest[i] = torch.minimum(nearest[i], _chamfer(x, y).amin(1))
        return {"mmd_lidm": float(nearest.mean()) * (COARSE / (2 * EXTENT)) ** 2}, []


def _chamfer(x: Tensor, y: Tensor) -> Tensor:
    """Chamfer distances in squared cells of all pairs of distance maps, (N, cells) and (M, cells)."""
    a, b = (x == 0).double(), (y == 0).double()
    return ((a @ y.T) / a.sum(1)[:, None] + (x @ b.T) / b.sum(1)) / 2


def squared_distance_map(held: np.ndarray) -> np.ndarray:
    """Squared distance of every cell from the nearest that is held, in cells, (H, W); NaN where none is held."""
    if not held.any():
        return np.full(held.shape, np.nan)
    return np.rint(distance_transform_edt(~held) ** 2)  # whole numbers but for the rounding of the root
