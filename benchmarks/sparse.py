"""How long and how much memory the sparse networks of FSVD and FPVD take for a full scan, with random weights.

A scan has fewer than 120,000 voxels of 5 cm; where it does, neighbouring scans are laid over it until there are as
many as asked for. Each network runs in a process of its own, so that the peak of one is not the other's: the peak is
the whole process's, Python and torch with it, and what they take before the network is given beside it.

python benchmarks/sparse.py --scans drive/velodyne_points/data        # KITTI .bin files
python benchmarks/sparse.py                                           # a simulated street
"""

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

from r2flow.errors import InputError
from r2flow.metrics.extractors import extractor_class
from r2flow.metrics.extractors.voxels import voxelise

NETWORKS = ("minkowskinet", "spvcnn")


def points_of(scans: Path | None) -> list[torch.Tensor]:
    """Points of real scans, or of simulated ones, (N, 3) in metres each."""
    if scans is not None:
        from r2flow.lidar.scan_files import read_points

        files = sorted(scans.rglob("*.bin"))
        if not files:
            raise InputError(f"{scans} holds no .bin files.")
        return [torch.from_numpy(np.ascontiguousarray(read_points(file).xyz, dtype=np.float32)) for file in files[:8]]
    from r2flow.lidar.projection import image_to_points
    from r2flow.lidar.sensors import SENSORS
    from r2flow.simulator import simulate

    sensor = SENSORS["hdl64e"].resized(columns=2048)
    scenes = [image_to_points(simulate(sensor, 0, i).image, sensor.rays())[0] for i in range(4)]
    return [torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32)) for xyz in scenes]


def voxels(scans: Path | None, num: int) -> tuple[torch.Tensor, torch.Tensor]:
    """`num` voxels: of one scan, and of others laid over it where it has fewer."""
    clouds, laid = points_of(scans), 1
    coords, features = voxelise(clouds[0])
    while len(coords) < num and laid < len(clouds):
        laid += 1
        coords, features = voxelise(torch.cat(clouds[:laid]))
    if len(coords) < num:
        raise InputError(f"{laid} scans have {len(coords)} voxels, fewer than {num}; give --num or more scans.")
    print(f"{num} voxels of {laid} scan(s)", file=sys.stderr)
    return coords[:num], features[:num]


def peak() -> float:
    """GiB that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@torch.inference_mode()
def measure(name: str, scans: Path | None, num: int, repeats: int, threads: int) -> None:
    """Run one network and print its line of the table."""
    torch.set_num_threads(threads)
    network = extractor_class(name).random()
    coords, features = voxels(scans, num)
    coords = torch.nn.functional.pad(coords, (1, 0))
    before, walls, works = peak(), [], []
    for _ in range(repeats):
        wall, work = time.perf_counter(), time.process_time()
        network(coords, features)
        walls.append(time.perf_counter() - wall)
        works.append(time.process_time() - work)
    print(
        f"| {name} | {num:,} | {threads} | {walls[0]:.1f} s | {statistics.median(walls):.1f} s | "
        f"{statistics.median(works):.1f} s | {peak():.2f} GiB | {before:.2f} GiB |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=Path, help="folder of KITTI .bin files; simulated scans if left out")
    parser.add_argument("--num", type=int, default=120_000, help="voxels")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--network", choices=NETWORKS, help="one alone, in this process")
    options = parser.parse_args()
    if options.network:
        measure(options.network, options.scans, options.num, options.repeats, options.threads)
        return
    print("| network | voxels | threads | first scan | median | CPU time | peak memory | before |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name in NETWORKS:
        subprocess.run([sys.executable, *sys.argv, "--network", name], check=True)


if __name__ == "__main__":
    main()
