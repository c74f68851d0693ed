"""What reads each kind of file in the fuzzing; a reader of a file with a checksum returns its
content as bytes.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError
from r2flow.base.files import reading
from r2flow.data.described import Described, describe
from r2flow.data.options import PairOptions, SourceOptions
from r2flow.data.pairs import PairStore
from r2flow.data.prepared import PreparedScans
from r2flow.data.reading import Reading, read_image
from r2flow.lidar.labels import read_labels
from r2flow.lidar.scan_files import LARGEST_FILE, read_points
from r2flow.lidar.scan_files.pickled import read_table
from r2flow.lidar.sensors import SENSORS, read_sensor
from r2flow.metrics.extractors.base import _read_published
from r2flow.model.checkpoint import load_checkpoint
from r2flow.runs.folder import read_config
from r2flow.store import Damaged

SENSOR = SENSORS["hdl64e"].resized(8, 64)


def points(path: Path) -> None:
    found = read_points(path)
    assert np.isfinite(found.xyz).all()
    assert len(found.xyz)


def image(path: Path) -> None:
    assert np.isfinite(
        read_image(path, Reading(SENSOR, reflectance=True, on_bad_scan="error"))
    ).all()


def labels(path: Path) -> None:
    scan = path.parents[2] / "beside" / "scan.bin"
    read_labels(path, scan, read_points(scan))


def in_folder(name: str) -> Callable[[Path], Path]:
    """A damaged file takes its place among undamaged ones, which lie in `beside/NAME`."""

    def place(path: Path) -> Path:
        folder = path.parents[2] / "beside" / name
        (folder / path.name).write_bytes(path.read_bytes())
        return folder

    return place


def prepared(path: Path) -> bytes:
    folder = in_folder("prepared")(path)
    scans = Described("it", SourceOptions("prepared", str(folder)))
    source = scans.kind.open(scans, Reading(SENSOR, reflectance=True))
    assert isinstance(source, PreparedScans)
    for shard in source.rows[:, 1]:
        try:
            source.store.read(int(shard))
        except Damaged as error:
            raise InputError(str(error)) from None
    return b"".join(source[number].tobytes() for number in range(len(source)))


def pairs(path: Path) -> bytes:
    folder = in_folder("pairs")(path)
    store = PairStore(
        folder, PairOptions(num=4, sampler={"name": "euler", "steps": 1}, batch_size=2), (2, 8, 64)
    )
    try:
        return store.read(0)[0]["x_1"].tobytes()
    except Damaged as error:
        raise InputError(str(error)) from None


def checkpoint(path: Path) -> bytes | None:
    state = load_checkpoint(path).generator.state_dict()
    if path.suffix != ".safetensors":  # torch's files have no checksum of their weights
        return None
    return b"".join(state[name].numpy().tobytes() for name in sorted(state))


def samples(path: Path) -> None:
    _ = describe(in_folder("samples")(path)).stored


def config(path: Path) -> None:
    read_config(in_folder("run")(path))


def weights(path: Path) -> None:
    _read_published(path)


def table(path: Path) -> None:
    with reading(path, LARGEST_FILE):
        read_table(path)


READERS: dict[str, Callable[[Path], object]] = {
    "points": points, "image": image, "labels": labels, "prepared": prepared, "pairs": pairs, "checkpoint": checkpoint,
    "samples": samples, "config": config, "weights": weights,
    "sensor": read_sensor, "table": table,
}  # fmt: skip
