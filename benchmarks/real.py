"""Completion of real scans of eight sensors: `densify`, `densify_small` and the interpolations.

The scans lie outside the repository, in the folder `real` of R2FLOW_SHARED. Each scan is of another
place. A sensor's rows are its own beams (`r2flow sensor`), those of the HDL-64E the image of the
paper. Cells: a model, then the best interpolation of that cell; with four places or more the
difference and its paired 95 % interval (Student's t) too. A cell ends with + where the model is
ahead, with - where it is behind; doubled where zero lies outside of the interval; IoU is compared
by its inverse. Last: each further model's errors over the first one's.

python benchmarks/real.py                                       # half an hour of one core
python benchmarks/real.py --sensors VLP-16,OS1-128 --out real.json
"""

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from r2flow.base.errors import InputError
from r2flow.data.reading import Reading, read_image
from r2flow.lidar.estimation import estimate_sensor
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.completion import completing
from r2flow.reports.completion import INTERPOLATIONS, completion_rows
from r2flow.reports.tables import Row, print_table

TASKS = ("rows:2", "rows:4", "points:0.1")
FILES = {  # patterns below the folder `real`
    "HDL-64E": (
        "kitti360/data_3d_raw/*/velodyne_points/data/*.bin",
        "odometry/sequences/00/velodyne/000000.bin",
        "odometry/sequences/00/velodyne/000094.bin",
        "odometry/sequences/00/velodyne/000198.bin",
        "odometry/sequences/08/velodyne/*.bin",
        "object/training/velodyne/*.bin",
        "raw/*/*_0005_sync/velodyne_points/data/0000000000.bin",
        "raw/*/*_0048_sync/velodyne_points/data/0000000000.bin",
    ),
    "HDL-32E": ("other_sensors/nuscenes_hdl32e/*.bin",),
    "VLP-16": ("other_sensors/vlp16/*.pcd",),
    "VLP-32C": ("other_sensors/rellis_vlp32c/*.bin",),
    "OS1-64": ("other_sensors/rellis_os1_64/*.bin",),
    "OS0-128": ("other_sensors/ouster_128/os0_128.pcd",),
    "OS1-128": ("other_sensors/ouster_128/os1_128.pcd",),
    "Pandar64": ("pandaset/*/lidar/00.pkl.gz",),
}
METRICS = {  # key of a row, heading, and whether less is better
    "mae_common_m": ("MAE, m", True),
    "chamfer_m": ("Chamfer, m", True),
    "iou": ("IoU 0.1 m", False),
    "drop_wrong": ("wrong ray-drop", True),
    "reflectance_mae": ("reflectance MAE", True),
}
FEWEST = 4  # places of an interval


def shared() -> Path:
    """The folder of the real scans."""
    folder = Path(os.environ.get("R2FLOW_SHARED", ""), "real")
    if not folder.is_dir():
        raise InputError("R2FLOW_SHARED names no folder that holds the folder `real` of scans.")
    return folder


def scans_of(name: str) -> tuple[list[Path], Reading]:
    """The files of a sensor and how they are read."""
    paths = [path for pattern in FILES[name] for path in sorted(shared().glob(pattern))]
    estimate = estimate_sensor([read_points(path) for path in paths[:3]], "mine").sensor
    sensor: Sensor = SENSORS["hdl64e"] if name == "HDL-64E" else estimate
    scale = estimate.reflectance_scale
    reading = Reading(sensor, reflectance_scale=scale or 1.0, reflectance=scale is not None)
    return paths, reading


def rows_of(name: str, tasks: Sequence[str], models: Sequence[str]) -> list[Row]:
    """A row a place, task and method."""
    paths, reading = scans_of(name)
    ways = {}
    for one in models:
        model = load_checkpoint(one).through(reading.sensor)
        ways[one] = (model, completing(model.generator, several=False))
    rows = []
    for path in paths:
        truth = read_image(path, reading)
        made = completion_rows([truth], reading.sensor, ways, tasks, num=1)
        rows += [{"sensor": name, "place": str(path.relative_to(shared())), **row} for row in made]
        print(name, path.name, flush=True)
    return rows


def values_of(rows: Sequence[Row], method: str, key: str) -> np.ndarray:
    """An error of a method at each place; NaN where there is nothing to compare."""
    return np.array([row.get(key, np.nan) for row in rows if row["method"] == method])


def cell(rows: Sequence[Row], model: str, key: str, less: bool) -> str:
    """The model, the best interpolation, and the interval of the difference over places."""
    own = values_of(rows, model, key)
    if np.isnan(own).all():
        return ""
    sign = 1 if less else -1
    others = [values_of(rows, method, key) for method in INTERPOLATIONS]
    best = min(others, key=lambda each: sign * each.mean())
    gain = sign * (best - own)
    mark = "+" if gain.mean() > 0 else "-"
    text = f"{own.mean():.3f} {best.mean():.3f}"
    if len(gain) >= FEWEST:
        half = student.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / len(gain) ** 0.5
        mark *= 1 + (abs(gain.mean()) > half)
        text += f" ({gain.mean():+.3f} +-{half:.3f})"
    return f"{text} {mark}"


def ratio(rows: Sequence[Row], models: Sequence[str], key: str, less: bool) -> float:
    """Mean error of the second model over that of the first."""
    first, second = (values_of(rows, model, key).mean() for model in models)
    return float(second / first if less else first / second)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sensors", default=",".join(FILES))
    parser.add_argument("--tasks", default=" ".join(TASKS))
    parser.add_argument("--models", default="densify,densify_small")
    parser.add_argument("--out", type=Path, help="JSON of all rows; read instead, if it is there")
    args = parser.parse_args()
    models = args.models.split(",")
    if args.out and args.out.exists():
        rows = json.loads(args.out.read_text())
    else:
        names = args.sensors.split(",")
        rows = [row for name in names for row in rows_of(name, args.tasks.split(), models)]
        if args.out:
            args.out.write_text(json.dumps(rows))
    lines = []
    ratios = []
    for name in dict.fromkeys(row["sensor"] for row in rows):
        for task in dict.fromkeys(row["task"] for row in rows):
            part = [row for row in rows if (row["sensor"], row["task"]) == (name, task)]
            places = len({row["place"] for row in part})
            for model in models:
                cells = [cell(part, model, key, less) for key, (_, less) in METRICS.items()]
                lines.append([f"{name}, {places}", task, model, *cells])
            for model in models[1:]:
                pair = (models[0], model)
                cells = [ratio(part, pair, key, less) for key, (_, less) in METRICS.items()]
                ratios.append([model, name, task, *cells])
    metrics = [heading for heading, _ in METRICS.values()]
    print_table(lines, ["sensor, places", "known", "model", *metrics])
    print_table(
        [[*line[:3], *(f"{value:.3f}" for value in line[3:])] for line in ratios],
        ["model", "sensor", "known", *metrics],
    )
    for model in models[1:]:
        found = np.array([line[3:] for line in ratios if line[0] == model])
        print(f"{model}: {np.nanmedian(found):.3f} in the median cell")


if __name__ == "__main__":
    main()
