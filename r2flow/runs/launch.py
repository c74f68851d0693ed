"""`r2flow train`: Hydra, sweeps, chains, exit codes.

Exit codes: 0 for a finished run, 2 for a user error, 75 if the same command resumes
(`trainer.max_time`, SLURM's time limit), 129 after a hang-up, 130 after Ctrl-C, 143 after SIGTERM.
"""

import hashlib
import os
import re
import signal
import sys
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig

from r2flow.base.config import key_of, override
from r2flow.base.errors import InputError
from r2flow.base.plugins import load_plugins
from r2flow.base.registry import Options
from r2flow.base.signals import LATER, STOPPING, Stopped, code_of, handling_signals, run_process
from r2flow.runs.composing import (
    CONF,
    WRONG,
    add_choices,
    as_hydra_takes,
    in_one_line,
    plain,
    register_resolver,
    with_choices,
)

if TYPE_CHECKING:
    from r2flow.model.config import RunConfig, TrainerOptions


class _JobEnded(RuntimeError):
    """A job of a sweep ended before its run was finished; arguments: exit code and folder."""


def main(arguments: Sequence[str], command: Sequence[str], plugins: Sequence[str] = ()) -> int:
    """Compose a command line's config and execute it: a run, a chain of runs or a sweep; return the
    exit code.

    Arguments are Hydra's overrides and flags. `command` starts this program, for the processes of
    sweeps.
    """
    # Otherwise Hydra prints errors itself, over many lines, and exits with 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    codes: list[int] = []  # of jobs
    errors: list[Exception] = []
    # SLURM signals every process of a job: a run handles the signal, a chain waits for the run.
    ignored = [signal.SIGUSR1] if "SLURM_JOB_ID" in os.environ else []
    try:
        with handling_signals(signal.SIG_IGN, ignored):
            parsed = _parsed(_with_plugins(arguments, plugins) or ["experiment=demo"])
            try:
                _run_hydra(parsed, command, codes, errors)
            except ValueError as error:  # of a sweeper, as of jobs without a value
                if not errors:
                    raise InputError(in_one_line(error)) from None
            if errors:  # jobs have printed theirs, and come last
                raise min(errors, key=lambda error: isinstance(error, _JobEnded))
            return max(codes, default=0)
    except SystemExit as end:
        if end.code:
            raise
        return 0  # of Hydra after --help
    except _JobEnded as error:
        # A remote launcher raises the first only.
        jobs = [job.args for job in errors or [error]]
        failed = [folder for code, folder in jobs if code != LATER]
        names = "; ".join(failed or [folder for _, folder in jobs])
        if failed:
            raise InputError(f"jobs of the sweep failed: {names}") from None
        print(f"jobs of the sweep resume with the same command: {names}")
        return LATER
    except WRONG as error:
        raise InputError(in_one_line(error)) from None
    except RecursionError:
        raise InputError("a config contains itself, or is nested too deeply.") from None


def _with_plugins(arguments: Sequence[str], plugins: Sequence[str]) -> list[str]:
    """Load the plug-ins of a command line and collect them into one `plugins=[...]`."""
    named = [text for text in arguments if text.lstrip("+").startswith("plugins=")]
    others = [text for text in arguments if text not in named]
    names = list(plugins)
    for text in named:
        names += re.findall(r"[^\[\], '\"]+", text.partition("=")[2])
    if not names:
        return others
    load_plugins(names)
    add_choices()
    return [*others, override("plugins", list(dict.fromkeys(names)))]


def _parsed(arguments: Sequence[str]) -> Namespace:
    """Hydra's flags and overrides. Refuses a single folder for all runs of a sweep."""
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise InputError(f"{message}; see --help. Keys have no dashes, as trainer.max_steps=100.")

    parser.error = refuse  # type: ignore[method-assign]  # the default prints all flags
    parsed = parser.parse_intermixed_args(arguments)  # flags may stand between them
    sweeps = parsed.multirun or "hydra.mode=MULTIRUN" in parsed.overrides
    for text in parsed.overrides if sweeps else ():
        # A sweep over several names is valid.
        if key_of(text) == "run_dir" or (key_of(text) == "name" and "," not in text):
            raise InputError(
                f"a sweep names its runs' folders: leave {text} out, or give "
                "hydra.sweep.dir=FOLDER."
            )
    parsed.flags = [text for text in arguments if text not in parsed.overrides]
    parsed.overrides = as_hydra_takes(parsed.overrides)
    return parsed


def _run_hydra(
    parsed: Namespace, command: Sequence[str], codes: list[int], errors: list[Exception]
) -> None:
    """Run the command line's job, or those of its sweep; collects exit codes, and errors, which
    Hydra would print.
    """
    folders = []
    if parsed.config_dir:
        folders = [os.path.abspath(parsed.config_dir)]
        command = [*command, "--config-dir", *folders]
    launcher = os.getpid()
    original = sys.argv

    def job(config: DictConfig) -> float | None:
        sys.argv = original  # Lightning starts the processes of other devices by it
        try:
            overrides = list(HydraConfig.get().overrides.task)
            # The command line, not the overrides: a config file can make a sweeper add overrides.
            named_here = any(text.startswith("plugins=") for text in parsed.overrides)
            plugins = config["plugins"]
            if plugins and not named_here:
                named = " ".join(f"--plugin {name}" for name in plugins)
                raise InputError(
                    f"plug-ins are named on the command line, never in a file: give {named}."
                )
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                if HydraConfig.get().job.num == 0:
                    _look_at_scans(config, overrides)
                if any(not isinstance(error, _JobEnded) for error in errors):
                    return None  # all jobs would end as the first one
                return _sweep_job(command, overrides, config["metric"])
            settings = plain(config)
            # imported here, so that Hydra's errors are reported before torch is loaded
            from r2flow.training import RunConfig, build, fit

            run = RunConfig.of(settings)
            if run.chain is not None:
                codes.append(_chain(run, run.chain, overrides, folders))
            else:
                codes.append(0 if fit(build(run, overrides)).finished else LATER)
        except Exception as error:
            if os.getpid() != launcher:  # a remote launcher sees only exceptions, after all jobs
                raise
            errors.append(error)
        return None

    def composed() -> None:
        sys.argv = [original[0], *parsed.flags, *parsed.overrides]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")(job)()

    register_resolver("job_folder", partial(job_folder, parsed.overrides))
    try:
        with_choices(composed)
    finally:
        sys.argv = original


def job_folder(given: Sequence[str], overrides: str) -> str:
    """Folder name of a sweep's job: the swept values, and a hash of all overrides."""
    parsed = OverridesParser.create().parse_overrides(list(given))
    swept = {one.get_key_element().lstrip("+~") for one in parsed if one.is_sweep_override()}
    before_a_key = r",(?=~|\+*[\w.@/]+=)"  # not the commas of a list
    texts = re.split(before_a_key, overrides)
    texts = [text for text in texts if text.partition("=")[0].lstrip("+~") in swept]
    readable = re.sub(r"[^\w.=+-]+", "_", ",".join(texts) or "job")[:80]
    digest = hashlib.sha256(os.fsencode(overrides)).hexdigest()
    return f"{readable}-{digest[:6]}"


def _look_at_scans(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse scans in files that no job of a sweep could train on, once; what else is wrong with a
    job, that says itself.
    """
    from r2flow.data.options import PAIRS, SIMULATED
    from r2flow.data.resolving import check_intensities
    from r2flow.training import RunConfig, build

    try:
        first = RunConfig.of(plain(config))
        if first.chain or first.data.name in (SIMULATED, PAIRS):
            return
        run = build(first, overrides)
    except InputError:
        return
    if run.stage.encoding.reflectance:
        check_intensities(run.data.plan)


def _sweep_job(command: Sequence[str], overrides: Sequence[str], metric: str) -> float | None:
    """Run a job of a sweep in its own process, so that its failure or DDP relaunch does not affect
    other jobs; the last value of a metric, for the sweeper, None if the run did not log it.
    """
    run_dir = HydraConfig.get().runtime.output_dir
    code = run_process([*command, *overrides, override("run_dir", str(run_dir))])
    if code in map(code_of, STOPPING):
        raise Stopped(code, "the sweep stopped; the same command resumes there")
    if code:
        raise _JobEnded(code, str(run_dir))
    from r2flow.reports.training import read_curves

    _, values = read_curves(run_dir, [metric]).get(metric, (None, [None]))
    return values[-1] if values[-1] is None else float(values[-1])


def _chain(
    run: "RunConfig", chain: Options, overrides: Sequence[str], folders: Sequence[str]
) -> int:
    from r2flow.reports.chain import REPORT, report_chain
    from r2flow.runs.chain import check_links, links_of, train_links
    from r2flow.runs.folder import has_ended

    if run.trainer.fast_dev_run:
        raise InputError(
            "a chain's links start from earlier runs, and trainer.fast_dev_run leaves none."
        )
    folder = Path(run.run_dir)
    links = links_of(chain, folder, overrides, folders)
    finished = all(has_ended(link.config.run_dir) for link in links)
    if not finished:
        check_links(links)
    if run.preview:  # scans of a trained model, while the chain trains
        _draw_preview(run.preview, folder / "preview")
    if code := train_links(links):
        return code
    out = folder / "report"
    if finished and (out / REPORT).is_file():
        print(f"report: finished before, {out / REPORT}")
    elif int(os.environ.get("LOCAL_RANK", "0")) == 0:
        runs = {link.name: Path(link.config.run_dir) for link in links}
        report_chain(runs, out, _report_device(run.trainer))
    return 0


def _draw_preview(model: str, out: Path) -> None:
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.shipped import find_model
    from r2flow.reports.outputs import write_samples

    picture = out / "samples.png"
    if not picture.is_file():
        write_samples(load_checkpoint(find_model(model)), out, num=4, seed=0)
    print(f"while you wait: scans of the included model {model}, {picture}", flush=True)


def _report_device(trainer: "TrainerOptions") -> str:
    import torch

    if not torch.cuda.is_available() or trainer.accelerator == "cpu":
        return "cpu"
    cards = trainer.devices
    return f"cuda:{cards[0]}" if isinstance(cards, list) else "cuda"
