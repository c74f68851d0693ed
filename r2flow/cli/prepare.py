"""The verb that turns a data set into prepared scans."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, grouped
from r2flow.cli.options import build_sized, check_words, cores, named_columns
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.prepared import Manifest
    from r2flow.data.preparing import Plan, Preparation


@dataclass(frozen=True)
class FileOptions:
    """Which files are taken, and what is done with a bad one."""

    split: Annotated[str | None, typer.Option(help="A part of the layout's split; all of it if left out.")] = None
    drives: Annotated[str | None, typer.Option(help="Names or numbers, separated by commas; all if left out.")] = None
    on_bad_scan: Annotated[str, typer.Option(help="error, or skip: leave out by name what cannot be used.")] = "error"


@dataclass(frozen=True)
class SceneOptions:
    """Which simulated scans are made."""

    num: Annotated[int | None, typer.Option(min=1, help="Scenes, of simulated scans.", show_default=False)] = None
    seed: Annotated[int, typer.Option(min=0, help="Of simulated scans.")] = 0


@dataclass(frozen=True)
class ShardOptions:
    """How the shards are written."""

    reflectance_levels: Annotated[
        int | None, typer.Option(help="Reflectance is kept as n / LEVELS; found from the scans if left out.")
    ] = None
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans a file.")] = 512
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one a core if left out.")] = None


@app.command(epilog="Example: r2flow prepare kitti_360 /data/KITTI-360 --out prepared/kitti_360")
@grouped
def prepare(
    reading: ReadingOptions,
    files: FileOptions,
    scenes: SceneOptions,
    shards: ShardOptions,
    layout: Annotated[
        str | None, typer.Argument(help="Layout of the data set (kitti_360, odometry, folder, ...), or simulated.")
    ] = None,
    root: Annotated[Path | None, typer.Argument(help="Its folder.", show_default=False)] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)] = None,
    check: Annotated[
        Path | None, typer.Option(help="Only read a prepared folder and name what is damaged.", show_default=False)
    ] = None,
) -> None:
    """Project a data set once, into shards that training reads: range in 2 bytes, reflectance in 1.

    Stopped or killed, the same command goes on; started twice, the two share the work; what is damaged, it makes again.
    Then: python train.py data=prepared data.root=FOLDER.
    """
    if check is not None:
        _check(check)
        return
    if layout is None or out is None:
        raise InputError("r2flow prepare needs LAYOUT ROOT --out FOLDER, or --check FOLDER.")
    from r2flow.data.preparing import Preparation

    check_words(projection=reading.projection, convention=reading.convention, on_bad_scan=files.on_bad_scan)
    _run(Preparation(out, _plan(layout, root, reading, files, scenes, shards)), files.on_bad_scan, shards.workers)


def _plan(
    layout: str,
    root: Path | None,
    reading: ReadingOptions,
    files: FileOptions,
    scenes: SceneOptions,
    shards: ShardOptions,
) -> "Plan":
    from r2flow.data.opening import SOURCES, scale_of_folder
    from r2flow.data.options import FOLDER
    from r2flow.data.preparing import plan_files, plan_simulated

    usual = SOURCES[layout]
    sensor = build_sized(reading.sensor or usual.sensor, reading.size)
    levels, shard_scans = shards.reflectance_levels, shards.shard_scans
    if layout == "simulated":
        of_files = {
            "ROOT": root, "--projection": reading.projection, "--convention": reading.convention,
            "--split": files.split, "--drives": files.drives, "--reflectance-scale": reading.reflectance_scale,
            "--columns": reading.columns,
        }  # fmt: skip
        wrong = [option for option, value in of_files.items() if value is not None]
        if wrong:
            raise InputError(f"simulated scans are no files: leave out {', '.join(wrong)}.")
        return plan_simulated(scenes.num or 512, scenes.seed, sensor, levels, shard_scans)
    if root is None:
        raise InputError(f"r2flow prepare {layout} needs the folder of its scans: r2flow prepare {layout} ROOT --out.")
    if scenes.num is not None:
        raise InputError("--num is for simulated scans; choose files by --split and --drives.")
    scale = scale_of_folder(root, sensor.reflectance_scale) if layout == FOLDER else usual.reflectance_scale
    return plan_files(
        layout, root, sensor, reading.projection or "spherical", reading.convention or "centre", files.split,
        files.drives.split(",") if files.drives else None, reading.reflectance_scale or scale,
        levels, shard_scans, named_columns(reading.columns),
    )  # fmt: skip


def _run(work: "Preparation", on_bad_scan: str, workers: int | None) -> None:
    from r2flow.progress import Bar

    recipe, workers = work.recipe, workers or cores()
    with Bar("checking what is there", recipe.scans, "scans") as advance:
        missing = work.begin(advance)
    scans = sum(len(recipe.numbers_of(shard)) for shard in missing)
    with Bar("preparing", scans, "scans") as advance:
        manifest = work.make(missing, on_bad_scan, workers if workers > 1 else 0, advance)
    print(_summary(work.folder, manifest))


def _summary(folder: Path, manifest: "Manifest") -> str:
    shards = manifest.shards
    scans, size = sum(shard.scans for shard in shards), sum(shard.bytes for shard in shards)
    said = f"range within {max(shard.range_error for shard in shards) * 1e3:.2f} mm"
    levels, error = manifest.recipe.levels, max(shard.reflectance_error for shard in shards)
    if levels is None:
        said += ", no reflectance in the scans"
    else:
        said += f", reflectance as n/{levels}, " + (f"at most {error:.2g} off" if error else "exactly")
    left_out = len(manifest.left_out)
    skipped = f"; {left_out} scans left out, named in manifest.json" if left_out else ""
    of = f"{scans} scan{'s' * (scans != 1)} in {len(shards)} shard{'s' * (len(shards) != 1)}"
    return f"{folder}: {of}, {size / 2**20:.1f} MiB; {said}{skipped}"


def _check(folder: Path) -> None:
    from r2flow.data.prepared import check_prepared, read_manifest
    from r2flow.progress import Bar

    shards = len(read_manifest(folder).shards)
    with Bar("checking", shards, "shards") as advance:
        damaged = check_prepared(folder, advance)
    for path, reason in damaged.items():
        print(f"{path}: {reason}")
    if damaged:
        raise InputError(
            f"{len(damaged)} of {shards} shards are damaged; the same r2flow prepare command makes these again."
        )
    print(f"{folder}: all {shards} shards are what was written")
