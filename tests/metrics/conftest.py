"""A small sensor, scans of it, and a network that needs no weights."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.metrics import METRICS
from r2flow.metrics.base import ScanMetric
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.scans import Scans

SMALL = SENSORS["hdl64e"].resized(8, 32)


class Summary(Extractor):
    """Six plain averages of a scan instead of a network: each metric of features can be built on
    it.
    """

    layer = "averages"
    dim = 6
    weights = "0123456789ab"

    def __init__(self, name: str = "summary") -> None:
        super().__init__()
        self.name = name  # type: ignore[misc]

    def features(self, scans: Scans) -> Tensor:
        r = scans.images[:, 0]
        quarters = r.unflatten(2, (4, -1)).mean((1, 3))
        both = torch.stack([r.amax((1, 2)), scans.returned.float().mean((1, 2, 3))], 1)
        return torch.where(
            scans.returned.flatten(1).any(1)[:, None], torch.cat([quarters, both], 1), torch.nan
        )


def untrained(network: type[Extractor], seed: int = 0) -> Extractor:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return network().requires_grad_(False).eval()


def put_in_place_of_networks(patch: pytest.MonkeyPatch) -> None:
    stand_ins = {name: SimpleNamespace(trained=partial(Summary, name)) for name in EXTRACTORS}
    patch.setattr(EXTRACTORS, "_entries", stand_ins)


def one_of_each_class() -> list[str]:
    """A name of every class in the table: its other names differ by their network alone."""
    with pytest.MonkeyPatch.context() as patch:
        put_in_place_of_networks(patch)
        return list({type(build()): name for name, build in METRICS.items()}.values())


def scans_of(n: int, seed: int = 0, scale: float = 40.0, sensor: Sensor = SMALL) -> Scans:
    """Random scans, (n, 2, H, W): as far as `scale` metres, decided by a seed."""
    g = torch.Generator().manual_seed(seed)
    r = 4 + scale * torch.rand(n, 1, *sensor.shape, generator=g) * torch.rand(
        n, 1, 1, 1, generator=g
    )
    r = r * (torch.rand(n, 1, *sensor.shape, generator=g) < 0.8)
    return Scans(torch.cat([r, torch.rand(r.shape, generator=g) * (r > 0)], 1), sensor)


def measured(metric: ScanMetric, real: Scans, generated: Scans) -> ScanMetric:
    metric.update(real, real=True)
    metric.update(generated, real=False)
    return metric


def given(metric: ScanMetric, real: ArrayLike, generated: ArrayLike) -> dict[str, float]:
    for rows, is_real in ((real, True), (generated, False)):
        metric._add_rows(torch.as_tensor(rows).flatten(1), is_real)
    return metric.compute()


@pytest.fixture
def summary(monkeypatch: pytest.MonkeyPatch) -> Summary:
    put_in_place_of_networks(monkeypatch)
    return Summary()
