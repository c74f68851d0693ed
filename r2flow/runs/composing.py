"""From a command line to a config: `conf/` composed by Hydra, choices for what plug-ins add, mistakes in one line."""

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import hydra
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType, Sweep
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf

from r2flow.errors import InputError
from r2flow.registry import Bound, Seed, check_options, did_you_mean, options_of

CONF = Path(__file__).resolve().parents[1] / "conf"

# What has a Hydra group: its registry, and what a config does not say because the run does.
REGISTRIES = {
    "stage": ("r2flow.stages", "STAGES", ("batch_size", "seed")),
    "backbone": ("r2flow.backbones", "BACKBONES", ("in_channels", "out_channels", "second_time")),
    "data": ("r2flow.data.opening", "SOURCES", ()),
}


def compose(overrides: Sequence[str] = (), folders: Sequence[str | Path] = ()) -> dict[str, Any]:
    """The config of a command line, as plain dicts: `compose(["data=kitti_raw", "data.root=FOLDER"])`.

    Args:
        folders: Further config folders, as `--config-dir` names one.

    Raises:
        HydraException: an unknown key or choice; `explain` has it in a line.
    """
    overrides = as_hydra_takes(overrides)
    search = (
        [f"hydra.searchpath=[{','.join(f'file://{Path(folder).resolve()}' for folder in folders)}]"] if folders else []
    )
    with _hydra():
        try:
            config = hydra.compose("train", [*overrides, *search], return_hydra_config=True)
        except MissingConfigException as error:
            if not add_choice(error):
                raise
            config = hydra.compose("train", [*overrides, *search], return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        return plain(config)


def names_folder(text: str) -> bool:
    """Whether a text names a folder below another one."""
    return bool(text.strip("./")) and ".." not in Path(text).parts


@dataclass(frozen=True)
class Keys:
    """The keys at the top of a run's config."""

    stage: Mapping[str, Any]
    backbone: Mapping[str, Any]
    sensor: Mapping[str, Any]
    encoding: Mapping[str, Any]
    data: Mapping[str, Any]
    trainer: Mapping[str, Any]
    callbacks: Mapping[str, Any]
    samples: Mapping[str, Any]
    run_dir: Annotated[str, Bound("that names a folder", lambda text: text.strip("/ "))]
    seed: Seed
    name: Annotated[str, Bound("that names a folder in runs", names_folder)] | int | float = "run"
    experiment: str | Sequence[str] | None = None
    generator: Mapping[str, Any] | str | None = None
    sampler: Mapping[str, Any] | None = None
    few: Mapping[str, Any] | None = None
    chain: Mapping[str, Any] | None = None
    preview: str | None = None
    loggers: Sequence[str] | str | None = None  # a word is answered by `build_loggers`
    plugins: Sequence[str] = ()
    parent: Mapping[str, Any] | None = None
    scans: Any = None


def check_keys(config: Mapping[str, Any]) -> None:
    """Check what stands at the top of a config.

    Raises:
        InputError: a key that nothing reads, one that is missing, or a value of another type.
    """
    check_options("the config", Keys, config)


@contextmanager
def _hydra() -> Iterator[None]:
    """Hydra on `conf/` for the length of a block; the process's own, if it has one, is untouched."""
    before, config = GlobalHydra.instance().hydra, HydraConfig.instance().cfg
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra, HydraConfig.instance().cfg = before, config


def plain(config: DictConfig) -> dict[str, Any]:
    """A composed config as plain dicts, all of it resolved but what is Hydra's own."""
    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    own._set_parent(config._get_parent())
    found = OmegaConf.to_container(own, resolve=True, throw_on_missing=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def add_choices(group: str) -> None:
    """Make a Hydra choice of each entry of a group's registry that has no YAML file: its constructor's options."""
    module, table, given_by_run = REGISTRIES[group]
    store = ConfigStore.instance()
    for name, entry in getattr(import_module(module), table).items():
        if (CONF / group / f"{name}.yaml").is_file():
            continue
        if group == "data":
            node: dict[str, Any] = {"defaults": ["base", "_self_"], "name": name}
        else:
            node = {key: value for key, value in options_of(entry, given=1).items() if key not in given_by_run}
            if group == "stage":
                node = {"init": None, **node}
            node = {"name": name, **node}
        store.store(name, node, group=group)


def add_choice(error: MissingConfigException) -> bool:
    """Whether a choice that Hydra did not find is one of a registry, as a plug-in may have entered it.

    A name that looks like a misspelt file's is not looked for there where that would take the time to load torch.
    All groups get their choices: the same command may name several.
    """
    group, _, name = str(error.missing_cfg_file or "").rpartition("/")
    if group not in REGISTRIES:
        return False
    module, table, _ = REGISTRIES[group]
    if module not in sys.modules and did_you_mean(name, choices(group)):
        return False
    if name not in getattr(import_module(module), table):
        return False
    for one in REGISTRIES:
        add_choices(one)
    return True


def choices(group: str) -> list[str]:
    """The names of a group's configs."""
    known = {path.stem for path in (CONF / group).glob("*.yaml")} - {"base"}
    stored = ConfigStore.instance().repo.get(group, {})
    return sorted(known | {name.removesuffix(".yaml") for name in stored})


CHOICE = str | dict | Sweep  # what a group of configs can be given
MAY_GO = ("callbacks", "chain", "experiment", "hydra", "plugins")  # from which ~KEY may take something


def as_hydra_takes(overrides: Sequence[str]) -> list[str]:
    """Overrides, of which `KEY={name: NAME, ...}` takes the whole place of what was there: it has options of its own.

    Raises:
        InputError: a group of configs without a choice from it, or what is not Hydra's grammar.
    """
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} - {"hydra"}
    found: list[str] = []
    parser = OverridesParser.create()
    for text in overrides:
        try:
            parsed = parser.parse_override(text)
        except HydraException:
            raise InputError(
                f"{text} cannot be read: give KEY=VALUE, brackets and quotes closed, and quotes around spaces and "
                "=, as 'KEY=\"a value\"'."
            ) from None
        key, value = parsed.key_or_group, parsed.value()
        if not key:
            raise InputError(f"{text} names no key: give KEY=VALUE.")
        if key == "hydra":
            raise InputError(f"{text}: hydra has keys of its own, as hydra.sweep.dir=FOLDER.")
        names = value if isinstance(value, list) else [value]
        if key in groups and (parsed.is_delete() or "" in names or not all(isinstance(one, CHOICE) for one in names)):
            if key == "experiment" and (parsed.is_delete() or value is None):  # as it is by itself
                continue
            raise InputError(f"{text} leaves the run without its {key}: give one of {', '.join(choices(key))}.")
        if parsed.is_delete() and key.partition(".")[0] not in MAY_GO:
            raise InputError(f"{text}: every run has its {key}; give {key}=VALUE.")
        named = isinstance(value, dict) and "name" in value and "." in key and not key.startswith("chain.")
        found += [f"{key}=null", f"++{text}"] if named and parsed.type == OverrideType.CHANGE else [text]
    if "size=small" in found and not any(re.match(r"\+?experiment=[^\[]", text) for text in found):
        raise InputError("size=small is a form of one experiment: give experiment=NAME, such as r2dm.")
    return found


def explain(error: Exception) -> str:
    """Hydra's complaint in one line, with the nearest key that exists."""
    text = str(error)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    unknown = re.search(r"Could not (?:override|delete from config\.) '([^']+)'", text)
    if unknown:
        within = re.search(r"full_key: (\S+)", str(error.__cause__))  # of a group's value, the key in it
        key = max(unknown[1], within[1] if within else "", key=len)
        others = [known for known in known_keys() if not key.startswith(f"{known}.")]  # its own group says nothing new
        return f"the config has no key '{key}'.{did_you_mean(key, others)} See --cfg job for all of them."
    missing = re.search(r"Missing mandatory value.*full_key: (\S+)", text, re.DOTALL)
    if missing:
        return f"{missing[1]} has no default: give {missing[1]}=VALUE."
    if "Could not find 'hydra/launcher/submitit" in text:
        return "this launcher needs an extra of the project: python -m pip install -e '.[slurm]'"
    choice = re.search(r"Could not find '([^/']+)/([^']+)'", text)
    if choice:
        group, name = choice.groups()
        known = choices(group)
        own = f" One of yours is found by --config-dir FOLDER, in FOLDER/{group}/NAME.yaml."
        return f"no {group} config named '{name}'; known: {', '.join(known)}.{did_you_mean(name, known) or own}"
    several = re.search(r"Ambiguous value for argument '([^=']+)=([^']*)'", text)
    if several:
        key, values = several.groups()
        return f"{key}={values} is several values: for a sweep add -m, for a list give {key}=[{values}]."
    return " ".join(lines[:2])


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


def known_keys() -> list[str]:
    """Every key of the default config, and its groups."""
    with _hydra():
        composed = hydra.compose("train")
    keys: list[str] = []

    def walk(node: DictConfig, prefix: str) -> None:
        for key in map(str, node):
            keys.append(prefix + key)
            value = node._get_node(key)
            if isinstance(value, DictConfig) and not value._is_none():
                walk(value, f"{prefix}{key}.")

    walk(composed, "")
    return keys
