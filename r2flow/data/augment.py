"""Augmentation of training scans: mirroring, rotation, dropped beams and dropped rays, drawn for each image."""

from dataclasses import dataclass

import numpy as np

from r2flow import noise
from r2flow.registry import Portion


@dataclass(frozen=True)
class Augmentation:
    """Augmentations of a training scan (`data.augment`); all are off by default.

    The draws for image k depend only on (seed, k), not on which other augmentations are on, and are independent of the
    image's noise and time.
    """

    flip: bool = False  # mirror half of the images: azimuth -> -azimuth; exact, as the bins are symmetric
    roll: bool = False  # rotate about the sensor by a whole number of columns, drawn uniformly; exact on the ring
    beam_dropout: Portion = 0.0  # probability that a row loses all its returns
    ray_dropout: Portion = 0.0  # probability that a return is dropped

    def __bool__(self) -> bool:
        return self != Augmentation()

    def __call__(self, image: np.ndarray, seed: int, k: int) -> np.ndarray:
        """Augment image k of a run, (2 or 1, H, W), metres and reflectance; dropped rays are 0 in all channels."""
        rows, columns = image.shape[-2:]
        draw = noise.generator(seed, "augmentation", k)
        mirrored, turn = draw.random() < 0.5, int(draw.integers(columns))
        beams = np.greater_equal(draw.random(rows), self.beam_dropout)[:, None]
        if self.flip and mirrored:
            image = image[..., ::-1]
        if self.roll:
            image = np.roll(image, turn, axis=-1)
        if self.beam_dropout:
            image = image * beams.astype(image.dtype)
        if self.ray_dropout:  # drawn last: only this augmentation draws a number per pixel
            image = image * (draw.random((rows, columns), dtype=np.float32) >= self.ray_dropout).astype(image.dtype)
        return np.ascontiguousarray(image)
