"""Chains of runs, such as 1-RF -> 2-RF -> k-TD: one after another, each from the weights of an
earlier one.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2flow.base.config import flatten, key_of, override
from r2flow.base.errors import InputError, naming
from r2flow.base.registry import Config, Options
from r2flow.base.signals import LATER, Stopped
from r2flow.data.options import PAIRS, SIMULATED
from r2flow.model.config import RunConfig, links_of_key
from r2flow.model.lineage import Parent
from r2flow.model.paths import FOLDER
from r2flow.reports.chain import link_label
from r2flow.runs.composing import compose
from r2flow.stages import STAGES
from r2flow.training import build, check, fit


@dataclass(frozen=True)
class Link:
    name: str  # in the chain, and of the folder
    config: RunConfig
    asked: tuple[str, ...]  # keys of the chain and of its command line
    parent: str | None = None  # name of the link that it starts from, if any


def links_of(
    chain: Options, folder: Path, overrides: Sequence[str], configs: Sequence[str] = ()
) -> list[Link]:
    """The runs of a chain in the order of their parents; `parent` names a link's parent.

    The command line, `overrides`, follows each link's own keys, as far as it concerns the link.
    `configs` are further folders of configs.
    """
    if any(key_of(text) == "stage.parent" for text in overrides):
        raise InputError(
            "stage.parent is each link's own: give +chain.LINK.stage.parent=RUN to one of them."
        )
    links: list[Link] = []
    for name, keys in chain.items():
        settings = _checked(name, keys)
        parent = settings.pop("parent", None)
        earlier = [link.name for link in links]
        # A mistyped link has neither.
        stage = settings["stage"]
        begins = "experiment" in settings or "parent" in stage
        if parent not in (None, *earlier) or (links and not begins and parent is None):
            raise InputError(
                f"chain.{name} starts from {parent or 'nothing'}; give parent=EARLIER or an "
                "experiment."
            )
        if parent is not None:
            stage["parent"] = str(Path(folder, parent))
        # Overrides given for this link alone come last: they replace the link's own keys.
        prefix = re.compile(rf"\+*chain\.{re.escape(name)}\.(?!parent=)")
        alone = [prefix.sub("", text, count=1) for text in overrides if prefix.match(text)]
        run_dir = override("run_dir", str(Path(folder, name)))
        links.append(_link(name, settings, [*overrides], [*alone, run_dir], parent, configs))
    return links


def _checked(name: Any, keys: Any) -> Config:
    """The keys of a link; its stage is a group, so that a parent can be added."""
    named = isinstance(name, str) and re.fullmatch(r"[\w-][\w.-]*", name)
    if not (isinstance(keys, Mapping) and named):
        raise InputError(
            f"chain.{name}: a link is a name ('1', not 1) and groups of keys; found {keys!r}."
        )
    if any(key.lstrip("+") == "plugins" for key in keys):
        raise InputError(
            f"chain.{name}.plugins: plug-ins are given to all links, as --plugin MODULE."
        )
    groups = {key: dict(one) if isinstance(one, Mapping) else one for key, one in keys.items()}
    stage = groups.get("stage") or {}
    return {**groups, "stage": {"name": stage} if isinstance(stage, str) else stage}


def _link(
    name: str,
    settings: Config,
    given: Sequence[str],
    last: Sequence[str],
    parent: str | None,
    configs: Sequence[str],
) -> Link:
    """A link with the overrides of the chain's command line that concern it."""
    with naming(f"chain.{name}"):
        config = RunConfig.of(compose(last, configs, settings))
        on_pairs = config.data.name == PAIRS or STAGES[config.recipe.name].needs_pairs
    concerning = ("all", "pairs" if on_pairs else "scans")
    overrides = [*(text for text in given if links_of_key(text) in concerning), *last]
    try:
        config = RunConfig.of(compose(overrides, configs, settings))
        data = settings.get("data", {})
        if config.data.name != SIMULATED and "scenes" in data:
            del data["scenes"]  # other scans have none, or their own
            config = RunConfig.of(compose(overrides, configs, settings))
    except InputError as error:
        raise _in_link(name, error) from None
    asked = [*(key for key, _ in flatten(settings)), *map(key_of, overrides)]
    return Link(name, config, tuple(asked), parent)


def _in_link(name: str, error: InputError) -> InputError:
    return InputError(f"chain.{name}: {error} For another link alone: +chain.LINK.KEY=VALUE.")


def train_links(links: Sequence[Link]) -> int:
    """Train the links that are not finished, in this process; the exit code is 0 or, if one was
    stopped, 75.
    """
    for number, link in enumerate(links, 1):
        try:
            with naming(f"chain.{link.name}"):
                label = link_label(link.name, link.config.recipe.name)
                print(f"[{number}/{len(links)}] {label}: {link.config.run_dir}", flush=True)
                finished = fit(build(link.config, link.asked)).finished
        except Stopped:
            print(
                f"the chain stopped in {link.name}; the same command resumes there",
                file=sys.stderr,
            )
            raise
        if not finished:
            return LATER
    return 0


def check_links(links: Sequence[Link]) -> None:
    """Build all links before the first one is trained, so that errors are reported early."""
    configs: dict[str, RunConfig] = {}
    for link in links:
        parent = None
        if link.parent is not None:
            before = configs[link.parent]
            steps = before.trainer.max_steps
            file = Path(before.run_dir, FOLDER, f"step-{steps:08d}.ckpt")
            parent = Parent(before.model_config(), file, steps)
        try:
            configs[link.name] = check(link.config, link.asked, parent)
        except InputError as error:
            raise _in_link(link.name, error) from None
