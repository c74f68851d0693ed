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

LARGEST_TABLE = 1 << 28  # bytes unpacked; a frame of PandaSet has 8 MB
MOST_STEPS = 10_000  # of a pickle; a table has some hundreds
TABLES = ("pandas", "numpy")  # packages whose names a table holds
OTHERS = {"builtins.slice", "__builtin__.slice", "_codecs.encode"}


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
        if module.partition(".")[0] not in TABLES and f"{module}.{name}" not in OTHERS:
            raise InputError(f"it names {module}.{name}, which is no part of a table. Is it safe?")
        return type(name, (_Named,), {})


def read_table(path: Path) -> dict[str, ndarray]:
    """The columns of numbers of a pickled `pandas.DataFrame`, as is or compressed by gzip.

    Every class and function that the pickle names becomes a `_Named`, which records how it was
    called; the arrays are built from these records. Pickles of pandas 0.25 to 3 are known.

    Raises:
        InputError: It names other packages than pandas and numpy, is too large, or is no table.
    """
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        with gzip.open(io.BytesIO(data)) as packed:
            data = packed.read(LARGEST_TABLE + 1)
    check(len(data) <= LARGEST_TABLE, f"it is larger than {LARGEST_TABLE >> 20} MiB unpacked.")
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
    manager: Any = held.get("_mgr", held.get("_data"))
    if manager.args:  # pandas 1.3 and later
        blocks, axes = manager.args
        pairs = [block.args[:2] for block in blocks]
    else:
        stored = manager.state[3]["0.14.1"]
        axes = stored["axes"]
        pairs = [(block["values"], block["mgr_locs"]) for block in stored["blocks"]]
    names = _values(axes[0].args[1]["data"])
    columns = {}
    for values, places in pairs:
        numbers = _values(values)
        if not isinstance(numbers, ndarray) or numbers.dtype.kind not in "fiub":
            continue
        whole = range(len(names))
        chosen = whole[slice(*places.args)] if _name(places) == "slice" else _values(places)
        for place, column in zip(chosen, numbers, strict=True):
            columns[str(names[place])] = column
    return columns


def _values(made: Any) -> ndarray | Sequence[Any]:
    """The values of a recorded array; those of an array of objects as a list."""
    name = _name(made)
    if name == "__pyx_unpickle_NDArrayBacked":  # pandas 3: strings
        return _values(made.state[1])
    if name == "_frombuffer":
        buffer, kind, shape, order = made.args
    else:
        check(name == "_reconstruct", f"it holds a {name}, not an array.")
        _, shape, kind, columns_first, buffer = made.state
        order = "F" if columns_first else "C"
    if isinstance(buffer, list):
        return buffer
    if _name(buffer) == "encode":
        buffer = buffer.args[0].encode("latin1")
    order_of_bytes = kind.state[1] if kind.state else "="
    dtype = np.dtype(kind.args[0]).newbyteorder(order_of_bytes)
    return np.frombuffer(buffer, dtype).reshape(shape, order=order)


def _name(made: Any) -> str:
    return type(made).__name__


def column(table: Mapping[str, ndarray], name: str) -> ndarray:
    """A column of a table."""
    check(name in table, f"it has no column {name}; it has: {', '.join(table)[:120]}.")
    return table[name]
