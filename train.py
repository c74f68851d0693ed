"""Compose the config, build what it names, fit. With no arguments: the demo, `experiment=demo`.

    python train.py
    python train.py data=kitti_raw data.root=FOLDER backbone=hdit_small
    python train.py experiment=r2flow_1rf data.root=KITTI-360 trainer=ddp
    python train.py experiment=r2flow_2rf stage.init=runs/r2flow_1rf trainer=ddp
    python train.py experiment=r2flow data.root=KITTI-360 trainer=ddp
    python train.py -m backbone=hdit_tiny,hdit_small seed=1,2,3

The same command again goes on from the run's last checkpoint.
"""

import functools
import hashlib
import logging
import os
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from r2flow.errors import InputError, explain_mistake

log = logging.getLogger("r2flow")

CONF = Path(__file__).resolve().parent / "conf"


def job_folder(arguments: Sequence[str], overrides: str) -> str:
    """A folder name for a job of a sweep: the values that are swept, and a hash of all overrides."""
    given = [argument.partition("=") for argument in arguments]
    swept = {key.lstrip("+~") for key, _, value in given if "," in value}
    parts = [part for part in overrides.split(",") if part.partition("=")[0].lstrip("+~") in swept]
    readable = re.sub(r"[^\w.=+-]+", "_", ",".join(parts) or "job")[:80]
    return f"{readable}-{hashlib.sha256(overrides.encode()).hexdigest()[:6]}"


def fit(config: dict[str, Any], asked: list[str]) -> None:
    """Train the stage that a plain config describes, in its run folder, from where it stopped.

    Args:
        asked: The keys that the command line gave.
    """
    # Imported here: a misspelt config should answer at once, not after torch has loaded.
    import lightning as L
    import torch
    from lightning.fabric.utilities.exceptions import MisconfigurationException

    from callbacks import build_callbacks, build_loggers
    from r2flow.checkpoints import checkpoints_of, step_of
    from r2flow.data.datamodule import ScanDataModule
    from r2flow.data.opening import resolve_reflectance
    from r2flow.data.options import DataOptions
    from r2flow.data.sources import AUTO
    from r2flow.generators import build_generator
    from r2flow.lineage import inherit
    from r2flow.noise import seed_torch
    from r2flow.registry import check_options
    from r2flow.reports.training import check_samples, finish
    from r2flow.runs import open_run, run_lock
    from r2flow.stages import STAGES, build_stage, check_roll
    from r2flow.stages.checkpointing import AtomicCheckpointIO

    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message="Total length of .list. across ranks is zero.*")
    warnings.filterwarnings("ignore", message=".*smaller than the logging interval.*")
    warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)

    run_dir = Path(config["run_dir"])
    trainer_options = dict(config["trainer"])
    check_trainer(trainer_options)
    check_options("samples", check_samples, config["samples"])
    check_samples(**config["samples"])
    if not (isinstance(config["seed"], int) and 0 <= config["seed"] < 2**63):
        raise InputError(f"seed must be a whole number of at least 0, found {config['seed']!r}.")
    config, parent = inherit(config, asked)
    check_options("data", DataOptions, config["data"])
    encoding = config["encoding"]
    encoding["reflectance"] = resolve_reflectance(encoding.get("reflectance", AUTO), config["data"])
    config["generator"] = config["generator"] or {"name": STAGES[config["stage"]["name"]].generator_name}
    seed_torch(config["seed"], "weights")
    generator = build_generator(config)
    if parent is not None:
        generator.start_from(parent.generator)
        del parent
    data = ScanDataModule(
        generator.space.sensor, generator.space.encoding, config["seed"], generator.noise_shape, **config["data"]
    )
    check_roll(data.augment, generator)
    data.setup()
    config["scans"] = data.fingerprint()
    stage = build_stage(config, generator)
    check_options("trainer", L.Trainer, trainer_options)
    callbacks, loggers = build_callbacks(config), build_loggers(config["loggers"], run_dir)
    try:
        trainer = L.Trainer(**trainer_options, callbacks=callbacks, logger=loggers, plugins=[AtomicCheckpointIO()])
    except (TypeError, ValueError, MisconfigurationException) as error:
        raise InputError(f"trainer: {' '.join(str(error).split())}") from None
    data.check_run(trainer.world_size, trainer.accumulate_grad_batches, trainer.max_steps)
    if trainer_options["fast_dev_run"]:
        trainer.fit(stage, data)
        return
    with run_lock(run_dir) if trainer.is_global_zero else nullcontext():
        last = open_run(run_dir, config)
        try:
            if last is None or step_of(last) < trainer.max_steps:  # else nothing is left to do, nor pairs to make
                if last is not None:
                    log.info("going on from %s", last)
                trainer.fit(stage, data, ckpt_path=last, weights_only=True)
        except SystemExit as stop:  # 1: how Lightning ends a run on Ctrl-C; else callbacks.requeue
            kept = (
                "goes on from the last checkpoint" if checkpoints_of(run_dir) else "starts it again: no checkpoint yet"
            )
            print(f"stopped at step {trainer.global_step}; the same command {kept}", flush=True)
            raise SystemExit(130 if stop.code == 1 else stop.code) from None
        if trainer.is_global_zero:
            device = "cuda" if torch.cuda.is_available() and trainer_options["accelerator"] != "cpu" else "cpu"
            finish(run_dir, config["samples"], config["seed"], device, trainer.max_steps)


def check_trainer(options: dict[str, Any]) -> None:
    """Refuse what Lightning would change in silence or end in a traceback."""
    import torch

    gpu = torch.cuda.is_available()
    if options["accelerator"] in ("gpu", "cuda") and not gpu:
        raise InputError("trainer.accelerator=gpu, but torch sees no GPU here; use trainer=cpu.")
    on_cpu = options["accelerator"] == "cpu" or (options["accelerator"] == "auto" and not gpu)
    if on_cpu and str(options["precision"]) in ("16-mixed", "16", "16-true"):
        raise InputError(
            f"trainer.precision={options['precision']} does not exist on a CPU (Lightning would turn it into "
            "bfloat16 in silence); use bf16-mixed or 32-true."
        )


def sweep_job(config: DictConfig) -> int:
    """One job of a sweep, as its own process: its failure or its DDP relaunch touches no other job."""
    from r2flow.chain import override

    overrides = list(HydraConfig.get().overrides.task)
    run_dir = HydraConfig.get().runtime.output_dir
    command = [sys.executable, __file__, *overrides, override("run_dir", str(run_dir))]
    log.info("job %s: %s", HydraConfig.get().job.num, " ".join(overrides))
    return subprocess.run(command, check=False).returncode


def chain(config: dict[str, Any], given: list[str]) -> int:
    """The runs that a config's `chain` names, and the report on them."""
    from r2flow.chain import is_reported, links_of, record_report, run_chain

    if config["trainer"]["fast_dev_run"]:
        raise InputError("a chain's links start from the runs before them, and trainer.fast_dev_run leaves none.")
    folder = Path(config["run_dir"])
    links = links_of(config["chain"], folder, given)
    for link in links:  # what a link cannot compose is better known now than after the links before it
        try:
            hydra.compose("train", list(link.overrides))
        except HydraException as error:
            raise InputError(f"chain.{link.name}: {explain(error)}") from None
    code, ran = run_chain(links, Path(__file__))
    if code:
        return code
    out = folder / "report"
    if not ran and is_reported(links, out):
        print(f"report: finished before, {out / 'chain.md'}")
        return 0
    import torch

    from r2flow.reports.chain import report

    device = "cuda" if torch.cuda.is_available() and config["trainer"]["accelerator"] != "cpu" else "cpu"
    report({link.name: link.run_dir for link in links}, out, device=device, command=" ".join(["python", *sys.argv]))
    record_report(links, out)
    return 0


class JobFailed(RuntimeError):
    """A job of a sweep ended badly; its own lines have said why."""


failed_jobs: list[str] = []
mistakes: list[str] = []
chain_codes: list[int] = []


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def run(config: DictConfig) -> None:
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        if sweep_job(config):
            failed_jobs.append(" ".join(HydraConfig.get().overrides.task))
            raise JobFailed(failed_jobs[-1])  # Hydra runs the other jobs first
        return
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    settings = {str(key): value for key, value in plain.items()}
    given = list(HydraConfig.get().overrides.task)
    try:
        if settings["chain"]:
            chain_codes.append(chain(settings, given))
        else:
            fit(settings, [one.lstrip("+~").partition("=")[0] for one in given])
    except (InputError, OSError) as error:  # Hydra would print its own lines around it
        mistakes.append(explain_mistake(error))


def main() -> int:
    """Run, and turn what the user can mend into one line and exit code 2."""
    # Otherwise Hydra prints composition errors itself, over many lines, and exits with 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if "SLURM_JOB_ID" in os.environ:  # It signals every process of a job: a run answers, a chain waits for it.
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    for kept in (mistakes, failed_jobs, chain_codes):
        kept.clear()
    if len(sys.argv) == 1:
        sys.argv.append("experiment=demo")
    # Taken now: in a launcher's process sys.argv is the launcher's.
    OmegaConf.register_new_resolver("job_folder", functools.partial(job_folder, tuple(sys.argv[1:])), replace=True)
    try:
        run()
    except JobFailed as error:
        failed = failed_jobs or [f"{error}, the first of them"]  # of other processes only the first is heard
        print(f"error: {len(failed_jobs) or 'some'} of the sweep's jobs failed: {'; '.join(failed)}", file=sys.stderr)
        return 2
    except (HydraException, OmegaConfBaseException) as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {explain_mistake(error)}", file=sys.stderr)
        return 2
    if mistakes:
        print(f"error: {mistakes[0]}", file=sys.stderr)
        return 2
    return max(chain_codes, default=0)


def explain(error: Exception) -> str:
    """Hydra's complaint in one line, with the nearest key that exists."""
    from r2flow.registry import did_you_mean

    text = str(error)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown.group(1)
        return f"the config has no key '{key}'.{did_you_mean(key, known_keys())} See --cfg job for all of them."
    if "Could not find 'hydra/launcher/submitit" in text:
        return "this launcher needs an extra of the project: python -m pip install -e '.[slurm]'"
    choice = re.search(r"Could not find '([^/']+)/([^']+)'", text)
    if choice:
        group, name = choice.groups()
        folder = CONF / group
        known = sorted(path.stem for path in folder.glob("*.yaml"))
        return f"no {group} config named '{name}'; known: {', '.join(known)}.{did_you_mean(name, known)}"
    return " ".join(lines[:2])


def known_keys() -> list[str]:
    """Every key of the default config, and its groups."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        composed = compose("train", return_hydra_config=False)
    keys = []

    def walk(node: DictConfig, prefix: str) -> None:
        for key in node:
            keys.append(f"{prefix}{key}")
            value = node._get_node(key)
            if isinstance(value, DictConfig) and not value._is_none():
                walk(value, f"{prefix}{key}.")

    walk(composed, "")
    return keys


if __name__ == "__main__":
    sys.exit(main())
