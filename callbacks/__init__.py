"""Callbacks of a run, as part of the package r2flow."""

from lightning.pytorch.callbacks import Callback

from r2flow.base.errors import InputError
from r2flow.base.registry import Options, Registry, construct

from .checkpoints import Checkpoints
from .curvature import Curvature
from .ema import EMA, HalfLifeEMA
from .guard import Guard
from .loggers import LearningRates
from .periodic import SamplePictures
from .progress import Progress
from .reflow_pairs import ReflowPairs
from .stopping import Stopping

__all__ = [
    "CALLBACKS",
    "EMA",
    "Checkpoints",
    "Curvature",
    "Guard",
    "HalfLifeEMA",
    "LearningRates",
    "Progress",
    "ReflowPairs",
    "SamplePictures",
    "Stopping",
    "build_callbacks",
]

if __name__ != "r2flow.callbacks":
    # Callbacks look up each other by class, and a second copy has other classes.
    raise ImportError(
        "import r2flow.callbacks, not callbacks: the folder is part of the package r2flow."
    )

# In the order of execution.
CALLBACKS: Registry[type[Callback]] = Registry(
    "callback",
    reflow_pairs=ReflowPairs,
    ema=EMA,
    half_life_ema=HalfLifeEMA,
    pictures=SamplePictures,
    curvature=Curvature,
    guard=Guard,
    requeue=Stopping,
    checkpoint=Checkpoints,
    progress=Progress,
)


def build_callbacks(options: Options) -> list[Callback]:
    """Build callbacks from the options of each, by its name in `CALLBACKS`; null disables one."""
    wanted = {name: given for name, given in options.items() if given is not None}
    for name in wanted:
        CALLBACKS[name]  # refuses an unknown name
    if {"ema", "half_life_ema"} <= wanted.keys():
        raise InputError(
            "a run keeps one average of its weights, found callbacks.ema and half_life_ema: null "
            "one."
        )
    built = [
        construct(f"callbacks.{name}", CALLBACKS[name], wanted[name])
        for name in CALLBACKS
        if name in wanted
    ]
    # It saves the state of all others, plug-ins' too.
    return sorted(built, key=lambda callback: isinstance(callback, Stopping))
