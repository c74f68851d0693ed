#!/usr/bin/env bash
# kiss-icp 1.3.0 deskews a scan as if its sweep filled all the time since the scan before.
#
# It is given the time of each point, but scales the times of a scan to [0, 1] and takes the motion
# between the last two scans as the motion of the sweep. That is right for a sensor that sweeps
# without a pause. Of every second scan of a recording (dropped messages, `--every 2`), whose points
# still span 0.1 s of 0.2 s, it removes twice the motion, and says nothing. Deskewing is on by
# default.
#
# A laser drives at 10 m/s along x and sees two points of the world, 20 m ahead of where it was at
# the sweep's start, at the start and at the end of a sweep of 0.1 s: 20 m and 19 m away. Deskewed
# they are one point. Prints the version and their distance; exits with 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check kiss-icp==1.3.0
cd "$folder"
venv/bin/python - <<'END'
import sys
from importlib.metadata import version

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.preprocess import get_preprocessor

print("kiss-icp", version("kiss-icp"))
config = load_config(None)
config.mapping.voxel_size = 1.0
print("deskew by default:", config.data.deskew)
preprocessor = get_preprocessor(config)
points = np.array([[20.0, 0.0, 0.0], [19.0, 0.0, 0.0]])
seconds = np.array([0.0, 0.1])
apart = []
for gap in (0.1, 0.2):
    since_last_scan = np.eye(4)
    since_last_scan[0, 3] = 10.0 * gap
    first, last = preprocessor.preprocess(points, seconds, since_last_scan)
    apart.append(float(abs(first[0] - last[0])))
    print(f"a scan each {gap} s: the same point, seen twice, is {apart[-1]:.3f} m apart")
sys.exit(not np.allclose(apart, [0.0, 1.0], atol=1e-6) or not config.data.deskew)
END
