"""Run folders: config, lock, and whether a command may resume the run."""

import logging
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from r2flow.base.config import at_most_three, check_tree, differences
from r2flow.base.errors import InputError, check
from r2flow.base.files import parse_yaml, write_file
from r2flow.base.registry import Config, Options
from r2flow.model.config import ModelConfig, contradictions, is_found
from r2flow.model.parts import HYPER, NOTES
from r2flow.model.paths import FOLDER, checkpoints_of, step_of
from r2flow.model.tensor_files import read_checkpoint

_log = logging.getLogger(__name__)

CONFIG = "config.yaml"


@contextmanager
def run_lock(run: str | Path, patience: float = 20.0) -> Iterator[None]:
    """Lock a run's folder for one process. The lock is released when its process ends, even if
    killed.
    """
    path = Path(run, ".lock")
    holder = Path(run, ".lock.holder")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(path, timeout=patience).acquire(poll_interval=0.2)
    except Timeout:
        owner = holder.read_text(encoding="utf-8") if holder.is_file() else "unknown"
        raise InputError(
            f"{run} is trained by another process ({owner}). Wait for it, or give name=OTHER."
        ) from None
    with lock:
        # Not in the lock file itself, which other processes may truncate when they try to lock it.
        write_file(holder, f"pid {os.getpid()} on {platform.node()}")
        yield


class _Dumper(yaml.SafeDumper):
    """Writes YAML without aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def read_config(run: str | Path) -> Config | None:
    """The config of a run folder, or None; `InputError` if the file is cut or damaged."""
    path = Path(run, CONFIG)
    if not path.is_file():
        return None
    try:
        text = path.read_text(encoding="utf-8")
        if text.startswith("---") and text.split()[-1] != "...":
            raise ValueError("it is cut")
        config = parse_yaml(text)
        check_tree(config)
    except (yaml.YAMLError, ValueError, RecursionError, AttributeError) as error:
        raise InputError(
            f"{path} is damaged ({str(error).splitlines()[0]}); the checkpoints are usable."
        ) from None
    return dict(config)


def has_ended(run: str | Path, last: Path | None = None) -> bool:
    """Whether a run's last checkpoint, or the one given, is that of its last step."""
    config = read_config(run)
    last = last or next(iter(checkpoints_of(run)), None)
    if config is None or last is None:
        return False
    length = ModelConfig(config).length
    total = length.max_steps
    if length.max_epochs != -1:
        total = read_checkpoint(last)[NOTES]["total_steps"]
    return 0 < total <= step_of(last)


def open_run(run: str | Path, config: Options, locked: bool = True) -> Path | None:
    """The newest readable checkpoint to resume a run from, or None for a new run; writes if its
    folder is `locked`.
    """
    for leftover in Path(run, FOLDER).glob(".*.part") if locked else ():  # of killed writers
        leftover.unlink(missing_ok=True)
    old = read_config(run)
    last = next(_readable(run, RESUMED), None)
    if last is not None and old is None:
        raise InputError(
            f"{run} has checkpoints without their {CONFIG}: give name=OTHER stage.parent={last}."
        )
    if old is not None and last is not None:
        _refuse_another_config(run, contradictions(old, config))
        samplers = [
            text for key, text in differences(old, config).items() if key.startswith("sampler.")
        ]
        if samplers and has_ended(run, last):
            raise InputError(
                f"{run} is finished and keeps its sampler: {'; '.join(samplers)}. Keep the "
                "setting, and draw with another sampler by "
                f"r2flow sample {run} --sampler NAME --steps N."
            )
    if locked and old != dict(config):  # free keys may have changed
        # From `---` to `...`, which shows that it is whole.
        text = yaml.dump(
            dict(config), Dumper=_Dumper, sort_keys=False, explicit_start=True, explicit_end=True
        )
        write_file(Path(run, CONFIG), text)
    return last


def check_run(run: str | Path, config: Options) -> None:
    """Refuse a run folder of another config, ignoring keys that depend on the data or a trained
    parent.
    """
    old = read_config(run)
    if old is None or not checkpoints_of(run):
        return
    other = contradictions(old, config)
    asked = {key: text for key, text in other.items() if not is_found(key)}
    _refuse_another_config(run, asked, alone=False)


def _refuse_another_config(
    run: str | Path, differing: Mapping[str, str], alone: bool = True
) -> None:
    if differing:
        more_steps = ""
        if alone and differing.keys() == {"trainer.max_steps"}:
            # Not the folder: the run may not be finished.
            last = next(_readable(run), run)
            more_steps = f", stage.parent={last} name=OTHER to learn on from its weights"
        raise InputError(
            f"{run} holds a run of another config: {at_most_three([*differing.values()])}. "
            f"Give the same settings and scans to resume it{more_steps}, or name=OTHER for a new "
            "one."
        )


RESUMED = (HYPER, NOTES, "state_dict", "optimizer_states", "lr_schedulers", "loops", "global_step")


def _readable(run: str | Path, needed: Sequence[str] = ()) -> Iterator[Path]:
    """The readable checkpoints that have the needed keys, newest first."""
    for path in checkpoints_of(run):
        try:
            content = read_checkpoint(path)
            check(isinstance(content, dict), f"{path} is not a checkpoint of a run.")
            lacking = next((key for key in needed if key not in content), None)
            check(lacking is None, f"{path} cannot be resumed: it has no {lacking}.")
        except InputError as error:
            _log.warning("%s Passing it over.", error)
        else:
            yield path
