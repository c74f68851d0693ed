"""The C++ program of examples/cpp completes a scan as Python does. `pytest -m slow`.

R2FLOW_ONNXRUNTIME names an unpacked release of onnxruntime, unless the system has one.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from r2flow import load
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.data.seeing import seeing_all
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.model.completion_export import export_completion
from tests.conftest import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The built program, the exported model and a scan."""
    folder = tmp_path_factory.mktemp("cpp")
    pytest.importorskip("onnxruntime", reason="the extra 'export'")
    if not (shutil.which("cmake") and shutil.which("c++")):
        pytest.skip("no cmake or C++ compiler is installed")
    where = f"-DONNXRUNTIME={os.environ.get('R2FLOW_ONNXRUNTIME', '')}"
    made = subprocess.run(
        ["cmake", "-S", ROOT / "examples/cpp", "-B", folder / "build", where],
        capture_output=True,
        text=True,
    )
    if "ONNXRUNTIME_HEADERS" in made.stderr or "ONNXRUNTIME_LIBRARY" in made.stderr:
        pytest.skip("onnxruntime's C++ headers are not installed: set R2FLOW_ONNXRUNTIME")
    assert made.returncode == 0, made.stderr
    subprocess.run(["cmake", "--build", folder / "build"], check=True, capture_output=True)
    source = SENSORS["vlp16"]
    model = load("densify_small")
    view = seeing_all(source, model.sensor)
    export_completion(model.through(view), folder / "model.onnx", source)
    image = open_scans("simulated:0", Reading(source), num=1).source[0]
    xyz, reflectance = image_to_points(image, source)
    write_points(folder / "scan.bin", xyz, reflectance)
    write_points(folder / "scan.pcd", xyz, 255 * reflectance)
    return folder


def run(folder: Path, *words: str) -> subprocess.CompletedProcess:
    program = folder / "build/complete"
    return subprocess.run([program, *words], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize(("scan", "full"), [("scan.bin", "1"), ("scan.pcd", "255")])
def test_the_program_completes_as_the_runtime_in_python(folder, scan, full):
    import onnxruntime

    said = run(folder, "model.onnx", scan, "dense.pcd", full)
    assert said.returncode == 0, said.stderr
    session = onnxruntime.InferenceSession(folder / "model.onnx")
    points = np.fromfile(folder / "scan.bin", np.float32).reshape(-1, 4)
    completed, measured = session.run(["completed", "measured"], {"points": points})
    found = read_points(folder / "dense.pcd")
    assert np.abs(found.xyz - completed[:, :3]).max() < 1e-3
    np.testing.assert_allclose(found.reflectance, float(full) * completed[:, 3], atol=1e-3)
    table = np.fromfile(folder / "dense.pcd", np.uint8)[-17 * len(completed) :].reshape(-1, 17)
    np.testing.assert_array_equal(table[:, 16].astype(bool), measured)
    assert f"{len(points)} points to {len(completed)} in" in said.stdout


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no PCD header"),
        (b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n", "no field z"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary\n1234", "fewer points"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2\n", "too few numbers"),
    ],
)
def test_other_files_are_refused_in_a_line(content, words, folder):
    (folder / "bad.pcd").write_bytes(content)
    said = run(folder, "model.onnx", "bad.pcd", "bad-dense.pcd")
    assert said.returncode == 2
    assert said.stderr.startswith("bad.pcd: ")
    assert words in said.stderr
    assert not (folder / "bad-dense.pcd").exists()


def test_a_scan_without_points_in_view_stays_empty(folder):
    np.full((5, 4), np.nan, np.float32).tofile(folder / "nan.bin")
    said = run(folder, "model.onnx", "nan.bin", "none.pcd")
    assert "5 points to 0 in" in said.stdout
