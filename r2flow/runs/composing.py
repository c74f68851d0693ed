"""Composition of configs: Hydra on `conf/`, with a choice for each entry of a registry."""

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import hydra
import yaml
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from r2flow.base.config import key_of, override
from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, did_you_mean, options_of

_T = TypeVar("_T")

CONF = Path(str(files("r2flow.conf")))
# Raised for a wrong config.
WRONG = (HydraException, OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError)

# Hydra groups: the registry of each, and the options that other groups of the config set.
REGISTRIES = {
    "stage": (
        "r2flow.stages",
        "STAGES",
        ("backbone", "sensor", "encoding", "generator", "sampler", "few", "seed"),
    ),
    "backbone": ("r2flow.backbones", "BACKBONES", ("in_channels", "out_channels", "second_time")),
    "data": ("r2flow.data.kinds", "SOURCES", ()),
    "sensor": ("r2flow.lidar.sensors", "SENSORS", ()),
}

_GROUPS = (*REGISTRIES, "encoding", "trainer", "callbacks", "experiment", "size")


def compose(
    overrides: Sequence[str] = (),
    folders: Sequence[str | Path] = (),
    keys: Options | None = None,
) -> Config:
    """Compose the config of a command line, as plain dicts: `compose(["data=kitti_raw",
    "data.root=FOLDER"])`.

    Args:
        folders: Additional config folders, as in `--config-dir`.
        keys: Values between those of the experiment and the overrides; names of a group's file
            choose that.

    Raises:
        InputError: what Hydra, OmegaConf or YAML says of an unknown key or choice, or of a damaged
            file.
    """
    search = [f"file://{Path(folder).resolve()}" for folder in folders]
    with _hydra():
        try:
            given = [*(_with_keys(keys) if keys else ()), *as_hydra_takes(overrides)]
            given.append(override("hydra.searchpath", search))
            config = with_choices(partial(hydra.compose, "train", given, return_hydra_config=True))
            HydraConfig.instance().set_config(config)
            return plain(config)
        except WRONG as error:
            raise InputError(in_one_line(error)) from None


def _with_keys(keys: Options) -> list[str]:
    """The choices among a link's keys; its values become a config of Hydra's."""
    values = {key: dict(one) if isinstance(one, Mapping) else one for key, one in keys.items()}
    named = [group for group in _GROUPS if isinstance(values.get(group), str)]
    choices = [override(group, values.pop(group)) for group in named]
    if "name" in values.get("stage", ()):
        choices.append(override("stage", values["stage"].pop("name")))
    values.pop("experiment", None)  # null
    ConfigStore.instance().store("keys", values, group="link", package="_global_")
    return [*as_hydra_takes(choices), "+link@_global_=keys"]


@contextmanager
def _hydra() -> Iterator[None]:
    """Context with Hydra initialised on `conf/`; restores a Hydra that the process has already
    initialised.
    """
    before = GlobalHydra.instance().hydra
    config = HydraConfig.instance().cfg
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = before
        HydraConfig.instance().cfg = config


def in_one_line(error: Exception) -> str:
    """The message of another library's error, in one line, without Hydra's own folders."""
    text = str(error) or str(error.__cause__)
    return " ".join(text.partition("Config search path:")[0].split())


def plain(config: DictConfig) -> Config:
    """Convert a composed config to plain dicts, resolved and without Hydra's own keys."""
    settings = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])  # type: ignore[misc]
    settings._set_parent(config._get_parent())
    resolved: Any = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
    return {str(key): value for key, value in resolved.items()}


def add_choices() -> None:
    """Add a Hydra choice for each registry entry without a YAML file, from its constructor's
    options.
    """
    for group, (module, table, given_elsewhere) in REGISTRIES.items():
        for name, entry in getattr(import_module(module), table).items():
            if (CONF / group / f"{name}.yaml").is_file():
                continue
            node: Config = {"name": name}
            if group == "data":
                node = {"defaults": ["base", "_self_"], "name": name}
            elif group == "sensor":
                node = {**options_of(import_module(module).build_sensor), "name": name}
            else:
                options = options_of(entry, given=1 if group == "backbone" else 0)
                node |= {key: value for key, value in options.items() if key not in given_elsewhere}
            ConfigStore.instance().store(name, node, group=group)


def with_choices(compose: Callable[[], _T]) -> _T:
    """The result of a composition; if it lacks a choice that a registry has, such as a plug-in's,
    of a second one.

    A name that resembles a file's is not looked up if that would import torch. All groups get their
    choices, since the same command may name several.
    """
    try:
        return compose()
    except ValueError as error:  # of Hydra, of a group without a name
        raise InputError(in_one_line(error)) from None
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
    if not GlobalHydra.instance().is_initialized():  # it knows `--config-dir`, too
        with _hydra():
            return choices(group)
    names = GlobalHydra.instance().config_loader().get_group_options(group)
    return [name for name in names if name != "base"]


def register_resolver(name: str, resolver: Callable[..., Any]) -> None:
    """Make `${name:ARGUMENT}` known to configs.

    omegaconf 2.4 warns that its function has a new name, which in 2.3 is that of another.
    """
    with warnings.catch_warnings(action="ignore"):
        OmegaConf.register_new_resolver(name, resolver, replace=True)


register_resolver("choices", lambda group: ", ".join(choices(group)))  # for --help
# Of the images of a run: ${part:32,STEPS,BATCH} is one in 32, and at least one.
register_resolver("part", lambda n, steps, batch: max(int(steps * batch / n), 1))


def as_hydra_takes(overrides: Sequence[str]) -> list[str]:
    """Convert two forms of overrides for Hydra.

    `KEY={name: NAME, ...}` replaces the whole value, since NAME has its own options;
    `sensor=FILE.yaml` becomes the options in the file. Of the others, the generator's name is added
    to the config, where it is null by default.
    """
    converted: list[str] = []
    parsed_overrides = OverridesParser.create().parse_overrides(list(overrides))
    for text, parsed in zip(overrides, parsed_overrides, strict=True):
        key = parsed.key_or_group
        if key == "sensor" and str(parsed.value()).lower().endswith((".yaml", ".yml")):
            converted += _sensor_of_file(str(parsed.value()), overrides)
        elif key == "generator.name":
            converted.append(f"++{text.lstrip('+')}")
        elif _replaces(parsed):
            converted += [f"{key}=null", f"++{text}"]
        else:
            converted.append(text)
    return converted


def _replaces(parsed: Override) -> bool:
    """Whether an override is a group with a name inside another group."""
    value = parsed.value()
    if not isinstance(value, dict) or "name" not in value or parsed.type != OverrideType.CHANGE:
        return False
    return "." in parsed.key_or_group and not parsed.key_or_group.startswith("chain.")


def _sensor_of_file(path: str, overrides: Sequence[str]) -> list[str]:
    from r2flow.lidar.sensors import options_of_sensor, read_sensor

    keys = set(map(key_of, overrides))
    options = options_of_sensor(read_sensor(path))
    return [
        override(f"++sensor.{name}", options[name])
        for name in options
        if f"sensor.{name}" not in keys
    ]
