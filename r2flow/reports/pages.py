"""Writing of reports: figures, JSON and Markdown, each with its provenance."""

import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

import r2flow
from r2flow.files import write_file
from r2flow.reports.pictures import save_figure
from r2flow.reports.tables import Row, words

# Markers and dashes distinguish lines without colour.
_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (7, 2)), (0, (1, 1)), "-", "--", "-.", ":", "-")
_COLOURS = (
    "#000000", "#1f6fb4", "#b5301c", "#3d7d3a", "#8c4fb0", "#c77c11",
    "#c2185b", "#0e6f6f", "#8f8f8f", "#d06a9e", "#7a5a2a", "#b9b936",
)  # fmt: skip
STYLES: tuple[dict[str, Any], ...] = tuple(
    {"marker": marker, "linestyle": dash, "color": colour}
    for marker, dash, colour in zip("os^DvPX*<>hp", _DASHES, _COLOURS, strict=True)
)


def command() -> str:
    """The command line of this process, quoted for a shell."""
    program, *arguments = sys.argv
    verb = Path(program).stem in ("r2flow", "__main__")
    return shlex.join([*(["r2flow"] if verb else ["python", program]), *arguments])


@dataclass(frozen=True)
class Page:
    """Contents of a report."""

    name: str  # stem of the files, such as `solvers`
    title: str
    text: Sequence[str]
    rows: Sequence[Row]
    figures: Mapping[str, Figure]
    seeds: Mapping[str, int] = field(default_factory=dict)
    device: str = "cpu"
    more: Mapping[str, Sequence[Row]] = field(default_factory=dict)


def write_page(page: Page, out: str | Path) -> list[Path]:
    """Write `out/NAME.png ...`, `NAME.pdf`, `NAME.json` and `NAME.md` atomically; returns the files."""
    out, origin = Path(out), provenance(page)
    written = [
        save_figure(figure, out / f"{name}.{ending}", title=page.title, about=json.dumps(origin))
        for name, figure in page.figures.items()
        for ending in ("png", "pdf")
    ]
    for ending, content in ("json", _json(page, origin)), ("md", _markdown(page, origin)):
        written.append(out / f"{page.name}.{ending}")
        write_file(written[-1], content)
    return written


def write_json(page: Page, path: Path) -> None:
    write_file(path, _json(page, provenance(page)))


def provenance(page: Page) -> dict[str, Any]:
    """Machine, versions, seeds, date and command of a page; only the command has paths."""
    machine = {
        "cpu": _cpu_name(), "cores": os.cpu_count() or 1, "threads": torch.get_num_threads(),
        "system": platform.platform(terse=True),
    }  # fmt: skip
    if page.device.startswith("cuda"):
        machine["gpu"] = torch.cuda.get_device_name(page.device)
    return {
        "report": page.title,
        "command": command(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine,
        "versions": {"r2flow": r2flow.__version__, "torch": torch.__version__, "python": platform.python_version()},
        "seeds": dict(page.seeds),
        "device": page.device,
    }


def blank_figure(width: float, height: float) -> Figure:
    """Create an empty figure, sized in inches."""
    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


def _json(page: Page, origin: Mapping[str, Any]) -> str:
    return json.dumps(_plain({"origin": origin, "rows": page.rows, **page.more}), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """Convert values for JSON, which has no NaN or infinity."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _markdown(page: Page, origin: Mapping[str, Any]) -> str:
    pictures = [f"![{name.replace('_', ' ')}]({name}.png)" for name in page.figures]
    lines = {key: (words(value) or "none") if isinstance(value, Mapping) else value for key, value in origin.items()}
    notes = [f"- {key}: {text}" for key, text in lines.items() if key not in ("report", "command")]
    again = ["## Where this comes from", "Made with", f"```\n{origin['command']}\n```", "\n".join(notes)]
    return "\n\n".join([f"# {page.title}", *pictures, *page.text, *again]) + "\n"


def _cpu_name() -> str:
    with suppress(OSError, IndexError):
        return re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))[0]
    return platform.processor() or "unknown"
