"""Composition of configs: Hydra on `conf/`, choices of registries and plug-ins, one-line error messages."""

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from typing import Annotated, Any, TypeVar

import hydra
import yaml
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, OverrideType, Sweep
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from r2flow.config import flatten, key_of, override
from r2flow.errors import InputError, check
from r2flow.registry import Bound, Seed, did_you_mean, options_of

T = TypeVar("T")

CONF = Path(__file__).resolve().parents[1] / "conf"
WRONG = (HydraException, OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError)  # raised for a wrong config

# Hydra groups: the registry of each, and the options that the run sets instead of the config.
REGISTRIES = {
    "stage": ("r2flow.stages", "STAGES", ("batch_size", "seed")),
    "backbone": ("r2flow.backbones", "BACKBONES", ("in_channels", "out_channels", "second_time")),
    "data": ("r2flow.data.opening", "SOURCES", ()),
    "sensor": ("r2flow.lidar.sensors", "SENSORS", ()),
}


def compose(overrides: Sequence[str] = (), folders: Sequence[str | Path] = ()) -> dict[str, Any]:
    """Compose the config of a command line, as plain dicts: `compose(["data=kitti_raw", "data.root=FOLDER"])`.

    Args:
        folders: Additional config folders, as in `--config-dir`.

    Raises:
        InputError: an unknown key or choice.
    """
    for name, given in ("overrides", overrides), ("folders", folders):
        check(not isinstance(given, str), f"{name} are a list, as {[given]}; found a text.")
    search = [f"file://{Path(folder).resolve()}" for folder in folders]
    with _hydra():  # also where a mistake is explained, by its choices
        try:
            overrides = [*as_hydra_takes(overrides), override("hydra.searchpath", search)]
            config = with_choices(partial(hydra.compose, "train", overrides, return_hydra_config=True))
            HydraConfig.instance().set_config(config)
            return plain(config)
        except WRONG as error:
            raise InputError(explain(error)) from None


IN_RUNS = Bound("that names a folder in runs", lambda text: text.strip("./") and ".." not in Path(text).parts)
NAMED = Bound("with a name", lambda group: "name" in group)  # a user's file may lack it
GLOBAL = Bound("of files that begin with # @package _global_", lambda name: True)  # else their keys lie in experiment


@dataclass(frozen=True)
class Keys:
    """Top-level keys of a run's config."""

    stage: Annotated[Mapping[str, Any], NAMED]
    backbone: Mapping[str, Any]
    sensor: Mapping[str, Any]
    encoding: Mapping[str, Any]
    data: Annotated[Mapping[str, Any], NAMED]
    trainer: Mapping[str, Any]
    callbacks: Mapping[str, Any]
    samples: Mapping[str, Any]
    run_dir: Annotated[str, Bound("that names a folder", lambda text: text.strip("/ "))]
    seed: Seed
    name: Annotated[str, IN_RUNS] | int | float = "run"
    experiment: Annotated[str | Sequence[str] | None, GLOBAL] = None
    generator: Mapping[str, Any] | str | None = None
    sampler: Mapping[str, Any] | None = None
    few: Mapping[str, Any] | None = None
    chain: Mapping[str, Any] | None = None
    preview: str | None = None
    loggers: Sequence[str] | None = None
    plugins: Sequence[str] = ()
    parent: Mapping[str, Any] | None = None
    scans: Any = None


@contextmanager
def _hydra() -> Iterator[None]:
    """Context with Hydra initialised on `conf/`; restores a Hydra that the process has already initialised."""
    before, config = GlobalHydra.instance().hydra, HydraConfig.instance().cfg
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra, HydraConfig.instance().cfg = before, config


def plain(config: DictConfig) -> dict[str, Any]:
    """Convert a composed config to plain dicts, resolved and without Hydra's own keys."""
    settings = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])  # type: ignore[misc]
    settings._set_parent(config._get_parent())
    resolved: Any = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
    return {str(key): value for key, value in resolved.items()}


def add_choices() -> None:
    """Add a Hydra choice for each registry entry without a YAML file, from its constructor's options."""
    for group, (module, table, given_by_run) in REGISTRIES.items():
        for name, entry in getattr(import_module(module), table).items():
            if (CONF / group / f"{name}.yaml").is_file():
                continue
            if group == "data":
                node: dict[str, Any] = {"defaults": ["base", "_self_"], "name": name}
            elif group == "sensor":
                node = {**options_of(import_module(module).build_sensor), "name": name}
            else:
                node = {key: value for key, value in options_of(entry, given=1).items() if key not in given_by_run}
                keys = {"name": name, **({"init": None} if group == "stage" else {})}
                taken = ", ".join(sorted(keys.keys() & node))
                check(not taken, f"{group} '{name}' has an option '{taken}', a key of every {group}: rename it.")
                node = keys | node
            ConfigStore.instance().store(name, node, group=group)


def with_choices(compose: Callable[[], T]) -> T:
    """The result of a composition; if it lacks a choice that a registry has, such as a plug-in's, of a second one.

    A name that resembles a file's is not looked up if that would import torch. All groups get their choices, since the
    same command may name several.
    """
    try:
        return compose()
    except MissingConfigException as error:
        group, _, name = str(error.missing_cfg_file or "").rpartition("/")
        if group not in REGISTRIES:
            raise
        module, table, _ = REGISTRIES[group]
        misspelt = module not in sys.modules and did_you_mean(name, choices(group))
        if misspelt or name not in getattr(import_module(module), table):
            raise
        add_choices()
        return compose()


def choices(group: str) -> list[str]:
    if GlobalHydra.instance().is_initialized():  # knows `--config-dir`, too
        return [name for name in GlobalHydra.instance().config_loader().get_group_options(group) if name != "base"]
    with _hydra():
        return choices(group)


OmegaConf.register_new_resolver("choices", lambda group: ", ".join(choices(group)), replace=True)  # for --help

MAY_GO = ("callbacks", "chain", "experiment", "hydra", "plugins")  # keys that ~KEY may delete from


def as_hydra_takes(overrides: Sequence[str]) -> list[str]:
    """Convert overrides for Hydra.

    `KEY={name: NAME, ...}` replaces the whole value, since NAME has its own options; `sensor=FILE.yaml` becomes the
    options in the file.
    """
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} - {"hydra"}
    converted: list[str] = []
    parser = OverridesParser.create()
    for text in map(_plain, overrides):
        try:
            parsed = parser.parse_override(text)
        except HydraException:
            raise InputError(
                f"{text} cannot be read: give KEY=VALUE, brackets and quotes closed, and quotes around =, "
                "brackets and, in a list, ~ and accents, as 'KEY=\"a value\"'."
            ) from None
        key, value = parsed.key_or_group, parsed.value()
        names = value if isinstance(value, list) else [value]
        empty = parsed.is_delete() or "" in names or not all(isinstance(n, str | dict | Sweep | Glob) for n in names)
        if not key:
            problem = " names no key: give KEY=VALUE"
        elif key == "hydra":
            problem = ": hydra has keys of its own, as hydra.sweep.dir=FOLDER"
        elif key in groups and empty:
            if key == "experiment" and (parsed.is_delete() or value is None):  # the default
                continue
            problem = f" leaves the run without its {key}: give one of {', '.join(choices(key))}"
        elif parsed.is_delete() and key.partition(".")[0] not in MAY_GO:
            problem = f": every run has its {key}; give {key}=VALUE"
        elif key == "sensor" and str(value).lower().endswith((".yaml", ".yml")):
            from r2flow.lidar.sensors import options_of_sensor, read_sensor

            options = {f"sensor.{name}": option for name, option in options_of_sensor(read_sensor(str(value))).items()}
            given = set(map(key_of, overrides))
            converted += [override(f"++{name}", option) for name, option in options.items() if name not in given]
            continue
        else:
            named = isinstance(value, dict) and "name" in value and "." in key and not key.startswith("chain.")
            replaced = named and parsed.type == OverrideType.CHANGE
            taken = f"++{text.lstrip('+')}" if key == "generator.name" else text  # generator is null by default
            converted += [f"{key}=null", f"++{text}"] if replaced else [taken]
            continue
        raise InputError(f"{text}{problem}.")
    if "size=small" in converted and not any(re.match(r"\+?experiment=[^\[]", text) for text in converted):
        raise InputError("size=small is a form of one experiment: give experiment=NAME, such as r2dm.")
    return converted


def _plain(text: str) -> str:
    """Quote a plain value that Hydra refuses, as ü and &, or takes for a number, as 2011_09_26, name=1e5; expand ~."""
    dates = r"""('[^']*'|"[^"]*")|(?<=[=,[])( *)(\d{4}_\d\d_\d\d)(?= *([],]|$))"""  # also in lists and sweeps
    text = re.sub(dates, lambda found: found[1] or f"{found[2]}'{found[3]}'", text.strip())
    key, _, value = text.partition("=")
    value = re.sub("^~(?=/|$)", lambda _: str(Path.home()), value.strip())
    number = re.fullmatch(r"-?\d{1,3}(_\d{3})*(\.[\d_]*)?", value)
    odd = key == "name" or (re.search(r"[^\t -}]|[&#]|\d_\d", text) and not number)
    plain = re.fullmatch(r"[\w.@/+]+", key) and not re.search(r"""[][{}(),='"]""", value)
    return override(key, value) if odd and plain else text


def explain(error: Exception) -> str:
    """Shorten an error of Hydra to one line, with the nearest existing key."""
    text = str(error) or str(error.__cause__)
    if isinstance(error, UnicodeDecodeError):  # of a reader that does not name the file
        local = {name: value for frame, _ in walk_tb(error.__traceback__) for name, value in frame.f_locals.items()}
        return f"{local.get('full_path', 'a config file')} is not UTF-8 ({error.reason}): save it in UTF-8."
    if unknown := re.search(r"Could not (?:override|delete from config\.) '([^']+)'", text):
        within = re.search(r"full_key: (\S+)", str(error.__cause__))  # the key inside a group's value
        key = max(unknown[1], within[1] if within else "", key=len)
        others = [other for other in known_keys(error) if not key.startswith(f"{other}.")]  # without the key's group
        more = "Add keys by +chain.LINK.KEY=VALUE" if "override 'chain." in text else "See --cfg job for all of them"
        return f"the config has no key '{key}'.{did_you_mean(key, others)} {more}."
    if missing := re.search(r"Missing mandatory value.*full_key: (\S+)", text, re.DOTALL):
        return f"{missing[1]} has no default: give {missing[1]}=VALUE."
    if "'hydra/launcher/submitit" in text:
        return "this launcher needs an extra of the project: python -m pip install 'r2flow[slurm]'."
    if choice := re.search(r"Could not find '((?:hydra/)?[^/']+)/([^']+)'", text):
        group, name, names = *choice.groups(), choices(choice[1])
        hint = f" For your own configs, also files in a sweep, give --config-dir FOLDER, with FOLDER/{group}/NAME.yaml."
        hint = " For a sensor of your own give sensor=FILE.yaml." if group == "sensor" else hint
        hint = " Others are plug-ins of Hydra." if group.startswith("hydra/") else hint
        return f"no {group} config named '{name}'; known: {', '.join(names)}.{did_you_mean(name, names) or hint}"
    if several := re.search(r"Ambiguous value for argument '([^=']+)=([^']*)'", text):
        key, values = several.groups()
        return f"{key}={values} is several values: for a sweep add -m, for a list give {key}=[{values}]."
    return " ".join(re.split(r"\s*\n\s*", text.strip())[: None if isinstance(error, yaml.YAMLError) else 2])


def known_keys(error: Exception) -> list[str]:
    """All keys and groups of the config that lacks one, with the choices of its command line; else of the default."""
    node = getattr(error.__cause__, "parent_node", None)
    with _hydra():
        keys: Any = OmegaConf.to_container(hydra.compose("train") if node is None else node._get_root(), resolve=False)
    leaves = (key.split(".") for key, _ in flatten(keys))
    return [*dict.fromkeys(".".join(leaf[: n + 1]) for leaf in leaves for n in range(len(leaf))), "experiment", "size"]
