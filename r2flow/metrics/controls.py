"""Controls: sets of scans made without knowledge of scenes, which every figure must put behind generated scans."""

import numpy as np

from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.noise import generator, standard_normal

CONTROLS = ("noise", "flat ground", "mean scan", "shuffled pixels")


class Control:
    """The images of one control by their numbers, (2 or 1, H, W).

    `noise` is x_0 ~ N(0, I) decoded as if it were a scan; `flat ground` measures r = -height / sin e;
    `mean scan` is the mean of the training scans where over half of them returned; `shuffled pixels` takes
    each pixel from a training scan of its own.

    Args:
        training: Real scans, (N, 2 or 1, H, W).
    """

    def __init__(self, name: str, training: np.ndarray, sensor: Sensor, seed: int = 0) -> None:
        self.name, self.training, self.sensor, self.seed = name, training, sensor, seed
        self._same = {"flat ground": self._flat_ground, "mean scan": self._mean_scan}.get(name, lambda: None)()

    def __getitem__(self, number: int) -> np.ndarray:
        if self._same is not None:
            return self._same
        return self._noise(number) if self.name == "noise" else self._shuffled(number)

    def first(self, num: int) -> np.ndarray:
        """The first `num` of them, (num, 2 or 1, H, W)."""
        return np.stack([self[number] for number in range(num)])

    def _noise(self, number: int) -> np.ndarray:
        encoding = Encoding(self.sensor, reflectance=self.training.shape[1] > 1)
        return encoding.decode(standard_normal(self.training.shape[1:], self.seed, "evaluation", number)).numpy()

    def _flat_ground(self) -> np.ndarray:
        e = self.sensor.rays()[0].numpy().astype(np.float64)
        r = np.where(e < 0, -self.sensor.height / np.sin(np.minimum(e, -1e-6)), 0)
        r = np.where((r >= self.sensor.min_range) & (r <= self.sensor.max_range), r, 0)
        return np.stack([r, 0.3 * (r > 0)])[: self.training.shape[1]].astype(np.float32)

    def _mean_scan(self) -> np.ndarray:
        returned = self.training[:, 0] > 0
        mean = self.training.sum(0) / np.maximum(returned.sum(0), 1)
        return np.where(returned.mean(0) > 0.5, mean, 0).astype(np.float32)

    def _shuffled(self, number: int) -> np.ndarray:
        rows, columns = np.indices(self.sensor.shape)
        scan = generator(self.seed, "shuffle", number).integers(len(self.training), size=self.sensor.shape)
        return np.moveaxis(self.training[scan, :, rows, columns], -1, 0)
