#!/usr/bin/env bash
# ouster-cli 1.0.1: `source FILE save scan.ply` merges all frames of a recording into one cloud and
# keeps ten points at most of each cube of 0.1 m; `save scan.csv` writes every pixel, a file a frame.
#
# One verb, `save`, and the ending alone decides whether a recording becomes scans or a map. Who
# exports a .pcap or .osf as .ply to train or evaluate on scans gets one cloud in which near
# surfaces have lost most of their points, in no order, and beams can no longer be told. The cube is
# an option in `save --help` (--voxel-size, --decimate false); that frames are merged is not said.
#
# Prints the versions and the numbers of points; exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check ouster-sdk==1.0.1
cd "$folder"
# A recording of two frames: a wall all around, 2.00 m away, then 2.01 m.
venv/bin/python - <<'END'
import numpy as np
from ouster.sdk import core, osf

info = core.SensorInfo.from_default(core.LidarMode._512x10)
with osf.Writer("two.osf", [info]) as writer:
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = number
        frame.field("RANGE")[:] = 2000 + 10 * number
        start = 10**12 + number * 10**8
        frame.timestamp[:] = start + np.arange(512) * 10**8 // 512
        frame.packet_timestamp[:] = start + np.arange(len(frame.packet_timestamp))
        frame.measurement_id[:] = np.arange(512)
        frame.status[:] = 1
        writer.save(0, frame)
END
for ending in ply csv; do
    venv/bin/ouster-cli source two.osf save "scan.$ending" > log.txt 2>&1 || { cat log.txt; exit 1; }
done
venv/bin/python - <<'END'
import re
import sys
from importlib.metadata import version
from pathlib import Path

print("ouster-sdk", version("ouster-sdk"))
clouds = sorted(Path().glob("*.ply"))
tables = sorted(Path().glob("scan*.csv"))
points = [int(re.search(rb"element vertex (\d+)", path.read_bytes())[1]) for path in clouds]
rows = [sum(not line.startswith("#") for line in path.open()) for path in tables]
print("the recording: 2 frames of 64 x 512 returns, 65536 in all")
for path, count in zip([*clouds, *tables], [*points, *rows], strict=True):
    print(f"{path.name}: {count} points")
merged = len(points) == 1 and points[0] < 32768  # fewer than in one of the frames
sys.exit(not (merged and rows == [32768, 32768]))
END
