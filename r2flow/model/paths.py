"""Where checkpoints lie: in run folders, in files, among the models that come with the package."""

import re
from pathlib import Path

from r2flow.base.errors import InputError
from r2flow.base.registry import did_you_mean
from r2flow.model.shipped import MODELS, find_model

FOLDER = "checkpoints"


def title_of(path: Path) -> str:
    """Name of a checkpoint's run, else of its file."""
    path = path.resolve()
    return path.parents[1].name if path.parent.name == FOLDER else path.stem


def step_of(path: Path) -> int:
    """The step in a checkpoint's file name; -1 without one."""
    match = re.search(r"step-(\d+)", path.name)
    return int(match.group(1)) if match else -1


def checkpoints_of(run: str | Path) -> list[Path]:
    """The checkpoints of a run folder, the latest first."""
    return _latest_first(Path(run, FOLDER))


def _latest_first(folder: Path) -> list[Path]:
    paths = [path for path in folder.glob("step-*.ckpt") if not path.is_symlink()]
    return sorted(filter(Path.is_file, paths), key=step_of, reverse=True)


def find_checkpoint(path: str | Path) -> Path:
    """Path of a checkpoint file, of the latest checkpoint of a run folder, or of a model's file by
    its name.

    A file or a run in the current folder takes precedence over a model of the same name.
    """
    name = str(path).rstrip("/")
    path = Path(path).expanduser()
    if path.is_file():
        return path
    checkpoints = checkpoints_of(path) or _latest_first(path)
    if checkpoints:
        return checkpoints[0]
    if name in MODELS and (path.is_dir() or not path.exists()):
        return find_model(name)
    problem = f"no checkpoint at {path}."
    known = [*MODELS, *(folder.name for folder in path.parent.glob("*/"))]
    models = ", ".join(MODELS)
    hint = f"Give a checkpoint file, a run folder or a model ({models})."
    hint += did_you_mean(path.name, known)
    if path.is_dir():
        problem = f"{path} holds no checkpoint ({FOLDER}/step-*.ckpt)."
        runs = sorted(str(run) for run in path.glob("*/") if checkpoints_of(run))
        hint = f"It holds runs: give {' or '.join(runs[:8])}." if runs else hint
    elif path.exists():  # reading a pipe would block
        problem = f"{path} is not a regular file."
    raise InputError(f"{problem} {hint}")
