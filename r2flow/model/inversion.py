"""Inversion of scans to noise, and interpolation between scans, by the ODE of a flow."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.data.described import Spec, describe
from r2flow.data.detection import reading_for
from r2flow.data.opening import open_scans
from r2flow.data.reading import AUTO
from r2flow.generators import Sampler, as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint
from r2flow.samplers import Adaptive

_TIGHT = Adaptive(tolerance=1e-5)


def real_scans(
    checkpoint: Checkpoint,
    specs: Sequence[Spec],
    reflectance_scale: float | None = None,
    most: int = 16,
    need_reflectance: bool = True,
) -> tuple[list[str], Tensor]:
    """Read scans, at most `most` per set, evenly spread, projected as the checkpoint's.

    Returns names, and range in metres and reflectance, (N, 2 or 1, H, W). `reflectance_scale` is
    the value of full reflectance in the files; None: by `reading_for`. `need_reflectance`: a set
    without reflectance is refused if the checkpoint has it.
    """
    reflectance = checkpoint.encoding.reflectance and (need_reflectance or AUTO)
    names = []
    images = []
    for scans in map(describe, specs):
        reading = reading_for([scans], checkpoint, reflectance_scale=reflectance_scale)
        reading = replace(reading, reflectance=reflectance, on_bad_scan="error", within_limits=True)
        source = open_scans(scans, reading).spread(most).source
        names += [Path(name).name.split(".")[0] for name in source.names]
        images += [torch.from_numpy(source[i]) for i in range(len(source))]
    return names, torch.stack(images)


class Inversion(NamedTuple):
    """Scans, their noise, and the scans generated from this noise; all on the CPU."""

    x_1: Tensor  # scans in model space, (B, C, H, W)
    x_0: Tensor  # noise
    again: Tensor  # scans generated from x_0
    evaluations: Tensor  # network evaluations of both directions, (B,)
    converged: Tensor  # whether both directions are solved to the tolerance and finite, (B,) bool


def invert(
    checkpoint: Checkpoint, images: Tensor, sampler: Sampler = _TIGHT, progress: Progress = None
) -> Inversion:
    """Solve the ODE backward from x_1 to x_0 and forward again; images are (B, 2 or 1, H, W).

    A scan with NaN is not converged and has NaN as noise; other scans of the batch are unaffected.
    """
    flow = as_flow(checkpoint.generator, "inversion")
    x_1 = checkpoint.encoding.encode(images[:, : 1 + checkpoint.encoding.reflectance].cpu())
    backward = flow.solve(x_1, 1.0, 0.0, sampler=sampler, progress=progress)
    # The last state of an unconverged solution is not noise.
    x_0 = backward.x.cpu().masked_fill(~backward.converged.view(-1, 1, 1, 1), math.nan)
    again = flow.solve(x_0, sampler=sampler, progress=progress)
    return Inversion(
        x_1,
        x_0,
        again.x.cpu(),
        backward.evaluations + again.evaluations,
        backward.converged & again.converged,
    )


def rms(x: Tensor) -> Tensor:
    """Root mean square over each scan's elements, (B, ...) -> (B,), float64."""
    return x.double().square().flatten(1).mean(1).sqrt()


def metres_apart(image: Tensor, other: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Errors between decoded images, (B, 2 or 1, H, W), per scan, each (B,) float64.

    Lower median and root mean square of |r' - r| in metres over the rays that return in both, NaN
    without any; share of all rays that return in only one.
    """
    before = image[:, 0].double().flatten(1)
    after = other[:, 0].double().flatten(1)
    returned = before > 0
    returns = after > 0
    apart = (after - before).abs().masked_fill(~(returned & returns), math.nan)
    dropped = (returned != returns).double().mean(1)
    return apart.nanmedian(1).values, apart.square().nanmean(1).sqrt(), dropped


def slerp(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """Spherical linear interpolation, (sin((1 - w) a) x + sin(w a) y) / sin a, a the angle.

    Unlike linear interpolation, it keeps the norm of noise, since independent samples are nearly
    orthogonal (Shoemake 1985, "Animating rotation with quaternion curves"). For a vanishing angle
    it is linear. Ends are (...), neither zero nor opposite, weights w (N,), the result (N, ...).
    """
    ends = torch.stack([x, y]).double()
    u, v = ends / ends.flatten(1).norm(dim=1).view(-1, *(1,) * x.ndim)
    # arccos of the inner product would lose half the digits of a small angle.
    angle = 2 / math.pi * torch.atan2((u - v).norm(), (u + v).norm())
    w = weights.double().view(-1, *(1,) * x.ndim)
    shares = torch.stack([1 - w, w], 1)
    return (shares * torch.sinc(shares * angle) / torch.sinc(angle) * ends).sum(1).to(x.dtype)


class Interpolation(NamedTuple):
    ends: Inversion  # inversion of the two given scans
    weights: Tensor  # interpolation weight of each frame, (N,), from 0 to 1
    # Range in metres and reflectance, (N, 2 or 1, H, W); first and last are round trips of the
    # ends.
    images: Tensor
    evaluations: Tensor  # network evaluations of each frame, (N,); of both directions for the ends
    converged: Tensor  # whether each frame is solved, (N,) bool; others are not samples of the flow


def interpolate_scans(
    checkpoint: Checkpoint,
    pair: Tensor,
    frames: int,
    sampler: Sampler = _TIGHT,
    progress: Progress = None,
    arrived: Callable[[int], None] = lambda done: None,
) -> Interpolation:
    """Invert two scans, (2, 2 or 1, H, W), `slerp` their noise, generate: the paper's figure 3.

    `frames`, at least 2, counts both ends; `arrived` is called with the number of finished frames,
    the ends first.
    """
    flow = as_flow(checkpoint.generator, "interpolation")
    ends = invert(checkpoint, pair, sampler, progress)
    if not ends.converged.all():
        raise InputError(
            f"the {'last' if ends.converged[0] else 'first'} scan cannot be carried to its noise "
            f"and back by {sampler.name}: try another sampler, a larger tolerance or more steps."
        )
    arrived(2)
    weights = torch.linspace(0, 1, frames, dtype=torch.float64, device="cpu")
    parts = []
    for noise in slerp(ends.x_0[0], ends.x_0[1], weights[1:-1]):
        parts.append(flow.solve(noise[None], sampler=sampler, progress=progress))
        arrived(2 + len(parts))

    def framed(outer: Tensor, name: str) -> Tensor:
        return torch.cat([outer[:1], *(getattr(part, name).cpu() for part in parts), outer[1:]])

    images = checkpoint.encoding.decode(framed(ends.again, "x"))
    evaluations = framed(ends.evaluations, "evaluations")
    return Interpolation(ends, weights, images, evaluations, framed(ends.converged, "converged"))
