"""Atomic writing of files, and safe reading of JSON."""

import errno
import fcntl
import json
import os
import re
import secrets
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

from r2flow.base.errors import InputError, check, naming, quoted

# Names of `atomic_write`'s temporary files and of `Store`'s locks.
_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{8}\.part|\..+-\d{6}\.lock", re.DOTALL)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a temporary file that replaces `path` when the block ends without an error.

    It is flushed to the disk before the rename and the folder after it: a reader, or a power cut,
    finds the old file or the whole new one. A link stays, and its target is written. The temporary
    file is locked while it is written: `clear_leftovers` removes those of killed processes.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # the rename would replace a device or a pipe
        kind = "a folder" if path.is_dir() else "not a regular file"
        raise InputError(f"{path} is {kind}; name a file to write to.")
    path.parent.mkdir(parents=True, exist_ok=True)
    target = Path(os.path.realpath(path))
    temporary = None
    try:
        temporary, opened = _temporary(target)
        with opened as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, target)
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        if error.errno is None:  # numpy's error of an incomplete write
            error = OSError(errno.ENOSPC, f"cannot be written whole, is there room? ({error})")
        name = str(error.filename or "")
        # errors of full disks have no name, of read-only folders the temporary
        if not name or name.endswith(".part"):
            error.filename = str(path)
        raise error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def _temporary(target: Path) -> tuple[Path, IO[bytes]]:
    """A new file beside a target, open and locked."""
    while True:
        path = target.parent / f".{target.name}.{secrets.token_hex(4)}.part"
        file = open(path, "xb")  # noqa: SIM115, the caller closes it
        locked(file.fileno(), fcntl.LOCK_SH)
        if os.fstat(file.fileno()).st_nlink:  # not cleared by another process before the lock
            return path, file
        file.close()


def locked(descriptor: int, kind: int) -> bool:
    """Whether a lock of an open file or folder (`fcntl.flock`) was taken; it ends with its process.
    Where the file system has no locks, it was.
    """
    try:
        fcntl.flock(descriptor, kind)
    except BlockingIOError:
        return False
    except OSError:  # no locks, as on some network disks
        return True
    return True


def clear_leftovers(folder: Path) -> None:
    """Remove temporary files of `atomic_write` and locks of `Store` that killed processes left in a
    folder; hidden files of others stay.
    """
    for leftover in folder.glob(".*"):
        if not _LEFTOVER.fullmatch(leftover.name):
            continue
        with suppress(OSError), open(leftover, "rb") as file:
            if locked(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB):
                leftover.unlink()


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written to or created, before any work; with a manifest it may
    be complete. Clears what killed commands left in it.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    usable = there.is_dir() and (
        (folder / "manifest.json").is_file() or os.access(there, os.W_OK | os.X_OK)
    )
    check(usable, f"{there} is not a folder that can be written to; give another one.")
    clear_leftovers(folder)


def write_file(path: str | Path, content: str | bytes) -> None:
    """Write a whole file atomically."""
    if isinstance(content, str):  # it may contain file names that are not UTF-8
        content = content.encode(errors="backslashreplace")
    with atomic_write(path) as file:
        file.write(content)


def save_array(path: str | Path, array: np.ndarray) -> None:
    """Write a .npy file atomically."""
    with atomic_write(path) as file:
        np.save(file, array)


def read_json(path: Path) -> Any:
    """Read a JSON file; raises ValueError if it is invalid or nested too deeply."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


_DEEPEST = 50  # levels of a YAML document
_BEGINS = (
    yaml.FlowSequenceStartToken,
    yaml.FlowMappingStartToken,
    yaml.BlockSequenceStartToken,
    yaml.BlockMappingStartToken,
)
_ENDS = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)


def parse_yaml(text: str, most_aliases: int = 0) -> Any:
    """Plain values of a YAML document.

    Raises:
        InputError: it has more aliases, as nested ones can stand for any size, or a key twice, or
            is nested deeply, which takes long to read.
    """
    aliases = depth = 0
    for token in yaml.scan(text):
        aliases += isinstance(token, yaml.AliasToken)
        depth += isinstance(token, _BEGINS) - isinstance(token, _ENDS)
        check(
            aliases <= most_aliases,
            "it has aliases (*NAME), which can stand for any size: write them out.",
        )
        check(depth <= _DEEPEST, f"it is nested more than {_DEEPEST} deep.")
    return yaml.load(text, _OneOfEachKey)


class _OneOfEachKey(yaml.SafeLoader):
    """YAML lets the last of equal keys win; here they are an error."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        counts = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for name, count in counts.items():
            check(count == 1, f"it has the key {quoted(name)} {count} times.")
        return super().construct_mapping(node, deep)


@contextmanager
def reading(path: Path, largest: int, what: str = "file", least: int = 1) -> Iterator[None]:
    """Read a regular file of `least` to `largest` bytes: every error becomes an InputError that
    names it.
    """
    with reading_errors(path):
        # reading a pipe or a device may never end
        size = path.stat().st_size if path.is_file() else None
        if not path.exists():
            raise InputError(f"{path} does not exist, or is a broken link. Is the path right?")
        if size is None:
            kind = (
                f"a folder, not a {what}; name a file in it"
                if path.is_dir()
                else "not a regular file"
            )
            raise InputError(f"{path} is {kind}.")
        refuse_pointer(path)
        if size < least:
            raise InputError(f"{path} is empty ({size} bytes); fetch or write it again.")
        if size > largest:
            most = f"{largest / 2**30:g} GiB" if largest >= 2**30 else f"{largest / 2**20:g} MiB"
            raise InputError(
                f"{path} has {size:,} bytes, too many for a {what} (at most {most}). "
                "Is it another file?"
            )
        yield


def refuse_pointer(path: Path) -> None:
    """Refuse the pointer to a file that Git keeps elsewhere."""
    if path.stat().st_size > 1024:  # files are opened once
        return
    start = path.read_bytes()
    if start.startswith(b"version https://git-lfs"):
        raise InputError(f"{path} is a Git LFS pointer, not the file itself: git lfs pull.")
    if b"/annex/objects/" in start[:32]:
        raise InputError(f"{path} is a git-annex pointer, not the file itself: git annex get.")


@contextmanager
def reading_errors(path: Path) -> Iterator[None]:
    """Turn every error of a reader into an InputError of one line with the file's name."""
    try:
        with naming(path):
            yield
    except InputError:
        raise
    except OSError as error:
        # pyarrow's messages have several lines.
        reason = " ".join(str(error.strerror or error).split())
        raise InputError(f"{path} cannot be read: {reason}.") from None
    except MemoryError:
        raise InputError(f"{path} cannot be read: it needs more memory than is free.") from None
    except ImportError as error:
        raise InputError(f"{path} cannot be read: a package is broken ({error}).") from error
    # NumPy, laspy, pyarrow and their decoders raise many kinds on damaged files
    except BaseException as error:
        # Rust decoders
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:160].rstrip('.')}"
        raise InputError(
            f"{path} is not a readable {path.suffix} file ({reason}). Is it damaged?"
        ) from error


def cache_folder(variable: str, name: str = "") -> Path:
    """Folder in an environment variable; default: `name` in r2flow's folder of the user's cache."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "r2flow", name)
    return Path(os.environ.get(variable) or default).expanduser()
