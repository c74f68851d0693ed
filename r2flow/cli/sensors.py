"""`r2flow sensor`: your own sensor, estimated from its scans."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import ColumnsOption, named_columns
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.lidar.beams import Beams
    from r2flow.lidar.calibration import Estimate


@app.command(epilog="Example: r2flow sensor my/scans --out conf/sensor/mine.yaml")
def sensor(
    scans: Annotated[list[Path], typer.Argument(help="Scan files, or folders of them, of one sensor.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The .yaml to write; none if left out.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the sensor; by default from that of the file.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    columns: ColumnsOption = None,
    most: Annotated[int, typer.Option("--num", min=1, help="The most scans to read of a folder.")] = 8,
) -> None:
    """Estimate a sensor from scans: beams, resolution, limits, height, reflectance; write it as YAML.

    The YAML is a sensor for the verbs (--sensor mine.yaml) and, in conf/sensor/, for train.py (sensor=mine).
    """
    from r2flow.lidar.calibration import estimate_sensor
    from r2flow.lidar.scan_files import read_points
    from r2flow.lidar.sensor_files import ENDINGS, write_sensor
    from r2flow.lidar.sensors import SENSORS
    from r2flow.progress import track
    from r2flow.reports.views import scans_of

    if out is not None and (out.suffix.lower() not in ENDINGS or out.is_dir()):
        raise InputError(f"--out must be a .yaml file, as --sensor expects; found {out}.")
    if out is not None and out.exists() and not overwrite:
        raise InputError(f"{out} is there already; give another --out, or --overwrite to replace it.")
    name = name or _name_of(out)
    if name in SENSORS or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise InputError(f"--name must be letters, digits and _, and not that of a built-in sensor; found {name!r}.")
    named = named_columns(columns)
    paths = [path for scan in scans for path in scans_of(scan, most)]
    points = [read_points(path, named) for path in track(paths, "reading", "scans", least=16)]
    estimate = estimate_sensor(points)
    found = estimate.sensor(name)
    _print(estimate)
    if out is not None:
        comment = (
            f"Estimated from {estimate.scans} scan(s) with {estimate.returns:,} returns, stored {estimate.beams.order}."
        )
        write_sensor(found, out, f"{comment}\nBeams: {_sureness(estimate.beams)}.")
        print(out)


def _name_of(out: Path | None) -> str:
    """A sensor's name from that of its file."""
    from r2flow.lidar.sensors import SENSORS

    name = re.sub(r"\W", "_", out.stem, flags=re.ASCII) if out is not None else "mine"
    return f"my_{name}" if name in SENSORS or not name[:1].isalpha() else name


def _print(estimate: "Estimate") -> None:
    from r2flow.reports.tables import print_table

    beams, (near, far) = estimate.beams, estimate.ranges
    rows: list[tuple[str, str]] = []
    e, middle = beams.elevations, len(beams.elevations) // 2
    shown = [*e[:2], None, *e[middle - 1 : middle + 1], None, *e[-2:]]
    rows.append(("beams", f"{len(e)}, {_sureness(beams)}"))
    rows.append(("elevations", " ".join("..." if one is None else f"{one:+.2f}" for one in shown) + " degrees"))
    if (known := estimate.nearest_known()) is not None:
        rows.append(("", f"nearest built-in sensor: {known[0]}, median distance {known[1]:.2f} degrees"))
    rows.append(("resolution", f"{estimate.steps:,.0f} steps a turn; images of {estimate.columns} columns"))
    rows.append(("range", f"{near:.2f} to {far:.2f} m"))
    if estimate.near_share > 0.05:
        share = f"{estimate.near_share:.0%} of the returns lie within 1 m"
        rows.append(("", f"{share}; if that is the vehicle itself, raise min_range in the YAML"))
    if estimate.height is None:
        rows.append(("height", "no ground found; 1.73 m, the default, is used"))
    else:
        rows.append(
            (
                "height",
                f"{estimate.height:.2f} m above the ground, which {estimate.ground_share:.0%} of the returns are on",
            )
        )
    if (found := estimate.reflectance) is None:
        rows.append(("reflectance", "none: encoding.reflectance=false"))
    else:
        values = f"{found.levels} values up to {found.highest:.4g}"
        rows.append(("reflectance", f"{values}: reflectance_scale={found.scale:g}"))
    rows.append(("storage", beams.order))
    print_table(rows, ("", ""))


def _sureness(beams: "Beams") -> str:
    """How the beams were found and how exactly, in words."""
    worst = int(beams.residuals.argmax())
    spread = (
        f"median residual {sorted(beams.residuals)[len(beams.residuals) // 2]:.3f} degrees, "
        f"worst {beams.residuals[worst]:.3f} (row {worst})"
    )
    if beams.stable is None:
        return f"lasers known from the files; {spread}"
    return f"from elevations alone, the same number over a {beams.stable:.1f}-fold range of bandwidths; {spread}"
