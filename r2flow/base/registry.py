"""Registries of named constructors, and their options, checked by pydantic against the
constructors' signatures.
"""

import difflib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from importlib.resources import files
from pkgutil import resolve_name
from typing import (
    Annotated,
    Any,
    ClassVar,
    NamedTuple,
    NotRequired,
    Required,
    TypeVar,
    get_args,
    get_type_hints,
)

from omegaconf import OmegaConf
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    with_config,
)
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from r2flow.base.errors import InputError, quoted

_T = TypeVar("_T")

Options = Mapping[str, Any]  # of a config, by key
Config = dict[str, Any]  # a config, or a part of one

MISSING = "???"  # OmegaConf's mandatory value
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)


def _refuse_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("must be a number")
    return value


Integer = Annotated[int, Field(ge=-(2**63), lt=2**63), BeforeValidator(_refuse_bool)]
Number = Annotated[float, BeforeValidator(_refuse_bool)]
Count = Annotated[Integer, Field(ge=1)]
Natural = Annotated[Integer, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Seed = Natural
Portion = Annotated[Number, Field(ge=0, lt=1)]
Share = Annotated[Number, Field(ge=0, le=1)]
Counts = Annotated[Sequence[Count], Field(min_length=1)]
Size = tuple[Count, Count]  # rows and columns

strict = with_config(_STRICT)  # decorates a dataclass of options: no unknown ones, no NaN


def Bound(words: str, holds: Callable[[Any], bool]) -> AfterValidator:
    """Range of an option, in its annotation: `width: Annotated[int, Bound("odd", lambda n: n %
    2)]`.
    """

    def validate(value: Any) -> Any:
        if not holds(value):
            raise ValueError(f"must be {words}")
        return value

    return AfterValidator(validate)


# Names of options in other packages.
_OTHER_NAMES = {"lr": "learning_rate", "num_workers": "workers", "data_dir": "root"}


def did_you_mean(name: str, known: Options | list[str]) -> str:
    """' Did you mean ...?' with the closest known name, or an empty string if there is none."""
    if _OTHER_NAMES.get(name) in known:
        return f" Did you mean '{_OTHER_NAMES[name]}'?"
    others = [other for other in known if other != name]  # as a broken link
    close = difflib.get_close_matches(name, others, n=1, cutoff=0.6)
    close += [other for other in others if other.startswith(name)]
    return f" Did you mean '{close[0]}'?" if close else ""


class UnknownName(InputError):
    """A registry has no entry with this name."""


class _Lazy(NamedTuple):
    place: str
    given: tuple[Any, ...]


def lazy(place: str, *given: Any) -> Any:
    """A registry entry `module:name` that is imported at its first use; with arguments to begin
    with, if given.
    """
    return _Lazy(place, given)


class Registry(Mapping[str, _T]):
    """Named values of one kind, and the names of the files in conf/KIND/, which stand for one of
    them with options.

    BACKBONES = Registry("backbone", hdit=HDiT, adm_unet=ADMUNet)
    BACKBONES["hditt"]
    # no backbone named 'hditt'; known: adm_unet, hdit. Did you mean 'hdit'?

    Attributes:
        on_missing: Functions that may add entries, such as loaders of installed plug-ins. Each is
            called once per process, when a registry first lacks a name; then the name is looked up
            again.
    """

    on_missing: ClassVar[list[Callable[[], None]]] = []

    def __init__(self, kind: str, **entries: _T) -> None:
        self.kind = kind
        self._entries = dict(entries)

    def __getitem__(self, name: str) -> _T:
        if name not in self:
            names = sorted({*self, *presets(self.kind)})
            hint = did_you_mean(str(name), names)
            raise UnknownName(
                f"no {self.kind} named {quoted(name)}; known: {', '.join(names)}.{hint}"
            )
        entry: Any = self._entries[name]
        if isinstance(entry, _Lazy):
            found: Any = resolve_name(entry.place)
            entry = partial(found, *entry.given) if entry.given else found
            self._entries[name] = entry
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

    def add(self, name: str, entry: _T) -> None:
        """Add an entry; raises ValueError for a name that is taken, except by a former run of a
        notebook's cell.
        """
        modules = {getattr(one, "__module__", "") for one in (self._entries.get(name), entry)}
        if name in self._entries and modules != {"__main__"}:
            raise ValueError(f"a {self.kind} named {name!r} exists already; choose another name.")
        self._entries[name] = entry

    def name_of(self, entry: Any) -> str | None:
        """The name of an entry, or None."""
        place = f"{getattr(entry, '__module__', '')}:{getattr(entry, '__qualname__', '')}"
        for name, known in self._entries.items():
            if known is entry or known == _Lazy(place, ()):
                return name
        return None

    def options(self, given: str | Options) -> Config:
        """Name and options of an entry, from a name, also of a file in conf/, or a mapping with a
        name and options.
        """
        options = {"name": given} if isinstance(given, str) else given
        name = options.get("name") if isinstance(options, Mapping) else None
        if not isinstance(name, str):
            known = ", ".join(sorted(self))
            raise InputError(
                f"a {self.kind} config needs a 'name', found {quoted(given)}; known: {known}."
            )
        options = dict(options)
        if name in self._entries or name not in presets(self.kind):
            return options
        preset = presets(self.kind)[name]
        return {**preset, **options, "name": preset["name"]}

    def build(self, given: str | Options, *args: Any) -> Any:
        """Construct the entry of a name, or of a group with its name, by `args` and the options."""
        options = self.options(given)
        name = options.pop("name")
        constructor: Any = self[name]
        return construct(f"{self.kind} '{name}'", constructor, options, *args)


@cache
def presets(group: str) -> dict[str, Config]:
    """Options of each file of a folder of conf/, by its name, with those of the files in its
    `defaults`.
    """
    folder = files("r2flow.conf") / group
    read: Config = {}
    for file in folder.iterdir() if folder.is_dir() else ():
        if file.name.endswith(".yaml"):
            content = OmegaConf.create(file.read_text(encoding="utf-8"))
            read[file.name.removesuffix(".yaml")] = OmegaConf.to_container(content)

    def merged(name: str) -> Config:
        options = dict(read[name])
        for base in reversed(options.pop("defaults", [])):
            if base in read:
                options = merged(base) | options
        return options

    return {name: merged(name) for name in read}


def check_options(
    what: str, constructor: Callable[..., Any], options: Options, given: int = 0
) -> Config:
    """Options as a constructor takes them that has `given` further arguments by position.

    Raises:
        InputError: an unknown option, a missing one, or a value that does not fit its annotation.
    """
    if not isinstance(options, Mapping):
        raise InputError(f"{what} must be a group of keys, found {quoted(options)}.")
    with _in_one_line(what, constructor, options, given):
        return _schema(constructor, given).validate_python(dict(options))


def construct(what: str, constructor: Callable[..., _T], options: Options | None, *args: Any) -> _T:
    """Call a constructor with `args` and checked options of a config; None: its defaults."""
    checked = check_options(what, constructor, options or {}, given=len(args))
    with _in_one_line(what, constructor, checked, len(args)):  # a strict dataclass checks, too
        return constructor(*args, **checked)


@contextmanager
def _in_one_line(
    what: str, constructor: Callable[..., Any], options: Any, given: int
) -> Iterator[None]:
    """Turn a ValidationError into an InputError about `what`."""
    try:
        yield
    except ValidationError as error:
        raise InputError(f"{what}: {_first_problem(error, options, constructor, given)}") from None


def options_of(constructor: Callable[..., Any], given: int = 0) -> Config:
    """Keyword options of a constructor, after `given` positional ones, with their defaults;
    `MISSING` without one.
    """
    parameters = keywords_of(constructor, given)
    return {name: MISSING if p.default is p.empty else p.default for name, p in parameters.items()}


_SEVERAL = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def signature_of(constructor: Callable[..., Any]) -> inspect.Signature:
    """The signature of a constructor.

    A class that passes `**options` on to its base has the arguments of that by keyword, or those
    that `**options: Unpack[TYPED_DICT]` names.
    """
    signature = inspect.signature(constructor)
    parameters = list(signature.parameters.values())
    if not (
        parameters
        and parameters[-1].kind is parameters[-1].VAR_KEYWORD
        and inspect.isclass(constructor)
    ):
        return signature
    _, base, *_ = [one for one in constructor.__mro__ if "__init__" in vars(one)]
    inherited = signature_of(base).parameters
    passed = inherited.keys() - signature.parameters.keys()
    for typed in get_args(parameters.pop().annotation):
        passed &= get_type_hints(typed).keys()
    taken = [p for p in inherited.values() if p.name in passed and p.kind not in _SEVERAL]
    if not any(p.kind is p.VAR_POSITIONAL for p in parameters):
        taken = [p.replace(kind=p.KEYWORD_ONLY) for p in taken if p.kind is not p.POSITIONAL_ONLY]
    parameters = [p for p in parameters if p.kind not in _SEVERAL]
    return signature.replace(parameters=sorted([*parameters, *taken], key=lambda p: p.kind))


def keywords_of(constructor: Callable[..., Any], given: int = 0) -> dict[str, inspect.Parameter]:
    """Parameters that can be given by keyword, after `given` positional ones."""
    named = [p for p in signature_of(constructor).parameters.values() if p.kind not in _SEVERAL]
    positional = [p for p in named if p.kind is not p.KEYWORD_ONLY][:given]
    return {p.name: p for p in named if p not in positional and p.kind is not p.POSITIONAL_ONLY}


@cache
def _schema(constructor: Callable[..., Any], given: int) -> TypeAdapter[Config]:
    fields: Config = {}
    for name, parameter in keywords_of(constructor, given).items():
        annotation = Any if parameter.annotation is parameter.empty else parameter.annotation
        required = parameter.default is parameter.empty
        fields[name] = Required[annotation] if required else NotRequired[annotation]
    config = _STRICT
    kinds = [p.kind for p in inspect.signature(constructor).parameters.values()]
    if inspect.Parameter.VAR_KEYWORD in kinds and not inspect.isclass(constructor):
        config = ConfigDict(**{**_STRICT, "extra": "allow"})
    typed_dict: Any = TypedDict  # of fields that are known now alone
    schema: Any = with_config(config)(typed_dict("options", fields))
    return TypeAdapter(schema)


def _first_problem(
    error: ValidationError, options: Any, constructor: Callable[..., Any], given: int
) -> str:
    """The first problem of a validation in one line, without the names of a union's members."""
    problem = error.errors(include_url=False)[0]
    if isinstance(own := problem.get("ctx", {}).get("error"), InputError):  # of a nested class
        return str(own)
    option = ".".join(map(str, problem["loc"]))
    if problem["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        if len(problem["loc"]) > 1:
            return f"no option '{option}'."
        known = list(keywords_of(constructor, given))
        hint = did_you_mean(option, known)
        return f"no option '{option}'; it has {', '.join(known) or 'none'}.{hint}"
    if problem["type"] in ("missing", "missing_argument"):
        return f"needs the option '{option}'."
    keys: list[str] = []
    for part in problem["loc"]:  # the rest are members of a union
        inside = part in options if isinstance(options, Mapping) else isinstance(part, int)
        if not inside:
            break
        keys.append(str(part))
        options = options[part]
    words = problem["msg"].removeprefix("Value error, ")
    words = words.replace("an instance of Sequence", "a list")
    return f"{'.'.join(keys)}: {words[:1].lower()}{words[1:]}, found {quoted(problem['input'])}."
