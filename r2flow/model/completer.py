"""Completion of clouds in memory, one after another, with all their fields."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy import ndarray

from r2flow.base.errors import IN_MEMORY, InputError, in_python, naming
from r2flow.data.seeing import Sight
from r2flow.lidar.added import completed_cloud
from r2flow.lidar.other_sensors import gaps_unknown
from r2flow.lidar.scan_files import Cloud, Points, points_of
from r2flow.lidar.scan_files.tables import column_names
from r2flow.lidar.sensors import Sensor
from r2flow.model.completion import complete
from r2flow.model.sampling import HasGenerator

Given = TypeVar("Given", Cloud, ndarray)


class Completer:
    """Completes clouds of one sensor, one after another: `completer = flow.completer("vlp16")`.

    The first cloud decides the sensor and the view, for all; the scale of reflectance is that of
    each cloud by itself, or the given one, so that no answer depends on the order of clouds.
    """

    def __init__(
        self,
        decide: Callable[[Points, str], tuple[HasGenerator, Sight]],
        columns: Sequence[str] | None,
        fill_gaps: bool,
        how: Mapping[str, Any],
    ) -> None:
        self._decide = decide
        self._columns = columns
        self._fill_gaps = fill_gaps
        self._how = how
        self._decided: tuple[HasGenerator, Sight] | None = None

    @property
    def sensor(self) -> Sensor:
        """The sensor of the answers; its rows are `image_row`."""
        if self._decided is None:
            raise InputError("the first cloud decides the sensor: complete one.")
        return self._decided[0].generator.space.sensor

    def __call__(self, cloud: Given, number: int = 0, seed: int = 0) -> Given:
        """The measured points of a cloud with all their fields, and then the added ones; see
        `r2flow.lidar.added.completed_cloud`.

        Args:
            cloud: A structured array, (N,) or (H, W), rows (N, 3 or 4): x, y, z, reflectance, or a
                `Cloud` (of `r2flow.lidar.scan_files.read_cloud`). x ahead, y left, z up, in metres.
            number: Of the cloud in its stream: an answer that is drawn depends on (seed, number).

        Returns:
            A structured array, or a `Cloud` for a `Cloud`.

        Raises:
            InputError: the cloud is no scan of the sensor, or its times or rings contradict it.
        """
        with in_python():
            if isinstance(cloud, Cloud):
                return self.completed(cloud, number, seed)
            return self.completed(_of_array(cloud, self._columns), number, seed).array()

    def completed(self, cloud: Cloud, number: int, seed: int, name: str = IN_MEMORY) -> Cloud:
        """As by a call; errors name the cloud, and options of the command line."""
        stored = cloud.renamed(self._columns) if cloud.named else cloud
        points = points_of(Path(name), stored.measured())
        if self._decided is None:
            self._decided = self._decide(points, name)
        model, see = self._decided
        given = see(Path(name), points)
        if self._fill_gaps:
            given = gaps_unknown(given)
        (completed,) = complete(
            model,
            torch.from_numpy(given.image)[None],
            torch.from_numpy(given.state)[None],
            seed=seed,
            first=number,
            **self._how,
        )
        image = completed.images[0].numpy()
        with naming(name):
            return completed_cloud(given, image, self.sensor, completed.trust(0))


def _of_array(array: ndarray, columns: Sequence[str] | None) -> Cloud:
    array = np.asarray(array)
    rows = array.ndim == 2 and array.dtype.names is None and array.dtype.kind in "fiu"
    if array.dtype.names is None and not rows:
        raise InputError(
            f"give a structured array, rows (N, 3 or 4) or a Cloud; found {array.dtype} "
            f"{array.shape}."
        )
    if not rows:
        return Cloud.of(array)
    width = array.shape[1]
    return Cloud(tuple(column_names(width, columns)), tuple(array.T), held=width)
