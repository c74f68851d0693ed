#!/usr/bin/env bash
# kiss-icp 1.3.0 drops the NaN points of a PointCloud2, but not their times.
#
# Organised clouds store lost rays as NaN points (is_dense false), as is usual with PCL. kiss-icp's reader of recordings removes these points and returns the times of all: from the
# first lost ray on, every point is deskewed by the time of another one. Both arrays then differ in
# length, and nothing is said. Deskewing is on by default.
#
# A laser drives at 10 m/s along x towards a wall, 20 m ahead at the sweep's start, and sees it
# eleven times in 0.1 s. Deskewed, it is flat: 19 m from where the laser is at the end. With ten lost
# rays before, as from the sky, it is slanted by a metre. Prints the version, the lengths and the
# deskewed wall; exits with 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check kiss-icp==1.3.0 rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'END'
import sys
from importlib.metadata import version

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.preprocess import get_preprocessor
from kiss_icp.tools.point_cloud2 import read_point_cloud
from rosbags.typesys import Stores, get_typestore

print("kiss-icp", version("kiss-icp"))
types = get_typestore(Stores.ROS2_HUMBLE).types


def cloud(rows):
    """A PointCloud2 of float32 fields."""
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "lidar")
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * place, 7, 1) for place, name in enumerate(rows.dtype.names)]
    data = rows.view(np.uint8)
    dense = bool(np.isfinite(rows["x"]).all())
    return types["sensor_msgs/msg/PointCloud2"](
        header, 1, len(rows), fields, False, 16, 16 * len(rows), data, dense
    )


wall = np.zeros(11, [(name, "f4") for name in ("x", "y", "z", "time")])
wall["time"] = np.linspace(0, 0.1, 11)
wall["x"] = 20 - 10 * wall["time"]
wall["y"] = np.arange(11) / 2
sky = np.zeros(10, wall.dtype)
for axis in "xyz":
    sky[axis] = np.nan
config = load_config(None)
config.mapping.voxel_size = 1.0
driven = np.eye(4)
driven[0, 3] = 1.0
slants = []
for name, rows in (("the wall alone", wall), ("ten lost rays before", np.concatenate([sky, wall]))):
    points, times = read_point_cloud(cloud(rows))
    x = np.array(get_preprocessor(config).preprocess(points, times, driven))[:, 0]
    slants.append(float(np.ptp(x)))
    print(f"{name}: {len(points)} points, {len(times)} times, x from {x.min():.2f} to {x.max():.2f} m")
sys.exit(not (np.allclose(slants, [0, 1], atol=1e-3) and config.data.deskew))
END
