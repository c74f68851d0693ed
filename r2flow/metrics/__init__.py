"""Registry of distances between real and generated scans; each name stands for one protocol.

`METRICS[name](sensor=...)` builds a metric. Importing this module does not import torch.

Not implemented: LiDARGen's JSD and MMD, which keep returns up to 70 m (scans are masked to 63 m
here), LiDM's, whose "MMD" is a minimum matching distance, and UltraLiDAR's, which compare voxel
centres of real scans with points of generated scans.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from r2flow.base.registry import Registry, lazy
from r2flow.metrics.extractors import EXTRACTORS

if TYPE_CHECKING:
    from r2flow.metrics.base import ScanMetric

# Published names of Frechet distances by network; other networks have `frechet_NETWORK`.
FIELD_NAMES = {
    "rangenet53": "frd",
    "rangenet21": "frid",
    "pointnet": "fpd",
    "spvcnn": "fpvd",
    "minkowskinet": "fsvd",
}

METRICS: Registry[Callable[..., ScanMetric]] = Registry(
    "metric",
    jsd=lazy("r2flow.metrics.jsd_mmd:JSD"),
    mmd=lazy("r2flow.metrics.jsd_mmd:MMD"),
    panel=lazy("r2flow.metrics.panel:Panel"),
    things=lazy("r2flow.metrics.things:Things"),
)


def add_network(name: str) -> None:
    """Register a network's metrics: Frechet distance and kernel distance."""
    frechet = FIELD_NAMES.get(name, f"frechet_{name}")
    METRICS.add(frechet, lazy("r2flow.metrics.features:FrechetDistance", name))
    METRICS.add(f"kid_{name}", lazy("r2flow.metrics.features:KernelDistance", name))


for _network in EXTRACTORS:
    add_network(_network)


def default_metrics(reflectance: bool) -> tuple[str, ...]:
    """Default metrics, which need no downloads; the headline first.

    KID, which is unbiased for few scans, accompanies the usual Frechet distance.
    """
    features = "handcrafted" if reflectance else "handcrafted_range"
    return ("panel", f"kid_{features}", f"frechet_{features}", "jsd", "mmd")
