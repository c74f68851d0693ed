"""A folder of simulated scans; the same command makes those that are missing."""

import json
import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r2flow import noise
from r2flow.errors import InputError
from r2flow.files import atomic_write, read_json, sole_use
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import FIRM_ENDINGS, write_points
from r2flow.lidar.sensors import Sensor
from r2flow.signals import end_with_parent, out_of_reach
from r2flow.simulator import REVISION, simulate

FORMATS = ("bin", "pcd", "ply", "npy")  # npy is the range image itself
MANIFEST = "simulated.json"
_BATCH = 4  # scans of a worker process between two updates of the progress


@dataclass(frozen=True)
class SimulatedFolder:
    """The scans of one folder.

    Attributes:
        path: The folder.
        sensor: Their sensor.
        seed: Scan i is a function of the sensor, the seed and i alone.
        formats: Endings of the files of a scan, some of `FORMATS`.
        labels: Whether each has a SemanticKITTI .label file, uint32 for each point in the order of the points.
    """

    path: Path
    sensor: Sensor
    seed: int
    formats: tuple[str, ...] = ("bin",)
    labels: bool = False

    def __post_init__(self) -> None:
        noise.generator(self.seed, "simulator", 0)  # refuses what is no seed
        for name in self.formats:
            if name not in FORMATS:
                raise InputError(f"no format named {name!r} for simulated scans; known: {', '.join(FORMATS)}.")
        if self.labels and self.formats == ("npy",):
            raise InputError(
                "labels are those of points, and .npy is a range image without any; add another format, such as bin."
            )

    def files(self, index: int) -> list[Path]:
        """The files of a scan."""
        endings = [*self.formats, *(["label"] if self.labels else [])]
        return [self.path / f"{index:06d}.{ending}" for ending in endings]

    def missing(self, indices: Sequence[int]) -> list[int]:
        """Scans of which a file is missing. Files are written whole or not at all."""
        return [index for index in indices if not all(file.is_file() for file in self.files(index))]

    def check(self) -> bool:
        """Whether the folder has been begun.

        Raises:
            InputError: it holds scans of another seed, sensor or revision, or scans and no note.
        """
        ours, note = _note(self.sensor, self.seed), self.path / MANIFEST
        if note.exists():
            found = _read_note(note)
            wrong = [key for key in ours if found.get(key) != ours[key]]
            if wrong:
                key = wrong[0]
                raise InputError(
                    f"{self.path} holds simulated scans with {key} {_short(found.get(key))}, not "
                    f"{_short(ours[key])}; choose another folder, or the same {key}."
                )
            return True
        taken = next((file for file in self.path.rglob("*") if file.name.endswith(FIRM_ENDINGS)), None)
        if taken:
            raise InputError(
                f"{self.path} holds scans already ({taken.relative_to(self.path)}) and no {MANIFEST}: give another "
                "folder, or data=folder to learn from them."
            )
        return False

    def begin(self) -> None:
        """Make the folder and note seed, sensor and revision of the simulator in it.

        Raises:
            InputError: what `check` refuses.
        """
        if not self.check():
            with atomic_write(self.path / MANIFEST, "w") as file:
                json.dump(_note(self.sensor, self.seed), file, indent=2)

    def write(self, index: int) -> None:
        """Make one scan and write its files."""
        scan = simulate(self.sensor, self.seed, index)
        rays = self.sensor.rays()
        xyz, reflectance = image_to_points(scan.image, rays)
        for path in self.files(index):
            if path.suffix == ".npy":
                with atomic_write(path) as file:
                    np.save(file, scan.image)
            elif path.suffix == ".label":
                # In the order of the points; ids are exact in float32.
                _, labels = image_to_points(np.stack([scan.image[0], scan.labels.astype(np.float32)]), rays)
                with atomic_write(path) as file:
                    file.write(labels.astype("<u4").tobytes())
            else:
                write_points(path, xyz, reflectance)


def write_folder(
    folder: SimulatedFolder, indices: Sequence[int], workers: int, advance: Callable[[], None] = lambda: None
) -> int:
    """Make the scans that are missing.

    Args:
        workers: Number of processes.
        advance: Called once for each scan, also for those that are there already.

    Returns:
        How many were made.

    Raises:
        InputError: as `SimulatedFolder.begin` does, or a process was killed.
    """
    folder.begin()
    with sole_use(folder.path / MANIFEST) as alone:
        if alone:  # what a killed writer has left
            for leftover in folder.path.glob(".*.part"):
                leftover.unlink(missing_ok=True)
        return _write_missing(folder, indices, workers, advance)


def _write_missing(folder: SimulatedFolder, indices: Sequence[int], workers: int, advance: Callable[[], None]) -> int:
    missing = folder.missing(indices)
    for _ in range(len(indices) - len(missing)):
        advance()
    if workers == 1 or len(missing) <= _BATCH:
        for index in missing:
            folder.write(index)
            advance()
        return len(missing)
    batches = [missing[start : start + _BATCH] for start in range(0, len(missing), _BATCH)]
    # Spawned, not forked: torch's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(batches)), context, _begin_worker)
    try:
        with out_of_reach():
            results = [pool.submit(_write_batch, folder, batch) for batch in batches]
        for done in as_completed(results):
            for _ in range(done.result()):
                advance()
    except BrokenProcessPool:
        raise InputError(
            f"a process that wrote {folder.path} was killed; is there memory for {workers} of them? "
            "The same command goes on."
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)
    return len(missing)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent process and end when it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _write_batch(folder: SimulatedFolder, indices: Sequence[int]) -> int:
    for index in indices:
        folder.write(index)
    return len(indices)


def simulated_seed(folder: Path) -> int | None:
    """The seed of the simulated scans in a folder; None where it holds none, or its note is damaged."""
    try:
        seed = read_json(folder / MANIFEST)["seed"]
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return seed if isinstance(seed, int) else None


def _note(sensor: Sensor, seed: int) -> dict[str, Any]:
    described = json.loads(json.dumps(sensor.described()))  # tuples as lists, as they come back
    return {"simulator": REVISION, "seed": seed, "sensor": described}


def _read_note(path: Path) -> dict[str, Any]:
    try:
        note = read_json(path)
    except ValueError:
        note = None
    if not isinstance(note, dict):
        raise InputError(f"{path} is damaged; remove it together with the scans beside it, or choose another folder.")
    return note


def _short(value: Any) -> str:
    """A seed or a revision as it is, a sensor by its name, size and range."""
    if isinstance(value, dict):
        rows = len(value.get("elevations", ()))
        return f"{value.get('name')} {rows}x{value.get('columns')}, {value.get('min_range')}-{value.get('max_range')} m"
    return str(value)
