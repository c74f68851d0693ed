"""JSD and MMD of the LiDAR Diffusion Models' evaluation toolbox, which differ from the usual JSD and MMD.

Ran, Guizilini and Wang (2024). Returns of 1 m < r < 56 m within +-50 m; each cell of the ground plane is occupied or
not, without counts. MMD is the minimum matching distance of Achlioptas et al. (2018), not maximum mean discrepancy. The
publication compares 2000 samples with KITTI-360's drive 0003.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from r2flow.metrics.base import ScanMetric, Side, blocks
from r2flow.metrics.jsd_mmd import JSD
from r2flow.metrics.scans import Scans

NEAR, FAR, EXTENT = 1.0, 56.0, 50  # metres
FINE, COARSE = 0.05, 0.5  # cell size in metres: JSD, MMD
BLOCK = 500  # scans per block: two blocks of distance maps and occupied cells take 640 MB


def occupied(points: Tensor, cell: float) -> Tensor:
    """Sorted indices (K,) of occupied ground-plane cells, in a grid with 2 EXTENT / cell cells per side."""
    r = points.norm(dim=1)
    inside = (r > NEAR) & (r < FAR) & (points[:, :2].abs() < EXTENT).all(1)
    side = round(2 * EXTENT / cell)
    x, y = (torch.floor(points[inside, :2] / cell).long() + side // 2).T
    return torch.unique(x * side + y)


class JSDLiDM(JSD):
    """Jensen-Shannon distance (root, natural logarithm) between counts of scans that occupy each 5 cm cell.

    A row lists the occupied cells, since a scan has 4 million.
    """

    name = "jsd_lidm"
    representation = "occupied cells from above"
    mask = (NEAR, FAR)
    settings: ClassVar[Mapping[str, Any]] = {
        "cell": FINE, "metres": [-EXTENT, EXTENT], "logarithm": "natural", "root": True
    }  # fmt: skip
    width = round(2 * EXTENT / FINE) ** 2

    def rows(self, scans: Scans) -> Tensor:
        """Indices of occupied cells, (B, K) float64, filled up with `width`."""
        cells = [occupied(points, FINE).double() for points in scans.points]
        rows = pad_sequence([pad(indices, (0, 1), value=self.width) for indices in cells], True, self.width)
        return torch.where(rows[:, :1] < self.width, rows, torch.nan)

    def accumulate(self, rows: Tensor, side: Side) -> None:
        total: Tensor = getattr(self, f"{side}_sum")
        cells = rows[rows < self.width].long().to(total.device)
        total.index_add_(0, cells, total.new_ones(len(cells)))


class MMDLiDM(ScanMetric):
    """Minimum matching distance: mean over real scans of the Chamfer distance to the nearest generated scan.

    A scan is the set A of occupied 0.5 m cells, scaled to a square of side 1. With |a - B| the distance of a cell to
    the nearest cell of B, the distance is (mean_a |a - B|^2 + mean_b |b - A|^2) / 2. The squared distance map of every
    scan is computed once and stored; the Chamfer distances of all pairs are then two matrix products, exactly.
    """

    name = "mmd_lidm"
    representation = "occupied cells from above"
    mask = (NEAR, FAR)
    settings: ClassVar[Mapping[str, Any]] = {
        "cell": COARSE, "metres": [-EXTENT, EXTENT], "distance": "Chamfer, squared, halved"
    }  # fmt: skip
    keeping = True
    biased = True
    fewest = 1

    def rows(self, scans: Scans) -> Tensor:
        side = round(2 * EXTENT / COARSE)
        maps = torch.full((len(scans), side * side), torch.nan)
        for squared, points in zip(maps, scans.points, strict=True):
            free = np.ones((side, side), dtype=bool)
            free.flat[occupied(points, COARSE).cpu().numpy()] = False
            if not free.all():  # integers up to rounding of the root
                squared[:] = torch.from_numpy(np.rint(distance_transform_edt(free) ** 2)).flatten()
        return maps

    def distance(self, real: Tensor, generated: Tensor) -> Tensor:
        nearest = torch.full((len(real),), torch.inf, dtype=torch.float64)
        for i, x in blocks(real, BLOCK):
            for _, y in blocks(generated, BLOCK):
                a, b = (x == 0).double(), (y == 0).double()  # occupied cells
                chamfer = ((a @ y.T) / a.sum(1)[:, None] + (x @ b.T) / b.sum(1)) / 2  # of all pairs, in squared cells
                nearest[i] = torch.minimum(nearest[i], chamfer.amin(1))
        return nearest.mean() * (COARSE / (2 * EXTENT)) ** 2
