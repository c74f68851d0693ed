"""A page that completes a scan in the browser, as a folder for any static server."""

import base64
import hashlib
import json
import shutil
import subprocess
import tarfile
from collections.abc import Sequence
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from r2flow.base.errors import InputError, check
from r2flow.base.files import write_file
from r2flow.base.progress import track
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.data.seeing import seeing_all
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion_export import export_completion
from r2flow.reports.view import (
    STEP,
    TRUST_SCALE,
    assets,
    colour_table,
    described_rays,
    digest,
    document,
)

SENSORS = ("vlp16", "vlp32c", "hdl32e")  # with fewer beams than the usual view has rows
_RUNTIME = "onnxruntime-web"
_VERSION = "1.30.0"
_DIGEST = "q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ=="
_RUNTIME_FILES = (
    "ort.wasm.bundle.min.mjs",
    "ort-wasm-simd-threaded.mjs",
    "ort-wasm-simd-threaded.wasm",
)
_LICENSE = f"""{_RUNTIME} {_VERSION}, MIT License, Copyright (c) Microsoft Corporation
https://github.com/microsoft/onnxruntime/blob/main/LICENSE
"""


def write_web(
    checkpoint: Checkpoint, folder: Path, sensors: Sequence[Sensor | str] = SENSORS
) -> None:
    """Write the page, a model for each sensor, the runtime and an example into a new folder.

    Args:
        checkpoint: A transfer flow.
        sensors: Sensors of the scans, or their names or YAML files.

    Raises:
        InputError: The folder exists, the runtime cannot be fetched by npm, or what
            `export_completion` refuses.
    """
    check(not folder.exists(), f"{folder} exists: give a new folder by --out.")
    with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as scratch:
        draft = Path(scratch, "page")
        _write_runtime(draft / "onnxruntime")
        known = [named_sensor(sensor) for sensor in sensors]
        models = [
            _write_model(checkpoint, sensor, draft)
            for sensor in track(known, "exporting", "models")
        ]
        _write_page(draft, models)
        image = open_scans("simulated:0", Reading(known[0]), num=1).source[0]
        points = np.column_stack(image_to_points(image, known[0])).astype("<f4")
        write_file(draft / "example.bin", points.tobytes())
        draft.rename(folder)


def _write_model(checkpoint: Checkpoint, sensor: Sensor, folder: Path) -> dict[str, Any]:
    """Export the model for a sensor; what the page has to know of it."""
    view = checkpoint.sensor
    model = checkpoint.through(seeing_all(sensor, view) or view)
    file = f"{sensor.name}.onnx"
    export_completion(model, folder / file, sensor)
    rays = np.asarray(model.sensor.rays(), dtype=np.float64)
    beams = np.asarray(sensor.elevations).round(4).tolist()
    return {"name": sensor.name, "file": file, "elevations": beams, "rays": described_rays(rays)}


def _write_page(folder: Path, models: Sequence[dict[str, Any]]) -> None:
    style, script = assets()
    for asset in ("style.css", "page.js", "worker.js", "readers.js"):
        write_file(folder / asset, _asset(asset))
    index = Template(_asset("index.html"))
    page = index.substitute(style_hash=digest(style), script_hash=digest(script))
    write_file(folder / "index.html", page)
    write_file(folder / "view.txt", document("", "{{data}}"))
    view = {
        "frames": [],
        "metres": STEP,
        "colours": colour_table(),
        "classes": [],
        "trust": TRUST_SCALE,
    }
    write_file(folder / "models.json", json.dumps({"models": models, "view": view}))


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _write_runtime(folder: Path) -> None:
    """The runtime from its npm package, checked by its hash."""
    npm = shutil.which("npm")
    if npm is None:
        raise InputError("--to web fetches onnxruntime-web by npm: install Node.js.")
    package = f"{_RUNTIME}@{_VERSION}"
    with TemporaryDirectory() as scratch:
        fetched = subprocess.run(
            [npm, "pack", package, "--silent"], cwd=scratch, capture_output=True, text=True
        )
        archives = [*Path(scratch).glob("*.tgz")]
        if fetched.returncode or not archives:
            problem = fetched.stderr.strip().split("\n")[-1][:200]
            raise InputError(f"npm pack {package} failed: {problem}")
        content = archives[0].read_bytes()
    found = base64.b64encode(hashlib.sha512(content).digest()).decode()
    check(found == _DIGEST, f"{package} has another content than expected: it is not used.")
    with tarfile.open(fileobj=BytesIO(content)) as archive:
        for name in _RUNTIME_FILES:
            member = archive.extractfile(f"package/dist/{name}")
            assert member is not None
            write_file(folder / name, member.read())
    write_file(folder / "LICENSE.txt", _LICENSE)
