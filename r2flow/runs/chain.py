"""Chains of runs, such as 1-RF -> 2-RF -> k-TD -> report: one process per link; finished links are skipped."""

import ctypes
import json
import re
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from r2flow.config import flatten, key_of, override, rule
from r2flow.errors import InputError, naming
from r2flow.files import read_json, write_file
from r2flow.model.checkpoint import checkpoints_of, step_of
from r2flow.runs.composing import compose
from r2flow.runs.folder import read_config
from r2flow.signals import code_of, listening
from r2flow.stages import STAGES

RECORD = "link.json"


@dataclass(frozen=True)
class Link:
    name: str  # in the chain, and of the folder
    run_dir: Path
    overrides: tuple[str, ...]  # command line of the run
    parent: str | None = None  # name of the link that it starts from, if any


def links_of(chain: Mapping[str, Any], folder: Path, given: Sequence[str], configs: Sequence[str] = ()) -> list[Link]:
    """The runs of a chain in the order of their parents; `init` names a link's parent.

    The user's command line, `given`, follows each link's own overrides, as far as it concerns the link.
    `configs` are further folders of configs.
    """
    if any(key_of(text) == "stage.init" for text in given):
        raise InputError("stage.init is each link's own: give +chain.LINK.stage.init=RUN to one of them.")
    links: list[Link] = []
    for name, difference in chain.items():
        if not (isinstance(difference, Mapping) and isinstance(name, str) and re.fullmatch(r"[\w-][\w.-]*", name)):
            raise InputError(f"chain.{name}: a link is a name ('1', not 1) and groups of keys; found {difference!r}.")
        settings = dict(difference)
        parent = None if (init := settings.pop("init", None)) is None else str(init)  # a name may be a number
        own = [
            override("stage" if key == "stage.name" else key, value)  # a choice, with its own options
            for key, value in flatten(settings)
            if (key, value) != ("experiment", None)
        ]
        if any(key_of(text) == "plugins" for text in own):
            raise InputError(f"chain.{name}.plugins: plug-ins are given to all links, as --plugin MODULE.")
        begins = dict(flatten(difference)).keys() & {"experiment", "init", "stage.init"}  # a mistyped link does not
        if parent not in (None, *(link.name for link in links)) or (links and not begins):
            raise InputError(f"chain.{name} starts from {parent or 'nothing'}; give init=EARLIER or an experiment.")
        if parent is not None:
            own.append(override("stage.init", str(Path(folder, parent))))
        # Overrides given for this link alone come last: they replace the link's own keys.
        alone = [text.lstrip("+") for text in given if text.lstrip("+").startswith(f"chain.{name}.")]
        alone = [key for text in alone if not (key := text.removeprefix(f"chain.{name}.")).startswith("init=")]
        with naming(f"chain.{name}"):
            config = compose([*own, *alone], configs)
            on_pairs = config["data"]["name"] == "pairs" or STAGES[config["stage"]["name"]].needs_pairs
        concerning = ("all", "pairs" if on_pairs else "scans")
        overrides = [text for text in given if rule(key_of(text)).links in concerning] + alone
        sets = [text for text in (*own, *overrides) if key_of(text) == "data"]
        if sets and not re.fullmatch("data='?simulated'?", sets[-1]):  # other scans have no scenes, or their own
            own = [text for text in own if key_of(text) != "data.scenes"]
        run_dir = Path(folder, name)
        links.append(Link(name, run_dir, (*own, *overrides, override("run_dir", str(run_dir))), parent))
    return links


def has_ended(run: Path) -> bool:
    """Whether a run's last checkpoint has reached its config's last step."""
    config, last = read_config(run), next(iter(checkpoints_of(run)), None)
    return config is not None and last is not None and step_of(last) >= config["trainer"]["max_steps"]


def is_finished(link: Link) -> bool:
    """Whether a link was finished by the same command and still has its checkpoint."""
    return is_noted(link.run_dir, link) and has_ended(link.run_dir)


def note(folder: Path, *links: Link) -> None:
    """Record in a folder the finished links that it holds or, for a report, compares."""
    write_file(folder / RECORD, json.dumps([_record(link) for link in links], indent=2))


def is_noted(folder: Path, *links: Link) -> bool:
    """Whether the folder has the record of exactly these links, as they are now."""
    try:
        return bool(read_json(folder / RECORD) == [_record(link) for link in links])
    except (OSError, ValueError):
        return False


def _record(link: Link) -> dict[str, Any]:
    """Record of a finished link: its command line without the chain's folder, which may move, and its checkpoint."""
    last = next(iter(checkpoints_of(link.run_dir)), None)
    folder = override("", f"{link.run_dir.parent}/")[:-1]  # quoted as in the overrides
    overrides = [text.replace(folder, "='") for text in link.overrides]
    return {"overrides": overrides, "checkpoint": last and [last.name, last.stat().st_size]}


def run_process(command: Sequence[str]) -> int:
    """Run a command, forward stop signals to it, and end it with this process; its exit code is that of a shell."""
    received: list[int] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if process is not None and process.poll() is None:
            process.send_signal(number)

    process: subprocess.Popen[bytes] | None = None
    with listening(pass_on):
        # PR_SET_PDEATHSIG: a run that outlived its chain or sweep would block the same command when given again.
        end = (lambda: ctypes.CDLL(None).prctl(1, signal.SIGKILL)) if sys.platform == "linux" else None
        process = subprocess.Popen(command, preexec_fn=end)
        if received:
            process.send_signal(received[0])
        code = process.wait() or -next(iter(received), 0)
    return code_of(-code) if code < 0 else code
