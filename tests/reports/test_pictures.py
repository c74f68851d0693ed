from itertools import pairwise

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from r2flow.lidar.labels import CLASSES
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.figures import figure_pixels, save_figure
from r2flow.reports.pictures import STREET, TRUST, _Dots, contact_sheet, scan_figure, trust_ids

SENSOR = SENSORS["hdl64e"].resized(16, 64)
E, A = SENSOR.rays().numpy()


def image(r: np.ndarray) -> np.ndarray:
    return np.stack([r, 0.5 * (r > 0)]).astype(np.float32)


@pytest.mark.parametrize(
    "r",
    [
        np.zeros_like(E),
        np.where((E < -0.3) & (A > 3.0), 5.0, 0.0),
        np.full_like(E, 79.9),
        np.full_like(E, 1.45),
    ],
)
def test_extreme_scans_are_drawn(tmp_path, r):
    for figure in (
        scan_figure(image(r), SENSOR.rays(), "scan"),
        contact_sheet([image(r)[:1]] * 2, SENSOR.rays()),
    ):
        assert save_figure(figure, tmp_path / "scan.png").read_bytes().startswith(b"\x89PNG")


def test_unmeasured_rays_are_white_in_the_first_scan_alone():
    scan, hidden = image(np.full_like(E, 10.0)), E > 0
    figure = contact_sheet([scan[:1], scan], SENSOR.rays(), ["known", "answer"], hidden)
    (white,) = [axes.images[1].get_array() for axes in figure.axes if len(axes.images) == 2]
    assert np.array_equal(white[..., 3], hidden)
    assert (white[hidden] == 1).all()


def test_no_two_legends_of_a_completed_scan_give_a_colour_two_meanings():
    scan, added = image(np.full_like(E, 10.0)), E > 0
    ids = trust_ids(scan, np.where(added, np.linspace(0.01, 2, 64), 0.0))
    figure = contact_sheet([scan, scan], SENSOR.rays(), (), added, [None, ids])
    meanings = {
        (patch.get_facecolor(), patch.get_label())
        for axes in figure.axes
        if axes.get_legend()
        for patch in axes.get_legend().legend_handles
    }
    names = {name for _, name in meanings}
    assert names == {"not measured", "measured, no return", "no return", "measured",
                     "added, up to 0.05 m", "up to 0.2 m", "up to 1 m", "more"}  # fmt: skip
    assert len({colour for colour, _ in meanings}) == len(names) - 1  # black: no return
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles.count("predicted error (68 %)") == 1  # of the second scan alone


def test_every_row_of_a_sensor_is_as_high_in_each_scan_of_a_sheet():
    """Two pixels of a PNG at least; the scan, its answer with classes, and one without."""
    sensor = SENSORS["hdl64e"].resized(128, 64)
    scan = np.full((2, *sensor.shape), 10.0, np.float32)
    ids = [None, np.full(sensor.shape, 40), None]
    images = [scan[:1], scan, scan]
    figure = contact_sheet(images, sensor.rays(), (), scan[0] > 99, ids, ["", "given"])
    boxes = [axes.get_window_extent() for axes in figure.axes if axes.images]
    assert len(boxes) == 1 + 3 + 2
    inches = [box.height / figure.dpi for box in boxes]
    np.testing.assert_allclose(inches, inches[0])
    assert 300 * inches[0] >= 2 * 128
    assert [axes.get_title("left") for axes in figure.axes].count("given") == 1
    assert not any(one.overlaps(other) for one, other in pairwise(boxes))


def test_measured_rows_do_not_blend_with_the_errors_between_them():
    """Rows measured and added in turn: the strip has the colours of errors alone; a sector that
    was measured keeps its own.
    """
    scan = image(np.full_like(E, 10.0))
    error = np.zeros(E.shape)
    error[::2, :40] = 0.1
    error[4, :40] = 0.5
    figure = contact_sheet([scan], SENSOR.rays(), labels=[trust_ids(scan, error)])
    shown = (255 * figure.axes[2].images[0].get_array()).round().astype(int)
    near, far, measured = (
        np.rint(255 * np.array(to_rgba(TRUST[number][1])[:3])) for number in (65002, 65003, 65000)
    )
    assert (shown[:3, :40] == near).all()
    assert (shown[3:6, :40] == far).all()  # the worse of the two rows beside
    assert (shown[6:-1, :40] == near).all()
    assert (shown[:, 42:-2] == measured).all()


def test_classes_of_labelled_scans_have_a_strip_and_a_legend():
    scan = image(np.full_like(E, 10.0))
    road = np.concatenate([scan, (E < 0)[None], scan[1:]])  # class 1 below the horizon
    figure = contact_sheet([scan, road], SENSOR.rays())
    (axes,) = [axes for axes in figure.axes if axes.get_legend()]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["road"]
    dots = [one for axes in figure.axes for one in axes.get_children() if isinstance(one, _Dots)]
    colours = np.array([to_rgba("0.8"), to_rgba(CLASSES[40][1])])[(E < 0).ravel().astype(int)]
    np.testing.assert_allclose(dots[2].colours / 255, colours, atol=1 / 255)  # from above
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles.count("perspective, colour: class") == 1
    assert np.array_equal(axes.images[0].get_array().any(2), E < 0)


def test_a_picture_is_as_wide_as_a_page_and_white(tmp_path, caplog):
    figure = scan_figure(image(np.full_like(E, 10.0)), SENSOR.rays())
    assert figure.get_figwidth() == pytest.approx(7.16)
    assert (figure_pixels(figure)[[0, -1]] == 255).all()
    caplog.set_level("INFO")  # as under Hydra
    pdf = save_figure(figure, tmp_path / "scan.pdf").read_bytes()
    assert not caplog.records
    assert pdf.startswith(b"%PDF")
    assert b"/Type3" not in pdf


@pytest.mark.parametrize(("near", "far"), [(4.0, 60.0), (1.0, 3.0)])  # of a street, of a room
def test_near_and_far_look_different_and_dropped_rays_are_black(near, far):
    half = np.where(A > 0, near, far)
    half[:, 24:40] = 0
    strip = figure_pixels(scan_figure(image(half), SENSOR.rays()))
    row = strip[int(strip.shape[0] * 0.12)].astype(int)  # through the range strip
    left, middle, right = (row[int(len(row) * place)] for place in (0.2, 0.5, 0.8))
    assert middle.max() < 30
    assert left[0] > left[2]  # near is warm
    assert right[2] > right[0]  # far is cold


@pytest.mark.parametrize("distance", [20.0, 2.0])
def test_a_wall_on_the_left_is_drawn_on_the_left(distance):
    wall = np.where((A > 1.2) & (A < 1.9), distance, 0.0)
    pixels = figure_pixels(figure := scan_figure(image(wall), SENSOR.rays()))
    (axes,) = (axes for axes in figure.axes if axes.get_title("left").startswith("bird's-eye"))
    box, (height, width) = axes.get_position(), pixels.shape[:2]
    left, right, top, bottom = (
        box.x0 * width,
        box.x1 * width,
        (1 - box.y1) * height,
        (1 - box.y0) * height,
    )
    drawn = (pixels[int(top) + 4 : int(bottom) - 4, int(left) + 4 : int(right) - 4] < 200).any(-1)
    middle = drawn.shape[1] // 2
    assert drawn[:, : middle - 20].sum() > 50
    assert drawn[:, middle + 20 :].sum() == 0


def test_the_fixed_view_is_the_same_for_a_room_and_a_street():
    titles = set()
    for distance in (2.0, 20.0):
        scan = image(np.full_like(E, distance))
        figure = scan_figure(scan, SENSOR.rays(), view=STREET)
        titles.add(tuple(axes.get_title("left") for axes in figure.axes))
    assert len(titles) == 1
