"""What a metric keeps of every scan: rows of numbers in a file, read block by block."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError

KEPT, LEFT_OUT = 1, 2  # flags of a row; 0 where nothing was written


class FeatureStore:
    """A table of float32 rows in a file, one for each scan, written by the scan's number and read memory-mapped.

    Several processes may write, each its own rows, into one folder of a shared file system; what is read does not
    depend on which process wrote a row, nor when. Rows that are not finite are left out.

    In a folder the files stay, and copies of the store share them. Without one they lie in a temporary folder that goes
    with the store, and a copy of the store copies them.
    """

    def __init__(self, name: str, folder: str | Path | None = None) -> None:
        self.name = name
        self.folder = None if folder is None else Path(folder)
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._round = 0

    def write(self, first: int, rows: Tensor) -> None:
        """Keep rows (B, D) of the scans `first`, `first + 1`, ...; a row written again is replaced."""
        table = np.ascontiguousarray(rows.detach().cpu().numpy(), dtype=np.float32)
        flags = np.where(np.isfinite(table).all(1), KEPT, LEFT_OUT).astype(np.uint8)
        _write(self._path("rows"), first * table.shape[1] * 4, table.tobytes())
        _write(self._path("flags"), first, flags.tobytes())

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
        gone = self._round - (1 if self.folder is None else 2)
        for kind in ("rows", "flags"):
            self._path(kind, gone).unlink(missing_ok=True)

    def _path(self, kind: str, number: int | None = None) -> Path:
        if self.folder is None and self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="r2flow-features-")
        folder = Path(self._temporary.name) if self._temporary else self.folder
        assert folder is not None
        folder.mkdir(parents=True, exist_ok=True)
        return folder / f"{self.name}-{self._round if number is None else number}.{kind}"

    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the kept rows, and all rows."""
        flags, rows = self._path("flags"), self._path("rows")
        if not flags.exists() or not flags.stat().st_size:
            return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
        kept = np.fromfile(flags, dtype=np.uint8) == KEPT
        # Copy on write: the tensors that torch makes of it may be written to, the file may not.
        table = np.memmap(rows, np.float32, "c", shape=(len(kept), rows.stat().st_size // (4 * len(kept))))
        return np.flatnonzero(kept), table

    def __getstate__(self) -> dict[str, Any]:
        paths = {kind: self._path(kind) for kind in ("rows", "flags")} if self._temporary else {}
        files = {kind: path.read_bytes() for kind, path in paths.items() if path.exists()}
        return {"name": self.name, "folder": self.folder, "round": self._round, "files": files}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["name"], state["folder"])  # type: ignore[misc]
        self._round = state["round"]
        for kind, content in state["files"].items():
            self._path(kind).write_bytes(content)


def _write(path: Path, offset: int, content: bytes) -> None:
    try:
        # Never truncated, never locked: other processes write other parts of it at the same time.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        with os.fdopen(descriptor, "r+b") as file:
            file.seek(offset)
            file.write(content)
    except OSError as error:
        raise InputError(
            f"the rows of single scans cannot be written to {path.parent}: {error.strerror or error}; "
            "set TMPDIR to a folder with more room, or measure fewer scans."
        ) from None
