"""Simulated street scenes as a source of range images."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from r2flow import simulator
from r2flow.base.files import cache_folder
from r2flow.base.registry import Config
from r2flow.data.sources import MadeScans
from r2flow.lidar.labels import common_classes
from r2flow.lidar.sensors import Sensor
from r2flow.store import Damaged, Store, checksum

_log = logging.getLogger(__name__)

WORTH_KEEPING = 32  # simulated scans: fewer are simulated again


@dataclass(eq=False)
class SimulatedScans(MadeScans):
    """Simulated scenes of one seed."""

    slow = True
    word = "scene"
    doing = "simulating"

    sensor: Sensor
    seed: int
    numbers: Sequence[int]
    reflectance: bool
    labels: bool = False  # whether images end with the common class of each ray

    def about(self) -> Config:
        return {
            "kind": "simulated",
            "seed": self.seed,
            "scenes": len(self),
            "reflectance": self.reflectance,
            "labels": self.labels,
        }

    def identity(self) -> Config:
        return {
            **self.about(),
            "numbers": checksum([*self.numbers])[:16],
            "simulator": simulator.REVISION,
            "sensor": self.sensor.described(),
        }

    def read_all(self, what: str, shape: tuple[int, ...]) -> np.ndarray:
        """All images; many are kept in the user's cache, so that they are simulated once."""
        if len(self) < WORTH_KEEPING:
            return super().read_all(what, shape)
        identity = self.identity()
        folder = cache_folder("R2FLOW_CACHE")
        store = Store(folder, f"simulated-{checksum(identity)[:16]}", identity)
        try:
            return store.read(0)[0]["images"]
        except (FileNotFoundError, Damaged):
            images = super().read_all(what, shape)
        with suppress(OSError):  # a full disk, a home that is read-only
            store.write(0, {"images": images})
            _log.info("the simulated scans are kept in %s (%.0f MB)", folder, images.nbytes / 1e6)
        return images

    @property
    def contents(self) -> str:  # type: ignore[override]
        # its revisions draw different scans of the same name
        return f"simulator {simulator.REVISION}"

    def __getitem__(self, index: int) -> np.ndarray:
        scan = simulator.simulate(self.sensor, self.seed, self.numbers[index])
        image = scan.image[: 1 + self.reflectance]
        return np.concatenate([image, common_classes(scan.labels)[None]]) if self.labels else image
