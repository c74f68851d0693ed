"""Trained generators by name: `r2flow.load("street")`, `r2flow sample street`, `stage.init=street`.

`NAME.safetensors` is in this folder for models that come with the package, else in the folder of models, where
`r2flow weights --add NAME FILE` copies it. r2flow does not download.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from r2flow.errors import InputError
from r2flow.files import atomic_write, cache_folder
from r2flow.registry import Registry

SHIPPED = Path(__file__).parent


@dataclass(frozen=True)
class Model:
    """A trained generator with a name.

    Attributes:
        about: Generated scans and training data.
        page: Source of the file; None: comes with the package.
    """

    about: str
    sha256: str
    licence: str = "MIT"
    page: str | None = None


MODELS: Registry[Model] = Registry(
    "model",
    street=Model(
        "street scenes in any number of evaluations, learned from simulated scans",
        "211cf04c4c10227a0504f1e323af2e6b2a6562caa377ba2c95f8f689ed99c4b5",
    ),
    street_full=Model(
        "street scenes at 64 x 1024, learned from simulated scans",
        "c4641b71eecd2086f1851cbb9816ae063bf27c1325a2ea45dfa06b378c766776",
        page="release/street_full.safetensors in the source of r2flow",
    ),
    densify=Model(
        "scans of few beams or points completed to all, in one evaluation, learned from simulated scans",
        "620e21cc5ef1b7568fd80afb729e65ce47462d5596b3bee04d0838c0072422c0",
    ),
)
DEFAULT = "street"
DENSIFY = "densify"


def models_folder() -> Path:
    """Folder of models that do not come with the package: R2FLOW_MODELS, or ~/.cache/r2flow/models."""
    return cache_folder("R2FLOW_MODELS", "models")


def model_file(name: str) -> Path:
    """Path of a model's file, which may be missing."""
    return (SHIPPED if MODELS[name].page is None else models_folder()) / f"{name}.safetensors"


def find_model(name: str) -> Path:
    """Find and verify the file of a model.

    Raises:
        InputError: unknown model, or missing or wrong file.
    """
    path, model = model_file(name), MODELS[name]
    if not path.is_file():
        get = f"get it from {model.page} and give r2flow weights --add {name} FILE" if model.page else "install again"
        raise InputError(f"the model {name} is not here (no {path}): {get}.")
    _check(name, path)
    return path


def add_model(name: str, file: Path) -> Path:
    """Copy the file of a model into the folder of models.

    Raises:
        InputError: unknown model, one that comes with the package, or wrong file.
    """
    if MODELS[name].page is None:
        raise InputError(f"the model {name} comes with the package; there is nothing to add.")
    if not file.is_file():
        raise InputError(f"{file} is not a file; the file of {name} is {MODELS[name].page}.")
    _check(name, file)
    path = model_file(name)
    with atomic_write(path) as out:
        out.write(file.read_bytes())
    return path


def name_of(path: Path) -> str | None:
    """Name of the model with this file, or None."""
    return next((name for name in MODELS if model_file(name) == path), None)


def _check(name: str, path: Path) -> None:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != MODELS[name].sha256:
        raise InputError(
            f"{path} is not the model {name}, or damaged: its SHA-256 is {digest[:16]}..., not "
            f"{MODELS[name].sha256[:16]}.... Get it again."
        )
