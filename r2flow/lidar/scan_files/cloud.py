"""All fields of a scan's points, as a file, a message or an array stores them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files.points import Points, column_points, places_of, renamed


@dataclass(frozen=True, eq=False)
class Cloud:
    """The N rows of a scan in their order, with rows of NaN; fields that r2flow does not
    understand, too.

    A reader of a format, or of a message, makes it; `points` are what r2flow understands of it.
    """

    names: tuple[str, ...]  # of the fields; of rows without names those that say what they are
    columns: tuple[ndarray, ...]  # (N,) or (N, count) each, of the stored type and byte order
    aliases: tuple[str, ...] = ()  # names that say what the fields are, if others than `names`
    header: Any = None  # what a writer of the format needs besides: PCD's viewpoint, LAS's header
    held: int | None = None  # how many fields the rows hold of a format without names, as a .bin

    def __len__(self) -> int:
        return len(self.columns[0]) if self.columns else 0

    @classmethod
    def of(cls, array: ndarray) -> "Cloud":
        """The cloud of a structured array, (N,) or (H, W), or of rows (N, 3 or 4): x, y, z and
        reflectance.
        """
        if array.dtype.names is None:
            names = ("x", "y", "z", "reflectance")[: array.shape[1]]
            return cls(names, tuple(array.T), held=len(names))
        rows = array.ravel()
        return cls(array.dtype.names, tuple(rows[name] for name in array.dtype.names))

    @property
    def named(self) -> bool:
        """Whether its format stores the names of the fields."""
        return self.held is None

    @property
    def meanings(self) -> tuple[str, ...]:
        """Names that say what the fields are."""
        return self.aliases or self.names

    def check_names(self) -> None:
        """Refuse two fields of one name, of which most formats would lose one."""
        for name in self.names:
            if name != "_" and self.names.count(name) > 1:
                raise InputError(f"it has two fields of the name {name}: rename one.")

    def array(self) -> ndarray:
        """All fields as a structured array, (N,), with packed rows; names as `check_names`."""
        self.check_names()
        names = [f"_{place}" if name == "_" else name for place, name in enumerate(self.names)]
        kinds = [
            (name, column.dtype, column.shape[1:])
            for name, column in zip(names, self.columns, strict=True)
        ]
        rows = np.empty(len(self), kinds)
        for name, column in zip(names, self.columns, strict=True):
            rows[name] = column
        return rows

    def renamed(self, columns: Sequence[str] | None) -> "Cloud":
        """The cloud whose fields are understood by a user's renames, as `intensities=reflectance`;
        see `read_points`.
        """
        return replace(self, aliases=tuple(renamed(self.meanings, columns)))

    def place(self, role: str) -> int | None:
        """The number of the field that is used of a role, a key of `points._ROLES`; None: none."""
        places = places_of(self.meanings, role)
        filled = [place for place in places if self.columns[place].any()]
        return next(iter(filled or places), None)

    def column(self, role: str) -> ndarray | None:
        """The field that is used of a role; None: there is none."""
        place = self.place(role)
        return None if place is None else self.columns[place]

    def points(self, raw: bool = False) -> Points:
        """What r2flow understands of the rows that are points (`column_points`), with the cloud."""
        found = column_points(self.meanings, self.columns, raw)
        return replace(found, cloud=self)

    def measured(self) -> "Cloud":
        """The rows that a sensor measured: those that a completion added have `measured` 0."""
        column = self.column("measured")
        if column is None:
            return self
        return self.take(np.flatnonzero(column != 0))

    def take(self, rows: ndarray) -> "Cloud":
        """Some rows, by their ascending numbers."""
        if len(rows) == len(self):
            return self
        return replace(self, columns=tuple(column[rows] for column in self.columns))

    def with_reflectance(self, values: ndarray) -> "Cloud":
        """The cloud with other values of reflectance, in the type of its field; a field `intensity`
        if it has none.
        """
        place = self.place("reflectance")
        if place is None:
            return self.with_fields({"intensity": values.astype(np.float32)})
        columns = [*self.columns]
        columns[place] = as_type(values, columns[place].dtype)
        return replace(self, columns=tuple(columns))

    def with_fields(self, fields: Mapping[str, ndarray]) -> "Cloud":
        """The cloud with further fields after its own, which replace those of the same name."""
        kept = [place for place, name in enumerate(self.names) if name not in fields]
        return replace(
            self,
            names=(*(self.names[place] for place in kept), *fields),
            columns=(*(self.columns[place] for place in kept), *fields.values()),
            aliases=(*(self.meanings[place] for place in kept), *fields),
        )


def as_type(values: ndarray, kind: np.dtype) -> ndarray:
    """Values in the type of a field; integers are rounded, and limited to what the type holds."""
    if kind.kind not in "iu" or values.dtype.kind in "iu":
        return values.astype(kind)
    limits = np.iinfo(kind)
    return np.rint(values).clip(limits.min, limits.max).astype(kind)
