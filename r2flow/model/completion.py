"""Scans completed from what is known of them: answer a of scan i is a function of (seed, i, a), in any
batch but for the network's rounding.

for found in complete(checkpoint, images, state, num=8):
    found.images, found.spread
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.posterior import completes
from r2flow.generators import Condition, Flow, Generator, Regression, Sampler, condition_of
from r2flow.generators.base import Progress, check_control
from r2flow.generators.flow import UNTOLD
from r2flow.lidar.encoding import LIMIT_TOLERANCE
from r2flow.lidar.interpolation import surfaces
from r2flow.lidar.known import Ray
from r2flow.lidar.sensors import Sensor
from r2flow.model.sampling import HasGenerator, Samples, draw

KEEP = ("exact", "blend", "mend")
CONFIRMED = 0.2  # of its range: nearer an answer confirms a doubtful return; docs/completion.md
ROUGH = 0.015  # of its range: how far the answers of a flow lie about a surface
EXACT = 0.004  # of its range: no surface is known better
TAILS = 2  # so many times the error at the measured rays is that between them taken for; docs/completion.md
SURE = 0.05  # of its range: a surface known better than that holds wherever an answer has the return
ANSWER = 2**32  # noise numbers from one answer to the next: answer 0 of scan i has the noise of sample i
USUAL = Sampler("mmps", 10, grid="power:2")  # of flows; docs/completion.md has others


@dataclass(frozen=True)
class Completed:
    """The answers to one scan.

    Attributes:
        images: Range in metres and, of a model that has it, reflectance, (num, 2 or 1, H, W), on the CPU; 0 without a
            return.
        evaluations: Network evaluations of each, (num,).
        converged: Whether each is a scan of the generator, (num,) bool.
        seconds: Of the generation of all of them; of a batch with other scans their share.
    """

    images: Tensor
    evaluations: Tensor
    converged: Tensor
    seconds: float

    @property
    def spread(self) -> Tensor:
        """How far the answers are apart: see `spread_of`."""
        return spread_of(self.images)


def spread_of(images: Tensor) -> Tensor:
    """Of several answers to a scan, ray by ray: standard deviation of the range and share with a return, (2, H, W).

    Args:
        images: (num, 2 or 1, H, W), 0 without a return.

    Returns:
        The standard deviation is in metres, over the answers that have a return there, with num - 1 below the fraction
        line; 0 where fewer than two have one.
    """
    r = images[:, 0].double()
    returned = r > 0
    count = returned.sum(0)
    mean = r.sum(0) / count.clamp(min=1)
    squares = ((r - mean).square() * returned).sum(0)
    return torch.stack([(squares / (count - 1).clamp(min=1)).sqrt(), returned.double().mean(0)]).float()


def completing(generator: Generator, sampler: Sampler | None = None, **changes: Any) -> Sampler:
    """How a generator completes scans: what is told of the scan by its own sampler, another flow by `USUAL`.

    Args:
        changes: Single settings of the sampler.

    Raises:
        InputError: it cannot complete scans, or not so.
    """
    if not (generator.told or isinstance(generator, Flow)) or generator.noise_shape != generator.space.shape:
        raise InputError(
            f"a {type(generator).__name__} cannot complete a scan: that needs a flow of range images, best one that "
            "was trained with stage=conditional."
        )
    usual = generator.sampler if generator.told else USUAL
    how = (sampler or usual).changed(**changes)
    check_control(how.method, changes)
    generator.check_sampler(how)
    if not generator.told and not completes(how.method):
        raise InputError(UNTOLD)
    return how


def complete(
    source: HasGenerator | Generator,
    images: Tensor,
    state: Tensor | None = None,
    num: int = 1,
    seed: int = 0,
    *,
    keep: str = "exact",
    sampler: Sampler | None = None,
    batch_size: int = 1,
    first: int = 0,
    on_surfaces: bool | None = None,
    progress: Progress = None,
    **changes: Any,
) -> Iterator[Completed]:
    """Complete scans of which a part is known, scan by scan.

    A scan of which everything is known costs no evaluation. One of which nothing is known is drawn as
    `r2flow.model.sampling.sample` draws it: answer 0 of scan i is sample i of the seed.

    Args:
        source: A checkpoint or its generator.
        images: Range in metres and, where known, reflectance, (B, 2 or 1, H, W), 0 without a return. A model with
            reflectance completes that of a scan without; a model of range alone leaves reflectance out.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W). If left out, a ray without a return counts as not
            measured.
        num: Answers to each scan.
        keep: `exact`: known rays come back as they were given, to the bit. `blend`: all measured rays are taken as
            doubtful, and the model says what they are. `mend`: the same, but a doubtful return that the answer
            confirms, within `CONFIRMED` of its range, stays as it was measured.
        sampler: How the generator is run; if left out, that of `completing`.
        batch_size: Answers at once. It does not change a fixed-step result beyond rounding.
        first: Number of the first scan.
        on_surfaces: Whether returns of an answer are moved towards the surfaces that the known ones lie on (`settled`);
            if left out, but for a regression's: its answer is a median, which has no scatter about them.
        progress: Called after every network evaluation of a batch.
        changes: Single settings of the sampler: steps, method, tolerance, grid.

    Raises:
        InputError: a generator that cannot complete, images or states that do not fit it, values that are no ranges of
            its sensor, num or batch_size below 1.
    """
    generator = source if isinstance(source, Generator) else source.generator
    how = completing(generator, sampler, **changes)
    if num < 1 or batch_size < 1:
        raise InputError(f"needs at least one answer and a batch of at least one; found {num} and {batch_size}.")
    if keep not in KEEP:
        raise InputError(f"keep must be {', '.join(KEEP[:-1])} or {KEEP[-1]}, found {keep!r}.")
    images = torch.as_tensor(images)
    _check_values(generator.space.sensor, images)
    images = images.detach().float().cpu()
    if state is None:
        state = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.UNKNOWN)).to(torch.uint8)
    state = torch.as_tensor(state).cpu()
    if keep != "exact":
        state = torch.where(state == Ray.UNKNOWN, state, torch.tensor(int(Ray.DOUBTFUL), dtype=state.dtype))
    condition = condition_of(generator.space, images, state)
    if on_surfaces is None:
        on_surfaces = not isinstance(generator, Regression)
    last = _Last(images, state, keep == "mend", on_surfaces)
    # A method that reads the condition has nothing to do without one.
    plain = generator.sampler.changed(precision=changes.get("precision")) if completes(how.method) else how
    yield from _answers(generator, how, plain, last, condition, num, seed, batch_size, first, progress)


def settled(r: Tensor, surface: Tensor, error: Tensor) -> Tensor:
    """Ranges of an answer, moved towards the surfaces that the measured returns lie on.

    Where the answer's log-range is log(surface) + d with |d| <= 3 s, s^2 = `ROUGH`^2 + e^2, e = `TAILS` error, it is
    taken for one of N(log surface, s^2) and becomes log(surface) + d e / s, which has the variance that the surface
    leaves. Further off it stays, unless the surface is known better than `SURE`: then the range is the surface's. No
    published method: docs/completion.md has what it is worth.

    Args:
        r: (..., H, W) in metres; 0, without a return, stays 0.
        surface: Range in metres, (..., H, W), of `r2flow.lidar.interpolation.surfaces`.
        error: Its error; infinite where there is none.
    """
    said = error.isfinite() & (r > 0)
    e = torch.where(said, TAILS * error, 1).clamp(min=EXACT)
    d = torch.where(said, r / torch.where(said, surface, 1), 1).log()
    s = (ROUGH**2 + e.square()).sqrt()
    share = torch.where(d.abs() <= 3 * s, e / s, torch.where(error < SURE, 0, 1))
    return torch.where(said, surface * (share * d).exp(), r).to(r)


def _answers(
    generator: Generator,
    how: Sampler,
    plain: Sampler,
    last: "_Last",
    condition: Condition,
    num: int,
    seed: int,
    batch_size: int,
    first: int,
    progress: Progress,
) -> Iterator[Completed]:
    images = last.images
    told = [_told(condition, i) for i in range(len(images))]
    pairs = ((i, a) for i in range(len(images)) for a in range(num))
    done: list[Samples] = []
    for said, group in groupby(pairs, key=lambda pair: told[pair[0]]):
        waiting = list(group)
        for start in range(0, len(waiting), batch_size):
            batch = waiting[start : start + batch_size]
            rows = [i for i, _ in batch]
            numbers = [first + i + a * ANSWER for i, a in batch]
            if said == ALL:
                found = _given(generator, images[rows])
            elif said == NOTHING:
                found = draw(generator, numbers, seed, plain, progress=progress)
            else:
                known = {name: value[rows] for name, value in condition.items()}
                found = draw(generator, numbers, seed, how, known, progress=progress)
            done += _one_by_one(replace(found, images=last(found.images, rows)))
            while len(done) >= num:
                yield _together(done[:num])
                done = done[num:]


ALL, SOME, NOTHING = "all", "some", "nothing"


def _told(condition: Condition, i: int) -> str:
    """How much a generator is told of scan i."""
    known, doubtful = condition["known"][i], condition["doubtful"][i]
    if bool((known > 0).all()):
        return ALL
    return SOME if bool((known > 0).any()) or bool((doubtful > 0).any()) else NOTHING


def _check_values(sensor: Sensor, images: Tensor) -> None:
    if images.ndim != 4 or not len(images):
        raise InputError(f"the images to complete must be (B, 2 or 1, H, W) with B of at least 1, found "
                         f"{tuple(images.shape)}.")  # fmt: skip
    if not bool(images.isfinite().all()):
        raise InputError("the images to complete hold NaN or infinite values; a ray without a return has the range 0.")
    strength = images[:, 1:]
    if bool(((strength < -LIMIT_TOLERANCE) | (strength > 1 + LIMIT_TOLERANCE)).any()):
        raise InputError(
            f"reflectance must lie in [0, 1], found {float(strength.min()):g} to {float(strength.max()):g}; divide it "
            "by what means full reflectance."
        )
    r = images[:, 0]
    near, far = sensor.min_range * (1 - LIMIT_TOLERANCE), sensor.max_range * (1 + LIMIT_TOLERANCE)
    wrong = (r != 0) & ((r < near) | (r > far))
    if bool(wrong.any()):
        raise InputError(
            f"a range of {float(r[wrong][0]):g} m is none of sensor '{sensor.name}', {sensor.min_range:g} to "
            f"{sensor.max_range:g} m; give 0 and the state of a ray that was not measured."
        )


def _given(generator: Generator, images: Tensor) -> Samples:
    """Scans of which everything is known."""
    channels = 1 + generator.space.encoding.reflectance
    none = torch.zeros(len(images), dtype=torch.int64)
    lacking = images.new_zeros(len(images), max(channels - images.shape[1], 0), *images.shape[2:])
    return Samples(torch.cat([images[:, :channels], lacking], 1), 0, none, none == 0, 0.0)


class _Last:
    """The last of an answer's way: returns moved to surfaces, and what was given where a ray is known or confirmed."""

    def __init__(self, images: Tensor, state: Tensor, mends: bool, on_surfaces: bool) -> None:
        self.images, self.state, self.mends = images, state, mends
        self.kept = (state == Ray.RETURN) | (state == Ray.EMPTY)
        self.surface = self.error = torch.full_like(images[:, 0], torch.inf)
        if on_surfaces:
            found = [surfaces(r, known) for r, known in zip(images[:, 0].numpy(), self.kept.numpy(), strict=True)]
            self.surface, self.error = (torch.from_numpy(np.stack(part)).float() for part in zip(*found, strict=True))

    def __call__(self, found: Tensor, rows: list[int]) -> Tensor:
        """Decoded scans (B, 2 or 1, H, W), answers to those of `rows`."""
        images, kept = self.images[rows], self.kept[rows]
        free = self.state[rows] == Ray.UNKNOWN
        moved = settled(found[:, 0], self.surface[rows], torch.where(free, self.error[rows], torch.inf))
        found = torch.cat([moved[:, None], found[:, 1:]], 1)
        if self.mends:
            r, s = images[:, 0], found[:, 0]
            near = (r > 0) & (s > 0) & ((s - r).abs() <= CONFIRMED * r)
            kept = kept | ((self.state[rows] == Ray.DOUBTFUL) & near)
        channels = min(found.shape[1], images.shape[1])
        pasted = torch.where(kept[:, None], images[:, :channels], found[:, :channels])
        return torch.cat([pasted, found[:, channels:]], 1) * (pasted[:, :1] > 0)


def _one_by_one(made: Samples) -> list[Samples]:
    share = made.seconds / len(made.images)
    return [
        Samples(made.images[b : b + 1], made.first, made.evaluations[b : b + 1], made.converged[b : b + 1], share)
        for b in range(len(made.images))
    ]


def _together(answers: list[Samples]) -> Completed:
    images, evaluations, converged = (
        torch.cat([getattr(one, name) for one in answers]) for name in ("images", "evaluations", "converged")
    )
    return Completed(images, evaluations, converged, sum(one.seconds for one in answers))
