"""The verb that turns a data set into prepared scans."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import ConventionOption, ProjectionOption, SizeOption, build_sized
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.prepared import Manifest
    from r2flow.data.preparing import Preparation


@app.command(epilog="Example: r2flow prepare kitti_360 /data/KITTI-360 --out prepared/kitti_360")
def prepare(
    layout: Annotated[
        str | None, typer.Argument(help="Layout of the data set (kitti_360, odometry, folder, ...), or simulated.")
    ] = None,
    root: Annotated[Path | None, typer.Argument(help="Its folder.", show_default=False)] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)] = None,
    check: Annotated[
        Path | None, typer.Option(help="Only read a prepared folder and name what is damaged.", show_default=False)
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Name of the sensor, or the YAML file of your own; if left out hdl64e, of nuscenes hdl32e.",
            show_default=False,
        ),
    ] = None,
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    convention: ConventionOption = "centre",
    split: Annotated[str | None, typer.Option(help="A part of the layout's split; all of it if left out.")] = None,
    drives: Annotated[str | None, typer.Option(help="Names or numbers, separated by commas; all if left out.")] = None,
    reflectance_scale: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Value in the files that means full reflectance; if left out 1, of nuscenes 255.",
            show_default=False,
        ),
    ] = None,
    reflectance_levels: Annotated[
        int | None, typer.Option(help="Reflectance is kept as n / LEVELS; found from the scans if left out.")
    ] = None,
    on_bad_scan: Annotated[str, typer.Option(help="error, or skip: leave out by name what cannot be used.")] = "error",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; one a core if left out.", show_default=False)
    ] = None,
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans a file.")] = 512,
    num: Annotated[int | None, typer.Option(min=1, help="Scenes, of simulated scans.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of simulated scans.")] = 0,
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
    if layout == "simulated":
        _refuse_file_options(root, projection, convention, split, drives, reflectance_scale)
    elif root is None:
        raise InputError(f"r2flow prepare {layout} needs the folder of its scans: r2flow prepare {layout} ROOT --out.")
    elif num is not None:
        raise InputError("--num is for simulated scans; choose files by --split and --drives.")
    from r2flow.data.opening import SOURCES
    from r2flow.data.preparing import Preparation, plan_files, plan_simulated

    usual = SOURCES[layout]
    chosen = build_sized(sensor or usual.sensor, size)
    if root is None:
        plan = plan_simulated(num or 512, seed, chosen, reflectance_levels, shard_scans)
    else:
        wanted = drives.split(",") if drives else None
        plan = plan_files(
            layout, root, chosen, projection, convention, split, wanted, reflectance_scale or usual.reflectance_scale,
            reflectance_levels, shard_scans,
        )  # fmt: skip
    _run(Preparation(out, plan), on_bad_scan, workers)


def _run(work: "Preparation", on_bad_scan: str, workers: int | None) -> None:
    from r2flow.progress import Bar

    recipe, workers = work.recipe, workers or _cores()
    with Bar("checking what is there", recipe.scans, "scans") as advance:
        missing = work.begin(lambda scans: _repeat(advance, scans))
    scans = sum(len(recipe.numbers_of(shard)) for shard in missing)
    with Bar("preparing", scans, "scans") as advance:
        manifest = work.make(missing, on_bad_scan, workers if workers > 1 else 0, lambda scans: _repeat(advance, scans))
    print(_summary(work.folder, manifest))


def _repeat(advance: Callable[[], None], times: int) -> None:
    for _ in range(times):
        advance()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


def _refuse_file_options(
    root: Path | None, projection: str, convention: str, split: str | None, drives: str | None, scale: float | None
) -> None:
    given = {
        "ROOT": root is not None, "--projection": projection != "spherical", "--convention": convention != "centre",
        "--split": split is not None, "--drives": drives is not None, "--reflectance-scale": scale is not None,
    }  # fmt: skip
    wrong = [option for option, is_given in given.items() if is_given]
    if wrong:
        raise InputError(f"simulated scans are no files: leave out {', '.join(wrong)}.")
