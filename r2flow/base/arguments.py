"""Named arguments of constructors: wrong ones are refused, docstrings describe all."""

import inspect
import re
from typing import Any, Self

from r2flow.base.errors import InputError
from r2flow.base.registry import did_you_mean

# One argument in a docstring's `Args`, with its lines.
_SAID = re.compile(r"^(    (\w+): .*(?:\n      +.*)*)", re.M)


class NamedArguments:
    """Base of classes whose constructors name each argument.

    A wrong name is refused with the right one. A subclass describes its own arguments; its
    `__doc__` takes the sentences of the others from its base.
    """

    def __new__(cls, *args: Any, **options: Any) -> Self:
        parameters = inspect.signature(cls).parameters
        if not any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
            for name in options.keys() - parameters.keys():
                hint = did_you_mean(name, list(parameters)) or f" It has {', '.join(parameters)}."
                raise InputError(f"{cls.__name__} has no argument '{name}'.{hint}")
        return super().__new__(cls)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        before, own, after = _parts(cls.__dict__.get("__doc__"))
        _, inherited, _ = _parts(cls.__base__.__doc__)
        said = inherited | own
        listed = [said[name] for name in inspect.signature(cls).parameters if name in said]
        arguments = "\n".join(["Args:", *listed])
        cls.__doc__ = "\n\n".join(filter(None, [before, arguments, after]))


def _parts(doc: str | None) -> tuple[str, dict[str, str], str]:
    """A docstring before `Args`, the lines of each argument by its name, and what follows them."""
    before, _, rest = inspect.cleandoc(doc or "").partition("Args:\n")
    arguments, _, after = rest.partition("\n\n")
    return before.strip(), {name: text for text, name in _SAID.findall(arguments)}, after
