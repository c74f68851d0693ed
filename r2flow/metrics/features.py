"""Metrics on a network's features of scans: Frechet and kernel distance, precision, recall, two-sample test."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics import FIELD_NAMES
from r2flow.metrics.base import SIDES, Protocol, ScanMetric, blocks
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.extractors.base import Extractor, weights_hash
from r2flow.metrics.scans import Scans

BLOCK = 2000  # scans per block: a kernel or matrix of distances takes 32 MB
NEIGHBOURS = 5  # k of `Manifold`
TIE = 1e-9  # relative tolerance: neighbours at exactly the radius count as inside
NAMES = ("precision", "recall", "density", "coverage")
SAME = 1e-5  # relative tolerance of equal scores
FEW = (
    "fewer scans than features on a side: its covariance has no full rank, and the distance is too large; compare it "
    "only with distances of as many scans."
)


class FeatureMetric(ScanMetric):
    """A metric whose rows are a network's features; a name in `EXTRACTORS` loads the network with its weights."""

    representation = "features of a network"
    keeping = True
    kind: ClassVar[str]
    names: ClassVar[Mapping[str, str]] = {}

    def __init__(self, extractor: Extractor | str, **options: Any) -> None:
        network = EXTRACTORS[extractor].trained() if isinstance(extractor, str) else extractor.eval()
        if isinstance(extractor, str) and network.weights == "random":  # a plug-in's own `trained`
            network.weights = weights_hash(network)
        name = f"{self.kind}_{network.name}"
        name = f"{name}_random" if network.weights == "random" else self.names.get(network.name, name)
        super().__init__(name=name, **options)
        self.extractor = network
        self.needs_reflectance = network.needs_reflectance

    @property
    def protocol(self) -> Protocol:
        network = self.extractor
        layer = f"{network.layer}, {network.dim}"
        return Protocol(self.name, self.representation, self.mask, network.name, network.weights, layer, self.settings)

    def rows(self, scans: Scans) -> Tensor:
        """Features of a batch, (B, D), computed once per network for all metrics."""
        # Networks with equal names and weights are the same; random networks are identified by object.
        network = self.extractor
        key = network if network.weights == "random" else (network.name, network.weights)
        if key not in scans.features:
            with torch.no_grad(), torch.autocast(scans.images.device.type, enabled=False):  # of a trainer around it
                scans.features[key] = network.features(scans)
        return scans.features[key]


def frechet_distance(mean_1: Tensor, covariance_1: Tensor, mean_2: Tensor, covariance_2: Tensor) -> float:
    """d^2 = |mu_1 - mu_2|^2 + tr(S_1 + S_2 - 2 (S_1 S_2)^(1/2)) (Dowson and Landau 1982), in float64.

    With S_i = A_i A_i^T, A_i eigenvectors times square roots of eigenvalues, tr (S_1 S_2)^(1/2) is the sum of the
    singular values of A_1^T A_2. This avoids complex roots and a regularised diagonal. The usual eigenvalues of
    S_1^(1/2) S_2 S_1^(1/2) have a rounding error of eps |S|^2, and their roots an error of sqrt(eps) |S|. S_i are
    positive semidefinite up to rounding.
    """
    a_1, a_2 = root(covariance_1.double()), root(covariance_2.double())
    common = torch.linalg.svdvals(a_1.T @ a_2).sum()
    d = (mean_1.double() - mean_2.double()).square().sum() + a_1.square().sum() + a_2.square().sum() - 2 * common
    return max(float(d), 0.0)  # rounding may give negative values for equal Gaussians


def root(covariance: Tensor) -> Tensor:
    """A, (D, rank), with A A^T = S.

    Drops eigenvalues up to D eps times the largest, which are rounding errors, as numpy's matrix_rank does.
    """
    values, vectors = torch.linalg.eigh(covariance)
    kept = values > values.abs().max() * len(values) * torch.finfo(values.dtype).eps
    return vectors[:, kept] * values[kept].sqrt()


def gaussian(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and unbiased covariance of features, (N, D), in float64.

    The covariance is taken about the mean: sums of x x^T would lose the variance of features far from 0.
    """
    mean = torch.stack([x.sum(0) for _, x in blocks(rows, BLOCK)]).sum(0) / len(rows)
    scatter = mean.new_zeros(len(mean), len(mean))
    for _, x in blocks(rows, BLOCK):  # a copy of all rows in float64 may have no room
        centred = x - mean
        scatter.addmm_(centred.T, centred)
    return mean, scatter / (len(rows) - 1)


class FrechetDistance(FeatureMetric):
    """Frechet distance between features of real and generated scans (Heusel et al. 2017).

    The Gaussians have the mean and the unbiased covariance of the features, in float64. The distance takes a minute on
    one core for 4096 features, and negligible time for 256.

    Names by network: `frd` (RangeNet-53, Zyrianov et al. 2022), `frid` (RangeNet-21), `fpvd` (SPVCNN) and
    `fsvd` (MinkowskiNet, all three Ran et al. 2024), `fpd` (PointNet, Shu et al. 2019), `frechet_<network>` for
    others, `frechet_<network>_random` with random weights.
    """

    kind = "frechet"
    names = FIELD_NAMES
    settings: ClassVar[Mapping[str, Any]] = {"covariance": "unbiased, n - 1"}
    biased = True

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        return values, remarks or [FEW] * (min(map(self.count, SIDES)) <= self.extractor.dim)

    def distance(self, real: Tensor, generated: Tensor) -> float:
        return frechet_distance(*gaussian(real), *gaussian(generated))


class KernelDistance(FeatureMetric):
    """Unbiased estimate of squared MMD with a cubic kernel, the KID of Binkowski et al. (2018).

    MMD^2 = mean_{i != j} k(x_i, x_j) + mean_{i != j} k(y_i, y_j) - 2 mean k(x_i, y_j), k(a, b) = (a . b / D + 1)^3 on D
    features. The expectation does not depend on the number of scans; values may be negative. The usual mean over random
    subsets of 1000 scans is replaced by the exact mean over all subsets.
    """

    kind = "kid"
    settings: ClassVar[Mapping[str, Any]] = {"kernel": "(a b / D + 1)^3", "estimate": "unbiased, all pairs"}
    biased = False

    def distance(self, real: Tensor, generated: Tensor) -> Tensor:
        return _mean(real, real) + _mean(generated, generated) - 2 * _mean(real, generated)


def _mean(x: Tensor, y: Tensor) -> Tensor:
    """Mean of k - 1 over the pairs of two sets (the 1 cancels in MMD^2), without pairs of a scan with itself."""
    total = x.new_zeros((), dtype=torch.float64)
    for i, a in blocks(x, BLOCK):
        for j, b in blocks(y, BLOCK):
            z = a @ b.T / x.shape[1]
            kernel = z * (3 + z * (3 + z))  # (z + 1)^3 - 1
            total += kernel.sum() - (kernel.trace() if x is y and i == j else 0)
    return total / (len(x) * (len(y) - (x is y)))


class Manifold(FeatureMetric):
    """Precision, recall, density and coverage of generated scans in a network's feature space.

    A set is represented by balls around its scans, with the distance to the k-th nearest neighbour in the set as
    radius. Kynkaanniemi et al. (2019): precision is the share of generated scans inside a real ball, recall the share
    of real scans inside a generated ball. Naeem et al. (2020): density is the mean number of real balls that contain a
    generated scan, over k (it may exceed 1 and is robust to outliers), coverage the share of real balls that contain a
    generated scan.

    The values are named `precision_<network>` and so on.
    """

    kind = "manifold"
    settings: ClassVar[Mapping[str, Any]] = {"neighbours": NEIGHBOURS, "distance": "Euclidean"}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        names = [f"{name}_{self.name.removeprefix('manifold_')}" for name in NAMES]
        if few := [side for side in SIDES if self.count(side) <= NEIGHBOURS]:
            remark = f"{self.name}: too few {' and '.join(few)} scans to have {NEIGHBOURS} neighbours each."
            return dict.fromkeys(names, float("nan")), [remark]
        real, generated = self.kept("real"), self.kept("generated")
        middle = real[:BLOCK].double().mean(0)
        in_real, in_generated = (radii(rows, NEIGHBOURS, middle) * (1 + TIE) for rows in (real, generated))
        balls = torch.zeros(len(generated), dtype=torch.float64)
        recalled, covered = (torch.zeros(len(real), dtype=torch.bool) for _ in range(2))
        for i, x in blocks(real, BLOCK):
            for j, y in blocks(generated, BLOCK):
                d = squared_distances(x - middle, y - middle)
                within = d <= in_real[i, None]
                balls[j] += within.sum(0)
                covered[i] |= within.any(1)
                recalled[i] |= (d <= in_generated[j]).any(1)
        values = (balls > 0, recalled, balls / NEIGHBOURS, covered)
        return {name: float(value.double().mean()) for name, value in zip(names, values, strict=True)}, []


def radii(rows: Tensor, k: int, middle: Tensor) -> Tensor:
    """Squared distance of each row to its k-th nearest neighbour, (N,); `middle` is subtracted for accuracy."""
    squared = []
    for i, x in blocks(rows, BLOCK):
        nearest = torch.full((len(x), k), torch.inf, dtype=torch.float64)
        for j, y in blocks(rows, BLOCK):
            d = squared_distances(x - middle, y - middle)
            if i == j:
                d.fill_diagonal_(torch.inf)
            nearest = torch.cat([nearest, d], 1).topk(k, largest=False).values
        squared.append(nearest.amax(1))
    return torch.cat(squared)


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    """|x - y|^2 of all pairs, (N, M), by matrix products; rounding errors of equal rows are set to 0."""
    size = x.square().sum(1)[:, None] + y.square().sum(1)
    d = size - 2 * x @ y.T
    return d.masked_fill_(d <= 1e-12 * size, 0)


class TwoSample(FeatureMetric):
    """Area under the ROC curve of a logistic regression between two sets (Lopez-Paz and Oquab 2017).

    Each contiguous half of both sets is scored by the classifier trained on the other half, so that neighbouring scans
    of a drive do not leak. 0.5: the sets cannot be distinguished; 1: always distinguished. `_low` and `_high` are a
    95 % interval for other, independent scans judged by these two classifiers, of as many as half: both err alike.
    """

    kind = "auc"
    names: ClassVar[Mapping[str, str]] = {"handcrafted": "auc", "handcrafted_range": "auc_range"}
    settings: ClassVar[Mapping[str, Any]] = {"classifier": "logistic, ridge 1", "folds": "two halves, score interval"}
    fewest = 4  # two to train on, two to test

    def figures(self) -> tuple[dict[str, float], list[str]]:
        names = [f"{self.name}{end}" for end in ("", "_low", "_high")]
        if any(self.count(side) < self.fewest for side in SIDES):
            return dict.fromkeys(names, float("nan")), [f"{self.name} needs {self.fewest} or more scans of each set."]
        sides = [self.kept(side).double() for side in SIDES]
        halves, value = [(x[: len(x) // 2], x[len(x) // 2 :]) for x in sides], 0.0
        for turn in (1, -1):
            (learn_real, judge_real), (learn_made, judge_made) = (both[::turn] for both in halves)
            score = _classifier(learn_real, learn_made)
            value += area(score(judge_real), score(judge_made)) / 2
        return dict(zip(names, (value, *interval(value, *(len(x) // 2 for x in sides))), strict=True)), []


def area(negative: Tensor, positive: Tensor) -> float:
    """P(positive > negative) + P(equal) / 2 for scores (N,) and (M,)."""
    difference = positive[None] - negative[:, None]
    equal = difference.abs() < SAME * (1 + positive.abs())  # features of a scan differ by rounding between batches
    return float(torch.where(equal, 0.5, (difference > 0).double()).mean())


def interval(value: float, n: int, m: int) -> tuple[float, float]:
    """Ends of all a with |a - value| <= 1.96 se(a) (Newcombe 2006), se of n by m scores (Hanley and McNeil 1982)."""
    a = torch.cat([torch.linspace(-20, 20, 100_001).double().sigmoid(), torch.tensor([value], dtype=torch.float64)])
    variance = a * (1 - a) * (1 + ((n + m) / 2 - 1) * ((1 - a) / (2 - a) + a / (1 + a))) / (n * m)
    inside = a[(a - value).square() <= 1.96**2 * variance]  # a's error: the value's is 0 if all pairs agree
    return float(inside.amin()), float(inside.amax())


def _classifier(real: Tensor, generated: Tensor) -> Callable[[Tensor], Tensor]:
    """Fit a logistic regression to two sets of equal total weight; return its score function, (N, D) to (N,)."""
    x = torch.cat([real, generated])
    centre, spread = x.mean(0), x.std(0).clamp(min=1e-9)
    x = torch.cat([(x - centre) / spread, x.new_ones(len(x), 1)], 1)
    y = torch.cat([x.new_zeros(len(real)), x.new_ones(len(generated))])
    each = torch.cat([x.new_full((len(part),), len(y) / 2 / len(part)) for part in (real, generated)])
    ridge = torch.eye(x.shape[1], dtype=x.dtype)  # an L2 penalty of 1 on the weights of standardised features
    ridge[-1, -1] = 1e-9
    w = x.new_zeros(x.shape[1])
    for _ in range(25):  # Newton's method
        p = (x @ w).sigmoid()
        curvature = (x * (each * p * (1 - p))[:, None]).mT @ x + ridge
        w = w - torch.linalg.solve(curvature, x.mT @ (each * (p - y)) + ridge @ w)
    return lambda rows: torch.cat([(rows - centre) / spread, rows.new_ones(len(rows), 1)], 1) @ w
