"""Registry of distances between real and generated scans; each name stands for one protocol.

`METRICS[name](keep=..., sensor=...)` builds a metric. Importing this module does not import metrics, networks or torch.

Not implemented: LiDARGen's JSD and MMD, which keep returns up to 70 m (scans are masked to 63 m here), and
UltraLiDAR's, which compare voxel centres of real scans with points of generated scans.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from r2flow.metrics.extractors import EXTRACTORS
from r2flow.registry import Registry

if TYPE_CHECKING:
    from r2flow.metrics.base import ScanMetric

# Published names of Frechet distances by network; other networks have `frechet_NETWORK`.
FIELD_NAMES = {"rangenet53": "frd", "rangenet21": "frid", "pointnet": "fpd", "spvcnn": "fpvd", "minkowskinet": "fsvd"}


def _lazily(where: str, *given: Any) -> Callable[..., ScanMetric]:
    """Constructor `module:Class` of this package, imported on the first call."""
    module, name = where.split(":")

    def build(**options: Any) -> ScanMetric:
        return getattr(importlib.import_module(f"{__name__}.{module}"), name)(*given, **options)

    return build


METRICS: Registry[Callable[..., ScanMetric]] = Registry(
    "metric",
    jsd=_lazily("jsd_mmd:JSD"),
    mmd=_lazily("jsd_mmd:MMD"),
    mmd_unbiased=_lazily("jsd_mmd:MMDUnbiased"),
    jsd_lidm=_lazily("lidm:JSDLiDM"),
    mmd_lidm=_lazily("lidm:MMDLiDM"),
    panel=_lazily("panel:Panel"),
    things=_lazily("things:Things"),
    auc=_lazily("two_sample:TwoSample", "handcrafted"),
    auc_range=_lazily("two_sample:TwoSample", "handcrafted_range"),
)


def add_network(name: str) -> None:
    """Register a network's metrics: Frechet distance, kernel distance, precision and recall."""
    METRICS.add(FIELD_NAMES.get(name, f"frechet_{name}"), _lazily("frechet:FrechetDistance", name))
    METRICS.add(f"kid_{name}", _lazily("kid:KernelDistance", name))
    METRICS.add(f"manifold_{name}", _lazily("manifold:Manifold", name))


for _network in EXTRACTORS:
    add_network(_network)


def default_metrics(reflectance: bool) -> tuple[str, ...]:
    """Default metrics, which need no downloads; the headline first.

    KID and the unbiased MMD, which are unbiased for few scans, accompany the usual Frechet distance and MMD.
    """
    features = "handcrafted" if reflectance else "handcrafted_range"
    return ("panel", f"kid_{features}", f"frechet_{features}", "jsd", "mmd", "mmd_unbiased")
