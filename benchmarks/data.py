"""How fast scans are read, on one core: from .bin files, and from prepared shards.

python benchmarks/data.py
python benchmarks/data.py --layout kitti_360 --root /data/KITTI-360 --split test

Every way is measured in this one process, all of them by turns, medians of the processor's time
(all files lie in the page cache): a ratio holds on a busy machine, too.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from r2flow.data.described import describe
from r2flow.data.loader import FlowDataset, ItemFormat
from r2flow.data.preparing import plan, prepare
from r2flow.data.reading import Reading, read_image
from r2flow.data.sources import spread
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate

HDL64E = SENSORS["hdl64e"]


def by_turns(ways: dict[str, Callable[[int], object]], times: int, pieces: int) -> dict[str, float]:
    """Median milliseconds of way(piece) on the processor, the ways by turns, after one unmeasured
    round of all.
    """
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(-pieces, times):
        for name, way in ways.items():
            start = time.process_time()
            way(turn % pieces)
            if turn >= 0:
                taken[name].append(time.process_time() - start)
    return {name: 1e3 * float(np.median(one)) for name, one in taken.items()}


def plain_projection(path: str | Path) -> np.ndarray:
    """The published image of a .bin the plain way: all points sorted by depth, the nearest written
    last.

    Rows and columns are clamped, ranges outside 1.45 to 80 m zeroed afterwards.
    """
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    x, y, z, _ = points.T
    depth = np.linalg.norm(points[:, :3], ord=2, axis=1, keepdims=True)
    elevation = np.arcsin(z[:, None] / (depth + 1e-8)) + np.deg2rad(25.0)
    h = 1 - elevation / np.deg2rad(28.0)
    w = (-np.arctan2(y, x)[:, None] / np.pi + 1) / 2 % 1
    grid = np.concatenate(
        [np.clip(np.floor(h * 64), 0, 63), np.clip(np.floor(w * 1024), 0, 1023)], axis=1
    )
    valid = (depth >= 1.45) & (depth <= 80.0)
    channels = np.concatenate([points, depth, valid], axis=1)
    order = np.argsort(-depth.squeeze(1))
    grid, channels = grid[order].astype(np.int32), channels[order]
    image = np.zeros((64, 1024, 6), dtype=np.float32)
    image[grid[:, 0], grid[:, 1]] = channels
    return (image[..., [4, 3]] * image[..., 5:]).transpose(2, 0, 1)


def simulated_files(folder: Path, num: int) -> list[Path]:
    """Simulated scans as KITTI .bin files, of twice the image's resolution, so that pixels compete
    as in real ones.
    """
    fine = HDL64E.resized(64, 2048)
    paths = [folder / f"{index:06d}.bin" for index in range(num)]
    for index, path in enumerate(paths):
        write_points(path, *image_to_points(simulate(fine, 0, index).image, fine.rays()))
    return paths


def measure_projection(paths: Sequence[Path], times: int) -> None:
    """Read and project a scan: ours, ours under the reference's convention, and the plain way."""
    ours = Reading(HDL64E, reflectance=True)
    reference = replace(ours, convention="reference")
    taken = by_turns(
        {
            "read_image": lambda i: read_image(paths[i], ours),
            "read_image, reference convention": lambda i: read_image(paths[i], reference),
            "plain numpy": lambda i: plain_projection(paths[i]),
        },
        times,
        len(paths),
    )
    same = [plain_projection(path)[0] == read_image(path, reference)[0] for path in paths]
    points = int(np.mean([path.stat().st_size // 16 for path in paths]))
    print(f"\nread and project a scan of about {points} points ({len(paths)} scans, {times} turns)")
    show(taken, "plain numpy")
    print(
        f"pixels in which the plain way and the reference convention differ: {1 - np.mean(same):.4%}"
    )


def measure_shards(paths: Sequence[Path], folder: Path, times: int) -> None:
    """A scan in model space, float32 (2, 64, 1024), out of the page cache."""
    encoding = Encoding(HDL64E)
    chosen = folder / "chosen"
    chosen.mkdir()
    for number, path in enumerate(paths):
        (chosen / f"{number:06d}.bin").symlink_to(path.resolve())
    prepare(plan(folder / "prepared", describe(chosen), Reading(HDL64E)))
    scans = describe(folder / "prepared")
    prepared = scans.open(Reading(HDL64E, reflectance=True))
    arrays = [folder / f"{i}.npy" for i in range(len(paths))]
    for number, path in enumerate(arrays):
        np.save(path, prepared[number])
    items = FlowDataset(prepared, ItemFormat(encoding, encoding.shape), 0, "training")

    taken = by_turns(
        {
            "prepared, in metres": lambda i: prepared[i],
            "prepared and encode": lambda i: encoding.encode(torch.from_numpy(prepared[i])),
            "np.load and encode": lambda i: encoding.encode(torch.from_numpy(np.load(arrays[i]))),
            "prepared, with noise to train on": lambda i: items[i, i],
        },
        10 * times,
        len(paths),
    )
    print(f"\na scan as an encoded image, from page cache ({len(paths)} scans, {10 * times} turns)")
    show(taken, "np.load and encode")


def show(taken: dict[str, float], against: str) -> None:
    print(f"{'':34s} {'ms':>8s} {'scans/s':>9s} {'ratio':>7s}")
    for name, ms in taken.items():
        print(f"{name:34s} {ms:8.3f} {1e3 / ms:9.0f} {taken[against] / ms:7.2f}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--root", type=Path, help="a data set of KITTI .bin scans; simulated ones if left out"
    )
    parser.add_argument("--layout", default="folder", help="its layout")
    parser.add_argument("--split", help="a part of the layout's split; all if left out")
    parser.add_argument("--scans", type=int, default=8, help="scans of it to measure")
    parser.add_argument(
        "--times",
        type=int,
        default=40,
        help="turns of the projection; ten times as many of the shards",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        root, layout = options.root or folder / "simulated", options.layout
        if options.root is None:
            simulated_files(root, options.scans)
        scans = describe(f"{layout}:{root}", split=options.split)
        found = [Path(path) for path in scans.paths if path.endswith(".bin")]
        paths = [found[i] for i in spread(len(found), options.scans)]
        measure_projection(paths, options.times)
        measure_shards(paths, folder, options.times)


if __name__ == "__main__":
    main()
