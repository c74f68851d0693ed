"""Errors that added points are said to have, against those that they have.

The density of `densify` is calibrated on simulated scans alone (`--fit`), written beside the model's
file. Rule: 3 scans of each of 8 sensors (`SIMULATED`, seed 7), three tasks, 1,500 hidden rays of each;
range noise of 1 to 8 mm, a range offset of each beam of 3 to 40 mm (the accuracy that data sheets
promise, 20 to 30 mm, is mostly of beams) and on the ground an elevation error of each beam of 0.005
to 0.1 degrees, standard deviations drawn for each scan, uniform in their logarithm. No real scan is
used.

The table: on the real scans of `benchmarks/real.py`, the share of added points whose true range lies
within `error_68` and `error_95`, over all and in fifths of `error_68`, and the expected calibration
error of `p_return` over added points, in ten bins. * marks what is off by more than 3 points.

python benchmarks/calibration.py --fit densify,densify_small   # two minutes of one core
python benchmarks/calibration.py                           # the table, without and with calibration
python benchmarks/calibration.py --drawn 8                 # truths between the least and greatest answer
python benchmarks/calibration.py --kept                    # what --max-error keeps, by distance and class
python benchmarks/calibration.py --own A B                 # B before and after `r2flow calibrate A`
python benchmarks/calibration.py --models densify --places # HDL-64E: mean and spread over scans
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchmarks.real import FILES, TASKS, scans_of, shared
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading, read_image, read_labelled_scan
from r2flow.generators.calibration import Calibration, fitted
from r2flow.lidar.estimation import estimate_sensor
from r2flow.lidar.known import ray_states
from r2flow.lidar.labels import COMMON, common_classes, labels_beside
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import SENSORS, Sensor, write_sensor
from r2flow.metrics.completion import spread_errors
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.completion import Completed, complete
from r2flow.model.shipped import model_file
from r2flow.reports.calibration import calibrate
from r2flow.reports.completion import kept_rays
from r2flow.reports.tables import print_table

SIMULATED = {
    "hdl64e": SENSORS["hdl64e"],
    "os1_64": SENSORS["os1_64"].resized(None, 2048),
    "os1_128": SENSORS["os1_128"],
    "vlp32c": SENSORS["vlp32c"].resized(None, 1800),
    "vlp16": SENSORS["vlp16"].resized(None, 1800),
    "vlp16, 64 rows": SENSORS["vlp16"].resized(64, 1024),
    "pandar64": SENSORS["pandar64"].resized(None, 1800),
    "hdl32e": SENSORS["hdl32e"],
}
SCANS, SEED, RAYS = 3, 7, 1500
PLACES = {  # scans of an HDL-64E below the folder `real`, by data set
    "KITTI-360": "kitti360/data_3d_raw/*/velodyne_points/data/*.bin",
    "KITTI raw": "raw/*/*/velodyne_points/data/*.bin",
    "KITTI object": "object/training/velodyne/*.bin",
    "SemanticKITTI": "odometry/sequences/*/velodyne/*.bin",
}
LIMITS = (0.05, 0.1, 0.2, 0.5)  # metres of --max-error
DISTANCES = ((0, 10), (10, 20), (20, 40), (40, 80))
KINDS = {name: number for number, name in enumerate(COMMON, 1)}  # classes of the labelled scans


@dataclass(frozen=True)
class Case:
    """A scan of which a part was hidden, and its completion."""

    truth: ndarray  # (2 or 1, H, W)
    hidden: ndarray  # (H, W) bool
    completed: Completed

    @classmethod
    def of(
        cls, model: Checkpoint, truth: ndarray, task: str, number: int = 0, num: int = 1
    ) -> "Case":
        kept = kept_rays(task, model.sensor, number)
        images = torch.from_numpy(truth)[None]
        masks = torch.from_numpy(kept)
        state = ray_states(images, masks[None])
        (completed,) = complete(model, images * masks, state, num)
        return cls(truth, ~kept, completed)

    @property
    def raw(self) -> "Case":
        """The case with the density as it was predicted."""
        return self.by(None)

    def by(self, calibration: Calibration | None) -> "Case":
        """The case with another calibration."""
        parts = tuple(replace(one, calibration=calibration) for one in self.completed.densities)
        return replace(self, completed=replace(self.completed, densities=parts))

    @property
    def added(self) -> ndarray:
        """Hidden rays with a return in the answer, (H, W) bool."""
        return self.hidden & (self.completed.images[0, 0].numpy() > 0)

    @property
    def errors(self) -> ndarray:
        """|range - true range| of all rays, (H, W)."""
        return np.abs(self.completed.images[0, 0].numpy() - self.truth[0])


def disturbed(image: ndarray, sensor: Sensor, draws: np.random.Generator) -> ndarray:
    """A simulated scan with the errors of the beams of a real sensor (see above)."""

    def scale(low: float, high: float) -> float:
        return float(np.exp(draws.uniform(np.log(low), np.log(high))))

    r = image[0]
    rows, columns = r.shape
    e = np.deg2rad(sensor.elevations)[:, None]
    turned = np.deg2rad(scale(0.005, 0.1)) * draws.standard_normal((rows, 1))
    ground = (e < 0) & (np.abs(r * np.sin(e) + sensor.height) < 0.3)
    longer = np.clip(turned / np.tan(np.minimum(e, -0.01)), -0.3, 0.3) * ground * r
    longer = longer + scale(0.001, 0.008) * draws.standard_normal((rows, columns))
    longer = longer + scale(0.003, 0.04) * draws.standard_normal((rows, 1))
    image = image.copy()
    image[0] = np.clip(r + longer, sensor.min_range, sensor.max_range) * (r > 0)
    return image


class Rays:
    """Hidden rays of many scans, completed by one model."""

    def __init__(self) -> None:
        self.densities: list[tuple[Tensor, Tensor, Tensor]] = []
        self.log_r: list[Tensor] = []
        self.logits: list[Tensor] = []
        self.returned: list[Tensor] = []

    def add(self, case: Case, rays: Tensor) -> None:
        """Twice `RAYS` rays of a case for returns, and `RAYS` of them with a return for ranges."""
        (one,) = case.completed.densities
        r = torch.from_numpy(case.truth[0]).flatten()[rays]
        self.logits.append(one.returns.flatten()[rays])
        self.returned.append(r > 0)
        rays, r = rays[r > 0][:RAYS], r[r > 0][:RAYS]
        parts = (x[0].flatten(1)[:, rays] for x in (one.logits, one.ranges, one.scales))
        logits, ranges, scales = parts
        self.densities.append((logits, ranges, scales))
        self.log_r.append(r.log())

    def fitted(self) -> Calibration:
        logits, returned = torch.cat(self.logits), torch.cat(self.returned)
        return fitted(self.densities, torch.cat(self.log_r), logits, returned)


def fit(names: list[str]) -> Iterator[Path]:
    """Calibrate models on simulated scans; write the files that are read with them."""
    models = {name: load_checkpoint(name) for name in names}
    found = {name: Rays() for name in names}
    for seed, (kind, sensor) in enumerate(SIMULATED.items()):
        scans = open_scans(f"simulated:{SEED}", Reading(sensor), num=SCANS).source
        for number in range(SCANS):
            draws = np.random.default_rng([SEED, seed, number])
            truth = disturbed(np.asarray(scans[number]), sensor, draws)
            for task in TASKS:
                hidden = np.flatnonzero(~kept_rays(task, sensor, number))
                rays = torch.from_numpy(draws.permutation(hidden)[: 2 * RAYS])
                for name, model in models.items():
                    found[name].add(Case.of(model.through(sensor), truth, task, number), rays)
        print(kind, flush=True)
    for name, rays in found.items():
        path = model_file(name).with_suffix(".calibration.yaml")
        rays.fitted().write(path, f"python benchmarks/calibration.py --fit {name}")
        yield path


def cases(
    name: str, model: Checkpoint, task: str, num: int = 1, scans: int | None = None
) -> Iterator[Case]:
    """Cases of a sensor's scans, of at most some, evenly spread."""
    paths, reading = scans_of(name)
    flow = model.through(reading.sensor)
    for path in paths[:: math.ceil(len(paths) / (scans or len(paths)))]:
        yield Case.of(flow, read_image(path, reading), task, 0, num)


def trusted(found: list[Case]) -> list[str]:
    """Cells of a row: shares within both errors, over all and in fifths; ECE of p_return."""
    errors, bounds, p, y = [], [], [], []
    for case in found:
        both = case.completed.error(0.68, 0.95)[:, 0].numpy()
        returned = case.truth[0] > 0
        right = case.added & returned
        errors.append(case.errors[right])
        bounds.append(both[:, right])
        p.append(case.completed.p_return[0].numpy()[case.added])
        y.append(returned[case.added])
    bound = np.concatenate(bounds, 1)
    inside = np.concatenate(errors) <= bound
    fifths = np.array_split(np.argsort(bound[0]), 5)
    cells = []
    for level, one in zip((0.68, 0.95), inside, strict=True):
        shares = [one.mean(), *(one[part].mean() for part in fifths)]
        cells += [f"{100 * x:.0f}{'*' * bool(abs(x - level) > 0.03)}" for x in shares]
    p_all, y_all = np.concatenate(p), np.concatenate(y)
    bins = np.minimum((10 * p_all).astype(int), 9)
    gaps = np.bincount(bins, p_all - y_all, 10)
    ece = np.abs(gaps).sum() / len(p_all)
    return [*cells, f"{100 * ece:.1f}{'*' * bool(ece > 0.03)}"]


def own_rows(name: str, folder: Path, judged: Path) -> Iterator[list[str]]:
    """Rows of the scans of a folder, without and with the factors of another folder of scans."""
    model = load_checkpoint(name)
    paths = sorted(judged.iterdir())
    sensor = estimate_sensor([read_points(path) for path in paths[:3]], "mine").sensor
    with TemporaryDirectory() as place:
        file = Path(place, "mine.yaml")
        about = [read_points(path) for path in sorted(folder.iterdir())[:3]]
        write_sensor(estimate_sensor(about, "mine").sensor, file, "")
        factors = calibrate(model, str(folder), str(file), file).factors
    scale = sensor.reflectance_scale
    reading = Reading(sensor, reflectance_scale=scale or 1.0, reflectance=scale is not None)
    flow = model.through(sensor)
    own = replace(flow.generator.calibration, factors=factors)
    for task in TASKS:
        found = [Case.of(flow, read_image(path, reading), task) for path in paths]
        yield [name, judged.parent.name, task, "", *trusted(found)]
        yield [name, judged.parent.name, task, "own", *trusted([case.by(own) for case in found])]


def classes_of(path: Path, reading: Reading) -> ndarray | None:
    """Semantic ids of a scan, (H, W); None without labels."""
    file = labels_beside(path)
    return None if file is None else read_labelled_scan(path, file, reading)[1]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fit", help="the models to calibrate")
    parser.add_argument("--models", default="densify,densify_small")
    parser.add_argument("--sensors", default=",".join(FILES))
    parser.add_argument("--tasks", default=" ".join(TASKS))
    parser.add_argument("--num", type=int, help="at most so many scans of a sensor")
    parser.add_argument("--drawn", type=int, help="number of drawn answers")
    parser.add_argument("--kept", action="store_true")
    parser.add_argument("--places", action="store_true")
    parser.add_argument("--own", nargs=2, type=Path, help="scans to calibrate on, scans to judge")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.fit:
        print(*fit(args.fit.split(",")))
        return
    lines = []
    for name in args.models.split(","):
        model = load_checkpoint(name)
        if args.kept:
            kept_table(name, model)
            continue
        if args.places:
            places_table(name, model)
            continue
        if args.own:
            for line in own_rows(name, *args.own):
                lines.append(line)
                print(*line, flush=True)
            continue
        for sensor in args.sensors.split(","):
            for task in args.tasks.split():
                found = cases(sensor, model, task, args.drawn or 1, args.num)
                if args.drawn:
                    each = [
                        spread_errors(c.truth, c.completed.images.numpy(), c.hidden) for c in found
                    ]
                    cover = np.mean([one["coverage"] for one in each])
                    cells = [f"{100 * cover:.0f}", f"{100 * each[0]['nominal']:.0f}"]
                    lines.append([name, sensor, task, *cells])
                    print(*lines[-1], flush=True)
                    continue
                both = list(found)
                for way, each in {"raw": [case.raw for case in both], "": both}.items():
                    lines.append([name, sensor, task, way, *trusted(each)])
                    print(*lines[-1], flush=True)
    if args.drawn:
        print_table(lines, ["model", "sensor", "known", "between, %", "should be"])
    elif lines:
        fifths = ["1st", "2nd", "3rd", "4th", "5th"]
        print_table(lines, ["model", "sensor", "known", "", "68", *fifths, "95", *fifths, "ECE"])


def places_table(name: str, model: Checkpoint) -> None:
    """Percentages of added points within error_68 and error_95, every 4th row known: the mean over
    the scans of each data set, the lowest and the highest.
    """
    reading = scans_of("HDL-64E")[1]
    flow = model.through(reading.sensor)
    lines = []
    for place, pattern in PLACES.items():
        shares = []
        for path in sorted(shared().glob(pattern)):
            case = Case.of(flow, read_image(path, reading), "rows:4")
            right = case.added & (case.truth[0] > 0)
            bounds = case.completed.error(0.68, 0.95)[:, 0].numpy()
            shares.append([100 * (case.errors <= bound)[right].mean() for bound in bounds])
            print(place, path.name, *(f"{share:.1f}" for share in shares[-1]), flush=True)
        cells = [f"{x.mean():.1f} ({x.min():.1f} to {x.max():.1f})" for x in np.transpose(shares)]
        lines.append([name, place, str(len(shares)), *cells])
    print_table(lines, ["model", "data set", "scans", "68", "95"])


def kept_table(name: str, model: Checkpoint) -> None:
    """Share of added points with error_68 of at most a limit, and the median and 68 % quantile of
    their true errors, by distance and, of labelled scans, by class; every 4th row known.
    """
    groups: dict[tuple[str, float], list[ndarray]] = {}
    for sensor in FILES:
        paths, reading = scans_of(sensor)
        flow = model.through(reading.sensor)
        for path in paths:
            truth = read_image(path, reading)
            case = Case.of(flow, truth, "rows:4")
            bound = case.completed.error(0.68)[0, 0].numpy()
            right = case.added & (truth[0] > 0)
            r = case.completed.images[0, 0].numpy()
            parts = {f"{a} to {b} m": right & (r >= a) & (r < b) for a, b in DISTANCES}
            ids = classes_of(path, reading)
            if ids is not None:
                kinds = common_classes(ids)
                parts |= {kind: right & (kinds == number) for kind, number in KINDS.items()}
            for part, rays in parts.items():
                groups.setdefault(part, []).append(np.stack([case.errors[rays], bound[rays]]))
    lines = []
    for part, found in groups.items():
        error, bound = np.concatenate(found, 1)
        cells = []
        for limit in LIMITS:
            kept = bound <= limit
            true = np.quantile(error[kept], 0.68) if kept.any() else np.nan
            cells.append(f"{100 * kept.mean():.0f} %, {true:.3f}")
        lines.append([name, part, f"{error.size:,}", *cells])
    print_table(lines, ["model", "points", "number", *(f"{x} m" for x in LIMITS)])


if __name__ == "__main__":
    main()
