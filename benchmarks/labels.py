"""Labels of real scans, by a labelled model that has seen simulated scans alone.

The scans lie outside the repository, in the folder `real` of R2FLOW_SHARED: SemanticKITTI's and a
drive of PandaSet. Beside the model stand a plain segmenter of its size, trained here on simulated
scans (`--seconds` of processor time), and the likeliest class of a ray's height and range. mIoU is
the mean over the classes that a scan has; intervals are 95 % over scans (Student's t).

python benchmarks/labels.py labels                    # any labelled model
python benchmarks/labels.py runs/NAME --seconds 600
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy import ndarray
from real import shared
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import t as student
from torch import Tensor, nn

from r2flow.backbones import BACKBONES
from r2flow.data.reading import Reading, read_image
from r2flow.data.simulated import SimulatedScans
from r2flow.lidar.labels import COMMON
from r2flow.lidar.projection import image_points
from r2flow.lidar.scan_files import pandaset, write_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.metrics.labels import class_ious, confusion, mean_iou
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.completion import complete, label
from r2flow.reports.tables import print_table

CLASSES = len(COMMON)
CROP = (32, 256)
BATCH = 8
MEAN = 0.265  # of reflectance, to which scans of other sensors are scaled, as in `densify`
# The class of each ray of a scan (2, H, W) and its probability, (H, W) each.
Segment = Callable[[ndarray, Sensor], tuple[ndarray, ndarray]]


def real_sets(
    rows: int = 64, columns: int | None = None
) -> dict[str, tuple[list[ndarray], Sensor]]:
    """Scans with the common class of each ray, (3, H, W), by data set."""
    sensor = SENSORS["hdl64e"].resized(rows, columns)
    reading = Reading(sensor, reflectance=True, labels=True)
    files = sorted(shared().glob("odometry/sequences/*/labels/*.label"))
    bins = [file.parent.parent / "velodyne" / f"{file.stem}.bin" for file in files]
    kitti = [read_image(path, reading) for path in bins]
    pandar = SENSORS["pandar64"].resized(rows, columns or 1800)
    reading = replace(reading, sensor=pandar, reflectance_scale=255.0)
    folder = shared() / "pandaset" / "002" / "lidar"
    stamps = json.loads((folder / "timestamps.json").read_text())
    out = Path(tempfile.mkdtemp())
    frames = []
    for file in sorted((shared() / "pandaset" / "frames").glob("*.npz")):
        frame = np.load(file)
        times = frame["t"].astype(float) + stamps[int(file.stem)]
        xyz = pandaset.in_laser(frame["xyz"] + frame["origin"], times, folder)
        path = out / f"{file.stem}.ply"
        write_points(path, xyz, frame["intensity"])
        path.with_suffix(".label").write_bytes(pandaset.CLASSES[frame["label"]].astype("<u4"))
        frames.append(read_image(path, reading))
    return {"SemanticKITTI": (kitti, sensor), "PandaSet": (frames, pandar)}


def simulated(
    sensor: str, num: int, columns: int | None = None, seed: int = 0, rows: int | None = None
) -> ndarray:
    """Simulated scans with the common class of each ray, (N, 3, H, W)."""
    own = SENSORS[sensor].resized(rows, columns)
    source = SimulatedScans(own, seed, range(num), True, labels=True)
    return source.read_all(f"{sensor}", (3, *own.shape))


def by_flow(model: Checkpoint, steps: int) -> Segment:
    def segment(image: ndarray, sensor: Sensor) -> tuple[ndarray, ndarray]:
        own = model if sensor.same_image(model.sensor) else model.through(sensor)
        state = torch.from_numpy(np.where(image[0] > 0, 1, 2))[None]
        (answer,) = complete(own, torch.from_numpy(image[None, :2]), state, steps=steps)
        label, probability = answer.images[0, 2:].numpy()
        return label, probability

    return segment


class Segmenter(nn.Module):
    """The model's backbone, from range, reflectance, height and elevation to logits of classes."""

    def __init__(self, sensor: Sensor, channels: int = 48) -> None:
        super().__init__()
        rays = sensor.resized(*CROP).rays()
        self.network = BACKBONES.build(
            {"name": "local", "channels": channels}, rays, in_channels=5, out_channels=CLASSES
        )

    def forward(self, scan: Tensor, elevations: Tensor) -> Tensor:
        """Logits, (B, K, h, w), of scans (B, 2, h, w) with elevations in radians, (B, h)."""
        e = elevations[:, None, :, None].expand_as(scan[:, :1])
        r, strength = scan[:, :1], scan[:, 1:2]
        height = r * e.sin() / 3
        inputs = torch.cat([(r + 1).log() - 2, (r > 0).float(), strength, height, 3 * e], 1)
        return self.network(torch.zeros(()), inputs).float()


def scaled(image: ndarray, sensor: Sensor) -> ndarray:
    if sensor.name == "hdl64e":
        return image
    seen = image[1][image[0] > 0]
    gain = MEAN / seen.mean() if seen.any() else 1.0
    return np.stack([image[0], (image[1] * gain).clip(0, 1), *image[2:]])


def trained(
    sets: Sequence[tuple[ndarray, Sensor]], seconds: float, seed: int = 0, channels: int = 48
) -> Segmenter:
    """A segmenter after some processor seconds, or its moving average.

    A crop of 32 x 256 is of each set of scans in turn, half of them mirrored.
    """
    torch.manual_seed(seed)
    draws = np.random.default_rng(seed)
    model = Segmenter(sets[0][1], channels)
    mean = torch.optim.swa_utils.AveragedModel(
        model, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.995)
    )
    optimiser = torch.optim.AdamW(model.parameters(), 2e-3, betas=(0.9, 0.99))
    start = time.process_time()
    step = 0
    while (spent := (time.process_time() - start) / seconds) < 1:
        optimiser.param_groups[0]["lr"] = 2e-3 * min(1.0, (step + 1) / 100, 4 * (1 - spent))
        crops, elevations = [], []
        for number in range(BATCH):
            images, sensor = sets[(step * BATCH + number) % len(sets)]
            image = scaled(images[draws.integers(len(images))], sensor)
            top = draws.integers(image.shape[1] - CROP[0] + 1)
            left = draws.integers(image.shape[2])
            part = np.roll(image, -left, 2)[:, top : top + CROP[0], : CROP[1]]
            crops.append(part[..., ::-1] if draws.random() < 0.5 else part)
            elevations.append(np.radians(sensor.elevations[top : top + CROP[0]]))
        batch = torch.from_numpy(np.stack(crops))
        with torch.autocast("cpu", torch.bfloat16):
            logits = model(batch[:, :2], torch.from_numpy(np.stack(elevations)).float())
        loss = F.cross_entropy(logits, batch[:, 2].long() - 1, ignore_index=-1)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        mean.update_parameters(model)
        step += 1
    return mean.module.eval()


def by_network(model: Segmenter) -> Segment:
    @torch.no_grad()
    def segment(image: ndarray, sensor: Sensor) -> tuple[ndarray, ndarray]:
        scan = torch.from_numpy(scaled(image[:2], sensor))[None]
        elevations = torch.from_numpy(np.radians(sensor.elevations)).float()[None]
        probability, label = model(scan, elevations).softmax(1)[0].max(0)
        return (label + 1).numpy(), probability.numpy()

    return segment


def by_place(sets: Sequence[tuple[ndarray, Sensor]]) -> Segment:
    """The likeliest class by height and range, of simulated scans."""
    count = np.full((64, 32, CLASSES), 1e-3)

    def place(image: ndarray, sensor: Sensor) -> tuple[ndarray, ndarray]:
        elevation = np.radians(sensor.elevations)[:, None]
        height = ((image[0] * np.sin(elevation) + 4) * 6).clip(0, 63).astype(int)
        return height, (image[0] / 2.5).clip(0, 31).astype(int)

    for images, sensor in sets:
        for image in images:
            seen = image[2] > 0
            h, r = place(image, sensor)
            np.add.at(count, (h[seen], r[seen], image[2][seen].astype(int) - 1), 1)
    share = count / count.sum(-1, keepdims=True)

    def segment(image: ndarray, sensor: Sensor) -> tuple[ndarray, ndarray]:
        p = share[place(image, sensor)]
        return p.argmax(-1) + 1, p.max(-1)

    return segment


def judged(scans: Sequence[ndarray], sensor: Sensor, segment: Segment) -> tuple[list[str], ndarray]:
    """The cells of a row, and of ten classes of probability the rays, and those that are right."""
    each, sure = [], np.zeros((2, 10))
    total = np.zeros((CLASSES + 1, CLASSES + 1))
    for image in scans:
        label, probability = segment(image[:2], sensor)
        counts = confusion(image[2], label)
        total += counts
        each.append(mean_iou(counts))
        seen = image[2] > 0
        of_ten = (probability[seen] * 10).astype(int).clip(0, 9)
        right = label[seen] == image[2][seen]
        sure += [np.bincount(of_ten, minlength=10), np.bincount(of_ten, right, 10)]
    half = student.ppf(0.975, len(each) - 1) * np.std(each, ddof=1) / len(each) ** 0.5
    accuracy = total.diagonal().sum() / total.sum()
    ious = class_ious(total)
    cells = [f"{np.mean(each):.3f} +-{half:.3f}", f"{accuracy:.3f}"]
    return cells + ["" if np.isnan(iou) else f"{iou:.2f}" for iou in ious], sure


def rows(
    ways: dict[str, Segment], sets: dict[str, tuple[list[ndarray], Sensor]]
) -> Iterator[tuple[list[str], ndarray]]:
    for name, (scans, sensor) in sets.items():
        for way, segment in ways.items():
            cells, sure = judged(scans, sensor, segment)
            yield [f"{name}, {len(scans)}", way, *cells], sure


def real_part(model: Checkpoint, ways: dict[str, Segment]) -> None:
    table, calibration = [], []
    for cells, sure in rows(ways, real_sets()):
        table.append(cells)
        share = sure[1] / sure[0].clip(1)
        bins = zip(share, sure[0], strict=True)
        calibration.append([*cells[:2], *(f"{p:.2f}" if n else "" for p, n in bins)])
    print_table(table, ["scans", "by", "mIoU", "right", *COMMON])
    print("\nOf rays said to be so sure, the share that is right:")
    print_table(calibration, ["scans", "by", *(f"{n / 10:.1f}-" for n in range(10))])


def flat_road(xyz: ndarray, classes: ndarray) -> float:
    """Share of the road's points within 25 m that lie within 0.2 m of a plane.

    The plane is fitted to all points near it, from z = -1.73 m on, whatever their class.
    """
    near = np.linalg.norm(xyz[:, :2], axis=1) < 25
    ones = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    plane = np.array([0, 0, -1.73])
    for within in (0.5, 0.4, 0.3, 0.2, 0.2, 0.2):
        used = near & (np.abs(xyz[:, 2] - ones @ plane) < within)
        plane = np.linalg.lstsq(ones[used], xyz[used, 2], rcond=None)[0]
    road = near & (classes == 1)
    return float((np.abs(xyz[road, 2] - ones[road] @ plane) < 0.2).mean())


def whole_cars(xyz: ndarray, classes: ndarray) -> float:
    """Share of the vehicles' points in clusters of the size of a car or a van: at least 10 points,
    0.8 to 3 m high and 1 to 7 m long. Points of a cluster are 0.5 m and 2 % of their range apart.
    """
    points = xyz[classes == 6]
    if len(points) < 10:
        return np.nan
    r = np.linalg.norm(points, axis=1)
    pairs = cKDTree(points).query_pairs(2.5, output_type="ndarray")
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[apart < 0.5 + 0.02 * r[pairs].min(1)]
    ones = np.ones(len(pairs))
    _, cluster = connected_components(
        coo_array((ones, tuple(pairs.T)), shape=(len(points), len(points))), directed=False
    )
    good = 0
    for number in range(cluster.max() + 1):
        own = points[cluster == number]
        size = np.ptp(own, axis=0)
        length = np.hypot(*size[:2])
        good += len(own) * (len(own) >= 10 and 0.8 <= size[2] <= 3 and 1 <= length <= 7)
    return good / len(points)


def geometry_part(model: Checkpoint, ways: dict[str, Segment], num: int = 64) -> None:
    street = load_checkpoint("street")
    sensor = street.sensor
    truth = simulated("hdl64e", num, sensor.columns, seed=9, rows=sensor.shape[0])
    drawn = street.sample(num, precision="bf16-mixed").numpy()
    own = model.through(sensor)
    sets = {
        "simulator, its labels": truth,
        "simulator, labelled": label(own, torch.from_numpy(truth[:, :2])).numpy(),
        "street, labelled": label(own, torch.from_numpy(drawn)).numpy(),
    }
    lines = []
    for name, images in sets.items():
        clouds = [image_points(image, sensor) for image in images]
        figures = [[part(xyz, v[1]) for part in (flat_road, whole_cars)] for xyz, v in clouds]
        shares = [(images[:, 2] == k)[images[:, 0] > 0].mean() for k in range(1, CLASSES + 1)]
        cells = [f"{value:.3f}" for value in np.nanmean(figures, axis=0)]
        lines.append([name, *cells, *(f"{share:.3f}" for share in shares)])
    print_table(lines, ["scans", "road on its plane", "vehicle in a car's size", *COMMON])


def map_part(model: Checkpoint, ways: dict[str, Segment], num: int = 8) -> None:
    """What the segmenter reads in scans drawn from maps of labels, and in the true scans."""
    truth = simulated("hdl64e", num, seed=9)
    maps = torch.from_numpy(truth).clone()
    maps[:, :2] = 0
    state = torch.zeros(maps[:, 0].shape)
    drawn = {
        f"drawn, {how}": torch.cat([a.images for a in complete(model, maps, state, sampler=how)])
        for how in ("jump:steps=1", "jump:steps=8", "transport")
    }
    lines = []
    for name, images in {"true": torch.from_numpy(truth), **drawn}.items():
        ious, errors = [], []
        for image, true in zip(images.numpy(), truth, strict=True):
            read, _ = ways["segmenter"](image[:2], model.sensor)
            both = (image[0] > 0) & (true[0] > 0)
            ious.append(mean_iou(confusion(true[2] * both, read)))
            errors.append(np.abs(np.log(image[0][both] / true[0][both])).mean())
        lines.append([name, f"{np.mean(ious):.3f}", f"{np.mean(errors):.3f}"])
    print_table(lines, ["scans", "mIoU of the map read back", "mean |log range error|"])


def densified_part(model: Checkpoint, ways: dict[str, Segment], num: int = 8) -> None:
    """Labels of the hidden rows of simulated scans of a VLP-16 with 64 rows, 16 of them known."""
    sensor = SENSORS["vlp16"].resized(64, 1800)
    truth = simulated("vlp16", num, 1800, seed=9, rows=64)
    beams = np.array(SENSORS["vlp16"].elevations)
    rows = np.abs(np.array(sensor.elevations)[:, None] - beams).min(1) < 1e-3
    known = np.broadcast_to(rows[:, None], sensor.shape)
    state = torch.from_numpy(np.where(known, np.where(truth[:, 0] > 0, 1, 2), 0))
    given = torch.from_numpy(truth * known)
    answers = complete(model.through(sensor), given, state)
    steps = -np.diff(np.radians(sensor.elevations)).mean(), 2 * np.pi / 1800
    found: dict[str, list[list[float]]] = {"labels known, densified": [], "nearest label": []}
    for image, answer in zip(truth, answers, strict=True):
        seen = known & (image[2] > 0)
        nearest = distance_transform_edt(~seen, steps, return_distances=False, return_indices=True)
        hidden = image[2] * ~known
        both = hidden * (answer.images[0, 0].numpy() > 0)
        ways_here = (answer.images[0, 2].numpy(), image[2][tuple(nearest)])
        for values, classes in zip(found.values(), ways_here, strict=True):
            values.append([mean_iou(confusion(true, classes)) for true in (hidden, both)])
    lines = [
        [name, *(f"{value:.3f}" for value in np.mean(values, axis=0))]
        for name, values in found.items()
    ]
    print_table(lines, ["hidden rays of a VLP-16", "mIoU", "mIoU where the model returns"])


def training_part(model: Checkpoint, ways: dict[str, Segment], num: int = 500) -> None:
    """Segmenters of 32 x 256 that learned from simulated, from generated scans, and from both.

    Each has three seeds and 60 processor seconds. Written down before: generated scans help if
    `both` is ahead of `simulated` in all three seeds of both sets of real scans.
    """
    street = load_checkpoint("street")
    own = street.sensor
    truth = simulated("hdl64e", num, own.columns, rows=own.shape[0])
    drawn = street.sample(num, steps=4, precision="bf16-mixed")
    made = label(model.through(own), drawn)[:, :3].numpy()
    kinds = {"simulated": [truth], "generated": [made], "both": [truth, made]}
    real = real_sets(*own.shape)
    lines = []
    for kind, sets in kinds.items():
        found: dict[str, list[str]] = {}
        for seed in range(3):
            network = trained([(images, own) for images in sets], 60, seed, channels=24)
            for cells, _ in rows({kind: by_network(network)}, real):
                found.setdefault(cells[0], []).append(cells[2].split()[0])
        lines += [[kind, name, *ious] for name, ious in found.items()]
    print_table(lines, ["trained on", "judged on", "seed 0", "seed 1", "seed 2"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = {
        "real": real_part,
        "geometry": geometry_part,
        "maps": map_part,
        "densified": densified_part,
        "training": training_part,
    }
    parser.add_argument("model", nargs="?", default="labels")
    parser.add_argument("--parts", default="real,geometry,maps,densified,training")
    parser.add_argument("--seconds", type=float, default=600, help="of the segmenter's training")
    parser.add_argument("--scenes", type=int, default=600, help="simulated scans of each sensor")
    parser.add_argument("--keep", type=Path, help="file of the segmenter; read, if it is there")
    args = parser.parse_args()
    model = load_checkpoint(args.model)
    seen = [
        (simulated("hdl64e", args.scenes), SENSORS["hdl64e"]),
        (simulated("pandar64", args.scenes, 1800), SENSORS["pandar64"].resized(columns=1800)),
    ]
    if args.keep and args.keep.exists():
        network = Segmenter(SENSORS["hdl64e"]).eval()
        network.load_state_dict(torch.load(args.keep, weights_only=True))
    else:
        network = trained(seen, args.seconds)
        if args.keep:
            torch.save(network.state_dict(), args.keep)
    ways = {f"{args.model}, {steps}": by_flow(model, steps) for steps in (1, 8)}
    ways |= {"segmenter": by_network(network), "height and range": by_place(seen)}
    for part in args.parts.split(","):
        parts[part](model, ways)


if __name__ == "__main__":
    main()
