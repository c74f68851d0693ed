"""PointNet (Qi et al., CVPR 2017), the network of FPD, trained on 16 classes of ShapeNet."""

import torch
from torch import Tensor, nn

from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.scans import Scans

CHUNK = 16384  # points per pass: 1024 channels of them take 64 MiB


class _PointMaximum(nn.Module):
    """Three layers per point, then the maximum over points: (B, 3, N) -> (B, 1024)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(3, 64, 1)
        self.conv2 = nn.Conv1d(64, 128, 1)
        self.conv3 = nn.Conv1d(128, 1024, 1)
        self.bn1 = nn.BatchNorm1d(64)
        self.bn2 = nn.BatchNorm1d(128)
        self.bn3 = nn.BatchNorm1d(1024)

    def forward(self, points: Tensor) -> Tensor:
        maxima = []
        for chunk in points.split(max(CHUNK // len(points), 1), dim=2):
            x = torch.relu(self.bn1(self.conv1(chunk)))
            x = torch.relu(self.bn2(self.conv2(x)))
            maxima.append(self.bn3(self.conv3(x)).amax(2))
        return torch.stack(maxima).amax(0)


class _Transform(_PointMaximum):
    """The matrix that transforms the input points: (B, 3, N) -> (B, 3, 3)."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, 9)
        self.bn4 = nn.BatchNorm1d(512)
        self.bn5 = nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        x = torch.relu(self.bn4(self.fc1(torch.relu(super().forward(points)))))
        x = torch.relu(self.bn5(self.fc2(x)))
        return self.fc3(x).view(-1, 3, 3) + torch.eye(3).to(x)


class _Cloud(_PointMaximum):
    """Global feature of a cloud, (B, 3, N) -> (B, 1024)."""

    def __init__(self) -> None:
        super().__init__()
        self.stn = _Transform()

    def forward(self, points: Tensor) -> Tensor:
        return super().forward(self.stn(points).mT @ points)


class PointNet(Extractor):
    """FPD's network; features are the global feature and the outputs of a classifier's layers.

    The classifier has three layers and k classes.
    """

    name = "pointnet"
    layer = "global feature and the classifier's three layers, 1024 + 512 + 256 + 16"

    def __init__(self, k: int = 16) -> None:
        super().__init__()
        self.dim = 1024 + 512 + 256 + k
        self.feat = _Cloud()
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, k)
        self.bn1 = nn.BatchNorm1d(512)
        self.bn2 = nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        """Points (B, 3, N) in units of 80 m, N >= 1 -> features (B, 1808)."""
        x = self.feat(points)
        y = torch.relu(self.bn1(self.fc1(x)))
        z = torch.relu(self.bn2(self.fc2(y)))
        return torch.cat([x, y, z, self.fc3(z)], 1)

    @torch.inference_mode()
    def features(self, scans: Scans) -> Tensor:
        """As published, each pixel is a point, and rays without a return are at the origin.

        Features are maxima over points, so the number of points at the origin does not matter. The
        unit is 80 m for every sensor.
        """
        return scans.nan_where_empty(self(scans.xyz.flatten(2).to(self.device) / 80.0))
