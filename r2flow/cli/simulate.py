"""`r2flow simulate`: scans of simulated street scenes."""

from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import OutOption, SensorOption, SizeOption, build_sized, cores


@app.command(epilog="Example: r2flow simulate --num 1000 --sensor os1_64 --seed 1 --out scans --labels")
def simulate(
    out: OutOption,
    num: Annotated[int, typer.Option(min=1, help="Number of scans.")] = 100,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Scan i depends on the seed and on i alone.")] = 0,
    format: Annotated[
        str, typer.Option(help="Any of bin,ply,pcd, or npy: the range image, (2, H, W) float32.")
    ] = "bin",
    labels: Annotated[bool, typer.Option("--labels", help="SemanticKITTI's .label files beside them.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; one a core if left out.", show_default=False)
    ] = None,
) -> None:
    """Simulate scans of street scenes. After a stop or a kill, the same command resumes."""
    from r2flow.progress import Bar
    from r2flow.simulator.folder import SimulatedFolder

    formats = tuple(dict.fromkeys(format.split(",")))
    folder = SimulatedFolder(out, build_sized(sensor, size), seed, formats, labels)
    folder.begin()
    missing = folder.missing(range(num))
    with Bar("simulating", len(missing), "scans") as advance:
        folder.make(missing, folder.simulate, workers or cores(), lambda scan: advance())
    kept = f", {num - len(missing)} were there already" if len(missing) < num else ""
    print(f"{len(missing)} scans ({', '.join(formats)}{', labels' if labels else ''}) in {out}{kept}")
