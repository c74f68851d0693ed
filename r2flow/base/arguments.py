"""Named arguments of constructors: signatures and docstrings have all, values are checked."""

import inspect
import re
from typing import Any, ClassVar, Self

from r2flow.base.registry import check_options, signature_of

# One argument in a docstring's `Args`, with its lines.
_SAID = re.compile(r"^(    (\w+): .*(?:\n      +.*)*)", re.M)


class NamedArguments:
    """Base of classes whose constructors name each argument.

    Names and values are checked by the annotations, as those of a config. A subclass whose
    constructor passes `**options` on to its base has the arguments of its base, or those that
    `**options: Unpack[TYPED_DICT]` names, in its signature. It describes its own arguments; its
    `__doc__` takes the sentences of the others from its base.
    """

    __signature__: ClassVar[inspect.Signature | None]

    def __new__(cls, *args: Any, **options: Any) -> Self:
        if args or options:  # a copy is made without
            positional = zip(inspect.signature(cls).parameters, args, strict=False)
            check_options(cls.__name__, cls, dict(positional) | options)
        return super().__new__(cls)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__signature__ = None  # not that of the base
        cls.__signature__ = signature_of(cls)
        before, described, after = _parts(cls.__dict__.get("__doc__"))
        _, inherited, _ = _parts(cls.__base__.__doc__)
        said = inherited | described
        listed = [said[name] for name in cls.__signature__.parameters if name in said]
        arguments = "\n".join(["Args:", *listed])
        cls.__doc__ = "\n\n".join(filter(None, [before, arguments, after]))


def _parts(doc: str | None) -> tuple[str, dict[str, str], str]:
    """A docstring before `Args`, the lines of each argument by its name, and what follows them."""
    before, _, rest = inspect.cleandoc(doc or "").partition("Args:\n")
    arguments, _, after = rest.partition("\n\n")
    return before.strip(), {name: text for text, name in _SAID.findall(arguments)}, after
