"""Published checkpoints, read as ours are: a file for each system, and a line in `FORMATS`."""

from typing import Any

from r2flow.published import flows, gans, lidargen, lidm, r2dm
from r2flow.published.flows import published_cfg
from r2flow.published.format import Format, Published

__all__ = ["FORMATS", "Format", "Published", "format_of", "published_cfg"]

FORMATS: tuple[Format, ...] = (
    flows.FORMAT, r2dm.FORMAT, gans.FORMAT, lidargen.FORMAT, lidm.DIFFUSION, lidm.FIRST_STAGE,
)  # fmt: skip


def format_of(content: Any) -> Format | None:
    """The published format of a torch file's content; None for another one."""
    return next((one for one in FORMATS if one.holds(content)), None)
