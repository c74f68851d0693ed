"""From a checkpoint to scans in metres, from scans back to their noise, and from one scan to another."""

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor, nn

from r2flow.backbones import Backbone
from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.flow.solvers import Solution, adapts, check_method, check_tolerance, solve
from r2flow.flow.straight_exit import solve_straight_first
from r2flow.lidar.region import Region
from r2flow.noise import standard_normal

Progress = Callable[[], None] | None

CHANNELS = ("both", "range", "reflectance")


@dataclass(frozen=True)
class Samples:
    """Generated scans.

    Attributes:
        images: Range in metres and reflectance, (B, 2 or 1, H, W), on the CPU; 0 where a ray was dropped or not
            asked for. One channel where only one was asked for.
        first: Number of the first one; scan i depends on (seed, i) alone.
        evaluations: Network evaluations of each, (B,).
        converged: Whether each is solved, (B,) bool; what is not is no scan of the flow.
    """

    images: Tensor
    first: int
    evaluations: Tensor
    converged: Tensor


def noise_of(indices: range, shape: tuple[int, ...], seed: int, purpose: str = "evaluation") -> Tensor:
    """x_0 of the given scans, (B, C, H, W), on the CPU."""
    return torch.stack([standard_normal(shape, seed, purpose, index) for index in indices])


def sample(
    checkpoint: Checkpoint,
    num: int,
    steps: int = 32,
    seed: int = 0,
    method: str = "euler",
    tolerance: float = 1e-5,
    batch_size: int = 1,
    progress: Progress = None,
    region: Region | None = None,
    channels: str = "both",
    straight_first: bool = False,
    grid: str | Tensor = "uniform",
) -> Iterator[Samples]:
    """Draw scans 0 to num - 1 of a seed, batch by batch.

    Args:
        steps: Steps from noise to data, of a method of fixed steps on a named grid.
        method: A solver's name (`r2flow.flow.solvers.solve`).
        tolerance: Of an adaptive method.
        batch_size: Scans at once. It does not change a fixed-step result beyond rounding.
        progress: Called after every network evaluation of a batch.
        region: The part of the image that is asked for. The model is evaluated on `evaluated_region` alone, from
            the same noise as the whole image's.
        channels: `range` or `reflectance` leaves the other one's decoding out; `both` takes what the model has.
        straight_first: Whether a scene that is straight to the tolerance takes one step, and the adaptive `method`
            the others (`r2flow.flow.straight_exit`).
        grid: Where fixed steps fall, a name or the times themselves.

    Raises:
        InputError: num or batch_size below 1; a channel that the model has not; a backbone that cannot be cut; a
            grid for a method that chooses its own steps, or straight_first with one that does not; a solver's own
            complaints.
    """
    if num < 1 or batch_size < 1:
        raise InputError(f"needs at least one scan and a batch of at least one; found {num} and {batch_size}.")
    check_channels(checkpoint, channels)
    check_method(method)
    check_tolerance(tolerance)
    if straight_first and not adapts(method):
        raise InputError(f"scenes that are not straight need an adaptive solver, dopri5 or bosh3; found {method!r}.")
    if adapts(method) and not (isinstance(grid, str) and grid == "uniform"):
        raise InputError(f"a time grid is for a solver of fixed steps; {method} chooses its own.")
    model, seen = checkpoint.model, None
    if region is not None:
        seen = evaluated_region(checkpoint, region)
        model = part_of(model, seen)
    shape = checkpoint.encoding.shape
    for first in range(0, num, batch_size):
        x_0 = noise_of(range(first, min(first + batch_size, num)), shape, seed)
        x_0 = x_0 if seen is None else seen.crop(x_0)
        if straight_first:
            with torch.inference_mode():
                end = solve_straight_first(model, x_0.to(_device(model)), tolerance, method, progress)
        else:
            end = _solve(model, x_0, 0.0, 1.0, method, steps, tolerance, progress, grid)
        images = decode(checkpoint, end.x.cpu(), channels)
        if region is not None and seen is not None:
            images = region.place(region.crop(seen.place(images)))
        yield Samples(images, first, end.evaluations, end.converged)


def batches(num: int, batch_size: int) -> int:
    """How many batches `sample` takes."""
    return math.ceil(num / batch_size)


def evaluated_region(checkpoint: Checkpoint, region: Region) -> Region:
    """The region rounded outward to what the backbone can take."""
    return region.rounded(cast(Backbone, checkpoint.model).unit)


def part_of(model: nn.Module, region: Region) -> nn.Module:
    """The model for a region of whole units, its weights shared; the model itself for all of the image."""
    return model if region.share == 1 else cast(Backbone, model).cropped(region.rows, region.columns)


def check_channels(checkpoint: Checkpoint, channels: str) -> None:
    """Know before the sampling whether there will be what is asked for.

    Raises:
        InputError: no such channel, or reflectance from a model of range alone.
    """
    if channels not in CHANNELS:
        raise InputError(f"channels must be {', '.join(CHANNELS[:-1])} or {CHANNELS[-1]}, found {channels!r}.")
    if channels == "reflectance" and not checkpoint.encoding.reflectance:
        raise InputError("this model was trained on range alone and has no reflectance to give.")


def decode(checkpoint: Checkpoint, x: Tensor, channels: str = "both") -> Tensor:
    """Model space to metres and reflectance, of the channels asked for: (B, C, h, w) to (B, 2 or 1, h, w).

    Reflectance alone still needs the range, by which a dropped ray is known; range alone leaves reflectance out.
    """
    encoding = checkpoint.encoding
    if channels == "range" and encoding.reflectance:
        encoding = copy.copy(encoding)
        encoding.reflectance = False
        x = x[:, : encoding.channels]
    image = encoding.decode(x)
    return image[:, 1:] if channels == "reflectance" else image


def _solve(
    model: nn.Module,
    x: Tensor,
    t_0: float,
    t_1: float,
    method: str,
    steps: int,
    tolerance: float,
    progress: Progress,
    grid: str | Tensor = "uniform",
) -> Solution:
    """A solution of the flow from x, on the CPU."""
    with torch.inference_mode():
        end = solve(model, x.to(_device(model)), t_0, t_1, method, steps, tolerance, progress, grid=grid)
    return replace(end, x=end.x.cpu())


def _device(model: nn.Module) -> torch.device:
    return next(model.parameters()).device


@dataclass(frozen=True)
class Inversion:
    """Scans, their noise, and what becomes of it on the way forward again.

    Attributes:
        x_1: The scans in model space, (B, C, H, W), on the CPU as all of it.
        x_0: Their noise.
        again: x_1 once more, from x_0.
        evaluations: Network evaluations of both ways, (B,).
        converged: Whether both ways are solved to the tolerance and finite, (B,) bool.
    """

    x_1: Tensor
    x_0: Tensor
    again: Tensor
    evaluations: Tensor
    converged: Tensor


def invert(
    checkpoint: Checkpoint,
    images: Tensor,
    method: str = "dopri5",
    steps: int = 32,
    tolerance: float = 1e-5,
    progress: Progress = None,
) -> Inversion:
    """x_1 -> x_0 by the flow's ODE backward in time, and forward again.

    A scene that holds a NaN is not converged, its noise is NaN, and its neighbours are what they are without it.

    Args:
        images: Range in metres and reflectance, (B, 2 or 1, H, W), 0 where a ray was dropped.
        method: A solver's name; a fixed-step one takes `steps`, an adaptive one `tolerance`.
        progress: Called after every network evaluation.

    Raises:
        InputError: images of another shape or without the model's reflectance; a solver's own complaints.
    """
    encoding = checkpoint.encoding
    if images.ndim != 4 or images.shape[2:] != checkpoint.sensor.shape:
        raise InputError(f"the model's images are {checkpoint.sensor.shape}, found {tuple(images.shape[2:])}.")
    x_1 = encoding.encode(images[:, : 1 + encoding.reflectance])
    there = _solve(checkpoint.model, x_1, 1.0, 0.0, method, steps, tolerance, progress)
    # where a solver gives up, its last state is not yet noise
    x_0 = there.x.masked_fill(~there.converged.view(-1, 1, 1, 1), math.nan)
    again = _solve(checkpoint.model, x_0, 0.0, 1.0, method, steps, tolerance, progress)
    return Inversion(x_1, x_0, again.x, there.evaluations + again.evaluations, there.converged & again.converged)


@dataclass(frozen=True)
class RoundTrip:
    """How far scans are from themselves after inversion and generation, each (B,).

    Attributes:
        rms: Root mean square in model space, whose values span [-1, 1].
        median_m: Median |r' - r| in metres over the rays that return before and after.
        rms_m: Its root mean square.
        dropped: Share of all rays that return before and not after, or the other way round.
        noise_std: Standard deviation of x_0; far from 1, the scan is unlike what the flow was trained on.
    """

    rms: Tensor
    median_m: Tensor
    rms_m: Tensor
    dropped: Tensor
    noise_std: Tensor


def round_trip(checkpoint: Checkpoint, inversion: Inversion) -> RoundTrip:
    """The errors of an inversion; NaN for a scene that is not finite, or in metres where no ray returns twice."""
    rms = (inversion.again - inversion.x_1).double().square().flatten(1).mean(1).sqrt()
    before, after = (checkpoint.encoding.decode(x)[:, 0].double() for x in (inversion.x_1, inversion.again))
    both = (before > 0) & (after > 0)
    apart = (after - before).abs().masked_fill(~both, math.nan).flatten(1)
    dropped = ((before > 0) != (after > 0)).flatten(1).double().mean(1).masked_fill(rms.isnan(), math.nan)
    metres = apart.nanmedian(1).values, apart.square().nanmean(1).sqrt()
    return RoundTrip(rms, *metres, dropped, inversion.x_0.double().flatten(1).std(1))


def slerp(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """Spherical linear interpolation, (sin((1 - w) a) x + sin(w a) y) / sin a, a the angle of x and y.

    Shoemake 1985, "Animating rotation with quaternion curves". Unlike the straight mean, which is shorter, it keeps
    the length of noise: two independent draws are nearly orthogonal. Where the angle vanishes it is the straight mean.

    Args:
        x: One end, (...).
        y: The other end, (...).
        weights: w of each point, (N,); 0 gives x and 1 gives y.

    Returns:
        (N, ...).

    Raises:
        InputError: x and y are opposite, so that no way between them is the shortest; or one is zero.
    """
    u, v = x.double().flatten(), y.double().flatten()
    lengths = torch.linalg.vector_norm(u), torch.linalg.vector_norm(v)
    if min(lengths) == 0:
        raise InputError("slerp needs two directions, and one of its ends is zero.")
    u, v = u / lengths[0], v / lengths[1]
    # arccos of the inner product loses half the digits of a small angle; this keeps them
    angle = 2 * torch.atan2(torch.linalg.vector_norm(u - v), torch.linalg.vector_norm(u + v))
    if math.pi - angle < 1e-6:
        raise InputError("slerp has no shortest way between opposite ends.")
    w = weights.double()
    near = angle < 1e-9
    of_x = 1 - w if near else ((1 - w) * angle).sin() / angle.sin()
    of_y = w if near else (w * angle).sin() / angle.sin()
    shape = -1, *(1,) * x.ndim
    return (of_x.view(shape) * x.double() + of_y.view(shape) * y.double()).to(x.dtype)


@dataclass(frozen=True)
class Interpolation:
    """Scans on the way from one to another.

    Attributes:
        ends: The two inverted.
        weights: Where each frame lies, (N,), from 0 to 1.
        images: Range in metres and reflectance, (N, 2 or 1, H, W); the first and the last are the ends' round trips.
        evaluations: Network evaluations of each frame, (N,); the ends' are those of their inversion.
        converged: Whether each is solved, (N,) bool; what is not is no scan of the flow. The ends always are.
    """

    ends: Inversion
    weights: Tensor
    images: Tensor
    evaluations: Tensor
    converged: Tensor


def interpolate_scans(
    checkpoint: Checkpoint,
    pair: Tensor,
    frames: int,
    method: str = "dopri5",
    steps: int = 32,
    tolerance: float = 1e-5,
    batch_size: int = 1,
    progress: Progress = None,
    arrived: Callable[[int], None] | None = None,
) -> Interpolation:
    """Invert two scans, `slerp` between their noises, generate the scans of it: the paper's figure 3.

    Args:
        pair: The two in metres and reflectance, (2, 2 or 1, H, W).
        frames: Scans in all, the two ends included.
        batch_size: Scans at once.
        progress: Called after every network evaluation.
        arrived: Called with the number of frames that are done, the ends first.

    Raises:
        InputError: fewer than two frames, an end that is not solved, or what `invert` and `slerp` refuse.
    """
    if frames < 2 or batch_size < 1:
        raise InputError(f"needs at least two frames and a batch of at least one; found {frames} and {batch_size}.")
    arrived = arrived or (lambda done: None)
    inverted = []
    for scan, which in zip(pair, ("first", "last"), strict=True):
        inverted.append(invert(checkpoint, scan[None], method, steps, tolerance, progress))
        if not inverted[-1].converged.all():
            raise InputError(
                f"the {which} scan cannot be carried to its noise and back by {method}: try another solver, "
                "a larger tolerance or more steps."
            )
        arrived(len(inverted))
    ends = Inversion(*(torch.cat([getattr(end, name) for end in inverted]) for name in Inversion.__annotations__))
    weights = torch.linspace(0, 1, frames, dtype=torch.float64)
    found: list[Solution] = []
    for x_0 in slerp(ends.x_0[0], ends.x_0[1], weights[1:-1]).split(batch_size):
        if len(x_0):
            found.append(_solve(checkpoint.model, x_0, 0.0, 1.0, method, steps, tolerance, progress))
            arrived(2 + sum(len(end.x) for end in found))
    x_1 = torch.cat([ends.again[:1], *(end.x for end in found), ends.again[1:]])
    evaluations = torch.cat([ends.evaluations[:1], *(end.evaluations for end in found), ends.evaluations[1:]])
    converged = torch.cat([ends.converged[:1], *(end.converged for end in found), ends.converged[1:]])
    return Interpolation(ends, weights, checkpoint.encoding.decode(x_1), evaluations, converged)
