"""`r2flow sensor`: your own sensor, estimated from its scans."""

import re
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import ColumnsOption, named_columns
from r2flow.errors import InputError


@app.command(epilog="Example: r2flow sensor my/scans --out conf/sensor/mine.yaml")
def sensor(
    scans: Annotated[list[Path], typer.Argument(help="Scan files, or folders of them, of one sensor.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The .yaml to write; none if left out.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    columns: ColumnsOption = None,
    most: Annotated[int, typer.Option("--num", min=1, help="The most scans to read of a folder.")] = 8,
) -> None:
    """Estimate a sensor from scans: beams, resolution, limits, height, reflectance; write it as YAML.

    The YAML is a sensor for the verbs (--sensor mine.yaml) and, in conf/sensor/, for train.py (sensor=mine).
    """
    from r2flow.data.sources import spread
    from r2flow.lidar.beams import estimate_sensor, nearest_sensor
    from r2flow.lidar.scan_files import read_points
    from r2flow.lidar.sensor_files import ENDINGS, write_sensor
    from r2flow.lidar.sensors import SENSORS
    from r2flow.progress import track
    from r2flow.reports.tables import print_table
    from r2flow.reports.views import scans_of

    if out is not None and (out.suffix.lower() not in ENDINGS or out.is_dir()):
        raise InputError(f"--out must be a .yaml file, as --sensor expects; found {out}.")
    if out is not None and out.exists() and not overwrite:
        raise InputError(f"{out} exists; give another --out, or --overwrite to replace it.")
    name = re.sub(r"\W", "_", out.stem, flags=re.ASCII) if out is not None else "mine"
    name = f"my_{name}" if name in SENSORS or not name[:1].isalpha() else name
    folders = [scans_of(path) for path in scans]
    paths = [folder[index] for folder in folders for index in spread(len(folder), most)]
    points = [read_points(path, named_columns(columns)) for path in track(paths, "reading", "scans", least=16)]
    mine, beams, steps = estimate_sensor(points, name)
    e, middle = mine.elevations, len(mine.elevations) // 2
    shown = " ... ".join(f"{a:+.2f} {b:+.2f}" for a, b in (e[:2], e[middle - 1 : middle + 1], e[-2:]))
    nearest, distance = nearest_sensor(beams.elevations)
    scale = mine.reflectance_scale
    rows = [
        ("beams", f"{len(e)}: {beams.order}"),
        ("elevations", f"{shown} degrees"),
        ("nearest sensor", f"{nearest}, its beams {distance:.2f} degrees away" if nearest else "none of the built-in"),
        ("resolution", f"{steps:,.0f} steps a turn; images of {mine.columns} columns"),
        ("range", f"{mine.min_range:g} to {mine.max_range:g} m; raise min_range if the vehicle itself is seen"),
        ("height", f"{mine.height:.2f} m above the ground"),
        ("reflectance", "none: encoding.reflectance=false" if scale is None else f"reflectance_scale={scale:g}"),
    ]
    print_table(rows, ("", ""))
    if out is not None:
        write_sensor(mine, out, f"Estimated from {len(points)} scan(s), stored {beams.order}.")
        print(out)
