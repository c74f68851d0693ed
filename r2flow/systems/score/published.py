"""LiDARGen's published checkpoints: a list of weights, optimizer, epoch, step, averaged weights.

The file stores neither image size nor ranges; they are the published ones, 64 x 1024 and 0.5 to
63 m.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from r2flow.model.published import Format, Published

_FIRST = "module.begin_conv.weight"  # with the prefix of torch's DataParallel


def _holds_score_model(content: Any) -> bool:
    if not isinstance(content, list) or len(content) not in (4, 5):
        return False
    return isinstance(content[0], Mapping) and _FIRST in content[0]


def _read_score_model(content: Any, path: Path, averaged: bool = True) -> Published:
    """Load a published score model.

    Averaged weights lack buffers, and files without averages have raw weights.
    """
    weights = {}
    for part in (content[0], *content[4:]) if averaged else content[:1]:
        for name, value in part.items():
            weights["network." + name.removeprefix("module.")] = value
    sigmas = weights["network.sigmas"]
    config = {
        "sensor": {
            "name": "hdl64e",
            "rows": 64,
            "columns": 1024,
            "min_range": 0.5,
            "max_range": 63.0,
        },
        "encoding": {
            "format": "shifted_log",
            "reflectance": len(weights["network.end_conv.weight"]) > 1,
            "limits": "open",
        },
        "backbone": {"name": "refinenet"},
        "generator": {
            "name": "score",
            "width": len(content[0][_FIRST]),
            "sigma_first": float(f"{sigmas[0]:.6g}"),
            "sigma_last": float(f"{sigmas[-1]:.6g}"),
            "levels": len(sigmas),
        },
        "data": {
            "name": "kitti_360",
            "reading": {"projection": "spherical", "convention": "lidargen"},
        },
        "published": {"system": "LiDARGen"},
    }
    return Published(config, weights, int(content[3]), {"name": "langevin", "steps": 5})


FORMAT = Format("LiDARGen", _holds_score_model, _read_score_model)
