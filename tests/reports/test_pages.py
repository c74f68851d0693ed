import json
import math
import re
import struct

import pytest
import torch

import r2flow
from r2flow.reports.figures import STYLES, blank_figure
from r2flow.reports.pages import Page, command, print_text, write_page
from r2flow.reports.tables import Table, print_table, shown

ROWS = [
    {"solver": "euler", "evaluations": 4, "error": 0.5},
    {"solver": "a|b\nc", "evaluations": 8, "error": math.nan, "note": "late"},
]


def page(**changes) -> Page:
    figure = blank_figure(3, 2)
    figure.add_subplot().plot([0, 1], [0, 1], **STYLES[0])
    given = {
        "name": "speed", "title": "How fast", "text": ["First.", Table(ROWS, {"solver": "s|", "error": "RMS"})], "details": ["Last.", Table(ROWS, {"solver": ""}, "All")],
        "rows": ROWS, "figures": {"speed": figure}, "seeds": {"scenes": 3},
    }  # fmt: skip
    return Page(**{**given, **changes})


def test_a_page_is_a_figure_a_json_and_markdown(tmp_path):
    written = write_page(page(), tmp_path / "new")
    assert [path.name for path in written] == ["speed.png", "speed.pdf", "speed.json", "speed.md"]
    assert sorted(tmp_path.joinpath("new").iterdir()) == sorted(written)  # no temporary file stays
    png = written[0].read_bytes()
    assert png.startswith(b"\x89PNG")
    assert struct.unpack(">II", png[16:24]) == (900, 600)  # 3 x 2 inches, 300 dpi


def test_every_file_says_where_it_comes_from(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["train.py", "seed=1"])
    assert command() == "python train.py seed=1"
    monkeypatch.setattr("sys.argv", ["/bin/r2flow", "report", "speed", "a b"])
    for path in write_page(page(), tmp_path):
        content = path.read_bytes().decode("latin-1")
        for words in (
            "r2flow report speed 'a b'",
            torch.__version__,
            r2flow.__version__,
            "threads",
            "scenes",
        ):
            assert words in content, (path.name, words)
        assert str(tmp_path) not in content  # nor any other path of the machine


def test_every_file_holds_the_rows_in_its_own_way(tmp_path):
    write_page(page(more={"paths": [{"values": [1.0, math.inf]}]}), tmp_path)
    content = json.loads((tmp_path / "speed.json").read_text(), parse_constant=pytest.fail)
    assert content["rows"] == [ROWS[0], {**ROWS[1], "error": None}]
    assert content["paths"] == [{"values": [1.0, None]}]
    assert content["origin"]["seeds"] == {"scenes": 3}
    text = (tmp_path / "speed.md").read_text()
    for words in (
        "# How fast\n\n![speed](speed.png)\n\nFirst.\n\n| s\\| |",
        "a\\|b\\nc | - |",
        "Last.\n\n## All\n\n|  |",
        f"\n\n    {command()}\n\n",
    ):
        assert words in text


def test_names_are_no_html_in_markdown_but_a_command_is_whole(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/bin/r2flow", "report", "<b>"])
    rows = [{"solver": "<script>alert(1)</script>"}]
    hostile = page(title="<img src=x>", text=[Table(rows, {"solver": "<i>"})])
    write_page(hostile, tmp_path)
    text = (tmp_path / "speed.md").read_text()
    before, command_line, after = re.split("\n\n    (.*)\n\n", text)
    assert "<" not in before + after
    assert "&lt;script>" in before
    assert "&lt;img" in before
    assert "'<b>'" in command_line


def test_a_page_that_fails_leaves_the_old_one(tmp_path):
    write_page(page(), tmp_path)
    before = {
        path: path.read_bytes()
        for path in tmp_path.iterdir()
        if path.suffix not in (".png", ".pdf")
    }
    with pytest.raises(TypeError):
        write_page(page(rows=[{"solver": object()}]), tmp_path)
    assert {
        path: path.read_bytes()
        for path in tmp_path.iterdir()
        if path.suffix not in (".png", ".pdf")
    } == before


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0123456, "0.0123"), (1.5e-7, "1.5e-07"), (0.0, "0"), (128, "128"), (True, "yes"), (None, ""), ("x", "x"),
     (12345.6, "1.2e+04"), (math.nan, "-"), (math.inf, "inf")],
)  # fmt: skip
def test_values_are_short(value, text):
    assert shown(value) == text


def test_in_the_terminal_numbers_stand_to_the_right_and_nothing_is_cut(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    long = "[1, 2] " + 30 * "long "
    print_table(
        [("x", 1.5, long), ("longer", "12345", "-")], ("name", "RMS", "remark"), title="Errors"
    )
    title, heads, *lines = capsys.readouterr().out.splitlines()
    assert title.strip() == "Errors"
    assert heads.split() == ["name", "RMS", "remark"]
    assert [line.split() for line in lines] == [
        ["x", "1.5", *long.split()],
        ["longer", "12345", "-"],
    ]
    assert lines[0].index("1.5") + 3 == lines[1].index("12345") + 5
    assert lines[0].index("[1, 2]") == lines[1].index("-")


def test_a_long_value_cuts_no_key_and_pads_no_line(capsys):
    print_table([["a.key.of.some.length", "x" * 3000], ["another", 1]], ("", ""))
    assert capsys.readouterr().out.splitlines() == [
        f"a.key.of.some.length  {'x' * 3000}",
        "another               1",
    ]


@pytest.mark.parametrize(
    "draw", [print_table, lambda rows, columns: print_text([Table(rows, columns)])]
)
def test_a_terminal_shows_wide_tables_in_its_width(capsys, monkeypatch, draw):
    monkeypatch.setenv("FORCE_COLOR", "1")  # counts as a terminal
    monkeypatch.setenv("COLUMNS", "60")
    draw([("a long value in words " * 9, 1.5, "b" * 70 + " | c")], ("name", "RMS", "code"))
    plain = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    assert max(map(len, plain.splitlines())) <= 60
    assert plain.count("value") == 9
    assert plain.count("b") == 70
    assert " | c" in plain
    assert "---" not in plain
