"""Sampling: scan i depends on (seed, i) alone, up to rounding in different batches."""

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Protocol

import torch
from torch import Tensor

from r2flow.base.errors import InputError, check
from r2flow.base.noise import Draws
from r2flow.generators import Answers, Condition, Generator, Sampler
from r2flow.generators.base import Precision, Progress

_log = logging.getLogger(__name__)


class HasGenerator(Protocol):
    """Any object with a generator, such as a checkpoint."""

    @property
    def generator(self) -> Generator: ...


@dataclass(frozen=True)
class Samples:
    """Generated scans; tensors are on the CPU."""

    #: range in metres and reflectance, (B, 2 or 1, H, W); 0 for rays dropped
    images: Tensor
    first: int  #: number of the first scan
    evaluations: Tensor  #: network evaluations per scan, (B,)
    converged: Tensor  #: whether the sampler converged, per scan, (B,) bool
    seconds: float  #: generation time of the batch, without noise and decoding
    density: Answers | None = None  #: of a transfer flow's answers


def sample(
    source: HasGenerator | Generator,
    num: int,
    seed: int = 0,
    *,
    sampler: Sampler | str | None = None,
    batch_size: int = 1,
    condition: Condition | None = None,
    precision: Precision = "32-true",
    progress: Progress = None,
    **changes: Any,
) -> Iterator[Samples]:
    """Draw scans 0 to num - 1 of a seed, batch by batch, and warn of those that are not solved.

    Args:
        source: A checkpoint or its generator.
        sampler: Sampler or its name; None: the generator's default.
        batch_size: Scans per batch. It does not change a fixed-step result beyond rounding.
        condition: Condition of the scans, each tensor (num, ...).
        precision: Precision of the network, see `Generator.forward`.
        progress: Called after every network evaluation of a batch.
        changes: Fields of the sampler: steps, tolerance, grid, ...

    Raises:
        InputError: num or batch_size below 1, a sampler that the generator does not have, an
            invalid field of the sampler, or a condition of the wrong length.
    """
    generator = source if isinstance(source, Generator) else source.generator
    for count in (num, batch_size):
        if not isinstance(count, Integral) or count < 1:
            raise InputError(f"needs whole numbers of scans, at least one; found {count!r}.")
    if isinstance(sampler, Sampler):
        sampler = sampler.changed(**changes)
    else:
        sampler = generator.choose(sampler, **changes)
    for name, value in (condition or {}).items():
        check(
            len(value) == num, f"the condition's {name} has {len(value)} scans, but num is {num}."
        )
    for first in range(0, num, batch_size):
        numbers = range(first, min(first + batch_size, num))
        part = condition and {n: value[first : numbers.stop] for n, value in condition.items()}
        drawn = draw(generator, numbers, seed, sampler, part, precision, progress)
        warn_unsolved(drawn.converged, first)
        yield drawn


@torch.no_grad()
def draw(
    generator: Generator,
    numbers: Sequence[int],
    seed: int,
    sampler: Sampler | None = None,
    condition: Condition | None = None,
    precision: Precision = "32-true",
    progress: Progress = None,
) -> Samples:
    """Draw the scans of these numbers as one batch (see `sample`); all generated images come from
    this function.
    """
    draws = Draws(seed, numbers)
    noise = draws.start(generator.noise_shape)
    start = time.perf_counter()
    generated = generator(
        noise, condition, sampler=sampler, draws=draws, precision=precision, progress=progress
    )
    x_1 = generated.x.cpu()  # also synchronises the GPU
    seconds = time.perf_counter() - start
    images = generator.space.decode(x_1)
    return Samples(
        images,
        numbers[0],
        generated.evaluations.cpu(),
        generated.converged.cpu(),
        seconds,
        generated.density,
    )


def warn_unsolved(converged: Tensor, first: int = 0, of: str = "") -> None:
    """Warn about unconverged scans; `first` is the number of the first scan, `of` says of what."""
    if not converged.all():
        lost = (first + (~converged).nonzero()[:, 0]).tolist()
        _log.warning(
            "not solved, so no scans of this flow: %s%s; try another solver, or for a velocity "
            "that is singular at t = "
            "1 a last step before it: --sampler adams3:finish=0.001.",
            ", ".join(map(str, lost)), of,
        )  # fmt: skip
