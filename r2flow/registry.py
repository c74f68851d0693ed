"""A table of named constructors, and wrong names that explain themselves."""

import difflib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Generic, TypeVar, Union, get_args, get_origin

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
        check_options(f"{self.kind} '{name}'", constructor, chosen, given=len(args))
        return constructor(*args, **chosen)


def check_options(what: str, constructor: Callable[..., Any], options: Mapping[str, Any], given: int = 0) -> None:
    """Hold options to the signature that they are meant for.

    Args:
        given: How many parameters are passed by position beside the options.

    Raises:
        InputError: an option that `constructor` does not take by keyword, one that it cannot do without, or a value
            that its annotation does not allow.
    """
    parameters = _parameters(constructor)
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return
    known = {p.name: p for p in parameters[given:] if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)}
    for key, value in options.items():
        if key not in known:
            hint = did_you_mean(key, known)
            raise InputError(f"{what} has no option {key!r}; it knows: {', '.join(known)}.{hint}")
        wanted = _wanted(known[key].annotation)
        if wanted and not any(fits(value) for _, fits in wanted):
            raise InputError(f"{what}: {key} must be {' or '.join(word for word, _ in wanted)}, found {value!r}.")
    for key, parameter in known.items():
        if parameter.default is parameter.empty and key not in options:
            raise InputError(f"{what} needs the option {key!r}.")


def _parameters(constructor: Callable[..., Any]) -> list[inspect.Parameter]:
    """A constructor's parameters; where a class takes `**options` for its base class, those of the base too."""
    parameters = list(inspect.signature(constructor).parameters.values())
    if parameters and parameters[0].name == "self":  # a decorated __init__
        parameters = parameters[1:]
    passes_on = any(p.kind is p.VAR_KEYWORD for p in parameters)
    if passes_on and inspect.isclass(constructor) and constructor.__bases__[0] is not object:
        own = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
        names = {p.name for p in own}
        return own + [p for p in _parameters(constructor.__bases__[0]) if p.name not in names]
    return parameters


Check = tuple[str, Callable[[Any], bool]]

PLAIN: dict[Any, Check] = {
    bool: ("true or false", lambda v: isinstance(v, bool)),
    int: ("a whole number", lambda v: isinstance(v, int) and not isinstance(v, bool)),
    float: ("a number", lambda v: isinstance(v, int | float) and not isinstance(v, bool)),
    str: ("a word", lambda v: isinstance(v, str)),
    NoneType: ("null", lambda v: v is None),
    list: ("a list", lambda v: isinstance(v, list | tuple)),
    tuple: ("a list", lambda v: isinstance(v, list | tuple)),
    Sequence: ("a list", lambda v: isinstance(v, list | tuple)),
    Mapping: ("a group of keys", lambda v: isinstance(v, Mapping)),
}


def _wanted(annotation: Any) -> list[Check]:
    """The checks of an annotation, any of which may hold; none where it cannot be checked."""
    alternatives = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    checks = [PLAIN.get(get_origin(one) or one) for one in alternatives]
    return [] if None in checks else [check for check in checks if check is not None]
