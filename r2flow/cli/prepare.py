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
    from r2flow.data.prepared import Plan


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
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans a file.")] = 64
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

    After a stop or a kill the same command resumes; two at once share the work; damaged shards are made again.
    Then: python train.py data=prepared data.root=FOLDER.
    """
    if check is not None:
        _check(check)
        return
    if layout is None or out is None:
        raise InputError("r2flow prepare needs LAYOUT ROOT --out FOLDER, or --check FOLDER.")
    check_words(projection=reading.projection, convention=reading.convention, on_bad_scan=files.on_bad_scan)
    _run(out, _plan(layout, root, reading, files, scenes, shards), files.on_bad_scan, shards.workers or cores())


def _plan(
    layout: str,
    root: Path | None,
    reading: ReadingOptions,
    files: FileOptions,
    scenes: SceneOptions,
    shards: ShardOptions,
) -> "Plan":
    from r2flow.data.opening import SOURCES, find_drives, scale_of_folder
    from r2flow.data.options import FOLDER
    from r2flow.data.prepared import plan_files, plan_simulated
    from r2flow.data.reading import Reading

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
    how = Reading(
        sensor, reading.projection or "spherical", reading.convention or "centre",  # type: ignore[arg-type]
        reading.reflectance_scale or scale, columns=named_columns(reading.columns),
    )  # fmt: skip
    drives = find_drives(layout, root, files.split, files.drives.split(",") if files.drives else None)
    return plan_files(layout, root, drives, how, levels, shard_scans)


def _run(out: Path, plan: "Plan", on_bad_scan: str, workers: int) -> None:
    from r2flow.data.prepared import prepare as make
    from r2flow.progress import Bar

    with Bar("checking", len(plan.shards), "shards") as checked, Bar("preparing", len(plan.shards), "shards") as made:
        notes = make(out, plan, on_bad_scan, workers, lambda shard: checked(), lambda shard: made())
    size = sum(plan.store(out).files(shard)[0].stat().st_size for shard in plan.shards)
    left_out = sum(len(note["left_out"]) for note in notes)
    scans, shards, levels = plan.recipe["scans"] - left_out, len(plan.shards), plan.recipe["levels"]
    range_error, error = (max(note["errors"][channel] for note in notes) for channel in (0, 1))
    kept = "no reflectance in the scans"
    if levels is not None:
        kept = f"reflectance as n/{levels}, " + (f"at most {error:.2g} off" if error else "exactly")
    skipped = f"; {left_out} scans left out" if left_out else ""
    of = f"{scans} scan{'s' * (scans != 1)} in {shards} shard{'s' * (shards != 1)}"
    print(f"{out}: {of}, {size / 2**20:.1f} MiB; range within {range_error * 1e3:.2f} mm, {kept}{skipped}")


def _check(folder: Path) -> None:
    from r2flow.data.prepared import check_prepared, read_prepared
    from r2flow.progress import Bar

    recipe, _ = read_prepared(folder)
    shards = -(-recipe["scans"] // recipe["shard_scans"])
    with Bar("checking", shards, "shards") as advance:
        damaged = check_prepared(folder, lambda shard: advance())
    for path, reason in damaged.items():
        print(f"{path}: {reason}")
    if damaged:
        raise InputError(f"{len(damaged)} of {shards} shards are damaged; the same r2flow prepare makes these again.")
    print(f"{folder}: all {shards} shards are what was written")
