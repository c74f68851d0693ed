"""Does a denser scan help odometry? KISS-ICP on every 4th row, the same densified, and all rows.

It needs the package kiss-icp, and the folder `real` of R2FLOW_SHARED. Scans are range images, known
pixels keep their measured points; KISS-ICP has its defaults without deskewing, from 3 m on.
PandaSet's poses are the reference, of every second frame of a drive, 0.2 s apart. The clips of
KITTI raw (48: every 2nd frame; 5: every 8th, 0.8 s apart) have none: that of all rows is their
reference, so it has no error there.

Columns: error of the last position against the length of the way, root mean square of the errors of
the steps, and steps that are more than 0.5 m off.

python -m pip install kiss-icp==1.3.0
python benchmarks/odometry.py
"""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP
from numpy import ndarray
from real import shared
from scipy.spatial.transform import Rotation

from r2flow.data.reading import Reading, read_points_image
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import ray_states
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import pandaset, write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.completion import complete
from r2flow.reports.tables import print_table

KNOWN = 4  # every KNOWNth row
FAILED = 0.5  # metres
WAYS = ("all rows", "every 4th row", "interpolated (1/r)", "densified")


def pandaset_drive() -> tuple[list[Path], Reading, ndarray]:
    """Scans in the laser's frame, written as .ply, and the laser's poses, (N, 4, 4)."""
    folder = shared() / "pandaset" / "002" / "lidar"
    stamps = json.loads((folder / "timestamps.json").read_text())
    poses = json.loads((folder / "poses.json").read_text())
    laser = np.eye(4)
    laser[:3, :3] = Rotation.from_euler("xyz", [*pandaset.TILT, 0]).as_matrix() @ pandaset.AHEAD.T
    laser[:3, 3] = pandaset.ORIGIN
    out = Path(tempfile.mkdtemp())
    paths, reference = [], []
    for file in sorted((shared() / "pandaset" / "frames").glob("*.npz")):
        frame = np.load(file)
        number = int(file.stem)
        world = frame["xyz"] + frame["origin"]
        xyz = pandaset.in_laser(world, frame["t"].astype(float) + stamps[number], folder)
        write_points(out / f"{file.stem}.ply", xyz, frame["intensity"])
        paths.append(out / f"{file.stem}.ply")
        # The middle of the sweep lies between two poses; the first one has none before it.
        between = [poses[max(number - 1, 0)], poses[number]]
        turns = Rotation.from_quat([[p["heading"][axis] for axis in "xyzw"] for p in between])
        vehicle = np.eye(4)
        vehicle[:3, :3] = turns.mean().as_matrix()
        vehicle[:3, 3] = np.mean([[p["position"][axis] for axis in "xyz"] for p in between], axis=0)
        reference.append(vehicle @ laser)
    sensor = SENSORS["pandar64"].resized(columns=1792)
    return paths, Reading(sensor, reflectance_scale=255.0, reflectance=True), np.stack(reference)


def kitti_clip(drive: str) -> tuple[list[Path], Reading, None]:
    paths = sorted(shared().glob(f"raw/*/*_{drive}_sync/velodyne_points/data/*.bin"))
    return paths, Reading(SENSORS["hdl64e"], reflectance=True), None


def clouds(path: Path, reading: Reading, model: Checkpoint) -> Iterator[ndarray]:
    """The points of a scan by each of `WAYS`, (N, 3)."""
    image, xyz = read_points_image(path, reading)
    rays = reading.sensor.rays()
    yield image_to_points(image, rays, xyz)[0]
    known = np.zeros(image.shape[1:], dtype=bool)
    known[KNOWN // 2 :: KNOWN] = True
    given = image * known
    state = ray_states(torch.from_numpy(image)[None], torch.from_numpy(known))
    (completed,) = complete(model, torch.from_numpy(given)[None], state)
    for answer in (given, interpolated(given, known), completed.images[0].numpy()):
        yield image_to_points(answer, rays, xyz * known)[0]


def travelled(scans: list[ndarray]) -> ndarray:
    """Poses of the laser by KISS-ICP, (N, 4, 4), relative to the first."""
    config = load_config(None)
    config.data.deskew = False
    config.data.min_range = 3.0
    config.mapping.voxel_size = config.data.max_range / 100  # as its command line sets it
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    poses = []
    for scan in scans:
        odometry.register_frame(scan.astype(np.float64), np.zeros(0))
        poses.append(odometry.last_pose)
    return np.stack(poses)


def compared(poses: ndarray, reference: ndarray) -> list[float | int | str]:
    """The columns of a row."""
    steps, true = (np.linalg.inv(each[:-1]) @ each[1:] for each in (poses, reference))
    off = np.linalg.inv(true) @ steps
    metres = np.linalg.norm(off[:, :3, 3], axis=1)
    degrees = np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude())
    way = np.linalg.norm(true[:, :3, 3], axis=1).sum()
    ends = [np.linalg.inv(each[0]) @ each[-1] for each in (poses, reference)]
    last = np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3])
    rms = [float(np.sqrt(np.mean(values**2))) for values in (metres, degrees)]
    return [f"{last:.3f} of {way:.1f}", *rms, int((metres > FAILED).sum())]


def main() -> None:
    clips = {
        "PandaSet 002, 0.2 s": pandaset_drive(),
        "KITTI raw 48, 0.2 s": kitti_clip("0048"),
        "KITTI raw 5, 0.8 s": kitti_clip("0005"),
    }
    lines = []
    for name, (paths, reading, reference) in clips.items():
        model = load_checkpoint("densify").through(reading.sensor)
        ways = zip(*(list(clouds(path, reading, model)) for path in paths), strict=True)
        for way, scans in zip(WAYS, ways, strict=True):
            poses = travelled(list(scans))
            if reference is None:
                reference = poses
            lines.append([name, way, *compared(poses, reference)])
            print(lines[-1], flush=True)
    print_table(lines, ["clip", "points", "end off, m", "a step, m", "a step, degrees", "failures"])


if __name__ == "__main__":
    main()
