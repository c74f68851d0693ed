"""What a folder of prepared scans says of itself: `manifest.json`."""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import r2flow
from r2flow.data.layouts import Drive
from r2flow.data.store import MANIFEST, shard_count, shard_items
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.lidar.sensors import Sensor

FORMAT = "r2flow scans 1"


@dataclass(frozen=True)
class Recipe:
    """What prepared scans are a function of, beside the files themselves; nothing in it tells where these lie.

    Attributes:
        revision: Of what makes them, `plans.PROJECTION` or the simulator's, not of r2flow as a whole: a newer release
            mends damaged shards of an older one.
        layout: Of the data set, or `simulated`.
        scans, names: Their number and the SHA-256 of their names.
        sensor: Every field of the `Sensor`.
        projection, convention: As in `r2flow.lidar.projection.project`.
        reflectance_scale: The value in the files that means full reflectance.
        levels: Code n of reflectance is n / levels; None where the scans have none.
        ranges: The numbers of the formula in `r2flow.data.quantise.RangeCodes`.
        shard_scans: Scans of the data set a shard; it holds fewer where some were left out.
        seed: Of simulated scans.
    """

    revision: int
    layout: str
    scans: int
    names: str
    sensor: dict[str, Any]
    projection: str
    convention: str
    reflectance_scale: float
    levels: int | None
    ranges: dict[str, float]
    shard_scans: int
    seed: int | None = None

    @property
    def digest(self) -> str:
        return checksum(asdict(self))

    @property
    def image_shape(self) -> tuple[int, int]:
        """(H, W)."""
        return len(self.sensor["elevations"]), self.sensor["columns"]

    @property
    def shards(self) -> int:
        return shard_count(self.scans, self.shard_scans)

    def numbers_of(self, shard: int) -> range:
        """The scans of the data set that a shard is made of."""
        return shard_items(shard, self.scans, self.shard_scans)


@dataclass(frozen=True)
class ShardEntry:
    """What is known of a shard that was written.

    Attributes:
        scans: How many it holds.
        left_out: Numbers of those that could not be used.
        bytes: Of the file.
        head: CRC-32 of the file up to its first tensor.
        sha256: Of the whole file.
        range_error: The most that a range is off, in metres.
        reflectance_error: The most that a reflectance is off; 0 where the levels fit.
    """

    scans: int
    left_out: tuple[int, ...]
    bytes: int
    head: int
    sha256: str
    range_error: float
    reflectance_error: float


@dataclass(frozen=True)
class Manifest:
    """Prepared scans: their recipe, their names by drive, and their shards once all are there."""

    recipe: Recipe
    drives: tuple[Drive, ...]
    shards: tuple[ShardEntry, ...] | None = None

    @property
    def left_out(self) -> set[int]:
        return {number for shard in self.shards or () for number in shard.left_out}

    @property
    def names(self) -> list[str]:
        """Of all scans of the data set, also those that were left out."""
        return [name for drive in self.drives for name in drive.scans]


def shard_name(shard: int) -> str:
    return f"scans-{shard:06d}.safetensors"


def checksum(content: Any) -> str:
    """SHA-256 of what can be written as JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def describe_sensor(sensor: Sensor) -> dict[str, Any]:
    """Every field of a sensor, as JSON gives them back."""
    fields: dict[str, Any] = json.loads(json.dumps(asdict(sensor)))
    return fields


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Names of a drive share their beginning, which is written once."""
    drives = []
    for drive in manifest.drives:
        prefix = os.path.commonprefix(drive.scans)  # noqa: RUF071  of letters, not of folders
        drives.append({"name": drive.name, "prefix": prefix, "scans": [name[len(prefix) :] for name in drive.scans]})
    left_out = manifest.left_out
    content = {
        "format": FORMAT,
        "made by": f"r2flow {r2flow.__version__}",
        "recipe": asdict(manifest.recipe),
        "left_out": [name for number, name in enumerate(manifest.names) if number in left_out],
        "shards": None if manifest.shards is None else [asdict(shard) for shard in manifest.shards],
        "drives": drives,
    }
    content["checksum"] = checksum(content)
    with atomic_write(folder / MANIFEST, "w") as file:
        json.dump(content, file, indent=1)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a folder, checked.

    Raises:
        InputError: it is not there, cannot be read, is of another format, or damaged.
    """
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = content["format"]
    except FileNotFoundError:
        raise InputError(f"{folder} holds no prepared scans (no {MANIFEST}); make them: r2flow prepare.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        raise _damaged(path) from None
    if found != FORMAT:
        raise InputError(f"{path} is of the format {found!r}, not {FORMAT!r}; prepare the scans again.")
    if content.pop("checksum", None) != checksum(content):
        raise _damaged(path)
    shards = content["shards"]
    return Manifest(
        Recipe(**content["recipe"]),
        tuple(Drive(d["name"], tuple(d["prefix"] + rest for rest in d["scans"])) for d in content["drives"]),
        None if shards is None else tuple(read_entry(shard) for shard in shards),
    )


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is damaged. Delete its folder and prepare the scans again.")


def read_entry(content: Mapping[str, Any]) -> ShardEntry:
    entry = ShardEntry(**content)
    return replace(entry, left_out=tuple(entry.left_out))
