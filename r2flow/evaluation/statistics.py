"""Disk cache of the metrics' statistics of real scans."""

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError
from r2flow.files import cache_folder
from r2flow.metrics.base import ScanMetric
from r2flow.plugins import plugin_digests
from r2flow.store import Damaged, Store, checksum

log = logging.getLogger(__name__)

FORMAT = 5  # increment if statistics change for the same scans and protocol


@dataclass(frozen=True)
class Statistics:
    """A metric's states after a set of scans, and scan counts."""

    states: Mapping[str, Tensor] = field(repr=False)  # from `ScanMetric.real_state`
    scans: int
    empty: int  # scans without a return within the mask
    chosen: str = ""  # description of their choice from the set


class Cache:
    """Folder of statistics of real scans; names in it are hashes of everything the statistics depend on."""

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = cache_folder("R2FLOW_CACHE") / "statistics" if folder is None else Path(folder)

    def _store(self, key: str) -> Store:
        return Store(self.folder / checksum(key)[:24], "statistics", {"key": key})

    def read(self, key: str) -> Statistics | None:
        """Read the statistics of a key from `key_of`; None if missing or damaged."""
        try:
            states, notes = self._store(key).read(0)
        except FileNotFoundError:
            return None
        except (Damaged, InputError) as error:
            log.warning("statistics in %s are damaged (%s): recomputing them.", self.folder, error)
            return None
        return Statistics({name: torch.from_numpy(value) for name, value in states.items()}, **notes)

    def write(self, key: str, statistics: Statistics) -> None:
        """Store statistics; only warn if the disk is not writable."""
        states = {name: value.numpy() for name, value in statistics.states.items()}
        try:
            self._store(key).write(0, states, {"scans": statistics.scans, "empty": statistics.empty})
        except OSError as error:
            log.warning("statistics are not cached: %s: %s", self.folder, error.strerror or error)


def key_of(metric: ScanMetric, scans: ScanSet, rule: str) -> str:
    """Everything a metric's statistics of a set depend on, as JSON.

    The key contains scan files with sizes and times (or seed, or manifest), sensor, projection, mask, subset, the
    metric's protocol with its weights' hash, the code of plug-ins, the device type, and the file format.
    """
    parts = {
        "format": FORMAT, "scans": scans.identity, "subset": rule, "protocol": asdict(metric.protocol),
        "keeps": metric.keeps, "plugins": plugin_digests(), "device": torch.device(metric.device).type,
    }  # fmt: skip
    return json.dumps(parts, sort_keys=True)
