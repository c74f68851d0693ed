"""Trained generators by name: `r2flow.load("street")`, `r2flow sample street`,
`stage.parent=street`.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from r2flow.base.errors import check
from r2flow.base.registry import Registry

FOLDER = Path(__file__).with_name("weights")


@dataclass(frozen=True)
class _Model:
    """A trained generator with a name."""

    about: str  # generated scans and training data
    sha256: str
    licence: str = "MIT"


MODELS: Registry[_Model] = Registry(
    "model",
    street=_Model(
        "street scenes in any number of evaluations, learned from simulated scans",
        "9177ee104c65d06690c4f1719eed8bda524704e7d631c371689ef7e3cec0f9d1",
    ),
    densify=_Model(
        "scans of few beams or points completed to all, learned from simulated scans",
        "3bf412e171f7e822f6411250b090af8a920d20b00c1a5f86f6d61eb62a213712",
    ),
    labels=_Model(
        "labels of scans, scans of labels and denser scans with both, from simulated scans",
        "3c173b5af27dc25516fdc24240cb4ea92533371668b6ba3013ea1404c13f126d",
    ),
    densify_small=_Model(
        "as densify with nearly its errors, in half of its time, learned from it",
        "4a5832556d65a6085aec763045b8fed73bae36f7919ac7440af56e4027f24c05",
    ),
)
DEFAULT = "street"
DENSIFY = "densify"


def model_file(name: str) -> Path:
    MODELS[name]  # refuses unknown names
    return FOLDER / f"{name}.safetensors"


def find_model(name: str) -> Path:
    """Find and verify the file of a model."""
    path = model_file(name)
    check(path.is_file(), f"the model {name} is not here (no {path}): install r2flow again.")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    same = digest == MODELS[name].sha256
    check(
        same,
        f"{path} is not the model {name}, or damaged: its SHA-256 is {digest[:16]}...; install "
        "r2flow again.",
    )
    return path


def name_of(path: Path) -> str | None:
    """Name of the model with this file, or None."""
    return next((name for name in MODELS if model_file(name) == path), None)
