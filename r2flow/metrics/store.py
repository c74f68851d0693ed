"""What a metric keeps of every scan: rows of numbers in a file, read block by block."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError

KEPT, LEFT_OUT = 1, 2  # flags of a row; 0 where nothing was written


class FeatureStore:
    """A table of float32 rows in a file, one for each scan, written by the scan's number and read memory-mapped.

    Several processes may write, each its own rows, into one folder of a shared file system; what is read does not
    depend on which process wrote a row, nor when. Rows that are not finite are left out.

    In a folder the files stay, and copies of the store share them. Without one they are temporary files without a name,
    which go with the process, however it ends, and a copy of the store copies them.
    """

    def __init__(self, name: str, folder: str | Path | None = None) -> None:
        self.name = name
        self.folder = None if folder is None else Path(folder)
        self._nameless: dict[str, IO[bytes]] = {}
        self._round = 0

    def write(self, first: int, rows: Tensor) -> None:
        """Keep rows (B, D) of the scans `first`, `first + 1`, ...; a row written again is replaced."""
        table = np.ascontiguousarray(rows.detach().cpu().numpy(), dtype=np.float32)
        flags = np.where(np.isfinite(table).all(1), KEPT, LEFT_OUT).astype(np.uint8)
        self._write("rows", first * table.shape[1] * 4, table.tobytes())
        self._write("flags", first, flags.tobytes())

    def __len__(self) -> int:
        """Rows that are kept."""
        return len(self._table()[0])

    def blocks(self, size: int) -> Iterator[tuple[slice, Tensor]]:
        """The kept rows in the order of their scans, at most `size` at a time: their places, and they in float64."""
        index, table = self._table()
        for start in range(0, len(index), size):
            chosen = index[start : start + size]
            yield slice(start, start + len(chosen)), torch.from_numpy(table[chosen].astype(np.float64))

    def tensor(self) -> Tensor:
        """All kept rows, (N, D) float32; mapped from the file where none is missing between them."""
        index, table = self._table()
        whole = len(index) == len(table)
        return torch.from_numpy(np.asarray(table if whole else table[index]))

    def clear(self) -> None:
        """Forget all rows.

        Every round writes new files. In a shared folder those of the last round stay for one more, since another
        process may still be reading them.
        """
        self._round += 1
        self._nameless.clear()
        if self.folder is not None:
            for kind in ("rows", "flags"):
                self._path(kind, self._round - 2).unlink(missing_ok=True)

    def _path(self, kind: str, number: int) -> Path:
        assert self.folder is not None
        return self.folder / f"{self.name}-{number}.{kind}"

    @contextmanager
    def _opened(self, kind: str) -> Iterator[IO[bytes]]:
        """A file of this round, to be read and written."""
        if self.folder is None:
            if kind not in self._nameless:
                self._nameless[kind] = tempfile.TemporaryFile()  # noqa: SIM115 (it lives as long as the store)
            yield self._nameless[kind]
            self._nameless[kind].flush()
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        # Never truncated, never locked: other processes write other parts of it at the same time.
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(self._path(kind, self._round), flags, 0o666), "r+b") as file:
            yield file

    def _write(self, kind: str, offset: int, content: bytes) -> None:
        try:
            with self._opened(kind) as file:
                file.seek(offset)
                file.write(content)
        except OSError as error:
            raise InputError(
                f"the rows of single scans cannot be written to {self.folder or tempfile.gettempdir()}: "
                f"{error.strerror or error}; set TMPDIR to a folder with more room, or measure fewer scans."
            ) from None

    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the kept rows, and all rows."""
        with self._opened("flags") as file:
            file.seek(0)
            kept = np.frombuffer(file.read(), dtype=np.uint8) == KEPT
        if not len(kept):
            return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
        with self._opened("rows") as file:
            width = file.seek(0, os.SEEK_END) // (4 * len(kept))
            # Copy on write: the tensors that torch makes of it may be written to, the file may not.
            return np.flatnonzero(kept), np.memmap(file, np.float32, "c", shape=(len(kept), width))

    def __getstate__(self) -> dict[str, Any]:
        files = {}
        for kind, file in self._nameless.items():
            file.seek(0)
            files[kind] = file.read()
        return {"name": self.name, "folder": self.folder, "round": self._round, "files": files}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["name"], state["folder"])  # type: ignore[misc]
        self._round = state["round"]
        for kind, content in state["files"].items():
            self._write(kind, 0, content)
