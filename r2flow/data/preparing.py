"""Preparation of scans: read and projected once, written as shards (`r2flow.data.prepared`)."""

import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError, check
from r2flow.base.progress import Bar, track
from r2flow.data.described import Described
from r2flow.data.files import ScanFiles
from r2flow.data.layouts import Drive
from r2flow.data.prepared import PreparedStore
from r2flow.data.quantise import OTHER_LEVELS, find_levels
from r2flow.data.reading import Reading, labelled, read_image
from r2flow.data.reflectance import lacks_reflectance
from r2flow.data.sensor_checks import warn_of_other_sensor
from r2flow.data.sources import spread
from r2flow.store import checksum

_log = logging.getLogger(__name__)

_PROJECTION = 4  # revision; increase it when the same files give different images or codes


def plan(
    folder: str | Path,
    scans: Described,
    reading: Reading,
    shard_scans: int = 64,  # 13 MB at 64 x 1024, held in memory until written
) -> PreparedStore:
    """The store in `folder` of scan files; reads some scans for the levels of reflectance."""
    root = scans.options.folder
    drives = [
        Drive(d.name, tuple(Path(os.path.relpath(p, root)).as_posix() for p in d.scans))
        for d in scans.drives
    ]
    reading = replace(reading, on_bad_scan="error", within_limits=True)
    warn_of_other_sensor(scans, reading)
    levels = _reflectance_levels(scans.paths, reading)
    reading = replace(reading, reflectance=levels is not None, labels=labelled(scans.paths) > 0)
    names = [name for drive in drives for name in drive.scans]
    recipe = {
        "revision": _PROJECTION, "layout": scans.options.name, "scans": len(names),
        "names": checksum(names), "reading": reading.described(), "levels": levels,
        "shard_scans": shard_scans,
    }  # fmt: skip
    return PreparedStore(folder, recipe, drives, ScanFiles(scans.paths, reading, root))


def _reflectance_levels(paths: Sequence[str], reading: Reading) -> int | None:
    if lacks_reflectance(paths, "skip", reading.columns) is not None:
        return None
    samples = []
    for index in spread(len(paths), 8):  # enough to see every level
        with suppress(InputError):  # reported when the scan is prepared
            samples.append(read_image(Path(paths[index]), replace(reading, reflectance=True))[1])
    values = np.concatenate(samples) if samples else np.zeros(0)
    return find_levels(values) if values.any() else OTHER_LEVELS


def _make_shard(store: PreparedStore, skip: bool, shard: int) -> None:
    assert store.source is not None
    left_out: list[int] = []
    images: list[np.ndarray] = []
    for number in store.parts[shard]:
        try:
            images.append(store.source[number])
        except InputError as error:
            if not skip:
                raise
            _log.warning("left out: %s", error)
            left_out.append(number)
    shape = len(images), len(store.codes), *store.reading.sensor.shape
    channels = np.reshape(images, shape).swapaxes(0, 1)
    tensors = {
        name: coder.encode(channel)
        for channel, (name, coder) in zip(channels, store.codes.items(), strict=True)
    }
    store.write(shard, tensors, {"left_out": left_out, "files": store.sources_of(shard)})


def prepare(
    store: PreparedStore, on_bad_scan: str = "error", workers: int = 1
) -> tuple[int, list[int]]:
    """Check the shards of a folder, and make missing or damaged shards; `on_bad_scan="skip"` leaves
    out unusable scans.

    The headers of the shards have the numbers of the scans left out and a digest of the files:
    shards of files that have changed since are refused. The result is the number of scans left out,
    and the shards that were made.
    """
    if not store.check() or store.missing(store.shards):  # else the folder may be read-only
        store.begin(drives=[[drive.name, drive.scans] for drive in store.drives])
    for shard in track(store.shards, "checking", "shards"):
        store.mend(shard)
        file = store.file(shard)
        check(
            not file.exists() or store.head(shard).get("files") == store.sources_of(shard),
            f"{file} holds scans of other files. Give another folder by {store.option}, or remove "
            "it to make it again.",
        )
    missing = store.missing(store.shards)
    with Bar("preparing", len(missing), "shards") as bar:
        store.make(
            missing,
            partial(_make_shard, store, on_bad_scan == "skip"),
            workers,
            lambda shard: bar(),
        )
    left_out = sum(len(store.head(shard)["left_out"]) for shard in store.shards)
    if left_out == len(store.names):
        for shard in store.shards:  # so that the folder takes another recipe
            store.file(shard).unlink(missing_ok=True)
        raise InputError(f"all {left_out} scans were left out as unusable.")
    return left_out, missing
