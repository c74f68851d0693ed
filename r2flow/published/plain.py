"""OmegaConf objects in a torch file, read as plain values: nothing of OmegaConf is imported or run."""

from typing import Any

import torch


class Inert:
    """What stands for an object of a class that is only looked at: it keeps what the pickle says of it."""

    def __init__(self, *arguments: Any) -> None:
        """Nothing is done with the arguments."""


# The classes that a pickled DictConfig names. `weights_only` refuses every other.
NAMES = (
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    *(f"omegaconf.base.{name}" for name in ("Metadata", "ContainerMetadata")),
    *(f"omegaconf.nodes.{name}Node" for name in ("Any", "Boolean", "Float", "Integer", "String")),
    "typing.Any",
    "collections.defaultdict",
    *(f"builtins.{name}" for name in ("bool", "dict", "float", "int", "list", "str")),
)
CONTENT, VALUE = "_content", "_val"


def inert() -> Any:
    """While it is entered, `torch.load(weights_only=True)` takes the classes in `NAMES`, each as `Inert`."""
    return torch.serialization.safe_globals([(Inert, name) for name in NAMES])


def plain(value: Any) -> Any:
    """The plain value of an `Inert` config or of one of its nodes; anything else as it is."""
    if not isinstance(value, Inert):
        return value
    kept = vars(value)
    if VALUE in kept:
        return kept[VALUE]
    content = kept.get(CONTENT)
    if isinstance(content, dict):
        return {key: plain(one) for key, one in content.items()}
    return [plain(one) for one in content] if isinstance(content, list) else content
