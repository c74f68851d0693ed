"""The verb that turns a data set into prepared scans."""

from dataclasses import replace
from typing import Annotated, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, grouped
from r2flow.cli.options import OutOption, cores
from r2flow.errors import InputError


@app.command(epilog="Example: r2flow prepare kitti_360:/data/KITTI-360 --out prepared/kitti_360")
@grouped
def prepare(
    reading: ReadingOptions,
    scans: Annotated[str, typer.Argument(help="A folder of scans, or LAYOUT:FOLDER, as kitti_360:/data/KITTI-360.")],
    out: OutOption,
    split: Annotated[str | None, typer.Option(help="A part of the layout's split; all of it if left out.")] = None,
    drives: Annotated[str | None, typer.Option(help="Names or numbers, separated by commas; all if left out.")] = None,
    on_bad_scan: Annotated[
        Literal["error", "skip"], typer.Option(help="skip: leave out by name what cannot be used.")
    ] = "error",
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans a file.")] = 64,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one a core if left out.")] = None,
) -> None:
    """Project a data set once, into shards that training reads: range in 2 bytes, reflectance in 1.

    After a stop or a kill the same command resumes; two at once share the work; damaged shards are made again.
    Then: python train.py data=prepared data.root=FOLDER.
    """
    from r2flow.data.opening import SOURCES, parse
    from r2flow.data.prepared import plan_files
    from r2flow.data.prepared import prepare as make
    from r2flow.progress import Bar

    options, file = parse(scans)
    if file is not None:
        raise InputError(f"{scans} is one scan; give the folder of a data set.")
    options = replace(options, split=split, drives=[*drives.split(",")] if drives else None)
    found = SOURCES[options.name].find_drives(options)
    plan = plan_files(options.name, options.folder, found, reading.reading([scans]), shard_scans)
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
