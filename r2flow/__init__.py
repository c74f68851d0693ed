"""R2Flow: rectified flows that generate LiDAR scans, range and reflectance.

Notation everywhere: `t = 0` is noise and `t = 1` is data; `x_0 ~ N(0, I)`, `x_1` a scan,
`x_t = (1 - t) x_0 + t x_1`, target `u_t = x_1 - x_0`, estimate `v_t = v(t, x_t)`.

    flow = r2flow.load("street")              # a model by name, a run folder or a checkpoint
    scans = flow.sample(4)                    # range in metres and reflectance, (4, 2, H, W)
    scan = r2flow.read("000000.bin", "vlp16")  # a scan file as such an image, (2, H, W)
"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch

    from r2flow.backbones import BACKBONES
    from r2flow.data.datamodule import ScanDataModule
    from r2flow.lidar.sensors import Sensor
    from r2flow.model.checkpoint import Checkpoint
    from r2flow.stages import STAGES, Distill, LearnFlowMap, Rectify, Reflow, Stage, Transfer

__version__ = "0.2.0"


class _Beside:
    """Finds r2flow.callbacks and r2flow.conf in a checkout, beside this package; a wheel has them
    in it.
    """

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name not in ("r2flow.callbacks", "r2flow.conf"):
            return None
        folder = Path(__file__).parents[1] / name.removeprefix("r2flow.")
        return spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )


if not Path(__file__).with_name("conf").is_dir():
    sys.meta_path.append(_Beside)

# Imported at their first use, so that `import r2flow` is fast.
_PLACES = {
    "BACKBONES": "r2flow.backbones",
    "ScanDataModule": "r2flow.data.datamodule",
    **dict.fromkeys(
        ("STAGES", "Distill", "LearnFlowMap", "Rectify", "Reflow", "Stage", "Transfer"),
        "r2flow.stages",
    ),
}

__all__ = [
    "BACKBONES",
    "STAGES",
    "Distill",
    "LearnFlowMap",
    "Rectify",
    "Reflow",
    "ScanDataModule",
    "Stage",
    "Transfer",
    "__version__",
    "load",
    "read",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'r2flow' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return __all__


def load(
    name: "str | Path",
    device: "str | torch.device" = "cpu",
    backbone: "torch.nn.Module | None" = None,
) -> "Checkpoint":
    """Load a trained generator: a model by name (see `r2flow info`), a run folder or a checkpoint
    file.

    Args:
        device: cpu, cuda, cuda:1, ..., or auto: a GPU if available.
        backbone: A module like the one that a model with a module of its user's was trained with.

    Raises:
        InputError: unknown model, unusable file or unavailable device.
    """
    from r2flow.base.devices import choose_device
    from r2flow.model.checkpoint import load_checkpoint

    return load_checkpoint(name, choose_device(str(device), "device"), backbone=backbone)


@overload
def read(
    path: "str | Path",
    sensor: "Sensor | str | None" = None,
    reflectance_scale: float | None = None,
    columns: "Sequence[str] | None" = None,
    return_sensor: Literal[False] = False,
) -> "torch.Tensor": ...


@overload
def read(
    path: "str | Path",
    sensor: "Sensor | str | None" = None,
    reflectance_scale: float | None = None,
    columns: "Sequence[str] | None" = None,
    *,
    return_sensor: Literal[True],
) -> "tuple[torch.Tensor, Sensor]": ...


def read(
    path: "str | Path",
    sensor: "Sensor | str | None" = None,
    reflectance_scale: float | None = None,
    columns: "Sequence[str] | None" = None,
    return_sensor: bool = False,
) -> "torch.Tensor | tuple[torch.Tensor, Sensor]":
    """Read a scan from a file: range in metres and reflectance, (2, H, W) float32, 0 for rays
    without a return.

    Args:
        path: A scan file, a range image (.npy) or a sample of the published code (.pth).
        sensor: Sensor of the image, or its name or YAML file. Default: the sensor in the manifest
            of a folder that r2flow wrote, else the built-in sensor with the file's beams, else
            hdl64e; a range image keeps its size.
        reflectance_scale: Value of full reflectance in the file. Default: the sensor's, else the
            first of 1, 100 (with a warning), 255, 256, 65535 that no value exceeds or, with a
            warning, about the largest value if that is below a tenth of it. Fractions of 1 are not
            divided by 100, 255, 256 or 65535.
        columns: Names of the columns of a file without names, as ("x", "y", "z", "intensity", "_");
            fields to rename in a file with names, as ("intensities=reflectance",).
        return_sensor: Return the sensor of the image, too.

    Raises:
        InputError: the file cannot be read, or no point is in the sensor's field of view.
    """
    from r2flow.data.opening import read

    image, found = read(path, sensor, reflectance_scale, columns)
    return (image, found) if return_sensor else image
