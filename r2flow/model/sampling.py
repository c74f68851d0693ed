"""Scans drawn from a generator: scan i is a function of (seed, i), in any batch but for the network's rounding."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Protocol

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Condition, Generator, Sampler
from r2flow.generators.base import Precision, Progress
from r2flow.lidar.region import Region
from r2flow.noise import Draws


class HasGenerator(Protocol):
    """A checkpoint, or whatever else holds a generator."""

    @property
    def generator(self) -> Generator: ...


@dataclass(frozen=True)
class Samples:
    """Generated scans.

    Attributes:
        images: Range in metres and reflectance, (B, 2 or 1, H, W), on the CPU; 0 where a ray was dropped or not
            asked for. One channel where only one was asked for.
        first: Number of the first one; scan i depends on (seed, i) alone.
        evaluations: Network evaluations of each, (B,), on the CPU.
        converged: Whether each is a scan of the generator, (B,) bool, on the CPU.
        seconds: Of the generation of all of them; neither their noise nor their decoding counts.
    """

    images: Tensor
    first: int
    evaluations: Tensor
    converged: Tensor
    seconds: float


def sample(
    source: HasGenerator | Generator,
    num: int,
    seed: int = 0,
    *,
    sampler: Sampler | None = None,
    batch_size: int = 1,
    condition: Condition | None = None,
    region: Region | None = None,
    channels: str = "both",
    precision: Precision = "32-true",
    progress: Progress = None,
    **changes: Any,
) -> Iterator[Samples]:
    """Draw scans 0 to num - 1 of a seed, batch by batch.

    Args:
        source: A checkpoint or its generator.
        sampler: How it is run; the generator's own if left out.
        batch_size: Scans at once. It does not change a fixed-step result beyond rounding.
        condition: What is known of the scans, each tensor (num, ...).
        region: The part of the image that is asked for. The network sees `evaluated_region` alone, with the same
            noise as in the whole image.
        channels: `range` or `reflectance` skips the decoding of the other one; `both` takes what the model has.
        precision: Of the network, see `Generator.forward`.
        progress: Called after every network evaluation of a batch.
        changes: `name` and fields of the sampler (`Generator.choose`): steps, tolerance, grid, ...

    Raises:
        InputError: num or batch_size below 1, a sampler or a channel that the generator does not have, steps of an
            adaptive solver or a tolerance of another one, a condition of another number of scans, a region that the
            generator cannot be cut to.
    """
    generator = source if isinstance(source, Generator) else source.generator
    if not (isinstance(num, Integral) and isinstance(batch_size, Integral) and num >= 1 and batch_size >= 1):
        raise InputError(f"needs at least one scan and a batch of at least one; found {num!r} and {batch_size!r}.")
    how = sampler.changed(**changes) if sampler else generator.choose(**changes)
    generator.space.check_channels(channels)
    for name, value in (condition or {}).items():
        if len(value) != num:
            raise InputError(f"the condition's {name} is of {len(value)} scans, and {num} are asked for.")
    for first in range(0, num, batch_size):
        numbers = range(first, min(first + batch_size, num))
        known = condition and {name: value[first : numbers.stop] for name, value in condition.items()}
        yield draw(generator, numbers, seed, how, known, region, channels, precision, progress)


@torch.no_grad()
def draw(
    generator: Generator,
    numbers: Sequence[int],
    seed: int,
    sampler: Sampler | None = None,
    condition: Condition | None = None,
    region: Region | None = None,
    channels: str = "both",
    precision: Precision = "32-true",
    progress: Progress = None,
) -> Samples:
    """The scans of these numbers together; every image that this project generates is made here.

    Args:
        numbers: Of the scans, (B,).

    See `sample` for the others.
    """
    draws, space = Draws(seed, numbers), generator.space
    noise = draws.start(generator.noise_shape)
    seen = None if region is None or region.share == 1 else evaluated_region(generator, region)
    if seen is not None:
        whole = space.shape[1:]
        generator, noise = generator.part(seen), seen.crop(noise)
        if condition is not None:  # what is known of each pixel
            condition = {n: seen.crop(value) if value.shape[-2:] == whole else value for n, value in condition.items()}
    start = time.perf_counter()
    made = generator(noise, condition, sampler=sampler, draws=draws, precision=precision, progress=progress)
    x_1 = made.x.cpu()  # which also waits for a GPU
    seconds = time.perf_counter() - start
    images = generator.space.decode(x_1, channels)
    if region is not None and seen is not None:
        images = region.place(region.crop(seen.place(images)))
    return Samples(images, numbers[0], made.evaluations.cpu(), made.converged.cpu(), seconds)


def batches(num: int, batch_size: int) -> int:
    """How many batches `sample` takes."""
    return math.ceil(num / batch_size)


def evaluated_region(generator: Generator, region: Region) -> Region:
    """The region and its margin, rounded outward to what the generator can be cut to; of the whole image, the image."""
    if region.share == 1:  # which every generator makes
        return Region(region.shape, 0, region.shape[0], 0, region.shape[1])
    return region.widened().rounded(generator.unit)
