"""The verb that turns a data set into prepared scans."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, grouped
from r2flow.cli.options import build_sized, check_words, cores, named_columns
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.prepared import Plan


OF_FILES = ("projection", "convention", "reflectance_scale", "columns")  # options of reading files


@app.command(epilog="Example: r2flow prepare kitti_360 /data/KITTI-360 --out prepared/kitti_360")
@grouped
def prepare(
    reading: ReadingOptions,
    layout: Annotated[
        str | None, typer.Argument(help="Layout of the data set (kitti_360, odometry, folder, ...), or simulated.")
    ] = None,
    root: Annotated[Path | None, typer.Argument(help="Its folder.", show_default=False)] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)] = None,
    check: Annotated[
        Path | None, typer.Option(help="Only read a prepared folder and name what is damaged.", show_default=False)
    ] = None,
    split: Annotated[str | None, typer.Option(help="A part of the layout's split; all of it if left out.")] = None,
    drives: Annotated[str | None, typer.Option(help="Names or numbers, separated by commas; all if left out.")] = None,
    on_bad_scan: Annotated[str, typer.Option(help="error, or skip: leave out by name what cannot be used.")] = "error",
    num: Annotated[
        int | None, typer.Option(min=1, max=10**7, help="Scenes, of simulated scans.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of simulated scans.")] = 0,
    reflectance_levels: Annotated[
        int | None, typer.Option(help="Reflectance is kept as n / LEVELS; found from the scans if left out.")
    ] = None,
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans a file.")] = 64,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one a core if left out.")] = None,
) -> None:
    """Project a data set once, into shards that training reads: range in 2 bytes, reflectance in 1.

    After a stop or a kill the same command resumes; two at once share the work; damaged shards are made again.
    Then: python train.py data=prepared data.root=FOLDER.
    """
    from r2flow.data.prepared import prepare as make
    from r2flow.progress import Bar

    if check is not None:
        _check(check)
        return
    if layout is None or out is None:
        raise InputError("r2flow prepare needs LAYOUT ROOT --out FOLDER, or --check FOLDER.")
    check_words(projection=reading.projection, convention=reading.convention, on_bad_scan=on_bad_scan)
    plan: Plan
    if layout == "simulated":
        of_files = {"ROOT": root, "--split": split, "--drives": drives}
        of_files |= {f"--{key.replace('_', '-')}": getattr(reading, key) for key in OF_FILES}
        wrong = [option for option, value in of_files.items() if value is not None]
        if wrong:
            raise InputError(f"simulated scans are no files: leave out {', '.join(wrong)}.")
        plan = _plan_simulated(reading, num or 512, seed, reflectance_levels, shard_scans)
    elif root is None:
        raise InputError(f"r2flow prepare {layout} needs the folder of its scans: r2flow prepare {layout} ROOT --out.")
    elif num is not None:
        raise InputError("--num is for simulated scans; choose files by --split and --drives.")
    else:
        plan = _plan_files(layout, root, reading, split, drives, reflectance_levels, shard_scans)
    with Bar("checking", len(plan.shards), "shards") as checked, Bar("preparing", len(plan.shards), "shards") as made:
        notes = make(out, plan, on_bad_scan, workers or cores(), lambda shard: checked(), lambda shard: made())
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


def _plan_simulated(reading: ReadingOptions, num: int, seed: int, levels: int | None, shard_scans: int) -> "Plan":
    from r2flow.data.opening import SOURCES
    from r2flow.data.prepared import plan_simulated

    sensor = build_sized(reading.sensor or SOURCES["simulated"].sensor, reading.size)
    return plan_simulated(num, seed, sensor, levels, shard_scans)


def _plan_files(
    layout: str,
    root: Path,
    reading: ReadingOptions,
    split: str | None,
    drives: str | None,
    levels: int | None,
    shard_scans: int,
) -> "Plan":
    from r2flow.data.opening import SOURCES, find_drives, usual_scale
    from r2flow.data.prepared import plan_files
    from r2flow.data.reading import Reading

    sensor = build_sized(reading.sensor or SOURCES[layout].sensor, reading.size)
    scale = reading.reflectance_scale or usual_scale(f"{layout}:{root}", sensor)
    how = Reading(
        sensor, reading.projection or "spherical", reading.convention or "centre",  # type: ignore[arg-type]
        scale, columns=named_columns(reading.columns),
    )  # fmt: skip
    chosen = find_drives(layout, root, split, drives.split(",") if drives else None)
    return plan_files(layout, root, chosen, how, levels, shard_scans)


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
