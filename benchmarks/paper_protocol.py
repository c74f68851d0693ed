"""The protocol `paper` beside the published evaluation, run from a checkout of it, on the same scans.

    git clone https://github.com/kazuto1011/r2flow published
    python benchmarks/paper_protocol.py published KITTI-360/data_3d_raw my/samples

Real scans are files of KITTI, samples any scans of 64 x 1024, as `r2flow evaluate` takes them. Compared are the
images and points of every real scan, bird's-eye histograms cell by cell, JSD, MMD and, with equal random weights, the
features of RangeNet-21, RangeNet-53 and PointNet. Needs einops; of `datasets`, `numba` and `torchvision` the published
files use a base class, a decorator and (x - mean) / std, for which the stand-ins below will do.
"""

import argparse
import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import nn

from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.evaluation.protocols import PAPER
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics import METRICS
from r2flow.metrics.birds_eye import js_distance
from r2flow.metrics.extractors.pointnet import PointNet
from r2flow.metrics.extractors.rangenet import RangeNet21, RangeNet53
from r2flow.metrics.jsd import histograms
from r2flow.metrics.scans import Scans

SENSOR = SENSORS["hdl64e"]


class Normalize(nn.Module):
    """torchvision's."""

    def __init__(self, mean: list[float], std: list[float]) -> None:
        super().__init__()
        self.mean, self.std = (torch.tensor(values).view(-1, 1, 1) for values in (mean, std))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - self.mean) / self.std


class Anything(ModuleType):
    """Whatever is asked of it."""

    def __getattr__(self, name: str) -> object:
        return type(name, (), {"__init__": lambda self, *_, **__: None})


def stand_in(name: str, **content: object) -> None:
    module = Anything(name)
    module.__dict__.update(content)
    sys.modules.setdefault(name, module)


def published(root: Path, path: str) -> ModuleType:
    """A file of the checkout."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, root / "r2flow" / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("published", type=Path)
    parser.add_argument("real", type=Path, help="A folder of KITTI's .bin files.")
    parser.add_argument("generated")
    parser.add_argument("--features", type=int, default=1, help="Real scans whose features are compared.")
    options = parser.parse_args()

    stand_in("numba", jit=lambda **_: lambda function: function)
    stand_in("datasets", Split=type("Split", (), {"TRAIN": "train", "TEST": "test"}))
    stand_in("torchvision", transforms=type("transforms", (), {"Normalize": Normalize}))
    files = {
        name: published(options.published, path)
        for name, path in {
            "data": "data/kitti_360/kitti_360.py", "bev": "metrics/bev.py", "lidar": "utils/lidar.py",
            "rangenet": "metrics/models/rangenet.py", "pointnet": "metrics/models/pointnet.py",
        }.items()
    }  # fmt: skip

    # Ours: the real scans as evaluate reads them, and the generated ones.
    real = open_scans(str(options.real), Reading(SENSOR, convention="reference"))
    judged = open_scans(options.generated, Reading(SENSOR))
    images = judged.source.batch(range(len(judged)))
    print(f"{len(real)} real scans, {len(images)} generated ones")

    # Theirs, as their evaluate.py has it.
    theirs, pixels, points_off = [], 0, 0.0
    ours = [real.source.with_points(number) for number in range(len(real))]
    for (image, xyz), path in zip(ours, real.source.paths, strict=True):
        whole = files["data"].load_points_as_images(path, scan_unfolding=False, W=1024).transpose(2, 0, 1)
        whole *= whole[[5]]
        depth = torch.from_numpy(whole[[4]])
        inside = torch.from_numpy(whole[[5]]) * ((depth > 0.5) & (depth < 63.0))
        theirs.append(torch.cat([depth, torch.from_numpy(whole[:4])]) * inside)
        pixels += int((whole[4] != image[0]).sum())
        points_off = max(points_off, float(np.abs(whole[:3] - xyz).max()))
    print(f"ranges: {pixels} of {len(real) * 65536} pixels differ; points: by at most {points_off:.3g} m")
    utility = files["lidar"].LiDARUtility(SENSOR.shape, "logscale", 1.45, 80.0)
    xyz = utility.convert_metric_depth(images[:, :1], format="cartesian")
    inside = (images[:, :1] > 0.5) & (images[:, :1] < 63.0)
    their_sets = [torch.stack(theirs), torch.cat([images[:, :1], xyz, images[:, 1:]], 1) * inside]
    our_sets = [
        Scans(torch.stack([torch.from_numpy(one) for one, _ in ours]), SENSOR, PAPER.rays(True),
              torch.stack([torch.from_numpy(one) for _, one in ours])),
        Scans(images, SENSOR, PAPER.rays(False)),
    ]  # fmt: skip

    counts = [
        torch.stack([files["bev"].point_cloud_to_histogram(one[1:4].flatten(1).T) for one in whole])
        for whole in their_sets
    ]
    for name, one, other in zip(("real", "generated"), counts, map(histograms, our_sets), strict=True):
        apart = (one.flatten(1) - other.float()).abs()
        print(
            f"bird's-eye histograms, {name}: {int((apart > 0).sum())} of {apart.numel()} cells differ, by "
            f"{int(apart.sum())} of {int(one.sum())} points"
        )
    order = list(range(len(real)))
    random.Random(0).shuffle(order)
    jsd = files["bev"].compute_jsd_2d(counts[0][order].float(), counts[1].float())
    mmd = files["bev"].compute_mmd_2d(counts[0][order].float(), counts[1].float())
    metrics = {name: METRICS[name](sensor=SENSOR) for name in ("jsd", "mmd")}
    mine = {}
    for metric in metrics.values():
        for side, scans in zip((True, False), our_sets, strict=True):
            metric.update(scans, real=side)
        mine |= metric.compute()
        metric.reset()
    for name, value in (("jsd", float(jsd)), ("mmd", mmd)):
        print(f"{name}: published {value:.9g}, ours {mine[name]:.9g}, {abs(mine[name] / value - 1):.2g} relative")
    exact = [count.double().sum(0).numpy() for count in counts]
    print(f"jsd of the published histograms in float64: {js_distance(*exact):.9g}")

    whole, few = their_sets[0][: options.features], options.features
    seen = Scans(our_sets[0].images[:few], SENSOR, xyz=our_sets[0].xyz[:few])
    for cls, inputs in ((RangeNet21, [0, 1, 2, 3]), (RangeNet53, [0, 1, 2, 3, 4])):
        network = cls.random(0)
        used = {"range": True, "xyz": True, "remission": len(inputs) == 5}
        other = files["rangenet"].RangeNet(used, network.head[1].out_channels, backbone=cls.layers)
        other.load_state_dict(network.state_dict())
        other.eval()
        before = files["rangenet"].PreProcess(network.mean.flatten().tolist(), network.std.flatten().tolist())
        with torch.no_grad():
            maps = other(before(whole[:, inputs]), feature="penultimate")
            expected = files["rangenet"].PostProcess()(maps, "subsample" if cls is RangeNet53 else "depth")
        print_features(cls.name, network.features(seen), expected)
    network = PointNet.random(0)
    other = files["pointnet"].PointNet1(k=16)
    other.load_state_dict(network.state_dict())
    other.eval()
    with torch.no_grad():
        expected = torch.cat([other(one[None, 1:4].flatten(2) / 80.0) for one in whole])
    print_features("pointnet", network.features(seen), expected)


def print_features(name: str, found: torch.Tensor, expected: torch.Tensor) -> None:
    off = (found - expected).abs().max() / expected.abs().max()
    print(f"{name}, random weights: features differ by {float(off):.2g} of the largest")


if __name__ == "__main__":
    main()
