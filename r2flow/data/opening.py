"""Open scans by name, for runs, commands and reports.

scans = open_scans("kitti_360:/data/KITTI-360", Reading(SENSORS["hdl64e"]), split="test")
scans.source[0]                 range in metres and reflectance, (2, H, W)
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.data.described import Described, Spec, describe
from r2flow.data.detection import reading_for
from r2flow.data.files import ScanFiles
from r2flow.data.options import SIMULATED
from r2flow.data.reading import AUTO, Reading
from r2flow.data.reflectance import lacks_reflectance
from r2flow.data.sets import ScanSet
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensors import Sensor


def open_scans(
    spec: Spec,
    reading: Reading | None = None,
    split: str | None = None,
    num: int | None = None,
) -> ScanSet:
    """Open the scans of a name. Scans are read on access, except those that decide whether the set
    has reflectance.

    Args:
        spec: As for `describe`.
        reading: How scans become images; None: `reading_for([spec])`.
        split: A part of the data set's standard split, of a name not yet looked up.
        num: Maximum number of scans, chosen by a fixed shuffle; the number of simulated scenes.
    """
    if num is not None and num < 1:
        raise InputError(f"num must be at least 1, or None for all scans; found {num!r}.")
    scans = describe(spec, split=split)
    reading = reading or reading_for([scans])
    if num and scans.options.name == SIMULATED:
        scans.options = replace(scans.options, scenes=num)
    return ScanSet(scans.label, scans.open(reading), reading.sensor).limited(num)


def open_each(scans: Described, paths: Sequence[str], reading: Reading) -> Iterator[ScanSet]:
    """Files of some scans one by one, each with the size of its range image and with the
    reflectance that it has.
    """
    for path in paths:
        image = read_range_image(path)
        sensor = reading.sensor
        if image is not None:
            sensor = sensor.resized(*image.shape[1:])
        reflectance = reading.reflectance
        if reflectance == AUTO:
            lacking = lacks_reflectance([path], reading.on_bad_scan, reading.columns)
            reflectance = lacking is None
        how = replace(reading, sensor=sensor, reflectance=reflectance)
        yield ScanSet(scans.label, ScanFiles([path], how, scans.options.folder), sensor)


def read(
    path: str | Path,
    sensor: Sensor | str | None = None,
    reflectance_scale: float | None = None,
    columns: Sequence[str] | None = None,
) -> tuple[Tensor, Sensor]:
    """The image of `r2flow.read` and its sensor."""
    scans = describe(path)
    if scans.file is None:
        raise InputError(f"{path} is a folder: r2flow.data.opening.open_scans opens it.")
    reading = reading_for(
        [scans],
        sensor=sensor,
        estimate_scale=True,
        reflectance_scale=reflectance_scale,
        columns=columns,
    )
    reading = replace(reading, on_bad_scan="error", within_limits=True)
    if sensor is None and read_range_image(scans.file) is not None:
        opened = next(open_each(scans, scans.paths, reading))
    else:
        opened = open_scans(scans, reading)
    image = torch.from_numpy(opened.source[0])
    if len(image) == 1:
        image = torch.cat([image, torch.zeros_like(image)])
    return image, opened.sensor
