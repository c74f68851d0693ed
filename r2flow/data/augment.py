"""Changes to training scans, drawn for each image of a run: mirrored, turned, with returns taken away."""

from dataclasses import dataclass

import numpy as np

from r2flow import noise
from r2flow.registry import Portion


@dataclass(frozen=True)
class Augmentation:
    """What may be done to a training scan (`data.augment`); all of it off by default.

    Image k's draws depend on (seed, k) alone, each kind's not on which others are on, and none is shared with its noise
    and time.
    """

    flip: bool = False  # mirror half of the images: azimuth -> -azimuth, exact as bins lie symmetrically about ahead
    roll: bool = False  # turn each about the sensor by a whole number of columns, drawn uniformly: exact on the ring
    beam_dropout: Portion = 0.0  # share of the rows that lose all their returns
    ray_dropout: Portion = 0.0  # share of the returns that are lost one by one

    def __bool__(self) -> bool:
        return self != Augmentation()

    def __call__(self, image: np.ndarray, seed: int, k: int) -> np.ndarray:
        """Image k of a run, (2 or 1, H, W) in metres and reflectance, changed; a ray that is dropped is 0 in both."""
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
        if self.ray_dropout:  # drawn last: it alone takes a number for each pixel
            image = image * (draw.random((rows, columns), dtype=np.float32) >= self.ray_dropout).astype(image.dtype)
        return np.ascontiguousarray(image)
