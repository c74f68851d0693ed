"""Registries of named constructors, with errors that list the known names and options."""

import dataclasses
import difflib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

from r2flow.errors import InputError, check

T = TypeVar("T")

MISSING = "???"  # OmegaConf's mandatory value
LARGEST = sys.float_info.max  # whole numbers can be larger


class Bound(NamedTuple):
    """Range of an option's value, in its annotation: `width: Annotated[int, Bound("below 9", lambda n: n < 9)]`."""

    words: str
    holds: Callable[[Any], bool]


Count = Annotated[int, Bound("of at least 1", lambda n: n >= 1)]
Natural = Annotated[int, Bound("of at least 0", lambda n: n >= 0)]
Positive = Annotated[float, Bound("above 0", lambda x: x > 0)]
NonNegative = Annotated[float, Bound("of at least 0", lambda x: x >= 0)]
Seed = Annotated[int, Bound("of at least 0 and below 2^63", lambda n: 0 <= n < 2**63)]
Portion = Annotated[float, Bound("in [0, 1)", lambda x: 0 <= x < 1)]
Share = Annotated[float, Bound("in [0, 1]", lambda x: 0 <= x <= 1)]


def did_you_mean(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """' Did you mean ...?' with the closest known name, or an empty string if there is none."""
    others = [other for other in known if other != name]  # a broken link is there under its own name
    close = difflib.get_close_matches(name, others, n=1, cutoff=0.6) or [o for o in others if o.startswith(name)]
    return f" Did you mean '{close[0]}'?" if close else ""


class UnknownName(InputError):
    """A registry has no entry with this name."""


class _Lazy(NamedTuple):
    place: str
    given: tuple[Any, ...]


def lazy(place: str, *given: Any) -> Any:
    """A registry entry `module:name` that is imported at its first use; with arguments to begin with, if given."""
    return _Lazy(place, given)


class Registry(Mapping[str, T]):
    """Named values of one kind.

    BACKBONES = Registry("backbone", hdit=HDiT, adm_unet=ADMUNet)
    BACKBONES["hditt"]
    # no backbone named 'hditt'; known: adm_unet, hdit. Did you mean 'hdit'?

    Attributes:
        on_missing: Functions that may add entries, such as loaders of installed plug-ins. Each is called once per
            process, when a registry first lacks a name; then the name is looked up again.
    """

    on_missing: ClassVar[list[Callable[[], None]]] = []

    def __init__(self, kind: str, **entries: T) -> None:
        self.kind = kind
        self._entries = dict(entries)

    def __getitem__(self, name: str) -> T:
        if name not in self:
            hint = did_you_mean(str(name), self)
            raise UnknownName(f"no {self.kind} named {name!r}; known: {', '.join(sorted(self))}.{hint}")
        entry = self._entries[name]
        if isinstance(entry, _Lazy):
            found: Any = resolve_name(entry.place)
            found = partial(found, *entry.given) if entry.given else found
            entry = self._entries[name] = found
        return entry

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __contains__(self, name: object) -> bool:
        while isinstance(name, str) and name not in self._entries and Registry.on_missing:
            Registry.on_missing.pop(0)()
        return isinstance(name, str) and name in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        return f"Registry({self.kind}: {', '.join(self)})"

    def add(self, name: str, entry: T) -> None:
        """Add an entry; raises ValueError for a name that is taken, except by a former run of a notebook's cell."""
        modules = {getattr(one, "__module__", "") for one in (self._entries.get(name), entry)}
        if name in self._entries and modules != {"__main__"}:
            raise ValueError(f"a {self.kind} named {name!r} exists already; choose another name.")
        self._entries[name] = entry

    def build(self, options: Mapping[str, Any], *args: Any) -> Any:
        """Call the entry `options["name"]` with `args` and the remaining options as keywords."""
        if not isinstance(options, Mapping) or not isinstance(options.get("name"), str):
            known = ", ".join(sorted(self))
            raise InputError(f"a {self.kind} config needs a 'name', found {options!r}; known: {known}.")
        chosen = dict(options)
        name = chosen.pop("name")
        constructor: Any = self[name]
        return construct(f"{self.kind} '{name}'", constructor, chosen, *args)


def check_options(what: str, constructor: Callable[..., Any], options: Mapping[str, Any], given: int = 0) -> None:
    """Check options against the signature of a constructor that takes `given` further arguments by position."""
    check(isinstance(options, Mapping), f"{what} must be a group of keys, found {options!r}.")
    parameters = _parameters(constructor)
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return
    known = _by_keyword(parameters, given)
    for key, value in options.items():
        if key not in known:
            names = ", ".join(known) or "none"
            raise InputError(f"{what} has no option {key!r}; it knows: {names}.{did_you_mean(key, known)}")
        if (wanted := _wanted(known[key].annotation)) and not wanted[1](value):
            raise InputError(f"{what}: {key} must be {wanted[0]}, found {value!r}.")
    for key, parameter in known.items():
        check(parameter.default is not parameter.empty or key in options, f"{what} needs the option {key!r}.")


def construct(what: str, constructor: Callable[..., T], options: Mapping[str, Any] | None, *args: Any) -> T:
    """Call a constructor with `args` and a config's options, which are checked; None: its defaults."""
    options = {} if options is None else options
    check_options(what, constructor, options, given=len(args))
    return constructor(*args, **options)


def options_of(constructor: Callable[..., Any], given: int = 0) -> dict[str, Any]:
    """Keyword options of a constructor, after `given` positional ones, with their defaults; `MISSING` without one."""
    options = _by_keyword(_parameters(constructor), given)
    defaults = {name: MISSING if p.default is p.empty else p.default for name, p in options.items()}
    if dataclasses.is_dataclass(constructor):
        for f in dataclasses.fields(constructor):
            if f.name in defaults and callable(f.default_factory):
                defaults[f.name] = f.default_factory()
    return defaults


def _by_keyword(parameters: Sequence[inspect.Parameter], given: int) -> dict[str, inspect.Parameter]:
    taken = [p.name for p in parameters if p.kind <= p.POSITIONAL_OR_KEYWORD][:given]
    kinds = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    return {p.name: p for p in parameters if p.kind in kinds and p.name not in taken}


def _parameters(constructor: Callable[..., Any]) -> list[inspect.Parameter]:
    """Parameters of a constructor; if a class passes `**options` to its base class, also those of the base."""
    parameters = list(inspect.signature(constructor).parameters.values())
    passes_on = any(p.kind is p.VAR_KEYWORD for p in parameters)
    if passes_on and inspect.isclass(constructor) and constructor.__bases__[0] is not object:
        direct = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
        names = {p.name for p in direct}
        return direct + [p for p in _parameters(constructor.__bases__[0]) if p.name not in names]
    return parameters


Check = tuple[str, Callable[[Any], bool]]  # what a value must be, and whether it is

PLAIN: dict[Any, Check] = {
    bool: ("true or false", lambda v: isinstance(v, bool)),
    int: ("a whole number", lambda v: isinstance(v, int) and not isinstance(v, bool)),
    float: ("a finite number", lambda v: isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= LARGEST),
    str: ("a word", lambda v: isinstance(v, str)),
    NoneType: ("null", lambda v: v is None),
    Mapping: ("a group of keys", lambda v: isinstance(v, Mapping)),
}


def _wanted(annotation: Any) -> Check | None:
    """The check of an annotation; None if it cannot be checked."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        bounds = [bound for bound in annotation.__metadata__ if isinstance(bound, Bound)]
        return reduce(_bounded, bounds, _wanted(inner[0]))
    if origin is Literal:
        return " or ".join(map(repr, inner)), lambda v: any(type(v) is type(x) and v == x for x in inner)
    if origin in (Union, UnionType):
        checks = [check for check in map(_wanted, inner) if check]
        words = " or ".join(words for words, _ in checks)
        return (words, lambda v: any(fits(v) for _, fits in checks)) if len(checks) == len(inner) else None
    if (origin or annotation) in (list, tuple, Sequence):
        size = len(inner) if origin is tuple and inner and Ellipsis not in inner else None
        each = _wanted(inner[0]) if inner else None
        words = f"a list{f' of {size}' if size else ''}{f', each {each[0]}' if each else ''}"

        def fits(value: Any) -> bool:
            right_size = isinstance(value, list | tuple) and size in (None, len(value))
            return right_size and (each is None or all(map(each[1], value)))

        return words, fits
    return PLAIN.get(origin or annotation)


def _bounded(check: Check | None, bound: Bound) -> Check | None:
    return check and (f"{check[0]} {bound.words}", lambda v: check[1](v) and bound.holds(v))
