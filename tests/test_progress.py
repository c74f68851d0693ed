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
