"""Sets of scans to be measured: whatever a user names, as numbered range images that are read when they are needed."""

import hashlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from r2flow import simulator
from r2flow.checkpoints import Checkpoint, checkpoints_of, weights_hash
from r2flow.data.layouts import LAYOUTS, find_drives
from r2flow.data.manifest import read_manifest
from r2flow.data.prepared import open_prepared
from r2flow.data.sources import ScanSource, SimulatedScans, spread
from r2flow.data.store import MANIFEST
from r2flow.errors import InputError
from r2flow.evaluation.reading import FolderScans, Reading, has_reflectance, scan_paths
from r2flow.flow.solvers import solve
from r2flow.lidar.sensors import Sensor
from r2flow.noise import generator
from r2flow.registry import did_you_mean
from r2flow.sampling import decode, noise_of

SIMULATED = "simulated"
CHECKPOINTS = (".ckpt", ".pth", ".safetensors")


@dataclass(frozen=True)
class ScanSet:
    """Scans to be measured.

    Attributes:
        label: As the user named it.
        source: The scans by number.
        sensor: Whose images they are.
        about: What a reader of a figure must know of them.
        identity: All that decides what the images are; None where they are drawn anew and nothing is worth keeping.
        drives: Numbers of the scans of each recording, where recordings are known.
    """

    label: str
    source: ScanSource
    sensor: Sensor
    about: Mapping[str, Any]
    identity: Mapping[str, Any] | None = None
    drives: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.source)

    def part(self, numbers: Sequence[int], name: str) -> "ScanSet":
        """Some of the scans, in the given order; `name` says which for a reader."""
        chosen = hashlib.sha256(np.asarray(numbers, dtype=np.int64).tobytes()).hexdigest()[:16]
        place = {number: i for i, number in enumerate(numbers)}
        drives = {
            drive: kept for drive, held in self.drives.items() if (kept := [place[n] for n in held if n in place])
        }
        return replace(
            self,
            source=self.source.subset(numbers),
            about={**self.about, "part": name},
            identity=None if self.identity is None else {**self.identity, "part": chosen},
            drives=drives,
        )

    def limited(self, most: int | None) -> "ScanSet":
        """At most `most` scans, by `fixed_choice`."""
        if most is None or most >= len(self):
            return self
        return self.part(fixed_choice(len(self), most), f"{most} of {len(self)}, fixed shuffle, seed 0")

    def batches(self, numbers: Sequence[int], batch_size: int, workers: int = 0) -> Iterator[Tensor]:
        """The scans of these numbers in order, each batch (B, 2 or 1, H, W), read by `workers` further processes."""
        chunks = [list(numbers[i : i + batch_size]) for i in range(0, len(numbers), batch_size)]
        # Processes cost seconds to start; and what is drawn is drawn where the network is.
        alone = isinstance(self.source, SampledScans) or len(chunks) < 8
        loader: DataLoader[Tensor] = DataLoader(
            _Batches(self.source),
            batch_size=None,
            sampler=chunks,  # each key is a batch's numbers
            num_workers=0 if alone else workers,
        )
        return iter(loader)


class _Batches(Dataset[Tensor]):
    """Batches by the numbers of their scans."""

    def __init__(self, source: ScanSource) -> None:
        self.source = source

    def __getitem__(self, numbers: list[int]) -> Tensor:
        if isinstance(self.source, SampledScans):
            return self.source.draw(numbers)
        return torch.from_numpy(np.stack([self.source[number] for number in numbers]))


def fixed_choice(count: int, most: int) -> list[int]:
    """`most` of `count` numbers, the first of a fixed shuffle (Philox, seed 0), in rising order."""
    return sorted(generator(0, "shuffle", 0).permutation(count)[:most].tolist())


def open_set(text: str, reading: Reading, split: str | None = None, num: int | None = None) -> ScanSet:
    """The scans that a user names.

    Args:
        text: A folder of scan files or range images, a folder of prepared shards, `LAYOUT:ROOT` or `simulated:SEED`.
        split: A part of the layout's standard split.
        num: At most so many, by a fixed shuffle; the number of simulated scenes, 1000 if left out.

    Raises:
        InputError: nothing is there, or what is there does not fit the sensor.
    """
    kind, colon, rest = text.partition(":")
    if colon and kind == SIMULATED:
        if not rest.isdigit():
            raise InputError(f"simulated scans are named by their seed, as simulated:0; found {text!r}.")
        return _simulated(int(rest), 1000 if num is None else num, reading)
    if colon and kind in LAYOUTS:
        found = _layout(text, kind, rest, split, reading)
    elif colon and not Path(text).exists() and "/" not in kind and "\\" not in kind:
        known = [*LAYOUTS, SIMULATED]
        raise InputError(f"no data layout named {kind!r}; known: {', '.join(known)}.{did_you_mean(kind, known)}")
    elif is_prepared(text):
        found = _prepared(text, split, reading)
    elif split is not None:
        raise InputError(f"{text} is a folder and has no standard split, found {split!r}; name it as LAYOUT:FOLDER.")
    else:
        found = _folder(text, reading)
    return found.limited(num)


def is_prepared(text: str) -> bool:
    """Whether a name is that of a folder of `r2flow prepare`."""
    return (Path(text).expanduser() / MANIFEST).is_file()


def prepared_reading(text: str) -> Reading:
    """How the scans in a folder of `r2flow prepare` were projected.

    Raises:
        InputError: a manifest that cannot be read.
    """
    recipe = read_manifest(Path(text).expanduser()).recipe
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in recipe.sensor.items()}
    return Reading(Sensor(**fields), recipe.projection, recipe.convention, recipe.reflectance_scale)  # type: ignore[arg-type]


def is_checkpoint(text: str) -> bool:
    """Whether a name is that of a flow to sample from: a checkpoint file or a run folder."""
    path = Path(text).expanduser()
    if path.is_dir():
        return bool(checkpoints_of(path)) or any(path.glob("step-*.ckpt"))
    return path.suffix in CHECKPOINTS


def sampled_set(
    flow: Checkpoint, label: str, num: int, steps: int, method: str = "euler", tolerance: float = 1e-5, seed: int = 0
) -> ScanSet:
    """Scans 0 to num - 1 of a flow's seed, drawn when they are asked for.

    Their noise is that of (seed, "evaluation", i), which no training step and no reflow pair has seen.

    Raises:
        InputError: fewer than one.
    """
    if num < 1:
        raise InputError(f"needs at least one scan to sample, found {num}.")
    about = {
        "kind": "sampled", "weights": weights_hash(flow), "step": flow.step, "num": num, "solver": method,
        "steps": steps, "seed": seed, "noise": "evaluation", "reflectance": flow.encoding.reflectance,
    }  # fmt: skip
    source = SampledScans(flow, range(num), steps, method, tolerance, seed)
    return ScanSet(label, source, flow.sensor, about)


class SampledScans:
    """Scans of a flow by their numbers; what one is depends on (seed, number) alone.

    Attributes:
        unsolved: How many of those drawn so far are no solution to the tolerance.
        evaluations: Network evaluations of each.
        seconds: Of the solution of a scan, for each batch.
    """

    def __init__(
        self, flow: Checkpoint, numbers: Sequence[int], steps: int, method: str, tolerance: float, seed: int
    ) -> None:
        self.flow, self.numbers, self.seed = flow, numbers, seed
        self.solve = partial(solve, flow.model, t_0=0.0, t_1=1.0, method=method, steps=steps, tolerance=tolerance)
        self.unsolved = 0
        self.evaluations: list[int] = []
        self.seconds: list[float] = []

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.draw([index])[0].numpy()

    @property
    def names(self) -> list[str]:
        return [f"sample {number}" for number in self.numbers]

    def subset(self, indices: Sequence[int]) -> "SampledScans":
        part = SampledScans.__new__(SampledScans)
        part.__dict__.update(self.__dict__, numbers=[self.numbers[i] for i in indices])
        return part

    def draw(self, indices: Sequence[int]) -> Tensor:
        """The scans of a batch together, (B, 2 or 1, H, W). One that is not solved is taken as it is, and counted."""
        shape = self.flow.encoding.shape
        x_0 = torch.cat([noise_of(range(n, n + 1), shape, self.seed) for n in (self.numbers[i] for i in indices)])
        start = time.perf_counter()
        with torch.inference_mode():
            end = self.solve(x=x_0.to(next(self.flow.model.parameters()).device))
            x_1 = end.x.cpu()
        self.seconds.append((time.perf_counter() - start) / len(x_1))
        self.evaluations += end.evaluations.tolist()
        self.unsolved += int((~end.converged).sum())
        return decode(self.flow, x_1).nan_to_num(0.0)


def _of_files(label: str, root: Path, paths: list[Path], reading: Reading, about: dict[str, Any]) -> ScanSet:
    """Files of which the first that has a return says whether the set has reflectance."""
    reading = replace(reading, reflectance=reading.reflectance and has_reflectance(paths))
    drives: dict[str, list[int]] = {}
    for number, path in enumerate(paths):
        drives.setdefault(str(path.parent.relative_to(root)), []).append(number)
    stats = [(str(path.relative_to(root)), s.st_size, s.st_mtime_ns) for path in paths if (s := path.stat())]
    # Some contents, too: unpacked archives have equal names, sizes and times.
    some = [hashlib.sha256(paths[number].read_bytes()).hexdigest() for number in spread(len(paths), 8)]
    files = hashlib.sha256(json.dumps([stats, some]).encode()).hexdigest()
    identity = {"files": files, **reading.identity()}
    about = {**about, "files": files[:12], "reflectance": reading.reflectance}
    source = FolderScans(root, paths, reading)
    _ = source[0]  # what does not fit is better known now than after the other set was read
    return ScanSet(label, source, reading.sensor, about, identity, drives)


def _folder(text: str, reading: Reading) -> ScanSet:
    root = Path(text).expanduser()
    return _of_files(text, root, scan_paths(root), reading, {"kind": "folder"})


def _layout(text: str, layout: str, root: str, split: str | None, reading: Reading) -> ScanSet:
    drives = find_drives(layout, root, split)
    paths = [Path(path) for drive in drives for path in drive.scans]
    found = _of_files(text, Path(root).expanduser(), paths, reading, {"kind": layout, "split": split or "all"})
    ends = np.cumsum([0, *(len(drive.scans) for drive in drives)]).tolist()
    return replace(found, drives={d.name: range(a, b) for d, a, b in zip(drives, ends[:-1], ends[1:], strict=True)})


def _prepared(text: str, split: str | None, reading: Reading) -> ScanSet:
    root = Path(text).expanduser()
    manifest = read_manifest(root)
    reflectance = reading.reflectance and manifest.recipe.levels is not None
    source = open_prepared(root, reading.sensor, split, None, reflectance, reading.projection, reading.convention)
    digest = hashlib.sha256((root / MANIFEST).read_bytes()).hexdigest()
    place = {name: number for number, name in enumerate(source.names)}
    drives = {d.name: numbers for d in manifest.drives if (numbers := [place[n] for n in d.scans if n in place])}
    about = {
        "kind": f"prepared {manifest.recipe.layout}", "split": split or "all", "manifest": digest[:12],
        "reflectance": reflectance,
    }  # fmt: skip
    identity = {"manifest": digest, "split": split, "reflectance": reflectance}
    return ScanSet(text, source, reading.sensor, about, identity, drives)


def _simulated(seed: int, num: int, reading: Reading) -> ScanSet:
    if num < 1:
        raise InputError(f"needs at least one scene to simulate, found {num}.")
    scenes = range(num)
    about = {"kind": SIMULATED, "seed": seed, "scenes": num, "reflectance": reading.reflectance}
    identity = {**about, "simulator": simulator.REVISION, **reading.identity()}
    source = SimulatedScans(reading.sensor, seed, scenes, reading.reflectance)
    return ScanSet(f"{SIMULATED}:{seed}", source, reading.sensor, about, identity)
