"""1-RF -> pairs -> 2-RF -> pairs -> k-TD -> report: each link its own process, finished ones skipped."""

import ctypes
import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2flow.checkpoints import checkpoints_of
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.runs import flatten

RECORD = "link.json"

# Of the command line: what the chain itself is, and what concerns only the link that reads scans.
CHAIN_KEYS = ("experiment", "name", "run_dir", "chain", "hydra")
SCAN_KEYS = (
    "backbone", "sensor", "encoding", "data", "data.root", "data.split", "data.drives", "data.scenes",
    "data.projection", "data.convention", "data.reflectance_scale", "data.on_bad_scan",
    "data.augment", "data.parts", "data.validation.data",
)  # fmt: skip


@dataclass(frozen=True)
class Link:
    """One run of a chain.

    Attributes:
        name: Its name in the chain, and of its folder.
        run_dir: Where it lives.
        overrides: Its command line.
    """

    name: str
    run_dir: Path
    overrides: tuple[str, ...]


def links_of(chain: Mapping[str, Mapping[str, Any]], folder: str | Path, given: Sequence[str]) -> list[Link]:
    """The runs of a chain in the order of their parents.

    Args:
        chain: Config differences by name; `init` names the link that one starts from.
        folder: The chain's folder; each link gets one of its name below it.
        given: What the user gave on the command line. It goes to every link that it concerns, after the link's own.

    Raises:
        InputError: a link starts from one that does not come before it, or the command line says where all do.
    """
    if any(one.lstrip("+~").partition("=")[0] == "stage.init" for one in given):
        raise InputError("stage.init is each link's own: give +chain.LINK.stage.init=RUN to one of them.")
    links: list[Link] = []
    for name, difference in chain.items():
        own, parent = dict(difference), difference.get("init")
        own.pop("init", None)
        overrides = [override(key, value) for key, value in flatten(own) if (key, value) != ("experiment", None)]
        if parent is not None:
            if parent not in [link.name for link in links]:
                raise InputError(f"chain.{name}.init={parent}: no link of that name comes before it.")
            overrides.append(override("stage.init", str(Path(folder, parent))))
        reads_scans = parent is None and (own.get("stage") or {}).get("init") is None
        overrides += [one for one in given if _concerns(one, reads_scans)]
        # What the user gave to this link alone comes last, for it is what the link's own has become.
        mine = f"chain.{name}."
        alone = [one.lstrip("+").removeprefix(mine) for one in given if one.lstrip("+").startswith(mine)]
        overrides += [one for one in alone if not one.startswith("init=")]
        run_dir = Path(folder, name)
        links.append(Link(name, run_dir, (*overrides, override("run_dir", str(run_dir)))))
    return links


def override(key: str, value: Any) -> str:
    """One key in Hydra's grammar."""
    if isinstance(value, list | tuple):
        return f"{key}=[{','.join(override('', one)[1:] for one in value)}]"
    if value is None or isinstance(value, bool):
        return f"{key}={json.dumps(value)}"
    if isinstance(value, str) and not value.replace("_", "").replace("-", "").isalnum():
        escaped = value.replace("\\", "\\\\").replace("'", "\\'")
        return f"{key}='{escaped}'"
    return f"{key}={value}"


def _concerns(given: str, reads_scans: bool) -> bool:
    key = given.lstrip("+~").partition("=")[0]
    if _within(key, CHAIN_KEYS):
        return False
    if reads_scans:
        return not _within(key, ("data.pairs",))
    return key not in SCAN_KEYS and not _within(key, ("backbone", "sensor", "encoding", "data.validation.data"))


def _within(key: str, groups: Sequence[str]) -> bool:
    return any(key == group or key.startswith(f"{group}.") for group in groups)


def run_chain(links: Sequence[Link], train: Path) -> tuple[int, bool]:
    """Run what is not finished yet, each link as its own process.

    Returns:
        The exit code of the first that fails, or 0, and whether any was run.
    """
    skipping = True
    for number, link in enumerate(links, 1):
        # After a link that had to run, the later ones look for themselves whether they still fit to it.
        if skipping and is_finished(link):
            print(f"[{number}/{len(links)}] {link.name}: finished before, {link.run_dir}", flush=True)
            continue
        skipping = False
        print(f"[{number}/{len(links)}] {link.name}: {link.run_dir}", flush=True)
        code = _run(link, train)
        if code:
            if code != 2:  # which is the user's to mend, and has been said
                print(f"the chain stopped in {link.name}; the same command goes on there", file=sys.stderr, flush=True)
            return code, True
        with atomic_write(link.run_dir / RECORD, "w") as file:
            json.dump(_record(link), file, indent=2)
    return 0, not skipping


def is_finished(link: Link) -> bool:
    """Whether a link ended well under the same command, and has not lost its checkpoint since."""
    try:
        record = json.loads((link.run_dir / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return record == _record(link) and record["checkpoint"] is not None


def _record(link: Link) -> dict[str, Any]:
    """What a finished link leaves: its command line, and its last checkpoint's name and size."""
    last = next(iter(checkpoints_of(link.run_dir)), None)
    return {"overrides": list(link.overrides), "checkpoint": last and [last.name, last.stat().st_size]}


def record_report(links: Sequence[Link], out: Path) -> None:
    """Note beside the report what it is of."""
    with atomic_write(out / RECORD, "w") as file:
        json.dump([_record(link) for link in links], file, indent=2)


def is_reported(links: Sequence[Link], out: Path) -> bool:
    """Whether the report on just these links is there."""
    try:
        return bool(json.loads((out / RECORD).read_text(encoding="utf-8")) == [_record(link) for link in links])
    except (OSError, ValueError):
        return False


def _run(link: Link, train: Path) -> int:
    command = [sys.executable, str(train), *link.overrides]
    with subprocess.Popen(command, preexec_fn=_die_with_parent if sys.platform == "linux" else None) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:  # the link has had it too, and says where it stopped
            process.wait()
            return 130


def _die_with_parent() -> None:
    """A link that outlives its killed chain would be in the way of the same command given again."""
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
