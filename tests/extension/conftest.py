"""Families that come from outside, as a user gives them: a file, `--plugin`, and what the config
says of it.
"""

import contextlib
import copy
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore
from r2flow.callbacks import CALLBACKS

from r2flow import cli
from r2flow.backbones import BACKBONES
from r2flow.base import plugins
from r2flow.flow.losses import LOSSES
from r2flow.generators import GENERATORS
from r2flow.runs.composing import REGISTRIES
from r2flow.samplers import SAMPLERS
from r2flow.stages import STAGES
from tests.conftest import Done
from tests.training.conftest import quickly

FAMILIES = Path(__file__).parent / "families"

TINY = [
    "data.scenes=8", "data.batch_size=2", "sensor.rows=16", "sensor.columns=64", "trainer.accelerator=cpu",
    "trainer.max_steps=6", "trainer.val_check_interval=3", "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false", "stage.warmup_images=4", "callbacks.ema.every=2",
    "callbacks.checkpoint.every=2", "callbacks.pictures.every=3", "callbacks.pictures.num=1", "samples.num=1",
    "loggers=[csv]",
]  # fmt: skip


@dataclass(frozen=True)
class Family:
    name: str
    file: str
    choices: tuple[str, ...]

    @property
    def plugin(self) -> str:
        return f"--plugin={FAMILIES / self.file}.py"

    def __str__(self) -> str:
        return self.name


GAN = Family("gan", "toy_gan", ("stage=toy_gan", "stage.width=16"))
COMPLETION = Family(
    "completion", "toy_completion", ("stage=toy_completion", "sampler={name: sde, steps: 2}")
)
BACKBONE = Family("backbone", "toy_backbone", ("backbone=toy_backbone", "sampler.steps=2"))
ALL = (GAN, COMPLETION, BACKBONE)


@contextlib.contextmanager
def loaded(*families: Family) -> Iterator[None]:
    """Families' files imported for the length of a block: what comes after is as if in a process of
    its own.
    """
    tables, store = (
        (GENERATORS, STAGES, BACKBONES, CALLBACKS, SAMPLERS, LOSSES),
        ConfigStore.instance(),
    )
    # Hydra's own stay
    choices = {group: copy.deepcopy(store.repo.get(group, {})) for group in REGISTRIES}
    before, known = [dict(table._entries) for table in tables], dict(plugins._loaded)
    plugins._loaded.clear()  # those of other tests in this process
    try:
        plugins.load_plugins([str(FAMILIES / f"{family.file}.py") for family in families])
        yield
    finally:
        store.repo.update(choices)
        plugins._loaded.clear()
        plugins._loaded.update(known)
        for table, entries in zip(tables, before, strict=True):
            table._entries.clear()
            table._entries.update(entries)


def r2flow(*arguments: object) -> Done:
    """`r2flow ARGUMENTS` in this process; no plug-in that it loads is there afterwards."""
    with loaded(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["r2flow", *map(str, arguments)])
        return quickly(cli.main)


def train(run: Path, family: Family, *more: str) -> Done:
    done = r2flow("train", family.plugin, *TINY, *family.choices, f"run_dir={run}", *more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="session", params=ALL, ids=str)
def trained(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Family, Path]:
    return request.param, run_of(request.param, tmp_path_factory)


RUNS: dict[Family, Path] = {}


def run_of(family: Family, folders: pytest.TempPathFactory) -> Path:
    if family not in RUNS:
        RUNS[family] = folders.mktemp(family.name) / "run"
        train(RUNS[family], family)
    return RUNS[family]
