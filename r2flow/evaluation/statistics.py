"""Disk cache of the metrics' statistics of real scans."""

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor

from r2flow.data.sets import ScanSet
from r2flow.files import cache_folder, write_file
from r2flow.metrics.base import ScanMetric
from r2flow.model.checkpoint import read_tensors

log = logging.getLogger(__name__)

FORMAT = 4  # increment if statistics change for the same scans and protocol


@dataclass(frozen=True)
class Statistics:
    """A metric's states after a set of scans, and scan counts."""

    states: Mapping[str, Tensor] = field(repr=False)  # from `ScanMetric.real_state`
    scans: int
    empty: int  # scans without a return within the mask
    chosen: str = ""  # description of their choice from the set


class Cache:
    """Folder of statistics of real scans; file names are hashes of everything the statistics depend on."""

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = cache_folder("R2FLOW_CACHE") / "statistics" if folder is None else Path(folder)

    def path(self, key: str) -> Path:
        """File of a key from `key_of`."""
        metric = json.loads(key)["protocol"]["metric"]
        return self.folder / f"{metric}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.safetensors"

    def read(self, key: str) -> Statistics | None:
        """Read the statistics of a key; None if missing or damaged."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            states, notes = read_tensors(path)
            return Statistics(states, int(notes["scans"]), int(notes["empty"])) if notes["key"] == key else None
        except (SafetensorError, OSError, KeyError, ValueError):
            log.warning("%s is damaged; recomputing its statistics.", path)
            return None

    def write(self, key: str, statistics: Statistics) -> None:
        """Store statistics; only warn if the disk is not writable."""
        notes = {"key": key, "scans": str(statistics.scans), "empty": str(statistics.empty)}
        data = save({name: value.contiguous() for name, value in statistics.states.items()}, metadata=notes)
        try:
            write_file(self.path(key), data)
        except OSError as error:
            log.warning("statistics are not cached: %s: %s", self.folder, error.strerror or error)


def key_of(metric: ScanMetric, scans: ScanSet, rule: str) -> str:
    """Everything a metric's statistics of a set depend on, as JSON.

    The key contains scan files with sizes and times (or seed, or manifest), sensor, projection, mask, subset, the
    metric's protocol with its weights' hash, the device type, and the file format.
    """
    parts = {
        "format": FORMAT, "scans": scans.identity, "subset": rule, "protocol": asdict(metric.protocol),
        "keeps": metric.keeps, "device": torch.device(metric.device).type,
    }  # fmt: skip
    return json.dumps(parts, sort_keys=True)
