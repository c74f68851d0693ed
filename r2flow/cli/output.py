"""What verbs print at their end."""

import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.reports.pages import Page


def numbers(option: str, text: str, kind: type = float) -> list[Any]:
    """'4,8' as [4, 8]."""
    try:
        values = [kind(part) for part in text.split(",")]
    except ValueError:
        values = [0]
    if not all(0 < value < math.inf for value in values):
        raise InputError(f"--{option} must be positive numbers separated by commas, found {text!r}.")
    return values


def command() -> str:
    """The command as it was typed, for a shell."""
    return shlex.join(["r2flow", *sys.argv[1:]])


def finish(page: "Page", out: Path, said: Sequence[str]) -> None:
    """Write a page; print these parts of it, and the files."""
    from r2flow.reports.pages import write_page

    written = write_page(page, out)
    print("\n\n".join(said), end="\n\n")
    print(*written, sep="\n")
