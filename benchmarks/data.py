"""How fast scans are read, on one core: from .bin files, from prepared shards, and the index of a whole data set.

python benchmarks/data.py
python benchmarks/data.py --layout kitti_360 --root /data/KITTI-360 --split test

Every way is measured in this one process, all of them by turns, medians of the processor's time (all files lie in the
page cache): a ratio holds on a busy machine, too.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from r2flow.data.layouts import Drive
from r2flow.data.loader import FlowDataset
from r2flow.data.opening import find_drives, open_prepared
from r2flow.data.prepared import Manifest, ScanRecipe, ShardEntry, checksum, describe_sensor, shard_name, write_manifest
from r2flow.data.preparing import Preparation, plan_files
from r2flow.data.quantise import RangeCodes
from r2flow.data.reading import read_scan
from r2flow.data.sources import spread
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate

HDL64E = SENSORS["hdl64e"]
KITTI_360_DRIVES = {0: 11518, 2: 14607, 3: 1400, 4: 9000, 5: 6700, 6: 9900, 7: 3500, 9: 15000, 10: 9481}  # 81,106 scans


def by_turns(ways: dict[str, Callable[[int], object]], times: int, pieces: int) -> dict[str, float]:
    """Median milliseconds of way(piece) on the processor, the ways by turns, after one unmeasured round of all."""
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(-pieces, times):
        for name, way in ways.items():
            start = time.process_time()
            way(turn % pieces)
            if turn >= 0:
                taken[name].append(time.process_time() - start)
    return {name: 1e3 * float(np.median(one)) for name, one in taken.items()}


def plain_projection(path: str | Path) -> np.ndarray:
    """The published image of a .bin the plain way: all points sorted by depth, the nearest written last.

    Rows and columns are clamped, ranges outside 1.45 to 80 m zeroed afterwards.
    """
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    x, y, z, _ = points.T
    depth = np.linalg.norm(points[:, :3], ord=2, axis=1, keepdims=True)
    elevation = np.arcsin(z[:, None] / (depth + 1e-8)) + np.deg2rad(25.0)
    h = 1 - elevation / np.deg2rad(28.0)
    w = (-np.arctan2(y, x)[:, None] / np.pi + 1) / 2 % 1
    grid = np.concatenate([np.clip(np.floor(h * 64), 0, 63), np.clip(np.floor(w * 1024), 0, 1023)], axis=1)
    valid = (depth >= 1.45) & (depth <= 80.0)
    channels = np.concatenate([points, depth, valid], axis=1)
    order = np.argsort(-depth.squeeze(1))
    grid, channels = grid[order].astype(np.int32), channels[order]
    image = np.zeros((64, 1024, 6), dtype=np.float32)
    image[grid[:, 0], grid[:, 1]] = channels
    return (image[..., [4, 3]] * image[..., 5:]).transpose(2, 0, 1)


def simulated_files(folder: Path, num: int) -> list[Path]:
    """Simulated scans as KITTI .bin files, of twice the image's resolution, so that pixels compete as in real ones."""
    fine = HDL64E.resized(64, 2048)
    paths = [folder / f"{index:06d}.bin" for index in range(num)]
    for index, path in enumerate(paths):
        write_points(path, *image_to_points(simulate(fine, 0, index).image, fine.rays()))
    return paths


def measure_projection(paths: Sequence[Path], times: int) -> None:
    """Read and project a scan: ours, ours under the reference's convention, and the plain way."""
    taken = by_turns(
        {
            "read_scan": lambda i: read_scan(paths[i], HDL64E),
            "read_scan, reference convention": lambda i: read_scan(paths[i], HDL64E, convention="reference"),
            "plain numpy": lambda i: plain_projection(paths[i]),
        },
        times,
        len(paths),
    )
    same = [plain_projection(path)[0] == read_scan(path, HDL64E, convention="reference")[0] for path in paths]
    points = int(np.mean([path.stat().st_size // 16 for path in paths]))
    print(f"\nread and project a scan of about {points} points ({len(paths)} scans, {times} turns)")
    show(taken, "plain numpy")
    print(f"pixels in which the plain way and the reference convention differ: {1 - np.mean(same):.4%}")


def measure_shards(paths: Sequence[Path], folder: Path, times: int) -> None:
    """A scan in model space, float32 (2, 64, 1024), out of the page cache."""
    encoding = Encoding(HDL64E)
    chosen = folder / "chosen"
    chosen.mkdir()
    for number, path in enumerate(paths):
        (chosen / f"{number:06d}.bin").symlink_to(path.resolve())
    preparation = Preparation(folder / "prepared", plan_files("folder", chosen, HDL64E))
    preparation.make(preparation.begin())
    prepared = open_prepared(folder / "prepared", HDL64E)
    numbers = range(len(paths))
    arrays = [folder / f"{i}.npy" for i in range(len(paths))]
    for number, path in zip(numbers, arrays, strict=True):
        np.save(path, prepared[number])
    items = FlowDataset(prepared, encoding, 0, "training")

    taken = by_turns(
        {
            "prepared, encoded": lambda i: prepared.encoded(numbers[i], encoding),
            "prepared, in metres": lambda i: prepared[numbers[i]],
            "np.load and encode": lambda i: encoding.encode(torch.from_numpy(np.load(arrays[i]))),
            "prepared, with noise to train on": lambda i: items[i, i],
        },
        10 * times,
        len(paths),
    )
    exact = all(
        torch.equal(prepared.encoded(n, encoding), encoding.encode(torch.from_numpy(np.load(path))))
        for n, path in zip(numbers, arrays, strict=True)
    )
    print(f"\na scan as an encoded image, from page cache ({len(paths)} scans, {10 * times} turns)")
    show(taken, "np.load and encode")
    print(f"encoded images equal to the bit: {exact}")


def show(taken: dict[str, float], against: str) -> None:
    print(f"{'':34s} {'ms':>8s} {'scans/s':>9s} {'ratio':>7s}")
    for name, ms in taken.items():
        print(f"{name:34s} {ms:8.3f} {1e3 / ms:9.0f} {taken[against] / ms:7.2f}")


def write_index(folder: Path) -> int:
    """The index of all of KITTI-360 at 64 x 1024 with shards that are all hole: their size in bytes."""
    drives = tuple(
        Drive(name, tuple(f"data_3d_raw/{name}/velodyne_points/data/{i:010d}.bin" for i in range(scans)))
        for drive, scans in KITTI_360_DRIVES.items()
        for name in [f"2013_05_28_drive_{drive:04d}_sync"]
    )
    names = [name for drive in drives for name in drive.scans]
    recipe = ScanRecipe(
        "0", "kitti_360", len(names), checksum(names), describe_sensor(HDL64E), "spherical", "centre", 1.0, 256,
        RangeCodes(HDL64E.min_range, HDL64E.max_range).describe(), 512,
    )  # fmt: skip
    entries = []
    for shard in range(recipe.shards):
        scans = len(recipe.numbers_of(shard))
        head, size = shard_head(scans)
        with open(folder / shard_name(shard), "wb") as file:
            file.write(head)
            file.truncate(len(head) + size)
        entries.append(ShardEntry(scans, (), len(head) + size, zlib.crc32(head), "", 6e-4, 0.0))
    write_manifest(folder, Manifest(recipe, drives, tuple(entries)))
    return sum(entry.bytes for entry in entries) + sum(p.stat().st_size for p in folder.glob("*.json"))


def shard_head(scans: int) -> tuple[bytes, int]:
    """A shard up to its first tensor, and the bytes of its tensors."""
    header: dict[str, object] = {"__metadata__": {"scans": "{}"}}
    end = 0
    pixels = (scans, *HDL64E.shape)
    for name, kind, width, shape in (
        ("crc32", "U32", 4, (scans,)),
        ("range", "U16", 2, pixels),
        ("reflectance", "U8", 1, pixels),
    ):
        size = width * int(np.prod(shape))
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [end, end + size]}
        end += size
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text, end


OPENING = """
import logging, sys, time
from pathlib import Path
from r2flow.data.opening import open_scans
def memory():  # of this process, now; the peak is that of the imports
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
logging.disable()  # that train and test drives are opened together
before, start = memory(), time.perf_counter()
source = open_scans(sys.argv[1]).source
names = source.names
print(f"{len(names)} scans: {time.perf_counter() - start:.2f} s, {memory() - before:.0f} MiB")
"""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="a data set of KITTI .bin scans; simulated ones if left out")
    parser.add_argument("--layout", default="folder", help="its layout")
    parser.add_argument("--split", help="a part of the layout's split; all if left out")
    parser.add_argument("--scans", type=int, default=8, help="scans of it to measure")
    parser.add_argument(
        "--times", type=int, default=40, help="turns of the projection; ten times as many of the shards"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        root, layout = options.root or folder / "simulated", options.layout
        if options.root is None:
            simulated_files(root, options.scans)
        found = [Path(p) for d in find_drives(layout, root, options.split) for p in d.scans if p.endswith(".bin")]
        paths = [found[i] for i in spread(len(found), options.scans)]
        measure_projection(paths, options.times)
        measure_shards(paths, folder, options.times)
        (folder / "index").mkdir()
        size = write_index(folder / "index")
        print(f"\nindex of KITTI-360 at 64 x 1024, {size / 1e9:.2f} GB with its scans: ", end="", flush=True)
        subprocess.run([sys.executable, "-c", OPENING, folder / "index"], check=True)


if __name__ == "__main__":
    main()
