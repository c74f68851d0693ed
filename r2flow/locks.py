"""Files that one process holds, among several at work in one folder."""

from contextlib import suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows has no flock: nobody is kept out there
    fcntl = None  # type: ignore[assignment]


class Lock:
    """A file that one process holds; the system lets go of it when that process ends, however it ends.

    Raises:
        BlockingIOError: another holds it, and `wait` is false.
    """

    def __init__(self, path: Path, wait: bool = False) -> None:
        self.file = _appended(path)
        if fcntl is None:
            return
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            self.file.close()
            raise
        except OSError:  # a file system without locks: likewise
            pass

    def release(self) -> None:
        # Said explicitly: a worker process that was forked meanwhile holds the file, too.
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(self.file, fcntl.LOCK_UN)
        self.file.close()


def _appended(path: Path) -> IO[bytes]:
    while True:
        path.parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):  # another process may have finished, and cleared the folder away
            return open(path, "ab")
