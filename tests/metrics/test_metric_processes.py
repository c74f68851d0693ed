"""One, two and three real processes: the same figures; test_cli_evaluate.py has all classes of
metrics by the verb.
"""

import json

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics import METRICS
from r2flow.metrics.base import StoredMetric
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.features import FrechetDistance, KernelDistance
from tests.metrics.conftest import scans_of

SENSOR = SENSORS["hdl64e"].resized(16, 64)


def images(seed, n):
    made = scans_of(n, seed, sensor=SENSOR).images
    made[1] = 0  # an empty scan
    return made


def measure(rank, ranks):
    """Figures and remarks without a common folder, of images that nobody numbers; twice, with scans
    in between.
    """
    network, found = EXTRACTORS["handcrafted"].trained(), []
    metrics = [METRICS[name](sensor=SENSOR) for name in ("jsd", "mmd")]
    metrics += [FrechetDistance(network, sensor=SENSOR), KernelDistance(network, sensor=SENSOR)]
    for metric in metrics:
        for seed in (1, 4):
            for real, scans in ((True, images(seed, 14)), (False, images(seed + 1, 11))):
                for batch in scans.split(3)[rank::ranks]:
                    metric.update(batch, real=real)
            kept = len(metric.real_rows) if isinstance(metric, StoredMetric) else 0
            found.append([metric.compute(), metric.remarks])
            assert not kept or len(metric.real_rows) == kept  # its own again
    return found


def work(rank, ranks, folder):
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=ranks
    )
    (folder / f"{rank}.json").write_text(json.dumps(measure(rank, ranks)))
    dist.destroy_process_group()


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [2, 3])
def test_processes_have_the_figures_of_one(ranks, tmp_path):
    expected = measure(0, 1)
    mp.start_processes(work, (ranks, tmp_path), nprocs=ranks, start_method="spawn")
    for rank in range(ranks):
        for one, other in zip(
            json.loads((tmp_path / f"{rank}.json").read_text()), expected, strict=True
        ):
            assert one[0] == pytest.approx(other[0], rel=1e-10, abs=1e-14)
            assert one[1] == other[1]
