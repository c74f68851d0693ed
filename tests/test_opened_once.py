"""Each name is looked up once in every verb: what is opened is counted by the interpreter itself."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate

COUNTED = """
import json, os, sys
from collections import Counter
from pathlib import Path
from r2flow import cli

counts = Counter()

def count(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], (str, os.PathLike)):
        counts[os.fspath(arguments[0])] += 1

result = Path(sys.argv[1])
sys.addaudithook(count)
for verb, arguments in json.load(sys.stdin).items():
    sys.argv = ["r2flow", *verb.split(), *arguments]
    try:
        cli.main()
    except SystemExit as end:
        assert not end.code, verb
result.write_text(json.dumps(counts))
"""


def test_every_file_is_opened_once_and_every_folder_listed_once(tmp_path: Path):
    sensor = SENSORS["hdl64e"].resized(32, 128)
    images = [simulate(sensor, 0, number).image for number in range(2)]
    clouds = [image_to_points(image, sensor.rays()) for image in images]
    sets = ("real", "generated", "completed", "viewed", "shown", "reported")
    for name in sets:
        (tmp_path / name).mkdir()
        for number, (image, cloud) in enumerate(zip(images, clouds, strict=True)):
            if name in ("generated", "viewed"):
                np.save(tmp_path / name / f"{number}.npy", image)
            else:
                write_points(tmp_path / name / f"{number}.bin", *cloud)
    real, generated, completed, viewed, shown, reported = (str(tmp_path / name) for name in sets)
    out = ["--out", str(tmp_path / "out")]
    alone = ["--metrics", "jsd", "--no-reference", "--no-baselines", "--workers", "0"]
    small = ["--size", "32x128"]
    verbs = {
        "evaluate": [real, generated, *alone, *small],
        "complete": [completed, *small, *out, "--pictures", "0"],
        "view": [viewed, "--out", str(tmp_path / "view.html")],
        "show": [shown, *out],
        "report completion": [reported, *small, *out, "--tasks", "rows:2"],
    }
    command = [sys.executable, "-c", COUNTED, str(tmp_path / "counts.json")]
    done = subprocess.run(command, input=json.dumps(verbs), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    counts = json.loads((tmp_path / "counts.json").read_text())
    for name in sets:
        folder = tmp_path / name
        listed = counts.pop(str(folder))
        opened = {Path(path).name: n for path, n in counts.items() if str(folder) in path}
        # complete also looks for a recording, and hashes the bytes: the manifest names its inputs;
        # NumPy opens a .npy for its header and to map it
        times = 1 if ".bin" in "".join(opened) and name != "completed" else 2
        assert listed == (2 if name == "completed" else 1), name
        assert opened.pop("manifest.json") == 1, name
        assert [*opened.values()] == [times, times], name
