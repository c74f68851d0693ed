"""Distances between real and generated scans, each under a name that means one protocol.

Importing this loads no metric, no network and not torch: what a name needs is imported when it is built.

Every metric is built by `METRICS[name](keep=..., folder=...)`. Two protocols in use are not offered. LiDARGen's own JSD
and MMD count returns of up to 70 m, where all scans here are masked to 63 m, as its successors' are; otherwise they are
`jsd` and `mmd`. UltraLiDAR's compare the voxel centres of real scans with the plain points of generated ones.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from r2flow.metrics.extractors import EXTRACTORS
from r2flow.registry import Registry

if TYPE_CHECKING:
    from r2flow.metrics.base import ScanMetric


def _lazily(where: str, *given: Any) -> Callable[..., ScanMetric]:
    """The constructor `module:Class` of this package, imported when it is called."""
    module, name = where.split(":")

    def build(**options: Any) -> ScanMetric:
        return getattr(importlib.import_module(f"{__name__}.{module}"), name)(*given, **options)

    return build


METRICS: Registry[Callable[..., ScanMetric]] = Registry(
    "metric",
    frd=_lazily("frechet:FrechetDistance", "rangenet53"),
    frid=_lazily("frechet:FrechetDistance", "rangenet21"),
    fpd=_lazily("frechet:FrechetDistance", "pointnet"),
    fpvd=_lazily("frechet:FrechetDistance", "spvcnn"),
    fsvd=_lazily("frechet:FrechetDistance", "minkowskinet"),
    frechet_embedded=_lazily("frechet:FrechetDistance", "embedded"),
    frechet_embedded_range=_lazily("frechet:FrechetDistance", "embedded_range"),
    jsd=_lazily("jsd:JSD"),
    mmd=_lazily("mmd:MMD"),
    jsd_lidm=_lazily("lidm:JSDLiDM"),
    mmd_lidm=_lazily("lidm:MMDLiDM"),
    beams=_lazily("beams:BeamHistograms"),
    drop_rate=_lazily("beams:DropRate"),
    **{f"manifold_{network}": _lazily("manifold:Manifold", network) for network in EXTRACTORS},
    **{f"kid_{network}": _lazily("kid:KernelDistance", network) for network in EXTRACTORS},
)
