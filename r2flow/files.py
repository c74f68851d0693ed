"""Output files: a reader finds the old file or the whole new one, and devices, pipes and links stay what they are."""

import errno
import json
import os
import secrets
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
    path.parent.mkdir(parents=True, exist_ok=True)
    target = Path(os.path.realpath(path))
    folder = Path(tempfile.gettempdir()) if is_stream else target.parent
    temporary = folder / f".{target.name}.{secrets.token_hex(4)}.part"
    # A file's name may be part of a text, and need not be UTF-8.
    encoding, errors = (None, None) if "b" in mode else ("utf-8", "backslashreplace")
    try:
        with open(temporary, mode.replace("w", "x"), encoding=encoding, errors=errors) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if is_stream:
            with open(temporary, "rb") as whole, open(path, "wb") as stream:
                shutil.copyfileobj(whole, stream)
        else:
            os.replace(temporary, target)
            _sync_folder(folder)
    except OSError as error:
        if error.errno is None:  # numpy's, of fewer bytes written than there are
            error = OSError(errno.ENOSPC, f"cannot be written whole, is there room? ({error})")
        named = str(error.filename or "")
        if not named or named.endswith(".part"):  # a full disk names no file, a read-only folder the temporary one
            error.filename = str(path)
        raise error
    finally:
        with suppress(OSError):
            temporary.unlink()


def save_array(path: str | Path, array: np.ndarray) -> None:
    """Write a .npy, whole or not at all."""
    with atomic_write(path) as file:
        np.save(file, array)


def parse_json(text: str) -> Any:
    """What a text of JSON says; a ValueError if it is not JSON or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: Path) -> Any:
    """What a file of JSON says; raises as `parse_json`."""
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


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":  # folders cannot be opened for syncing there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cache_folder(variable: str, name: str = "") -> Path:
    """The folder that an environment variable names; else `name` in r2flow's folder of the user's cache."""
    if named := os.environ.get(variable):
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "r2flow", name).expanduser()
