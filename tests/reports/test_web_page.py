"""The page of `r2flow export --to web` in headless Chromium, served as a folder. `pytest -m browser`."""

import json
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from r2flow import load
from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.reports.web import write_web
from tests.reports.test_view_in_browser import chromium  # noqa: F401

pytestmark = pytest.mark.browser


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("onnxruntime", reason="the extra 'export'")
    if shutil.which("npm") is None:
        pytest.skip("no npm is installed, which fetches onnxruntime-web")
    folder = tmp_path_factory.mktemp("web") / "try"
    write_web(load("densify_small"), folder, ["vlp16"])
    return folder


@pytest.fixture
def page(folder, chromium):  # noqa: F811
    """The page, which asks for nothing beyond its folder."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    home = f"http://127.0.0.1:{server.server_port}"
    context = chromium.new_context(viewport={"width": 1200, "height": 900})
    shown = context.new_page()
    errors, requests = [], []
    shown.on("pageerror", lambda error: errors.append(str(error)))
    shown.on("request", lambda request: requests.append(request.url))
    shown.goto(home)
    shown.wait_for_selector("html[data-ready]", state="attached", timeout=60_000)
    yield shown
    context.close()
    server.shutdown()
    assert not errors
    assert all(url.startswith((home, "data:", "blob:", "about:")) for url in requests), requests


def answered(page) -> str:
    page.wait_for_selector("html[data-done], #trouble:not([hidden])", timeout=120_000)
    return page.inner_text("#trouble") if page.is_visible("#trouble") else ""


def expected(folder, points):
    import onnxruntime

    session = onnxruntime.InferenceSession(folder / "vlp16.onnx")
    return session.run(["completed", "measured", "error_68"], {"points": points})


@pytest.mark.parametrize("ending", ["bin", "pcd", "ply", "ascii.pcd", "csv"])
def test_a_dropped_scan_is_completed_as_in_python(ending, folder, page, tmp_path):
    points = np.fromfile(folder / "example.bin", np.float32).reshape(-1, 4)
    path = tmp_path / f"scan.{ending}"
    if ending == "csv":
        rows = [",".join(map(repr, row)) for row in points.tolist()]
        path.write_text("\n".join(["x,y,z,intensity,ring", *(f"{row},7" for row in rows)]))
    elif ending == "ascii.pcd":
        head = f"FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {len(points)}\n"
        rows = [" ".join(map(repr, row)) for row in points.tolist()]
        path.write_text("\n".join([f"{head}DATA ascii", *rows]))
    else:
        write_points(path, points[:, :3], points[:, 3])
    page.set_input_files("#file", path)
    assert answered(page) == ""
    completed, measured, error = expected(folder, points)
    added = int((~measured).sum())
    said = page.inner_text("#status")
    assert f"{measured.sum():,} measured points in view, {added:,} added" in said
    assert ("ring" in said) == (ending == "csv")
    assert page.get_attribute("html", "data-done") == str(added)
    with page.expect_download() as download:
        page.click("[data-format=ply]")
    saved = tmp_path / "saved.ply"
    download.value.save_as(saved)
    found = read_points(saved)
    np.testing.assert_allclose(found.xyz, completed[:, :3], atol=1e-3)
    np.testing.assert_allclose(found.reflectance, completed[:, 3], atol=1e-3)
    stored = np.dtype([("point", "<f4", 4), ("error", "<f4"), ("measured", "u1")])
    rows = np.frombuffer(saved.read_bytes()[-stored.itemsize * len(completed) :], stored)
    np.testing.assert_array_equal(rows["measured"], measured)
    np.testing.assert_allclose(rows["error"], error, rtol=0.01, atol=1e-3)


def test_the_view_shows_measured_and_added_points_by_their_predicted_errors(folder, page):
    page.click("#example")
    assert answered(page) == ""
    frame = page.frames[1]
    frame.wait_for_selector("html[data-ready]", state="attached", timeout=60_000)
    captions = [one.inner_text() for one in frame.query_selector_all("figcaption span")]
    assert captions == ["your scan", "completed"]
    frame.click("text=predicted error")
    legend = [one.inner_text() for one in frame.query_selector_all("#legend span")]
    kinds = ["measured", "added, up to 0.05 m", "up to 0.2 m", "up to 1 m", "more"]
    assert legend[1:6] == kinds
    points = np.fromfile(folder / "example.bin", np.float32).reshape(-1, 4)
    _, measured, error = expected(folder, points)
    counts = frame.evaluate(
        """async () => {
          const { scans } = window.view.page;
          return Promise.all(scans.map(async ({ frames: [text] }) => {
            const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
            const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
            const plain = new Uint8Array(await new Response(stream).arrayBuffer());
            const classes = plain.subarray(plain.length - plain.length / 4);
            return [0, ...window.view.page.trust.steps, Infinity].map(
              (_, kind) => classes.filter((one) => one === kind).length);
          }));
        }"""
    )
    own, completed = counts
    assert own == completed
    own[0] -= sum(own) - len(measured)  # rays without a point have the number of measured ones
    assert own[0] == measured.sum()
    bounds = [0, *frame.evaluate("() => window.view.page.trust.steps"), np.inf]
    added, _ = np.histogram(error[~measured], bounds)
    # errors in the browser differ in their last digits
    slack = [(np.abs(error - bound) < 1e-3).sum() for bound in bounds[1:-1]]
    assert (np.abs(np.cumsum(own[1:-1]) - np.cumsum(added)[:-1]) <= slack).all()
    assert sum(own[1:]) == (~measured).sum()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.bin", b"", "is empty"),
        ("a.bin", b"12345", "rows of four float32"),
        ("a.pcap", b"12345", "is not read here"),
        ("a.csv", b"x,y\n1,2\n", "no field z"),
        ("a.pcd", b"FIELDS x y z\nDATA ascii\n", "no points"),
        ("a.ply", b"nothing", "no header"),
        ("a.bin", np.zeros((200, 4), "f4").tobytes(), "Fewer than 100"),
        ("a.bin", np.ones((4_000_001, 4), "f4").tobytes(), "more than one scan"),
    ],
)
def test_other_files_are_refused_in_a_line(name, content, words, page, tmp_path):
    (tmp_path / name).write_bytes(content)
    page.set_input_files("#file", tmp_path / name)
    said = answered(page)
    assert said.startswith(f"{name}: ")
    assert words in said
    assert not page.is_visible("#save")


def test_a_scan_of_another_sensor_is_asked_for(page, tmp_path):
    sphere = np.random.default_rng(0).normal(size=(9000, 3))
    sphere[:, 2] /= 4
    points = 9 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    write_points(tmp_path / "livox.bin", points, points[:, 0] * 0)
    page.set_input_files("#file", tmp_path / "livox.bin")
    assert "beams of none of these sensors" in answered(page)
    page.select_option("#sensor", "vlp16")
    assert answered(page) == ""


def test_a_folder_that_exists_is_not_written_to(folder):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    with pytest.raises(InputError, match="exists"):
        write_web(load("densify_small"), folder)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    models = json.loads((folder / "models.json").read_text())["models"]
    assert [model["name"] for model in models] == ["vlp16"]
