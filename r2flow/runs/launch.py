"""What `train.py` and `r2flow train` do: Hydra, sweeps, chains, exit codes, and mistakes in one line.

Exit codes: 0 at the run's end, 2 for what the user can mend, 75 where the same command resumes (`trainer.max_time`,
SLURM's time limit), 130 after Ctrl-C, 143 after SIGTERM.
"""

import functools
import hashlib
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from r2flow import __version__
from r2flow.config import key_of
from r2flow.errors import InputError, explain_mistake, one_line, open_streams, tell_odd
from r2flow.plugins import load_plugins, take_plugins
from r2flow.runs.composing import (
    CONF,
    REGISTRIES,
    add_choice,
    add_choices,
    as_hydra_takes,
    check_keys,
    compose,
    explain,
    override,
    plain,
)
from r2flow.signals import LATER, Stopped, listening, stop_at_once

log = logging.getLogger("r2flow")

Task = Callable[[DictConfig], None]


class JobEnded(RuntimeError):
    """A job of a sweep ended before its run did: its exit code and its folder."""


def main(arguments: Sequence[str], command: Sequence[str]) -> int:
    """Compose a command line's config and do what it says: a run, a chain of runs or a sweep.

    Args:
        arguments: Hydra's overrides and flags, and any number of `--plugin NAME`.
        command: How this very program is started, for the processes of sweeps and chains.

    Returns:
        The exit code; what went wrong has been said in one line.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints mistakes itself, over many lines, and exits with 1
    ended: list[tuple[int, str]] = []  # jobs of a sweep
    open_streams()
    try:
        # SLURM signals every process of a job: a run answers, a chain waits for it.
        ignored = [signal.SIGUSR1] if "SLURM_JOB_ID" in os.environ else []
        with listening(stop_at_once), listening(signal.SIG_IGN, ignored):
            if "--version" in arguments:
                print(f"r2flow {__version__}")
                return 0
            arguments, plugins = _plugins_of(list(arguments) or ["experiment=demo"])
            load_plugins(plugins)
            for group in REGISTRIES if plugins else ():
                add_choices(group)
            arguments = _checked_arguments(arguments)
            _run_hydra(arguments, functools.partial(_job, arguments, command, ended, os.getpid()))
            if ended:
                raise JobEnded(*ended[0])
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except Stopped as stop:
        if str(stop):  # of several devices one speaks
            print(stop, flush=True)
        return stop.code
    except KeyboardInterrupt:  # Ctrl-C where nobody listens: in a library's thread
        print("stopped", flush=True)
        return 130
    except JobEnded as error:
        jobs = ended or [error.args]  # a launcher elsewhere raises the first alone
        failed = [folder for code, folder in jobs if code != LATER]
        number, names = (len(failed or jobs) if ended else "some"), "; ".join(failed or [folder for _, folder in jobs])
        if failed:
            print(f"error: {number} of the sweep's jobs failed: {names}", file=sys.stderr)
            return 2
        print(f"{number} of the sweep's jobs resume with the same command: {names}")
        return LATER
    except (HydraException, OmegaConfBaseException) as error:
        print(f"error: {one_line(explain(error))}{_forgotten_plugins(arguments)}", file=sys.stderr)
        return 2
    except RecursionError:
        print("error: a config contains itself, or is nested too deeply.", file=sys.stderr)
        return 2
    except (InputError, OSError) as error:
        print(f"error: {explain_mistake(error)}", file=sys.stderr)
        return 2
    finally:
        tell_odd()
    return 0


def _plugins_of(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The command line with its plug-ins as one `plugins=[...]`, and these, however they were given."""
    others, names = take_plugins(arguments)
    given = [one for one in others if one.lstrip("+").startswith("plugins=")]
    for one in given:
        names += [name.strip(" '\"") for name in one.partition("=")[2].strip("[]").split(",")]
    names = list(dict.fromkeys(name for name in names if name))
    rest = [one for one in others if one not in given]
    return [*rest, *([override("plugins", names)] if names else [])], names


def _forgotten_plugins(arguments: Sequence[str]) -> str:
    """The plug-ins of the run that a command names, where it gives none: its config may name what they hold."""
    given = dict(one.partition("=")[::2] for one in arguments)
    run = given.get("run_dir") or f"runs/{given.get('name')}"
    if "plugins" in given or not Path(run, "config.yaml").is_file():
        return ""
    from r2flow.runs.folder import read_config

    names = " ".join(f"--plugin {name}" for name in (read_config(run) or {}).get("plugins") or ())
    return f" {run} was made with {names}: give it again." if names else ""


def _checked_arguments(arguments: list[str]) -> list[str]:
    """Hydra's flags, then its overrides.

    Raises:
        InputError: a flag that it does not have, or one folder for all runs of a sweep.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise InputError(f"{message}; see --help. Keys have no dashes, as trainer.max_steps=100.")

    parser.error = refuse  # type: ignore[method-assign]  # its own prints all of the flags
    parsed = parser.parse_intermixed_args(arguments)  # flags may stand between them
    overrides = parsed.overrides
    for one in overrides if parsed.multirun or "hydra.mode=MULTIRUN" in overrides else ():
        # Several names are a sweep like any other.
        if key_of(one) == "run_dir" or (key_of(one) == "name" and "," not in one):
            raise InputError(
                f"a sweep gives each run a folder of its own: leave {one} out, or give hydra.sweep.dir=FOLDER."
            )
    return [*(one for one in arguments if one not in overrides), *as_hydra_takes(overrides)]


def _run_hydra(arguments: Sequence[str], job: Task) -> None:
    """Hydra's own main, on these arguments; a job sees the process's."""
    original = sys.argv

    def task(config: DictConfig) -> None:
        sys.argv = original  # Lightning starts a run's other devices by it
        job(config)

    decorated = hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")(task)
    resolver = functools.partial(job_folder, tuple(arguments))
    OmegaConf.register_new_resolver("job_folder", resolver, replace=True)
    try:
        sys.argv = [original[0], *arguments]
        try:
            decorated()
        except MissingConfigException as error:
            if not add_choice(error):
                raise
            sys.argv = [original[0], *arguments]
            decorated()
    finally:
        sys.argv = original


def job_folder(arguments: Sequence[str], overrides: str) -> str:
    """A folder name for a job of a sweep: the values that are swept, and a hash of all overrides."""
    given = [argument.partition("=") for argument in arguments]
    swept = {key.lstrip("+~") for key, _, value in given if "," in value}
    parts = [part for part in overrides.split(",") if part.partition("=")[0].lstrip("+~") in swept]
    readable = re.sub(r"[^\w.=+-]+", "_", ",".join(parts) or "job")[:80]
    return f"{readable}-{hashlib.sha256(os.fsencode(overrides)).hexdigest()[:6]}"


def _job(
    arguments: Sequence[str], command: Sequence[str], ended: list[tuple[int, str]], launcher: int, config: DictConfig
) -> None:
    """What Hydra runs. Of the exceptions only `Exception` is caught by it: SystemExit says the code.

    Args:
        ended: Where the jobs of a sweep are noted that ended before their runs.
        launcher: The process in which this list is read.
    """
    try:
        given = list(HydraConfig.get().overrides.task)
        # Of the command line, not of the overrides: a file can have a sweeper add some of these.
        if config["plugins"] and not any(one.startswith("plugins=") for one in arguments):
            named = " ".join(f"--plugin {name}" for name in config["plugins"])
            raise InputError(f"plug-ins are named on the command line, never in a file: give {named}.")
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            _sweep_job(command, given, ended)
            if ended and os.getpid() != launcher:  # a launcher elsewhere hears exceptions alone, after all jobs
                raise JobEnded(*ended[-1])
            return
        settings = plain(config)
        check_keys(settings)
        code = _chain(settings, given, command) if settings["chain"] else _fit(settings, given)
    except (InputError, OSError, OmegaConfBaseException) as error:  # Hydra would print its own lines around it
        said = one_line(explain(error)) if isinstance(error, OmegaConfBaseException) else explain_mistake(error)
        print(f"error: {said}", file=sys.stderr)
        raise SystemExit(2) from None
    if code:
        raise SystemExit(code)


def _config_folders() -> list[str]:
    """Where `--config-dir` points, for processes of our own."""
    sources = HydraConfig.get().runtime.config_sources
    return [source.path for source in sources if source.provider == "command-line"]


def _restart(command: Sequence[str]) -> list[str]:
    return [*command, *(part for folder in _config_folders() for part in ("--config-dir", folder))]


def _sweep_job(command: Sequence[str], given: Sequence[str], ended: list[tuple[int, str]]) -> None:
    """One job of a sweep, as its own process: its failure or its DDP relaunch touches no other job."""
    from r2flow.runs.chain import run_process

    run_dir = HydraConfig.get().runtime.output_dir
    log.info("job %s: %s", HydraConfig.get().job.num, " ".join(given))
    code = run_process([*_restart(command), *given, override("run_dir", str(run_dir))])
    if code in (130, 143):
        raise Stopped(code, "the sweep stopped; the same command resumes there")
    if code:
        ended.append((code, str(run_dir)))


def _fit(settings: dict[str, Any], given: Sequence[str]) -> int:
    # Imported here: a misspelt config answers at once, not after torch has loaded.
    from r2flow.training import build, fit

    return 0 if fit(build(settings, given)).finished else LATER


def _chain(settings: dict[str, Any], given: Sequence[str], command: Sequence[str]) -> int:
    """The runs that a config's `chain` names, and the report on them."""
    from r2flow.runs.chain import is_finished, is_reported, links_of, record_report, run_chain

    if settings["trainer"]["fast_dev_run"]:
        raise InputError("a chain's links start from the runs before them, and trainer.fast_dev_run leaves none.")
    folder = Path(settings["run_dir"])
    links = links_of(settings["chain"], folder, given)
    if not all(map(is_finished, links)):
        _check_links(links)
    if settings["preview"]:
        _preview(settings["preview"], folder / "preview")
    code, ran = run_chain(links, _restart(command))
    if code:
        return code
    out = folder / "report"
    if not ran and is_reported(links, out):
        print(f"report: finished before, {out / 'chain.md'}")
        return 0
    import torch

    from r2flow.reports.chain import report

    device, cards = "cpu", settings["trainer"]["devices"]
    if torch.cuda.is_available() and settings["trainer"]["accelerator"] != "cpu":
        device = f"cuda:{cards[0]}" if isinstance(cards, list) else "cuda"
    report({link.name: link.run_dir for link in links}, out, device=device, command=" ".join(["python", *sys.argv]))
    record_report(links, out)
    return 0


def _preview(model: str, out: Path) -> None:
    """Draw scans of a trained model, to look at while a chain trains."""
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.models import find_model
    from r2flow.reports.outputs import write_samples

    if not (out / "samples.png").is_file():
        write_samples(load_checkpoint(find_model(model)), out, num=4, seed=0)
    print(f"preview: scans of the model {model} in {out / 'samples.png'}, point clouds beside it", flush=True)


def _check_links(links: Sequence[Any]) -> None:
    """Compose and build every link before the first one runs: what is refused is refused now.

    Raises:
        InputError: a link that cannot be composed or built.
    """
    folders = _config_folders()
    configs = {}
    for link in links:
        try:
            configs[link.name] = compose(link.overrides, folders)
        except (HydraException, OmegaConfBaseException) as error:
            raise InputError(f"chain.{link.name}: {explain(error)}") from None
    from r2flow.model.checkpoint import FOLDER
    from r2flow.runs.lineage import Parent
    from r2flow.training import check

    for link in links:
        parent = None
        if link.parent is not None:
            before = configs[link.parent]
            steps = before["trainer"]["max_steps"]
            path = Path(before["run_dir"], FOLDER, f"step-{steps:08d}.ckpt")
            parent = Parent(before, path, steps)
        try:
            configs[link.name] = check(configs[link.name], link.overrides, parent)
        except InputError as error:
            raise InputError(f"chain.{link.name}: {error}") from None
