"""LiDARGen's published checkpoints: a list of weights, optimizer, epoch, step and averaged weights.

The file stores neither image size nor ranges; they are the published ones, 64 x 1024 and 0.5 to 63 m.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from r2flow.model.published import Format, Published

WRAPPED = "module."  # prefix of torch's DataParallel
FIRST, LAST = "begin_conv.weight", "end_conv.weight"


def holds(content: Any) -> bool:
    return (
        isinstance(content, list)
        and len(content) in (4, 5)
        and isinstance(content[0], Mapping)
        and WRAPPED + FIRST in content[0]
    )


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """Load a published score model; averaged weights lack buffers, files without averages have raw weights."""
    weights: dict[str, Tensor] = {name.removeprefix(WRAPPED): value for name, value in content[0].items()}
    sigmas = weights["sigmas"]
    config = {
        "sensor": {"name": "hdl64e", "rows": 64, "columns": 1024, "min_range": 0.5, "max_range": 63.0},
        "encoding": {"format": "shifted_log", "reflectance": len(weights[LAST]) > 1, "limits": "open"},
        "backbone": {"name": "refinenet"},
        "generator": {
            "name": "score",
            "width": len(weights[FIRST]),
            "sigma_first": float(f"{sigmas[0]:.6g}"),
            "sigma_last": float(f"{sigmas[-1]:.6g}"),
            "levels": len(sigmas),
        },
        "data": {"name": "kitti_360", "reading": {"projection": "spherical", "convention": "lidargen"}},
        "published": {"system": "LiDARGen"},
    }
    if averaged:
        weights |= {name.removeprefix(WRAPPED): value for name, value in dict(*content[4:]).items()}
    named = {f"network.{name}": value for name, value in weights.items()}
    return Published(config, named, int(content[3]), {"name": "langevin", "steps": 5})


FORMAT = Format("LiDARGen", holds, read)
