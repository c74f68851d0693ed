import csv
import json
import math
import struct

import pytest
import torch

import r2flow
from r2flow.errors import InputError
from r2flow.reports.pages import STYLES, Page, blank_figure, prepare_folder, write_page
from r2flow.reports.pictures import figure_pixels
from r2flow.reports.tables import table

ROWS = [
    {"solver": "euler", "evaluations": 4, "error": 0.5},
    {"solver": "a|b, c", "evaluations": 8, "error": math.nan, "note": "late"},
]


def page(**changes) -> Page:
    figure = blank_figure(3, 2, "title")
    figure.add_subplot().plot([0, 1], [0, 1], **STYLES[0])
    given = {
        "name": "speed", "title": "How fast", "text": ["First.", table(ROWS, {"solver": "solver", "error": "RMS"})],
        "rows": ROWS, "figures": {"speed": figure}, "command": "r2flow report speed 'a b'", "seeds": {"scenes": 3},
    }  # fmt: skip
    return Page(**{**given, **changes})


def test_a_page_is_a_figure_a_csv_a_json_and_markdown(tmp_path):
    written = write_page(page(), tmp_path / "new")
    assert [path.name for path in written] == ["speed.png", "speed.csv", "speed.json", "speed.md"]
    assert sorted(tmp_path.joinpath("new").iterdir()) == sorted(written)  # no temporary file stays
    png = written[0].read_bytes()
    assert png.startswith(b"\x89PNG")
    assert struct.unpack(">II", png[16:24]) == (300, 200)


def test_every_file_says_where_it_comes_from(tmp_path):
    for path in write_page(page(), tmp_path):
        content = path.read_bytes().decode("latin-1")
        for words in ("r2flow report speed 'a b'", torch.__version__, r2flow.__version__, "threads", "scenes"):
            assert words in content, (path.name, words)
        assert str(tmp_path) not in content  # nor any other path of the machine


def test_the_csv_reads_back(tmp_path):
    write_page(page(), tmp_path)
    lines = (tmp_path / "speed.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert rows[0] == {"solver": "euler", "evaluations": "4", "error": "0.5", "note": ""}
    assert rows[1]["solver"] == "a|b, c"


def test_the_json_is_strict_and_whole(tmp_path):
    write_page(page(more={"paths": [{"values": [1.0, math.inf]}]}), tmp_path)

    def refuse(constant):
        raise AssertionError(constant)

    content = json.loads((tmp_path / "speed.json").read_text(), parse_constant=refuse)
    assert content["rows"] == [ROWS[0], {**ROWS[1], "error": None}]
    assert content["paths"] == [{"values": [1.0, None]}]
    assert content["origin"]["seeds"] == {"scenes": 3}
    assert content["origin"]["machine"]["cores"] >= 1


def test_the_markdown_shows_the_figure_the_text_and_the_command(tmp_path):
    write_page(page(), tmp_path)
    text = (tmp_path / "speed.md").read_text()
    for words in (
        "# How fast\n",
        "![speed](speed.png)",
        "First.",
        "| a\\|b, c | - |",
        "```\nr2flow report speed 'a b'\n",
    ):
        assert words in text


def test_a_page_that_fails_leaves_the_old_one(tmp_path):
    write_page(page(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir() if path.suffix != ".png"}
    with pytest.raises(TypeError):
        write_page(page(rows=[{"solver": object()}]), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.suffix != ".png"} == before


def test_a_figure_is_as_wide_as_its_title():
    figure = blank_figure(2, 2, "Each metric's first figure, generated scans and real ones")
    figure_pixels(figure)
    title = figure.texts[0].get_window_extent()
    assert 0 <= title.x0 < title.x1 <= figure.bbox.width


def test_a_folder_that_cannot_be_one_is_refused_before_anything_is_measured(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"file is a file, not a folder; give another name"):
        prepare_folder(tmp_path / "file" / "reports")
    assert prepare_folder(tmp_path / "a" / "b").is_dir()
