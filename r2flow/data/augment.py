"""Augmentation of training scans: mirroring and rotation, drawn for each image."""

from dataclasses import dataclass

import numpy as np

from r2flow.base import noise


@dataclass(frozen=True)
class Augmentation:
    """Augmentations of a training scan (`data.augment`); both are off by default.

    The draws for image k depend only on (seed, k), and are independent of each other and of the
    image's noise and time.
    """

    # mirror half of the images: azimuth -> -azimuth; exact, as the bins are symmetric
    flip: bool = False
    # rotate about the sensor by a whole number of columns, drawn uniformly; exact on the ring
    roll: bool = False

    def __bool__(self) -> bool:
        return self != Augmentation()

    def __call__(self, image: np.ndarray, seed: int, k: int) -> np.ndarray:
        """Augment image k of a run, (2 or 1, H, W), metres and reflectance."""
        draw = noise.generator(seed, "augmentation", k)
        mirrored = draw.random() < 0.5
        turn = int(draw.integers(image.shape[-1]))
        if self.flip and mirrored:
            image = image[..., ::-1]
        if self.roll:
            image = np.roll(image, turn, axis=-1)
        return np.ascontiguousarray(image)
