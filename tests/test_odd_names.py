"""Names of files that are no plain words, and a disk that is full."""

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg

from r2flow.base.errors import Harmless, InputError, explain_mistake
from r2flow.base.files import atomic_write
from r2flow.reports.figures import blank_figure, figure_pixels
from tests.conftest import small_disk, write_scan

ODD = [r"a$b$c", r"$\frac$", "a\nb", os.fsdecode(b"caf\xe9"), "ä ß 日", "-x", "a'b\"c"]
NAMES = ["".join(ODD), *(pytest.param(name, marks=pytest.mark.slow) for name in ODD)]


@pytest.mark.parametrize("name", NAMES)
def test_scans_of_any_name_are_drawn_measured_and_prepared(r2flow, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = Path(f"./{name}")
    folder.mkdir()
    for number in range(2):
        write_scan(folder / f"{name}{number}.bin", number)
    for arguments in (
        ("show", folder, "--out=~/views"),
        ("prepare", folder, "-o", "prepared", "--size", "16x64", "--workers", 1),
        (
            "evaluate",
            folder,
            folder,
            "--metrics",
            "jsd",
            "--out",
            "page",
            "--size",
            "16x64",
            "--workers",
            0,
        ),
    ):
        assert r2flow(*[f"./{one}" if one is folder else one for one in arguments]).said
    assert Path("views").is_dir()  # shells leave the ~ of --out=~/views


@pytest.mark.parametrize("name", NAMES)
def test_a_mistake_in_a_scan_of_any_name_is_one_line(r2flow, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(f"./{name}.bin").write_bytes(b"\0" * 30)
    line = r2flow("show", f"./{name}.bin", "-o", "out").refusal
    assert "14 bytes" in line
    assert name.partition("\n")[0].encode("utf-8", "backslashreplace").decode() in line


@pytest.mark.parametrize("name", NAMES)
def test_models_of_any_name_sample(r2flow, saved, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(saved[0].parents[1], f"./{name}")
    assert r2flow("sample", f"./{name}", "-o", f"./{name}/s", "--num", 1, "--steps", 1).said
    assert r2flow("report", "curvature", f"./{name}", "-o", "page", "--num", 1, "--steps", 2).said


def test_a_dollar_in_a_text_is_drawn_as_one():
    def drawn(text: str, parsed: bool) -> np.ndarray:
        with rc_context({"text.usetex": parsed}):  # as a matplotlibrc of an author of papers
            figure = blank_figure(4, 1)
            figure.text(0.1, 0.5, text, parse_math=parsed)
            return figure_pixels(figure)

    np.testing.assert_array_equal(drawn("a$b$c", True), drawn("a$b$c", False))
    ours, usual = figures = [blank_figure(4, 3) for _ in range(2)]
    for figure in figures:
        figure.subplots().set(xscale="log", xlim=(1, 1e4))
    canvas = FigureCanvasAgg(usual)
    canvas.draw()
    np.testing.assert_array_equal(
        figure_pixels(ours, int(ours.dpi)), np.asarray(canvas.buffer_rgba())[..., :3]
    )


def test_a_full_disk_is_one_line_that_names_the_file(tmp_path: Path):
    raised = pytest.raises(OSError, match="cannot be written whole")
    with small_disk(10_000), raised as caught, atomic_write(tmp_path / "a.npy") as file:
        np.save(file, np.zeros((2, 64, 1024), np.float32))
    assert explain_mistake(caught.value).startswith(
        f"{tmp_path / 'a.npy'}: cannot be written whole"
    )
    assert list(tmp_path.iterdir()) == []


def test_a_newline_in_a_name_does_not_eat_the_line():
    assert explain_mistake(InputError("a\nb.bin is empty.")) == r"a\nb.bin is empty."
    assert explain_mistake(OSError(5, "Input/output error", "a\nb")) == r"a\nb: Input/output error"
    # nor does it control the terminal
    assert explain_mistake(InputError("a\033[31mb")) == r"a\x1b[31mb"
    of_a_worker = "Caught InputError in DataLoader worker process 0.\nOriginal Traceback (most recent call last):\n"
    of_a_worker += '  File "x", line 1\nr2flow.base.errors.InputError: a\nb.bin is empty.\n'
    assert explain_mistake(InputError(of_a_worker)) == r"a\nb.bin is empty."


@pytest.mark.parametrize(
    ("terminal", "bold", "end"),
    [(True, "\033[1m", "\033[0m"), (False, r"\x1b[1m", r"\x1b[0m")],
)
def test_names_in_results_do_not_control_the_terminal(monkeypatch, terminal, bold, end):
    raw = io.BytesIO()
    monkeypatch.setattr(Harmless, "isatty", lambda self: terminal)
    stream = Harmless(raw, "utf-8", line_buffering=True)
    stream.write("a\033]0;title\007b\033[2Jc\x9b5nd\033[1mbold\033[0m ä\t\u202egnp.bin\n")
    plain = r"a\x1b]0;title\x07b\x1b[2Jc\x9b5nd" + f"{bold}bold{end} ä\t\\u202egnp.bin\n"
    assert raw.getvalue().decode() == plain
