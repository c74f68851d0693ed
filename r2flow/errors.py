"""The exception for mistakes of the user."""

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path


class InputError(ValueError):
    """Something that the user gave cannot be used.

    The message is one line: what was wrong, what was found, what to do. The command line prints it
    without a traceback and exits with 2; any other exception is a defect of ours and keeps its traceback.
    """


def require(what: str, extra: str, *packages: str) -> None:
    """Refuse what needs a package that is not installed, and say which extra of r2flow brings it.

    Raises:
        InputError: one is missing.
    """
    for package in packages:
        if find_spec(package) is None:
            raise InputError(f"{what} needs the package {package}: python -m pip install 'r2flow[{extra}]'.")


# System errors that a user can mend; others (a lost connection, a broken pipe) keep their traceback.
MENDABLE = {
    errno.EACCES, errno.EPERM, errno.ENOENT, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENOTEMPTY,
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Puts a file's name before an InputError about it."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def explain_mistake(error: InputError | OSError) -> str:
    """A mistake in one line: an InputError's own, or what the system refused (a read-only folder, a full disk).

    Raises:
        OSError: the error itself, where a user cannot mend it.
    """
    if isinstance(error, OSError):
        if error.errno not in MENDABLE:
            raise error
        if error.errno in (errno.ENOTDIR, errno.EEXIST) and error.filename:
            named = Path(os.fsdecode(error.filename))
            file = next((path for path in (named, *named.parents) if path.exists() and not path.is_dir()), None)
            if file is not None:
                return one_line(f"{file} is a file, not a folder; give another name.")
        where = f"{error.filename}: " if error.filename else ""
        return one_line(f"{where}{error.strerror or error}")
    text = str(error)
    if "Traceback (most recent call last)" in text:  # of a loader's worker: the line is the last of it
        text = text.rpartition("InputError: ")[2]
    return one_line(text) or "unknown"


def one_line(text: str) -> str:
    """A text of which a file's name may be part, with whatever that holds, as one line that every terminal takes."""
    return "\\n".join(printable(text).strip().splitlines())


def printable(text: str) -> str:
    """A text of which a file's name may be part: bytes of it that are no UTF-8 as \\udcff."""
    return text.encode("utf-8", "backslashreplace").decode()


def print_any_name() -> None:
    """Have standard output take such names, as standard error does."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
