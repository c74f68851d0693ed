"""A table of named constructors, and wrong names that explain themselves."""

import difflib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from r2flow.errors import InputError

T = TypeVar("T")


def did_you_mean(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """' Did you mean ...?' for the closest known name, or nothing when none is close."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    close = close or [other for other in known if other.startswith(name)]
    return f" Did you mean '{close[0]}'?" if close else ""


class Registry(Generic[T]):
    """Named values of one kind, read like the table they are.

    BACKBONES = Registry("backbone", hdit=HDiT, adm_unet=ADMUNet)
    BACKBONES["hditt"]
    # no backbone named 'hditt'; known: adm_unet, hdit. Did you mean 'hdit'?
    """

    def __init__(self, kind: str, **entries: T) -> None:
        self.kind = kind
        self._entries = dict(entries)

    def __getitem__(self, name: str) -> T:
        try:
            return self._entries[name]
        except KeyError:
            known = ", ".join(sorted(self._entries))
            hint = did_you_mean(str(name), self._entries)
            raise InputError(f"no {self.kind} named {name!r}; known: {known}.{hint}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    def items(self) -> Iterator[tuple[str, T]]:
        return iter(self._entries.items())

    def add(self, name: str, entry: T) -> None:
        """Enter a value of your own.

        Raises:
            ValueError: the name is taken.
        """
        if name in self._entries:
            raise ValueError(f"a {self.kind} named {name!r} exists already; choose another name.")
        self._entries[name] = entry

    def build(self, options: Mapping[str, Any], *args: Any) -> Any:
        """Call the entry `options["name"]` with `args` and the remaining options as keywords.

        Raises:
            InputError: no such name, or an option that the constructor does not know.
        """
        chosen = dict(options)
        if "name" not in chosen:
            raise InputError(f"a {self.kind} config needs a 'name'; known: {', '.join(sorted(self._entries))}.")
        name = chosen.pop("name")
        constructor = self[name]
        if not callable(constructor):
            raise TypeError(f"{self.kind} {name!r} is a value, not a constructor")
        check_options(f"{self.kind} '{name}'", constructor, chosen)
        return constructor(*args, **chosen)


def check_options(what: str, constructor: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Hold options to the signature that they are meant for.

    Raises:
        InputError: an option that `constructor` does not take by keyword, or a value of another type than its
            annotation says where that is bool, int, float or str.
    """
    parameters = inspect.signature(constructor).parameters
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    known = {n: p for n, p in parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)}
    for key, value in options.items():
        if key not in known:
            hint = did_you_mean(key, known)
            raise InputError(f"{what} has no option {key!r}; it knows: {', '.join(known)}.{hint}")
        wanted = PLAIN_TYPES.get(str(getattr(known[key].annotation, "__name__", known[key].annotation)))
        if wanted is not None and not _is_a(value, *wanted):
            raise InputError(f"{what}: {key} must be {wanted[-1]}, found {value!r}.")


PLAIN_TYPES: dict[str, tuple[type, str]] = {
    "bool": (bool, "true or false"),
    "int": (int, "a whole number"),
    "float": (float, "a number"),
    "str": (str, "a word"),
}


def _is_a(value: Any, wanted: type, _: str) -> bool:
    if wanted is bool or isinstance(value, bool):
        return wanted is bool and isinstance(value, bool)
    return isinstance(value, (int, float) if wanted is float else wanted)
