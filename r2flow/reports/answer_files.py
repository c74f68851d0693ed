"""Files of completed scans: their names, what they hold, and the check of a folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from r2flow.base.errors import InputError, naming
from r2flow.base.files import atomic_write, save_array
from r2flow.base.progress import track
from r2flow.data.partial import PartialScan
from r2flow.lidar.added import completed_cloud
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import write_labels
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.projection import image_points
from r2flow.lidar.scan_files import WRITTEN, scan_ending, write_cloud
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.answer_rays import Answered, Job
from r2flow.reports.outputs import write_labelled
from r2flow.store import Store, manifest_of


def answer_files(scan: PartialScan, out: Path, num: int) -> list[Path]:
    """Files of the answers to a scan: of its own format, if it can be written."""
    if scan.path and (out / scan.name).resolve().parent == scan.path.resolve().parent:
        raise InputError(f"{out} is the folder of the scans; give another --out.")
    ending = scan.ending if scan.ending in WRITTEN else ".ply"
    width = len(str(num - 1))
    numbers = [f"_{number:0{width}d}" for number in range(num)] if num > 1 else [""]
    return [out / f"{scan.name}{number}{ending}" for number in numbers]


def check_inputs(
    store: Store, scans: Sequence[PartialScan], files: Mapping[str, Sequence[Path]]
) -> dict[str, str]:
    """Hashes of the scans by name; refuses a folder with other answers."""
    store.check()
    before = manifest_of(store.folder).get("inputs", {})
    inputs = {scan.name: scan.identity() for scan in track(scans, "hashing", "scans")}
    for name, paths in files.items():
        if before.get(name) != inputs[name] and any(path.exists() for path in paths):
            raise InputError(
                f"{store.folder} holds files of another scan of the name {name}; give another "
                "--out."
            )
    return inputs


def write_answers(
    checkpoint: Checkpoint, answered: Answered, files: Sequence[Path], job: Job
) -> None:
    """Write the answers to a scan, and the spread of several."""
    scan, known, completed = answered.scan, answered.known, answered.completed
    out = files[0].parent
    if len(files) > 1:
        deviation, returned = completed.spread.numpy()
        with atomic_write(out / f"{Path(scan.name).name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    labelled = checkpoint.encoding.labels
    sensor = checkpoint.sensor
    rays = sensor.rays()
    silent = known.points.reflectance is None if known.points else len(known.image) == 1
    drawn = "reflectance" in job.hide
    for number, (path, image) in enumerate(zip(files, completed.images.numpy(), strict=True)):
        name = path.name.removesuffix(scan_ending(path.name) or path.suffix)
        if scan.image:
            if labelled:
                write_labelled(image, rays, out, name, ["ply"], job.label_ids)
            save_array(path, image[: 1 if silent and not drawn else 2])  # none is invented
            continue
        with naming(scan.path or scan.name):
            cloud = completed_cloud(known, image, sensor, completed.trust(number))
        if labelled or drawn:
            reflectance, *labels = _of_points(known, image, rays)
            if labelled:
                write_labels(out, name, *labels, ids=job.label_ids)
            if drawn:
                cloud = cloud.with_reflectance(reflectance * known.scale)
        write_cloud(path, cloud)


def _of_points(known: Partial, image: ndarray, rays: Tensor) -> ndarray:
    """The channels of an answer after its range at each point of a completed cloud, (C - 1, N):
    measured points have those of the nearest measured ray.
    """
    assert known.points is not None
    measured = known.state == Ray.RETURN
    xyz, values = image_points(image * measured, rays, known.xyz)
    _, estimated = image_points(image * ~measured, rays)
    nearest = cKDTree(xyz).query(known.points.xyz)[1]
    return np.concatenate([values[:, nearest], estimated], axis=1)
