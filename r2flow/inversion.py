"""From scans back to their noise, and from one scan to another: what only a flow can do."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Sampler, as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint
from r2flow.samplers import Adaptive, Jump

TIGHT = Adaptive(tolerance=1e-5)


@dataclass(frozen=True)
class Inversion:
    """Scans, their noise, and what becomes of it on the way forward again; all on the CPU.

    Attributes:
        x_1: The scans in model space, (B, C, H, W).
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


def invert(checkpoint: Checkpoint, images: Tensor, sampler: Sampler = TIGHT, progress: Progress = None) -> Inversion:
    """x_1 -> x_0 by the flow's ODE backward in time, and forward again.

    A scan that holds a NaN is not converged, its noise is NaN, and its neighbours are what they are without it.

    Args:
        images: Range in metres and reflectance, (B, 2 or 1, H, W), 0 where a ray was dropped.
        sampler: The solver of both ways.
        progress: Called after every network evaluation.

    Raises:
        InputError: a generator without an ODE, images of another shape, a solver that cannot be used, or jumps of a
            flow map that has learned none back in time.
    """
    _check_way_back(checkpoint, sampler)
    encoding, flow = checkpoint.encoding, as_flow(checkpoint.generator, "inversion")
    if images.ndim != 4 or images.shape[2:] != checkpoint.sensor.shape:
        raise InputError(f"the model's images are {checkpoint.sensor.shape}, found {tuple(images.shape[2:])}.")
    x_1 = encoding.encode(images[:, : 1 + encoding.reflectance])
    there = flow.solve(x_1, 1.0, 0.0, sampler=sampler, progress=progress)
    # where a solver gives up, its last state is not yet noise
    x_0 = there.x.cpu().masked_fill(~there.converged.view(-1, 1, 1, 1), math.nan)
    again = flow.solve(x_0, sampler=sampler, progress=progress)
    evaluations, converged = there.evaluations + again.evaluations, there.converged & again.converged
    return Inversion(x_1, x_0, again.x.cpu(), evaluations, converged)


def _check_way_back(checkpoint: Checkpoint, sampler: Sampler) -> None:
    jumps = (checkpoint.config.get("stage") or {}).get("jumps") or {}
    if isinstance(sampler, Jump) and not jumps.get("backward"):
        raise InputError(
            "this flow map has learned no jumps back in time (stage.jumps.backward): give --sampler adams3."
        )


def round_trip(checkpoint: Checkpoint, inversion: Inversion) -> dict[str, Tensor]:
    """How far scans are from themselves after inversion and generation, each (B,).

    Returns:
        `rms` in model space, whose values span [-1, 1]; `median_m`, `rms_m` and `dropped` of `metres_apart`;
        `noise_std`, the standard deviation of x_0: far from 1, the scan is unlike what the flow was trained on. NaN for
        a scan that is not finite.
    """
    apart = rms(inversion.again - inversion.x_1)
    median_m, rms_m, dropped = metres_apart(*(checkpoint.encoding.decode(x) for x in (inversion.x_1, inversion.again)))
    return {
        "rms": apart, "median_m": median_m, "rms_m": rms_m, "dropped": dropped.masked_fill(apart.isnan(), math.nan),
        "noise_std": inversion.x_0.double().flatten(1).std(1),
    }  # fmt: skip


def rms(x: Tensor) -> Tensor:
    """Root mean square over each scan's elements, (B, ...) -> (B,), float64."""
    return x.double().square().flatten(1).mean(1).sqrt()


def metres_apart(image: Tensor, other: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far decoded images, (B, 2 or 1, H, W), are from others, scan by scan, each (B,) float64.

    Returns:
        Lower median and root mean square of |r' - r| in metres over the rays that return in both, NaN where none does;
        the share of all rays that return in one alone.
    """
    before, after = image[:, 0].double(), other[:, 0].double()
    both = (before > 0) & (after > 0)
    apart = (after - before).abs().masked_fill(~both, math.nan).flatten(1)
    dropped = ((before > 0) != (after > 0)).flatten(1).double().mean(1)
    return apart.nanmedian(1).values, apart.square().nanmean(1).sqrt(), dropped


def slerp(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """Spherical linear interpolation, (sin((1 - w) a) x + sin(w a) y) / sin a, a the angle of x and y.

    Shoemake 1985, "Animating rotation with quaternion curves". Unlike the straight mean it keeps the length of noise:
    two independent draws are nearly orthogonal. Where the angle vanishes it is the straight mean.

    Args:
        x, y: The ends, (...).
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
        evaluations: Network evaluations of each frame, (N,); the ends' are those of both ways.
        converged: Whether each is solved, (N,) bool; what is not is no scan of the flow.
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
    sampler: Sampler = TIGHT,
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
    flow = as_flow(checkpoint.generator, "interpolation")
    arrived = arrived or (lambda done: None)
    inverted = []
    for scan, which in zip(pair, ("first", "last"), strict=True):
        inverted.append(invert(checkpoint, scan[None], sampler, progress))
        if not inverted[-1].converged.all():
            raise InputError(
                f"the {which} scan cannot be carried to its noise and back by {sampler.name}: try another sampler, "
                "a larger tolerance or more steps."
            )
        arrived(len(inverted))
    ends = Inversion(*(torch.cat([getattr(end, name) for end in inverted]) for name in Inversion.__annotations__))
    weights = torch.linspace(0, 1, frames, dtype=torch.float64)
    noise = slerp(ends.x_0[0], ends.x_0[1], weights[1:-1])
    x_1, evaluations, converged = [ends.again[:1]], [ends.evaluations[:1]], [ends.converged[:1]]
    for first in range(0, len(noise), batch_size):
        found = flow.solve(noise[first : first + batch_size], sampler=sampler, progress=progress)
        x_1.append(found.x.cpu())
        evaluations.append(found.evaluations)
        converged.append(found.converged)
        arrived(2 + first + len(found.x))
    images = checkpoint.encoding.decode(torch.cat([*x_1, ends.again[1:]]))
    counted = torch.cat([*evaluations, ends.evaluations[1:]])
    return Interpolation(ends, weights, images, counted, torch.cat([*converged, ends.converged[1:]]))
