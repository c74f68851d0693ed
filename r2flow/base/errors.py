"""Errors of user input, their messages, and output streams."""

import errno
import io
import logging
import os
import re
import reprlib
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)

_LONGEST = 4000  # characters of a message
IN_MEMORY = "points in memory"  # the name of points without a file


class InputError(ValueError):
    """Unusable input of the user.

    The message is one line: what was wrong, what was found, what to do. The command line prints it
    without a traceback and exits with 2; any other exception is a bug and keeps its traceback.
    """


def check(holds: object, message: str) -> None:
    """Raise an InputError unless a condition holds; `files.reading` adds the file's name."""
    if not holds:
        raise InputError(message)


_short = reprlib.Repr()
_short.maxstring = _short.maxother = 120
_short.maxlong = 40


def quoted(value: object) -> str:
    """A value of the user in a message, cut: those of files can be of any size."""
    return _short.repr(value)[:200]


def require(what: str, extra: str, *packages: str) -> None:
    """Raise InputError with the extra to install if a package is missing."""
    for package in packages:
        check(
            find_spec(package),
            f"{what} needs the package {package}: python -m pip install 'r2flow[{extra}]'.",
        )


# System errors that are no fault of files, disks or limits: they keep their traceback.
_BUGS = (ConnectionError, TimeoutError, ChildProcessError, ProcessLookupError)


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Prefix the message of an InputError with the name of a file, unless it begins with it."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise type(error)(f"{path}: {error}") from None


# What the command line calls an argument, and what Python does.
_IN_PYTHON = (
    (r"data\.reading\.\w+=\S+, that of its part of data\.parts, or ", ""),
    (r"--reflectance-scale ([\d.e+]*[\de])", r"reflectance_scale=\1"),
    (r"--columns ([\w,]+=?\w+)", r"columns=['\1']"),
    (r"--from, in Python by sensor", "sensor"),
    (r"--(\w+)-?(\w*)", r"\1_\2"),
)


@contextmanager
def in_python() -> Iterator[None]:
    """Errors name arguments of Python instead of options of the command line."""
    try:
        yield
    except InputError as error:
        text = str(error)
        for option, argument in _IN_PYTHON:
            text = re.sub(option, argument, text)
        raise type(error)(text.replace("columns_", "columns")) from None


_warned: set[tuple[Path, str]] = set()  # folders and kinds of odd values


def warn_odd(path: Path, kind: str, points: int = 0) -> None:
    """Warn about odd values of a file, once per folder and kind in a process; points in memory
    count as a folder.
    """
    folder = path if path.name == IN_MEMORY else path.parent
    if (folder, kind) not in _warned:
        _warned.add((folder, kind))
        number = f" ({points:,} points; reported once per folder)" if points else ""
        _log.warning("%s: %s%s", path, kind, number)


def explain_mistake(error: InputError | OSError) -> str:
    """One line for an InputError or a system error that a user can fix; raises others."""
    if isinstance(error, OSError):
        if error.errno is None or isinstance(error, _BUGS):
            raise error
        where = f"{error.filename}: " if error.filename else ""
        return one_line(f"{where}{error.strerror or error}")
    text = str(error)
    if "Traceback (most recent call last)" in text:
        # From a loader's worker, with the message at the end.
        text = text.rpartition("InputError: ")[2]
    return one_line(text) or "unknown"


def one_line(text: str) -> str:
    """Make a text with file names one printable line, cut in the middle if it is very long."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return printable("\\n".join(text.strip().splitlines()))


def printable(text: str) -> str:
    """Escape control characters and bytes that are not UTF-8, as in file names."""
    safe = {c for c in text if c == "\n" or unicodedata.category(c)[0] != "C"}
    return "".join(c if c in safe else c.encode("unicode_escape").decode() for c in text)


class PlainFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class Unbroken(io.FileIO):
    """A file descriptor that can be written to after its reader, terminal or disk room is gone."""

    # Of standard output, if it was not the end of its reader (`| head`).
    lost: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if self.fileno() == 1 and error.errno not in (errno.EPIPE, errno.EIO):
                Unbroken.lost = OSError(error.errno, error.strerror, "standard output")
            with open(os.devnull, "wb") as null:
                os.dup2(null.fileno(), self.fileno())
            return len(data)


# Of names, in results: sequences that a terminal obeys, but for rich's colours; marks of direction.
_OBEYED = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]|\x1b(?!\[[\d;]*m)"
)


class Harmless(io.TextIOWrapper):
    """A text stream that escapes control characters, but for line ends and, of rich on a terminal,
    colours.
    """

    def write(self, text: str) -> int:
        if not self.isatty():
            text = text.replace("\x1b", r"\x1b")
        return super().write(_OBEYED.sub(lambda found: printable(found[0]), text))


def open_streams() -> None:
    """Make standard output and error accept any file name, outlive their reader, exist in a daemon
    and have a width.
    """
    if os.environ.get("COLUMNS") == "0":  # rich would print nothing
        del os.environ["COLUMNS"]
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (open until exit)
        elif stream is getattr(sys, f"__{name}__"):
            stream.flush()
            raw = io.BufferedWriter(Unbroken(stream.fileno(), "w", closefd=False))
            lines = name == "stderr" or stream.isatty()
            kind = Harmless if name == "stdout" else io.TextIOWrapper
            text = kind(raw, stream.encoding, "backslashreplace", line_buffering=lines)
            setattr(sys, name, text)
