"""Scans and range images to draw."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from r2flow.data.opening import find_drives, open_scans, own_reading, parse
from r2flow.data.options import FOLDER, SIMULATED
from r2flow.data.reading import Reading, read_labelled_scan
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles, SimulatedScans, spread, warn_of_other_sensor
from r2flow.lidar.labels import labels_beside
from r2flow.lidar.scan_files import read_range_image


class View(NamedTuple):
    """A scan to draw: its path, and its index in an opened set."""

    path: Path
    scans: ScanSet
    number: int

    @property
    def image(self) -> np.ndarray:
        return self.scans.source[self.number]

    @property
    def rays(self) -> Tensor:
        return self.scans.sensor.rays()

    def labelled(self) -> tuple[np.ndarray, np.ndarray | None]:
        """The image, and semantic ids, (H, W), from a .label file or the simulator; else None."""
        source = self.scans.source
        if isinstance(source, SimulatedScans):
            from r2flow.simulator import simulate

            made = simulate(source.sensor, source.seed, source.scenes[self.number])
            return made.image[: 1 + source.reflectance], made.labels
        if not isinstance(source, ScanFiles):
            return self.image, None
        path, reading = Path(source.paths[self.number]), source.reading
        if labels_beside(path) is None or read_range_image(path) is not None:
            return self.image, None
        return read_labelled_scan(path, replace(reading, on_bad_scan="error"))


def scans_of(path: Path) -> list[Path]:
    """A scan file, or the scans of a folder."""
    if not path.is_dir():
        return [path]
    return [Path(scan) for drive in find_drives(FOLDER, path) for scan in drive.scans]


def _print_choice(what: str | Path, count: int, most: int) -> None:
    if count > most:
        print(f"{what}: {most} of its {count:,} scans, evenly spread (--num)")


def views_of(spec: str, reading: Reading, most: int) -> list[View]:
    """Up to `most` scans of a set (`open_scans`), evenly spread.

    Files not written by r2flow are opened one by one, since sizes of range images and reflectance may differ.
    """
    reading = replace(reading, on_bad_scan="error")
    options, file = parse(spec)
    if own_reading(spec) is None and options.name == FOLDER:
        paths = scans_of(file or Path(options.folder))
        _print_choice(spec, len(paths), most)
        chosen = [paths[index] for index in spread(len(paths), most)]
        warn_of_other_sensor(chosen, reading, spec)
        return [View(path, open_scans(path, reading, own_size=True), 0) for path in chosen]
    opened = open_scans(spec, reading)
    if options.name != SIMULATED:  # simulated sets have any size
        _print_choice(spec, len(opened), most)
    scans = opened.spread(most)
    return [View(Path(options.folder, name), scans, number) for number, name in enumerate(scans.source.names)]
