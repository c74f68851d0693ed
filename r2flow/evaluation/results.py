"""Results of sampled sets, stored in a folder so that an interrupted evaluation resumes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from r2flow.data.sets import ScanSet
from r2flow.evaluation.measuring import MetricResult
from r2flow.files import atomic_write, read_json
from r2flow.metrics.base import ScanMetric
from r2flow.store import checksum


class Results:
    """Folder with one file per sampled set, named by a hash of everything its results depend on.

    Args:
        folder: None: store nothing.
        how: Other settings that affect results: bootstrap draws, protocol, device.
    """

    def __init__(self, folder: Path | None, metrics: Mapping[str, ScanMetric], **how: Any) -> None:
        self.folder = folder
        self.recipe = {"metrics": {name: metric.protocol.asdict() for name, metric in metrics.items()}, **how}

    def read(self, real: ScanSet, sampled: ScanSet) -> list[MetricResult] | None:
        """Read the results of a sampled set against a real one; None if missing or damaged."""
        if self.folder is None:
            return None
        try:
            return [MetricResult(**entry) for entry in read_json(self._path(self.folder, real, sampled))]
        except (OSError, ValueError, TypeError):
            return None

    def write(self, real: ScanSet, sampled: ScanSet, results: Sequence[MetricResult]) -> None:
        """Store the results of a sampled set."""
        if self.folder is not None:
            with atomic_write(self._path(self.folder, real, sampled), "w") as file:
                json.dump([asdict(result) for result in results], file)

    def _path(self, folder: Path, real: ScanSet, sampled: ScanSet) -> Path:
        recipe = {"real": real.identity or [real.label, len(real)], "sampled": sampled.about, **self.recipe}
        return folder / f"{checksum(recipe)[:16]}.json"
