"""What a published format of checkpoints is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from r2flow.generators import Generator


@dataclass(frozen=True)
class Published:
    """A generator of a published file in our terms.

    Attributes:
        config: `r2flow.generators.build_generator` makes the generator of it; the file's own config under `published`.
        weights: Of that generator, by our names.
        step: Optimiser steps taken.
        sampler: Options of its `Sampler`, as published; None for 32 Euler steps.
        finish: Called with the generator, which has its weights, and the config.
    """

    config: dict[str, Any]
    weights: dict[str, Tensor]
    step: int = 0
    sampler: Mapping[str, Any] | None = None
    finish: Callable[[Generator, Mapping[str, Any]], None] | None = None


class Read(Protocol):
    """Raises `InputError` for a file of this format that lacks or garbles a part."""

    def __call__(self, content: Any, path: Path, averaged: bool = True) -> Published: ...


class Format(NamedTuple):
    """A published layout of checkpoint files.

    Attributes:
        system: Whose it is.
        holds: Whether the content of a torch file is of this format.
        read: The generator in it, with its averaged weights or, on demand, the raw ones.
    """

    system: str
    holds: Callable[[Any], bool]
    read: Read
