"""Shared by all tests: where reference tensors and real scans lie, and small sensors."""

import contextlib
import io
import logging
import os
import resource
import sys
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import numpy as np
import pytest
import torch
from hydra._internal.hydra import Hydra
from matplotlib.figure import Figure
from r2flow.callbacks.checkpoints import AtomicCheckpointIO

from r2flow import cli
from r2flow.base import errors
from r2flow.base.errors import InputError
from r2flow.base.registry import construct
from r2flow.data.described import describe
from r2flow.data.layouts import Drive
from r2flow.data.preparing import plan, prepare
from r2flow.data.reading import Reading
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.parts import MODEL
from r2flow.reports.figures import save_figure
from r2flow.stages import STAGES
from r2flow.stages.base import Stage

ROOT = Path(__file__).resolve().parent.parent
# it would compose each config twice, to read the null of hydra.mode
Hydra.get_mode = lambda *_, **__: None

# a worker for each core: more threads would wait for each other
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)
    os.environ.setdefault("OMP_NUM_THREADS", "1")


CONFIG: dict[str, Any] = {  # a flow of 8 x 64
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 64, "rays": "centre"},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {
        "name": "hdit",
        "base_channels": 8,
        "depths": [1, 1],
        "num_heads": [1, 2],
        "time_channels": 16,
    },
    "data": {"name": "simulated", "batch_size": 4},
    "stage": {"name": "rectify"},
    "seed": 0,
}
SENSOR = SENSORS["hdl64e"].resized(8, 64)  # of that flow

TINY: dict[str, dict[str, Any]] = {
    "hdit": {"base_channels": 16, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
    "adm_unet": {
        "base_channels": 8,
        "channel_multiplier": [1, 2],
        "num_residual_blocks": 1,
        "num_heads": 2,
    },
    "vit": {"channels": 16, "depth": 2, "heads": 2, "time_channels": 16, "patch": [4, 4]},
    "local": {"channels": 8, "dilations": [1, 2]},
}
TINY["efficient_unet"] = TINY["adm_unet"]


def tiny_options(name: str) -> dict[str, Any]:
    """Options of a backbone that builds in milliseconds and takes images of 16 x 64."""
    return {"name": name, **TINY.get(name, {})}


class Trap:
    """A pickle of it runs code when it is loaded."""

    def __reduce__(self) -> Any:
        return exec, ("raise SystemExit('a file has run code')",)


def make_stage(config: dict[str, Any], **options: Any) -> Stage:
    """The stage of a config, with further options."""
    given = {key: config[key] for key in (*MODEL, "sampler", "few", "seed") if key in config}
    own = {**config.get("stage", {"name": "rectify"}), **options}
    return construct("stage", STAGES[own.pop("name")], {**given, **own})


def write_checkpoint(path: Path, config: dict[str, Any]) -> Path:
    stage = make_stage(config)
    state = stage.state_dict()
    content = {"state_dict": state, "current_model_state": state, "global_step": 7}
    content |= {
        "hyper_parameters": dict(stage.hparams),
        "datamodule_hyper_parameters": config["data"],
    }
    stage.on_save_checkpoint(content)
    AtomicCheckpointIO().save_checkpoint(content, path)
    return path


def write_run(folder: Path, flow: Checkpoint, stage: dict[str, Any], scale: float = 1.0) -> Path:
    """A run folder with the weights of a flow, times a number."""
    weights = dict(flow.generator.named_parameters())
    state = flow.generator.state_dict()
    options = {
        "sampler": None,
        "few": None,
        "seed": 0,
        "generator": {"name": "rectified_flow"},
        **flow.config.stored,
    }
    model = {key: options[key] for key in (*MODEL, "sampler", "few", "seed")}
    content = {
        "state_dict": {
            f"generator.{name}": scale * v if name in weights else v for name, v in state.items()
        },
        "hyper_parameters": {
            **model,
            **{key: value for key, value in stage.items() if key != "name"},
        },
        "datamodule_hyper_parameters": flow.config.stored.get("data", {}),
        "r2flow": {
            "stage": stage["name"],
            "plugins": [],
            "total_steps": 7,
            **flow.generator.drawing(),
        },
        "global_step": 7,
    }
    AtomicCheckpointIO().save_checkpoint(content, folder / "checkpoints" / "step-00000007.ckpt")
    return folder


@contextlib.contextmanager
def small_disk(size: int) -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@contextlib.contextmanager
def memory_below(size: int) -> Iterator[None]:
    """What is allocated while the block runs is at no time more than a number of bytes."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < size
    finally:
        tracemalloc.stop()


@contextlib.contextmanager
def refused(*words: object) -> Iterator[None]:
    with pytest.raises(InputError) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert all(str(word) in str(caught.value) for word in words), caught.value


def quiet_trainer(folder: Path, **options: Any) -> L.Trainer:
    quiet = ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary")
    given = {**dict.fromkeys(quiet, False), "max_epochs": -1, **options}
    return L.Trainer(accelerator="cpu", default_root_dir=folder, **given)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference tensors and real scans, which is never part of the repository."""
    folder = Path(os.environ.get("R2FLOW_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip("needs the reference tensors and real scans in ../shared or R2FLOW_SHARED")
    return folder


@pytest.fixture(params=list(SENSORS))
def sensor(request: pytest.FixtureRequest) -> Sensor:
    return SENSORS[request.param]


@pytest.fixture(autouse=True)
def _from_the_start() -> None:
    torch.manual_seed(0)
    errors._warned.clear()


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, dict]:
    """A checkpoint of ours with random weights, averaged and raw, and the averaged ones."""
    stage = make_stage(CONFIG)
    parameters = dict(stage.named_parameters())
    raw = {
        name: torch.randn_like(v) if name in parameters else v
        for name, v in stage.state_dict().items()
    }
    averaged = {name: v + 1 if name in parameters else v for name, v in raw.items()}
    content = {"state_dict": averaged, "current_model_state": raw, "global_step": 7}
    content |= {
        "hyper_parameters": dict(stage.hparams),
        "datamodule_hyper_parameters": CONFIG["data"],
    }
    stage.on_save_checkpoint(content)
    path = tmp_path / "run" / "checkpoints" / "step-00000007.ckpt"
    AtomicCheckpointIO().save_checkpoint(content, path)
    return path, averaged


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str

    @property
    def said(self) -> str:
        assert self.returncode == 0, self.stderr
        return self.stdout

    @property
    def quiet(self) -> str:
        assert not self.stderr
        return self.said

    @property
    def refusal(self) -> str:
        """The one line of an error of the user's, without a warning."""
        assert self.returncode == 2, self.stderr
        (line,) = self.stderr.splitlines()
        return line


def captured(run: Callable[[], int | None]) -> Done:
    said, complained = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
            code = run() or 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    # `report solvers` raises it for its process
    logging.getLogger("r2flow.flow").setLevel(logging.NOTSET)
    return Done(code, said.getvalue(), complained.getvalue())


@pytest.fixture
def r2flow(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Done]:
    def typed(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["r2flow", *map(str, arguments)])
        return captured(cli.main)

    return typed


def draw_quickly(patch: pytest.MonkeyPatch) -> None:
    """Pictures in fewer pixels, and no PDFs; test_pages.py and test_pictures.py have them whole."""

    def save(figure: Figure, path: Path, **about: Any) -> Path:
        if path.suffix == ".pdf":
            path.touch()
            return path
        return save_figure(figure, path, dpi=100, **about)

    for module in ("pages", "figures"):
        patch.setattr(f"r2flow.reports.{module}.save_figure", save)


@pytest.fixture
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_quickly(monkeypatch)


def ground(sensor: Sensor, above: float = 0.0) -> np.ndarray:
    """An image of the ground 1.73 m below, and of another range above it."""
    e = sensor.rays()[0].numpy()
    r = np.where(e < -0.03, -1.73 / np.sin(np.minimum(e, -0.03)), above)
    return np.stack([r, np.full_like(r, 0.3)]).astype(np.float32)


def write_scan(path: Path, number: int, reflectance: float = 0.5) -> None:
    """A scan whose only return lies at 5 + number metres."""
    path.parent.mkdir(parents=True, exist_ok=True)
    r = 5.0 + number
    write_points(
        path, np.array([[r, 0.01, -0.05 * r]], np.float32), np.array([reflectance], np.float32)
    )


def folder_of(folder: Path, first: int, count: int) -> Path:
    for number in range(first, first + count):
        write_scan(folder / f"{number:06d}.bin", number)
    return folder


def numbers(source: Sequence[np.ndarray]) -> list[int]:
    """The number that each scan of `write_scan` carries in its range."""
    return [round(float(source[i][0].max())) - 5 for i in range(len(source))]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("[!.]*")) if path.is_file()}


@pytest.fixture
def kitti_360(tmp_path: Path) -> Path:
    for drive in (0, 2, 3, 4, 10):
        for frame in range(3):
            name = f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data/{frame:010d}.bin"
            write_scan(tmp_path / name, drive * 3 + frame)
    return tmp_path


@pytest.fixture
def numbered(tmp_path: Path) -> Path:
    return folder_of(tmp_path / "scans", 0, 12)


def images(count: int, seed: int) -> np.ndarray:
    """Walls with holes at 4 to 60 m, (N, 2, 8, 64)."""
    draw = np.random.default_rng(seed)
    r = draw.uniform(4, 60, (count, 1, 8, 64)) * (draw.random((count, 1, 8, 64)) > 0.3)
    return np.concatenate([r, 0.5 * (r > 0)], 1).astype(np.float32)


def folder(path: Path, scans: np.ndarray) -> Path:
    path.mkdir(parents=True)
    for number, image in enumerate(scans):
        np.save(path / f"{number:06d}.npy", image)
    return path


@pytest.fixture
def real(tmp_path: Path) -> Path:
    return folder(tmp_path / "real", images(12, 1))


@pytest.fixture
def generated(tmp_path: Path) -> Path:
    return folder(tmp_path / "generated", images(10, 2))


def find_drives(name: str, root: Path, split=None, drives=None) -> list[Drive]:
    return describe(f"{name}:{root}", split=split, drives=drives).drives


def prepare_folder(root: Path, out: Path, sensor: Sensor, layout: str = "folder") -> Path:
    prepare(plan(out, describe(f"{layout}:{root}"), Reading(sensor)))
    return out
