"""Output files: a reader finds the old file or the whole new one, and devices, pipes and links stay what they are."""

import errno
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from r2flow.errors import InputError


@contextmanager
def atomic_write(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file that replaces `path` when the block ends without an error.

    It is flushed to the disk before the rename and the folder after it: a reader, or a power cut, finds the old file or
    the whole new one. A link stays, and its target is replaced. A device or a pipe is written into.

    Raises:
        IsADirectoryError: `path` is a folder.
        InputError: it is a socket, a block device or a link to nothing.
    """
    path = Path(path)
    is_stream = _is_stream(path)
    make_folder(path.parent)
    target = Path(os.path.realpath(path))
    temporary = None
    try:
        handle, temporary = _temporary(target.name, None if is_stream else target.parent)
        # A file's name may be part of a text, and need not be UTF-8.
        encoding, errors = (None, None) if "b" in mode else ("utf-8", "backslashreplace")
        with os.fdopen(handle, mode, encoding=encoding, errors=errors) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if is_stream:
            with open(temporary, "rb") as whole, open(path, "wb") as stream:
                shutil.copyfileobj(whole, stream)
        else:
            os.chmod(temporary, 0o666 & ~_umask())  # mkstemp is private to the user; outputs are not
            os.replace(temporary, target)
            _sync_folder(target.parent)
    except OSError as error:
        if error.errno is None:  # numpy's, of fewer bytes written than there are
            error = OSError(errno.ENOSPC, f"cannot be written whole, is there room? ({error})")
        named = str(error.filename or "")
        if not named or named.endswith(".part"):  # a full disk names no file, a read-only folder the temporary one
            error.filename = str(path)
        raise error
    finally:
        if temporary is not None:
            with suppress(FileNotFoundError):
                os.unlink(temporary)


def save_array(path: str | Path, array: np.ndarray) -> None:
    """Write a .npy, whole or not at all."""
    with atomic_write(path) as file:
        np.save(file, array)


def make_folder(path: Path) -> None:
    """Make a folder where there is none, also where another process removes it at this moment."""
    while True:
        try:
            return path.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            if os.path.lexists(path) and not path.is_dir():
                raise


def _temporary(name: str, folder: Path | None) -> tuple[int, str]:
    """An open temporary file in a folder, which another process that is done with it may have removed meanwhile."""
    for _ in range(20):
        with suppress(FileNotFoundError):
            return tempfile.mkstemp(".part", f".{name}.", folder)
        if folder is not None:
            make_folder(folder)
    return tempfile.mkstemp(".part", f".{name}.", folder)


def parse_json(text: str) -> Any:
    """What a text of JSON says.

    Raises:
        ValueError: it is none, or nested too deeply to be one that was written here.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: Path) -> Any:
    """What a file of JSON says.

    Raises:
        OSError: it cannot be read.
        ValueError: it is none; see `parse_json`.
    """
    return parse_json(path.read_text(encoding="utf-8"))


def refuse_unreadable(path: Path, largest: int, what: str = "file") -> None:
    """Refuse a path that is no regular file, or of 0 or more than `largest` bytes, before it is opened."""
    if path.is_symlink() and not path.exists():
        raise InputError(f"{path} is a link to {path.readlink()}, which does not exist.")
    if not path.exists():
        raise InputError(f"{path} does not exist. Is the path right?")
    if path.is_dir():
        raise InputError(f"{path} is a folder, not a {what}; name a file in it.")
    if not path.is_file():  # reading a pipe would wait for ever, a device never end
        raise InputError(f"{path} is not a regular file.")
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"{path} is empty (0 bytes); fetch or write it again.")
    if size > largest:
        most = f"{largest / 2**30:g} GiB" if largest >= 2**30 else f"{largest / 2**20:g} MiB"
        raise InputError(f"{path} has {size:,} bytes, too many for a {what} (at most {most}). Is it another file?")


def _is_stream(path: Path) -> bool:
    """Whether a path is written into rather than replaced: a character device or a pipe."""
    try:
        kind = path.stat().st_mode
    except FileNotFoundError:
        if path.is_symlink():
            raise InputError(
                f"{path} is a link to {path.readlink()}, which does not exist; remove the link or name another file."
            ) from None
        return False
    if stat.S_ISDIR(kind):
        raise IsADirectoryError(errno.EISDIR, "is a folder; name a file to write to", str(path))
    if stat.S_ISSOCK(kind) or stat.S_ISBLK(kind):
        what = "socket" if stat.S_ISSOCK(kind) else "block device"
        raise InputError(f"{path} is a {what}; name a file to write to.")
    return not stat.S_ISREG(kind)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":  # folders cannot be opened for syncing there
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:  # whoever took the file out of it removed it
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cache_folder(variable: str, name: str = "") -> Path:
    """The folder that an environment variable names; else `name` in r2flow's folder of the user's cache."""
    if named := os.environ.get(variable):
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "r2flow", name).expanduser()
