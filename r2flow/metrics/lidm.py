"""JSD and MMD of the LiDAR Diffusion Models' evaluation toolbox, which differ from the usual ones.

Ran, Guizilini and Wang (2024). Returns of 1 m < r < 56 m within +-50 m; each cell of the ground
plane is occupied or not, without counts. MMD is the minimum matching distance of Achlioptas et al.
(2018), not maximum mean discrepancy. The publication compares 2000 samples with KITTI-360's drive
0003.
"""

from typing import ClassVar

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from r2flow.metrics.base import StoredMetric, blocks
from r2flow.metrics.jsd_mmd import JSD
from r2flow.metrics.scans import Scans

_NEAR = 1.0  # metres, as all lengths here
_FAR = 56.0
_EXTENT = 50
_METRES = [-_EXTENT, _EXTENT]
FINE = 0.05  # cell size of JSD
COARSE = 0.5  # cell size of MMD


def _occupied(points: Tensor, cell: float) -> Tensor:
    """Sorted indices (K,) of occupied ground-plane cells, of 2 _EXTENT / cell cells per side."""
    r = points.norm(dim=1)
    inside = (r > _NEAR) & (r < _FAR) & (points[:, :2].abs() < _EXTENT).all(1)
    side = round(2 * _EXTENT / cell)
    x, y = (torch.floor(points[inside, :2] / cell).long() + side // 2).T
    return torch.unique(x * side + y)


class JSDLiDM(JSD):
    """Jensen-Shannon distance (root, natural logarithm) between counts of scans per 5 cm cell.

    A scan counts in each cell that it occupies. A row lists the occupied cells, since a scan has 4
    million.
    """

    name = "jsd_lidm"
    representation = "occupied cells from above"
    mask = (_NEAR, _FAR)
    settings: ClassVar = {
        "cell": FINE,
        "metres": _METRES,
        "logarithm": "natural",
        "root": True,
    }
    width = round(2 * _EXTENT / FINE) ** 2

    def rows(self, scans: Scans) -> Tensor:
        """Indices of occupied cells, (B, K) float64, filled up with `width`."""
        rows = []
        for points in scans.points:
            cells = _occupied(points, FINE).double()
            rows.append(cells if len(cells) else cells.new_full((1,), torch.nan))
        return pad_sequence(rows, True, self.width)

    def accumulate(self, rows: Tensor, side: int) -> None:
        cells = rows[rows < self.width].long().to(self.sums.device)
        self.sums[side] += cells.bincount(minlength=self.width)


class MMDLiDM(StoredMetric):
    """Minimum matching distance: mean over real scans of the Chamfer distance to the nearest scan.

    The nearest is of the generated scans. A scan is the set A of occupied 0.5 m cells, scaled to a
    square of side 1. With |a - B| the distance of a cell to the nearest cell of B, the distance is
    (mean_a |a - B|^2 + mean_b |b - A|^2) / 2. The squared distance map of every scan is computed
    once and stored; the Chamfer distances of all pairs are then two matrix products, exactly.
    """

    name = "mmd_lidm"
    representation = "occupied cells from above"
    mask = (_NEAR, _FAR)
    settings: ClassVar = {
        "cell": COARSE,
        "metres": _METRES,
        "distance": "Chamfer, squared, halved",
    }
    biased = True
    fewest = 1

    def rows(self, scans: Scans) -> Tensor:
        side = round(2 * _EXTENT / COARSE)
        maps = torch.full((len(scans), side * side), torch.nan)
        for squared, points in zip(maps, scans.points, strict=True):
            free = np.ones((side, side), dtype=bool)
            free.flat[_occupied(points, COARSE).cpu().numpy()] = False
            if not free.all():  # integers up to rounding of the root
                squared[:] = torch.from_numpy(np.rint(distance_transform_edt(free) ** 2)).flatten()
        return maps

    def values(self, real: Tensor, generated: Tensor) -> list[float]:
        nearest = torch.full((len(real),), torch.inf, dtype=torch.float64)
        for i, x in blocks(real):
            a = (x == 0).double()  # occupied cells
            for _, y in blocks(generated):
                b = (y == 0).double()
                to_generated = (a @ y.T) / a.sum(1)[:, None]  # of all pairs, in squared cells
                to_real = (x @ b.T) / b.sum(1)
                nearest[i] = torch.minimum(nearest[i], ((to_generated + to_real) / 2).amin(1))
        return [float(nearest.mean()) * (COARSE / (2 * _EXTENT)) ** 2]
