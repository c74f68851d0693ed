"""Scans with the ray-drop and reflectance of another sensor: translate(checkpoint, images, numbers)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Sampler, SensorFlow
from r2flow.generators.base import Precision, Progress
from r2flow.generators.sensor import hidden_returns
from r2flow.model.sampling import HasGenerator
from r2flow.noise import Draws

HIDDEN = 0.25  # share of the returns that is filled as holes are: the mean of the usual training


@dataclass(frozen=True)
class Translated:
    """Scans as the sensor would see them.

    Attributes:
        images: Range in metres and reflectance, (B, 2, H, W); 0 without a return.
        filled: Returns where the given scan has none, between returns of it, (B, H, W) bool.
        converged: Whether each is finite, (B,) bool.
    """

    images: Tensor
    filled: Tensor
    converged: Tensor


@torch.no_grad()
def translate(
    source: HasGenerator,
    images: Tensor,
    numbers: Sequence[int],
    seed: int = 0,
    *,
    sampler: Sampler | None = None,
    precision: Precision = "32-true",
    progress: Progress = None,
) -> Translated:
    """The same geometry with ray-drop and reflectance drawn anew. Ranges of returns that stay are as given, to the bit.

    Holes between returns may be filled, by values linear in 1 / range between the neighbours; sky stays empty.

    Args:
        source: A checkpoint of a `SensorFlow`.
        images: Range in metres, (B, 1 or 2, H, W); reflectance is not read.
        numbers: Of the scans, (B,): scan i is a function of (seed, i).

    Raises:
        InputError: another generator, or images of another size.
    """
    flow = source.generator
    if not isinstance(flow, SensorFlow):
        raise InputError(f"a {type(flow).__name__} knows no sensor: train one by experiment=sensor.")
    shape = flow.space.shape[1:]
    if images.ndim != 4 or images.shape[2:] != shape:
        raise InputError(f"the images must be (B, 1 or 2, {shape[0]}, {shape[1]}), found {tuple(images.shape)}.")
    draws, r = Draws(seed, numbers), images[:, :1].to(flow.device)
    noise = draws.step((3, *shape), 1).to(r)
    features, surface, log_r = flow.geometry(r, hidden_returns(noise[:, :2], HIDDEN), noise[:, 2:])
    made = flow(
        draws.start(flow.noise_shape), flow.condition(features), sampler=sampler, draws=draws, precision=precision,
        progress=progress,
    )  # fmt: skip
    returned = surface & (made.x[:, :1] > 0)
    sensor = flow.space.sensor
    ranges = torch.where(r > 0, r, log_r.exp().clamp(sensor.min_range, sensor.max_range))
    encoded = flow.space.encoding.encode(torch.cat([ranges, (made.x[:, 1:].to(r) + 1) / 2], 1))
    strength = flow.space.decode(encoded)[:, 1:]  # of the levels that the sensor has
    image = torch.cat([ranges, strength], 1) * returned
    return Translated(image.cpu(), (returned & (r == 0))[:, 0].cpu(), made.converged.cpu())
