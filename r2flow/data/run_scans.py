"""The scans of a run: opened by its plan, with some held out, kept in memory, in a random order."""

import logging
from collections.abc import Sequence

import numpy as np

from r2flow.data.described import Described
from r2flow.data.loader import MixedOrder, Mixture, Order, Permutations
from r2flow.data.options import ValidationOptions
from r2flow.data.reading import Reading
from r2flow.data.resolving import DataPlan
from r2flow.data.sources import InMemory, ScanSource, holdout_block, spread
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor

_log = logging.getLogger(__name__)

_Opened = tuple[Mixture, Mixture, list[str]]
Scans = Mixture | np.ndarray  # scans, or the numbers of pairs


def open_for_training(
    scans: Described, encoding: Encoding, sensor: Sensor | None = None
) -> ScanSource:
    """The scans of a set, not yet read, with the channels of an encoding, as images of its sensor
    or of another one.
    """
    reading = {
        **scans.options.reading_fields,
        "sensor": (sensor or encoding.sensor).described(),
        "reflectance": encoding.reflectance,
        "labels": encoding.labels,
        "within_limits": True,
    }
    return scans.open(Reading.of(reading))


def open_plan(plan: DataPlan, encoding: Encoding, validation: ValidationOptions) -> _Opened:
    """The training scans, the held-out ones, and the names of all training sets.

    Without `validation.data`, each part of a mixture holds out one block.
    """
    whole = [
        open_for_training(scans, encoding, sensor)
        for scans, sensor in zip(plan.sets, plan.sensors, strict=True)
    ]
    names: list[str] = []
    for number, source in enumerate(whole):
        # a number makes the names of several parts' scans distinct
        label = f"{number}: " if len(whole) > 1 else ""
        names += [f"{label}{name}" for name in source.names]
    training = whole
    if plan.held_out is not None:
        held = [open_for_training(plan.held_out, encoding)]
    else:
        training = []
        held = []
        for source in whole:
            starts = sorted(numbers[0] for numbers in source.drives.values() if len(numbers))
            first, last = holdout_block(len(source), validation.share, starts)
            training.append(source.subset(first))
            held.append(source.subset(last))
    _warn_of_shared(training, held)
    mixed = Mixture(held)
    return Mixture(training), mixed.subset(spread(len(mixed), validation.scans)), names


def _warn_of_shared(training: Sequence[ScanSource], held: Sequence[ScanSource]) -> None:
    trained = set[str]().union(*(source.places() for source in training))
    validated = set[str]().union(*(source.places() for source in held))
    if shared := trained & validated:
        _log.warning(
            "%d held-out scans are trained on, as %s: give each set its own split or drives",
            len(shared),
            min(shared),
        )


def in_memory(source: Mixture, what: str, most_gib: float) -> Mixture:
    """The source with its slow parts read into memory, if they fit; `what` they are, for the
    progress bar.
    """
    parts = [*source.parts]
    firsts = {i: part[0] for i, part in enumerate(parts) if part.slow and len(part)}
    size = sum(len(parts[i]) * first.nbytes for i, first in firsts.items())
    if size > most_gib * 2**30:
        return source
    for i, first in firsts.items():
        parts[i] = InMemory(parts[i].read_all(what, first.shape), parts[i].names)
    return Mixture(parts)


def order_of(source: Scans, weights: Sequence[float], seed: int) -> Order:
    """The order of images: by the weights of several parts of a mixture, else by permutations."""
    if isinstance(source, Mixture) and len(weights) > 1:
        return MixedOrder([len(part) for part in source.parts], weights, seed)
    return Permutations(len(source), seed)
