import sys

import pytest

from r2flow.progress import Bar, track


def test_a_bar_goes_to_standard_error_with_count_unit_and_note(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    monkeypatch.setenv("COLUMNS", "120")
    with Bar("sampling", 4, "scans", shown=True) as bar:
        bar(2)
        bar()
        bar.set(note="12 evaluations")
    shown = capsys.readouterr()
    assert shown.out == ""
    for words in ("sampling", "3/4", "scans", "12 evaluations"):
        assert words in shown.err


@pytest.mark.parametrize("items", [[3, 1, 2], range(5), (n for n in (1, 2))])
def test_track_gives_every_item_once_and_shows_nothing_without_a_terminal(items, capsys):
    expected = [1, 2] if not hasattr(items, "__len__") else list(items)
    assert list(track(items, "reading", total=len(expected))) == expected
    assert capsys.readouterr() == ("", "")


def test_without_a_terminal_there_is_a_line_every_half_minute(capsys, monkeypatch):
    now = 100.0
    monkeypatch.setattr("r2flow.progress.time.monotonic", lambda: now)
    with Bar("completing", 300, "scans") as bar:
        bar.set(100)  # of an earlier run
        for _ in range(8):
            now += 10.0
            bar(5)
    shown = capsys.readouterr()
    assert shown.out == ""
    # 15 scans in 30 s leave 185 for 6 min 10 s; 30 in 60 s leave 170 for 5 min 40 s
    assert shown.err.splitlines() == [
        "completing 115/300 scans  0.50/s  6:10 left",
        "completing 130/300 scans  0.50/s  5:40 left",
    ]


def test_several_processes_write_lines_on_a_terminal_too(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    now = 100.0
    monkeypatch.setattr("r2flow.progress.time.monotonic", lambda: now)
    with Bar("process 2 of 8: drawing", 64, "pairs", lines=True) as bar:
        for done in (16, 32):
            now += 40.0
            bar.set(done)
    assert capsys.readouterr() == ("", "process 2 of 8: drawing 32/64 pairs  0.40/s  1:20 left\n")


def test_work_goes_on_where_standard_error_was_closed(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert list(track([1, 2], "reading")) == [1, 2]
