"""Chains of runs, such as 1-RF -> 2-RF -> k-TD: one after another, each from the weights of an
earlier one.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2flow.base.config import flatten, key_of, links_of_key, override
from r2flow.base.errors import InputError, naming
from r2flow.base.registry import Config, Options
from r2flow.base.signals import LATER, Stopped
from r2flow.model.lineage import Parent
from r2flow.model.paths import FOLDER
from r2flow.reports.chain import link_label
from r2flow.runs.composing import compose
from r2flow.stages import STAGES
from r2flow.training import build, check, fit


@dataclass(frozen=True)
class Link:
    name: str  # in the chain, and of the folder
    run_dir: Path
    overrides: tuple[str, ...]  # command line of the run
    parent: str | None = None  # name of the link that it starts from, if any


def links_of(
    chain: Options, folder: Path, given: Sequence[str], configs: Sequence[str] = ()
) -> list[Link]:
    """The runs of a chain in the order of their parents; `parent` names a link's parent.

    The user's command line, `given`, follows each link's own overrides, as far as it concerns the
    link. `configs` are further folders of configs.
    """
    if any(key_of(text) == "stage.parent" for text in given):
        raise InputError(
            "stage.parent is each link's own: give +chain.LINK.stage.parent=RUN to one of them."
        )
    links: list[Link] = []
    for name, difference in chain.items():
        parent, own = _own(name, difference)
        earlier = [link.name for link in links]
        # A mistyped link has neither.
        begins = dict(flatten(difference)).keys() & {"experiment", "parent", "stage.parent"}
        if parent not in (None, *earlier) or (links and not begins):
            raise InputError(
                f"chain.{name} starts from {parent or 'nothing'}; give parent=EARLIER or an "
                "experiment."
            )
        if parent is not None:
            own.append(override("stage.parent", str(Path(folder, parent))))
        # Overrides given for this link alone come last: they replace the link's own keys.
        prefix = re.compile(rf"\+*chain\.{re.escape(name)}\.(?!parent=)")
        alone = [prefix.sub("", text, count=1) for text in given if prefix.match(text)]
        with naming(f"chain.{name}"):
            config = compose([*own, *alone], configs)
        on_pairs = config["data"]["name"] == "pairs" or STAGES[config["stage"]["name"]].needs_pairs
        concerning = ("all", "pairs" if on_pairs else "scans")
        overrides = [text for text in given if links_of_key(key_of(text)) in concerning] + alone
        sets = [text for text in (*own, *overrides) if key_of(text) == "data"]
        # Other scans have no scenes, or their own.
        if sets and not re.fullmatch("data='?simulated'?", sets[-1]):
            own = [text for text in own if key_of(text) != "data.scenes"]
        run_dir = Path(folder, name)
        own += [*overrides, override("run_dir", str(run_dir))]
        links.append(Link(name, run_dir, tuple(own), parent))
    return links


def _own(name: Any, difference: Any) -> tuple[str | None, list[str]]:
    """The parent's name and the overrides of a link of the config."""
    named = isinstance(name, str) and re.fullmatch(r"[\w-][\w.-]*", name)
    if not (isinstance(difference, Mapping) and named):
        raise InputError(
            f"chain.{name}: a link is a name ('1', not 1) and groups of keys; found {difference!r}."
        )
    settings = dict(difference)
    parent = settings.pop("parent", None)
    own: list[str] = []
    for key, value in flatten(settings):
        if (key, value) != ("experiment", None):
            # A choice, with its own options.
            own.append(override("stage" if key == "stage.name" else key, value))
    if any(key_of(text) == "plugins" for text in own):
        raise InputError(
            f"chain.{name}.plugins: plug-ins are given to all links, as --plugin MODULE."
        )
    return None if parent is None else str(parent), own


def train_links(links: Sequence[Link], folders: Sequence[str] = ()) -> int:
    """Train the links that are not finished, in this process; the exit code is 0 or, if one was
    stopped, 75.
    """
    for number, link in enumerate(links, 1):
        try:
            with naming(f"chain.{link.name}"):
                config = compose(link.overrides, folders)
                label = link_label(link.name, config)
                print(f"[{number}/{len(links)}] {label}: {link.run_dir}", flush=True)
                finished = fit(build(config, link.overrides)).finished
        except Stopped:
            print(
                f"the chain stopped in {link.name}; the same command resumes there",
                file=sys.stderr,
            )
            raise
        if not finished:
            return LATER
    return 0


def check_links(links: Sequence[Link], folders: Sequence[str] = ()) -> None:
    """Build all links before the first one is trained, so that errors are reported early."""
    configs: Config = {}
    for link in links:
        parent = None
        if link.parent is not None:
            before = configs[link.parent]
            steps = before["trainer"]["max_steps"]
            parent = Parent(
                before, Path(before["run_dir"], FOLDER, f"step-{steps:08d}.ckpt"), steps
            )
        try:
            configs[link.name] = check(compose(link.overrides, folders), link.overrides, parent)
        except InputError as error:
            raise InputError(
                f"chain.{link.name}: {error} For another link alone: +chain.LINK.KEY=VALUE."
            ) from None
