"""torch.hub: `torch.hub.load("OWNER/r2flow", "street")`, or `torch.hub.load(FOLDER, "street",
source="local")`.
"""

from pathlib import Path

dependencies = [
    "torch",
    "numpy",
    "safetensors",
    "pydantic",
    "omegaconf",
    "yaml",
    "scipy",
    "filelock",
    "rich",
]


def street(device: str = "cpu"):
    """The model that comes with the package; `.sample(4)` draws scans, `.generator` is the torch
    module.
    """
    return flow("street", device)


def flow(name: str | Path, device: str = "cpu"):
    """A trained generator: a model by its name, a run folder or a checkpoint file."""
    from r2flow import load

    return load(name, device)
