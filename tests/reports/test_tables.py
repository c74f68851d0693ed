import math

import pytest

from r2flow.reports.tables import print_table, shown, table

ROWS = [{"name": "a|b", "error": 0.12345, "steps": 4}, {"name": "c", "error": math.nan}]
COLUMNS = {"name": "solver", "error": "RMS"}


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0123456, "0.0123"), (1.5e-7, "1.5e-07"), (0.0, "0"), (128, "128"), (True, "yes"), (None, ""), ("x", "x"),
     (12345.6, "1.2e+04"), (math.nan, "-"), (math.inf, "inf")],
)  # fmt: skip
def test_values_are_short(value, text):
    assert shown(value) == text


def test_rows_are_markdown_by_key_or_in_order():
    text = "| solver | RMS |\n|---|---|\n| a\\|b | 0.123 |\n| c | - |"
    assert table(ROWS, COLUMNS) == text
    assert table([("a|b", 0.12345), ("c", math.nan)], ["solver", "RMS"]) == text


def test_in_the_terminal_numbers_stand_to_the_right_and_nothing_is_cut(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    long = "[1, 2] " + 30 * "long "
    print_table([("x", 1.5, long), ("longer", "12345", "-")], ("name", "RMS", "remark"), title="Errors")
    title, heads, *lines = capsys.readouterr().out.splitlines()
    assert title.strip() == "Errors"
    assert heads.split() == ["name", "RMS", "remark"]
    assert [line.split() for line in lines] == [["x", "1.5", *long.split()], ["longer", "12345", "-"]]
    assert lines[0].index("1.5") + 3 == lines[1].index("12345") + 5
    assert lines[0].index("[1, 2]") == lines[1].index("-")


def test_a_long_value_cuts_no_key_and_pads_no_line(capsys):
    print_table([["a.key.of.some.length", "x" * 3000], ["another", 1]], ("", ""))
    assert capsys.readouterr().out.splitlines() == [f"a.key.of.some.length  {'x' * 3000}", "another               1"]
