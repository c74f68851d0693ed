"""Completion of partial scans: answer a to scan i depends on (seed, i, a) alone, up to the
network's rounding.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.devices import multiplies_bfloat16
from r2flow.base.errors import InputError, check
from r2flow.generators import Answers, Flow, Generator, Sampler, TransferFlow, condition_of
from r2flow.generators.base import Precision, Progress
from r2flow.lidar.encoding import LIMIT_TOLERANCE, wrong_with
from r2flow.lidar.known import Ray, ray_states
from r2flow.lidar.sensors import Sensor
from r2flow.model.sampling import HasGenerator, Samples, draw, warn_unsolved
from r2flow.samplers import Transport, build_sampler, parse_sampler


@dataclass(frozen=True)
class Completed(Samples):
    """The answers to scan number `first`, with reflectance if the model has it."""

    measured: Tensor = field(default_factory=lambda: torch.zeros(()) > 0)  #: rays, (H, W) bool
    #: of each batch of answers; empty without a transfer flow, and where no ray is hidden
    densities: tuple[Answers, ...] = ()

    def error(self, *levels: float) -> Tensor:
        """Metres along the ray within which the true range, if the ray returns, lies with these
        probabilities, (levels, A, H, W) float32.

        It is 0 for measured rays and those without a return. It is NaN for added points of a model
        that predicts no density: all but transfer flows.
        """
        r = self.images[:, :1]
        if not self.densities:
            added = (r[:, 0] > 0) & ~self.measured
            return torch.where(added, torch.nan, 0.0).expand(len(levels), *added.shape)
        parts = r.split([len(one.returns) for one in self.densities])
        pairs = zip(self.densities, parts, strict=True)
        return torch.cat([one.error(part.to(one.returns), levels).cpu() for one, part in pairs], 1)

    def trust(self, answer: int) -> dict[str, tuple[ndarray, float]]:
        """Fields of the points of an answer: `error_68`, `error_95`, `p_return` of each ray, (H,
        W), and of all measured points; none without a predicted density.
        """
        if not self.densities:
            return {}
        errors = self.error(0.68, 0.95)[:, answer].numpy()
        p = self.p_return[answer].numpy()
        return {"error_68": (errors[0], 0.0), "error_95": (errors[1], 0.0), "p_return": (p, 1.0)}

    def within(self, metres: float) -> "Completed":
        """These answers without added points whose 68 % error exceeds some metres.

        Raises:
            InputError: The model or its sampler predicts no errors.
        """
        (error,) = self.error(0.68)
        predicts = not error.isnan().any()
        check(predicts, "this model predicts no errors: leave max_error out, or give densify.")
        return replace(self, images=self.images * (error <= metres)[:, None])

    @property
    def p_return(self) -> Tensor:
        """Probability that a ray returns, (A, H, W) float32: 1 and 0 for measured rays; NaN for
        hidden ones of a model that predicts no density.
        """
        returned = (self.images[:, 0] > 0).float()
        p = torch.full_like(returned, torch.nan)
        if self.densities:
            p = torch.cat([one.p_return[:, 0].cpu() for one in self.densities])
        return torch.where(self.measured, returned, p)

    @property
    def spread(self) -> Tensor:
        """Per ray over the answers: standard deviation of the range in metres, and share of
        returns, (2, H, W).

        The standard deviation is over answers with a return, with denominator n - 1; 0 if fewer
        than two have one.
        """
        r = self.images[:, 0].double()
        returned = r > 0
        count = returned.sum(0)
        mean = r.sum(0) / count.clamp(min=1)
        squares = ((r - mean).square() * returned).sum(0)
        return torch.stack(
            [(squares / (count - 1).clamp(min=1)).sqrt(), returned.double().mean(0)]
        ).float()


def completing(
    generator: Generator, name: str | None = None, *, several: bool = False, **changes: Any
) -> Sampler:
    """The sampler for completion: the generator's default if it takes a condition, else the flow's
    first completer.

    For `several` different answers, a transfer flow uses `transport`. `changes` are fields of the
    sampler.
    """
    if (
        not (generator.takes_condition or isinstance(generator, Flow))
        or generator.noise_shape != generator.space.shape
    ):
        raise InputError(
            f"a {type(generator).__name__} cannot complete a scan: that needs a flow of range "
            "images."
        )
    if generator.takes_condition:
        if several and name is None and not changes and hasattr(generator, Transport.needs):
            name = "transport"
        return generator.choose(name, **changes)
    changes = (parse_sampler(name) if name else {}) | changes
    name = changes.pop("name", None)
    completers = {completer.name: completer for completer in getattr(generator, "completers", ())}
    completer = completers.get(name or next(iter(completers)))
    how = (
        build_sampler({"name": name, **changes})
        if completer is None
        else completer.changed(**changes)
    )
    how.check(generator)
    check(how.completes, f"sampler {how.name} takes no condition: give mmps, replace or repaint.")
    return how


def usual_precision(generator: Generator, measured: bool = False) -> Precision:
    """bf16-mixed where it is faster and its errors are known to be small, else 32-true.

    It needs a CPU with products of bfloat16, and a transfer flow or a model that was `measured`. No
    error of `densify` on real scans grows by more than 1 %; samples of `street` move by 0.2 % of
    the range, at the same distance to held-out scans.
    """
    small = measured or isinstance(generator, TransferFlow)
    fast = generator.device.type == "cpu" and multiplies_bfloat16()
    return "bf16-mixed" if small and fast else "32-true"


def complete(
    source: HasGenerator | Generator,
    images: Tensor,
    state: Tensor | None = None,
    num: int = 1,
    seed: int = 0,
    *,
    sampler: Sampler | str | None = None,
    batch_size: int = 1,
    first: int = 0,
    precision: Precision | None = None,
    max_error: float | None = None,
    progress: Progress = None,
    **changes: Any,
) -> Iterator[Completed]:
    """Complete partial scans, one after another, and warn of what is not solved. Known rays are
    returned bit for bit.

    A fully known scan costs no evaluation. A fully unknown scan is sampled as by
    `r2flow.model.sampling.sample`: answer 0 to scan i is sample i of the seed.

    Args:
        source: A checkpoint or its generator. Generators with `draws = False` need a known ray in
            each scan.
        images: Range in metres and optionally reflectance, then common classes, (B, 1 to 3, H, W),
            0 without a return. A model with reflectance adds it to scans without, a labelled model
            labels where the class is 0, and ranges where only the class is known; other models
            ignore what they do not have.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W); None: rays without a return count as
            not measured.
        num: Answers per scan.
        sampler: Sampler or its name; None: that of `completing`, for several answers `transport` if
            there is one.
        batch_size: Answers per batch. It does not change a fixed-step result beyond rounding.
        first: Number of the first scan.
        precision: Precision of the network; None: `usual_precision`.
        max_error: Metres that the 68 % error of an added point may have; None: any.
        progress: Called after every network evaluation of a batch.
        changes: Fields of the sampler: steps, grid, ...

    Raises:
        InputError: a generator that cannot complete scans, images or states that do not fit it, or
            values outside its sensor's range.
    """
    generator = source if isinstance(source, Generator) else source.generator
    whole = hasattr(num, "__index__") and hasattr(batch_size, "__index__")
    check(
        whole and min(num, batch_size) >= 1,
        f"give answers and a batch of at least 1; found {num!r}, {batch_size}.",
    )
    check(max_error is None or max_error > 0, f"max_error is metres above 0; found {max_error!r}.")
    if isinstance(sampler, Sampler):
        how = sampler.changed(**changes)
    else:
        how = completing(generator, sampler, several=num > 1, **changes)
    plain = generator.sampler if how.completes else how  # for a scan without a known ray
    images = torch.as_tensor(images).detach().float().cpu()
    if state is None:
        state = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.UNKNOWN)).to(torch.uint8)
    state = torch.as_tensor(state).cpu()
    conditions = condition_of(generator.space, images, state)
    _check_values(generator.space.sensor, images)
    for i, (image, measured) in enumerate(zip(images, state != Ray.UNKNOWN, strict=True)):
        condition = {name: value[i : i + 1] for name, value in conditions.items()}
        known = condition["known"] > 0
        any_known = bool(known.any())
        encoding = generator.space.encoding
        returns = 1 + encoding.reflectance
        answers = image.new_zeros(num, returns + 2 * encoding.labels, *image.shape[1:])
        evaluations = answers.new_zeros(num).long()
        converged = answers.new_ones(num).bool()
        seconds = 0.0
        densities = []
        for start in range(0, 0 if bool(known.all()) else num, batch_size):
            at = slice(start, min(start + batch_size, num))
            # of noise: 0 is sample i's
            numbers = [first + i + answer * 2**32 for answer in range(at.start, at.stop)]
            given = {
                name: value.expand(len(numbers), -1, -1, -1) for name, value in condition.items()
            }
            drawn = draw(
                generator, numbers, seed, how if any_known else plain, given if any_known else None,
                precision=precision or usual_precision(generator), progress=progress,
            )  # fmt: skip
            answers[at], evaluations[at], converged[at] = (
                drawn.images,
                drawn.evaluations,
                drawn.converged,
            )
            seconds += drawn.seconds
            if drawn.density is not None:
                densities.append(drawn.density)
        shared = min(returns, image.shape[0])
        answers[:, :shared] = torch.where(measured, image[:shared], answers[:, :shared])
        warn_unsolved(converged, of=f" of the answers to scan {first + i}")
        completed = Completed(
            answers * (answers[:, :1] > 0),
            first + i,
            evaluations,
            converged,
            seconds,
            measured=measured,
            densities=tuple(densities),
        )
        yield completed if max_error is None else completed.within(max_error)


def label(source: HasGenerator | Generator, images: Tensor, **how: Any) -> Tensor:
    """Range, reflectance, common class and its probability of each ray, (B, 4, H, W).

    Every ray of the images, (B, 2 or 1, H, W), is known; `how` as for `complete`.
    """
    answers = complete(source, images, ray_states(images), **how)
    return torch.cat([answer.images for answer in answers])


def _check_values(sensor: Sensor, images: Tensor) -> None:
    r = images[:, 0]
    near = sensor.min_range * (1 - LIMIT_TOLERANCE)
    far = sensor.max_range * (1 + LIMIT_TOLERANCE)
    wrong = ~((r == 0) | ((r >= near) & (r <= far)))
    if bool(wrong.any()):
        raise InputError(
            f"a range of {float(r[wrong][0]):g} m is outside sensor '{sensor.name}', "
            f"{sensor.min_range:g} to "
            f"{sensor.max_range:g} m; give 0 and the state of a ray that was not measured."
        )
    problem = next(filter(None, (wrong_with(image, math.inf) for image in images)), None)
    check(problem is None, f"{problem}.")
