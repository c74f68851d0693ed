"""Pickled pandas tables, read without pandas and without running anything that a pickle names."""

import gzip
import io
import pickle
import pickletools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, check

_LARGEST_TABLE = 1 << 28  # bytes unpacked; a frame of PandaSet has 8 MB
MOST_STEPS = 10_000  # of a pickle; a table has some hundreds
_TABLES = ("pandas", "numpy")  # packages whose names a table holds


class _Named:
    """What a pickle would make of a class or function: only its arguments and its state."""

    args: tuple = ()
    state: Any = None

    def __new__(cls, *args: Any) -> "_Named":
        made = super().__new__(cls)
        made.args = args
        return made

    def __init__(self, *args: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Named]:
        if module.partition(".")[0] not in _TABLES and name != "slice":
            raise InputError(f"it names {module}.{name}, which is no part of a table. Is it safe?")
        return type(name, (_Named,), {})


def read_table(path: Path) -> dict[str, ndarray]:
    """The columns of numbers of a pickled `pandas.DataFrame`, as is or compressed by gzip.

    Every class and function that the pickle names becomes a `_Named`, which records how it was
    called; the arrays are built from these records. Tables of pandas 0.25 to 1.2 are known, as
    PandaSet's.

    Raises:
        InputError: It names other packages than pandas and numpy, is too large, or is no table.
    """
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        with gzip.open(io.BytesIO(data)) as packed:
            data = packed.read(_LARGEST_TABLE + 1)
    check(len(data) <= _LARGEST_TABLE, f"it is larger than {_LARGEST_TABLE >> 20} MiB unpacked.")
    # The unpickler allocates what a damaged step declares: a place in its memo, or a length.
    for number, (step, value, _) in enumerate(pickletools.genops(data)):
        place = int(value or 0) if step.name in ("PUT", "LONG_BINPUT") else 0
        check(max(number, place) <= MOST_STEPS, "it is no pickled table: it has too many steps.")
    return _columns(_Unpickler(io.BytesIO(data)).load())


def _columns(frame: Any) -> dict[str, ndarray]:
    """The columns of a recorded `DataFrame`: a manager of labels and of blocks of columns."""
    held = frame.state if _name(frame) == "DataFrame" else None
    if not isinstance(held, dict):
        raise InputError(f"it holds a {_name(frame)}, not a table.")
    state = held["_data"].state if "_data" in held else None
    if not isinstance(state, tuple):
        raise InputError("it is a table of pandas 1.3 or later; PandaSet's are of pandas 1.0.")
    stored = state[3]["0.14.1"]
    names = _values(stored["axes"][0].args[1]["data"])
    columns = {}
    for block in stored["blocks"]:
        numbers = _values(block["values"])
        if not isinstance(numbers, ndarray) or numbers.dtype.kind not in "fiub":
            continue
        places = block["mgr_locs"]
        whole = range(len(names))
        numbered = whole[slice(*places.args)] if _name(places) == "slice" else _values(places)
        for place, column in zip(numbered, numbers, strict=True):
            columns[str(names[place])] = column
    return columns


def _values(made: Any) -> ndarray | Sequence[Any]:
    """The values of a recorded array; those of an array of objects as a list."""
    check(_name(made) == "_reconstruct", f"it holds a {_name(made)}, not an array.")
    _, shape, kind, columns_first, buffer = made.state
    if isinstance(buffer, list):
        return buffer
    dtype = np.dtype(kind.args[0]).newbyteorder(kind.state[1])
    return np.frombuffer(buffer, dtype).reshape(shape, order="F" if columns_first else "C")


def _name(made: Any) -> str:
    return type(made).__name__


def column(table: Mapping[str, ndarray], name: str) -> ndarray:
    """A column of a table."""
    check(name in table, f"it has no column {name}; it has: {', '.join(table)[:120]}.")
    return table[name]
