"""How far the methods of completion are from the posterior, on problems whose posterior is known.

The prior is a Gaussian with a dense covariance, 32 values on a ring with a standard deviation of
0.5, with its exact velocity. A method is then affine in all noise that it draws: its mean and its
covariance are computed, not sampled.
Columns: evaluations of a scan. Figures: Wasserstein-2 distance of the Gaussians, over the root of
the posterior's total variance; in brackets the error of the mean by the same measure, and the
spread (1 is right).

python benchmarks/completion.py                        # some minutes on one core
python benchmarks/completion.py --cases sector --methods mmps,replace
"""

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.flow.maps import MeanVelocity
from r2flow.flow.solvers import named_grid
from r2flow.samplers import build_sampler

WIDTH = 32
METHODS_SHOWN = "replace,repaint:4,repaint:10,mmps:1,0,mmps:2,0,mmps:2"
ANSWERS = 16  # measurements of a case, over which the squared error of the mean is averaged


def ring(width: int = WIDTH, std: float = 0.5, length: float = 3.0) -> Tensor:
    """A covariance that falls with the distance on a ring, with a small share of white noise."""
    apart = torch.arange(width, dtype=torch.float64)
    apart = (apart[:, None] - apart).abs()
    near = torch.exp(-torch.minimum(apart, width - apart) / length)
    return std**2 * (0.95 * near + 0.05 * torch.eye(width, dtype=torch.float64))


class Correlated:
    """x_1 from a mixture of Gaussians with dense covariances S_i: what is measured of some elements
    says of others.

    As in `GaussianMixture`, with matrices: in component i, x_t has mean t m_i and covariance
    C_i = (1 - t)^2 + t^2 S_i, and x_1 - x_0 the mean m_i + (t S_i - (1 - t)) C_i^-1 (x - t m_i).

    Args:
        means: m_i, (K, D) float64.
        covariances: S_i, (K, D, D) float64.
        weights: (K,) float64, of sum 1.
    """

    def __init__(self, means: Tensor, covariances: Tensor, weights: Tensor | None = None) -> None:
        self.means, self.covariances = means, covariances
        self.weights = (
            torch.full((len(means),), 1 / len(means)).to(means) if weights is None else weights
        )
        self.values, self.vectors = torch.linalg.eigh(covariances)

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        t, offset, (means, values, vectors) = self._offset(t, x)
        variance = (1 - t) ** 2 + t**2 * values  # (K, B, D), as all that follows
        slopes = means + torch.einsum(
            "kbi,kji->kbj", (t * values - (1 - t)) / variance * offset, vectors
        )
        scores = self.weights.to(x).log()[:, None] - 0.5 * (
            variance.log() + offset**2 / variance
        ).sum(-1)
        return (scores.softmax(0)[..., None] * slopes).sum(0).view(x.shape)

    def solution(self, x_0: Tensor, t: Tensor | float) -> Tensor:
        """x_t of a single Gaussian: along S's eigenvectors it is `Gaussian`'s."""
        assert len(self.means) == 1
        t, x = torch.as_tensor(t, dtype=torch.float64).reshape(-1, 1), x_0.double().flatten(1)
        moved = x @ self.vectors[0] * ((1 - t) ** 2 + t**2 * self.values[0]).sqrt()
        return (t * self.means[0] + moved @ self.vectors[0].T).view(x_0.shape)

    def posterior(self, forward: Tensor, y: Tensor, sigma: float | Tensor) -> "Correlated":
        """The law of x_1 given y = A x_1 + sigma n, a mixture of Gaussians again.

        Args:
            forward: A, (M, D), of full rank where sigma is 0.
            y: (M,); with M = 0 nothing is measured.
            sigma: Of each measured value, (M,) or one for all.
        """
        if not len(y):
            return self
        seen = self.covariances @ forward.T  # (K, D, M)
        spread = forward @ seen + torch.diag_embed(torch.as_tensor(sigma).to(y).expand(len(y)) ** 2)
        gain = torch.linalg.solve(spread, seen.mT).mT
        off = y - self.means @ forward.T
        likelihood = torch.distributions.MultivariateNormal(torch.zeros_like(y), spread).log_prob(
            off
        )
        means = self.means + torch.einsum("kdm,km->kd", gain, off)
        return Correlated(
            means, self.covariances - gain @ seen.mT, (self.weights.log() + likelihood).softmax(0)
        )

    def sample(self, count: int, draws: torch.Generator) -> Tensor:
        """x_1, (count, D)."""
        chosen = torch.multinomial(self.weights, count, replacement=True, generator=draws)
        n = torch.randn(count, self.means.shape[1], generator=draws, dtype=self.means.dtype)
        scaled = n * self.values.clamp(min=0).sqrt()[chosen]
        return self.means[chosen] + torch.einsum("bi,bji->bj", scaled, self.vectors[chosen])

    def _offset(self, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """t (1, B or 1, 1), x_t - t m_i along the eigenvectors, (K, B, D), and the components in
        x's type.
        """
        means, values, vectors = (part.to(x) for part in (self.means, self.values, self.vectors))
        t = t.to(x).reshape(1, -1, 1)
        offset = torch.einsum("kbj,kji->kbi", x.flatten(1) - t * means[:, None], vectors)
        return t, offset, (means[:, None], values[:, None], vectors)


def gaussian() -> Correlated:
    """The prior."""
    return Correlated(torch.full((1, WIDTH), 0.3, dtype=torch.float64), ring()[None])


class Case:
    """The values that a mask leaves: A as a matrix, and y and the mask as methods take them."""

    def __init__(self, mask: Tensor) -> None:
        self.mask, self.width, self.unknown = mask.double(), len(mask), mask == 0
        self.matrix = torch.eye(self.width, dtype=torch.float64)[mask > 0]

    def measure(self, x_1: Tensor) -> Tensor:
        """The known values, (B, M)."""
        return x_1 @ self.matrix.T

    def measurement(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """y and the mask of known values, (B, D) each, from (B, M)."""
        return y @ self.matrix, (self.mask > 0).expand(len(y), -1)


CASES: dict[str, Callable[[], Case]] = {
    "rows": lambda: Case(torch.arange(WIDTH) % 4 == 0),
    "sector": lambda: Case(torch.arange(WIDTH) >= 10),
    "nothing": lambda: Case(torch.zeros(WIDTH)),
}


def velocity_of(prior: Correlated) -> MeanVelocity:
    """The exact velocity, as methods take it."""
    return lambda t, x, s: prior(t, x)


def map_of(prior: Correlated) -> MeanVelocity:
    """The exact flow map of a Gaussian."""

    def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
        if s == t:
            return prior(t, x)
        values, vectors, mean = prior.values[0], prior.vectors[0], prior.means[0]
        scale = (((1 - s) ** 2 + s**2 * values) / ((1 - t) ** 2 + t**2 * values)).sqrt()
        return (s * mean + ((x - t * mean) @ vectors * scale) @ vectors.T - x) / (s - t)

    return u


@torch.no_grad()
def moments(
    u: MeanVelocity, method: str, case: Case, y: Tensor, times: Tensor
) -> tuple[Tensor, Tensor]:
    """Means (B, D) for measurements (B, M), and the covariance (D, D), exact for a linear u."""
    drawn = [0]
    nothing = torch.zeros(len(y), case.width, dtype=torch.float64)

    def no_noise(j: int) -> Tensor:
        drawn[0] = max(drawn[0], j)
        return nothing

    means = build_sampler(method).run(u, nothing, *case.measurement(y), times, no_noise)
    unit = torch.eye(case.width, dtype=torch.float64)
    rows = (1 + drawn[0]) * case.width  # a unit of each value of each noise

    def noise(j: int) -> Tensor:
        e = torch.zeros(rows, case.width, dtype=torch.float64)
        e[j * case.width : (j + 1) * case.width] = unit
        return e

    x_1 = build_sampler(method).run(
        u, noise(0), *case.measurement(y[:1].expand(rows, -1)), times, noise
    )
    effect = x_1 - means[:1]
    return means, effect.T @ effect


def root(matrix: Tensor) -> Tensor:
    """The symmetric root of a positive matrix."""
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp(min=0).sqrt() @ vectors.T


def bures(a: Tensor, b: Tensor) -> Tensor:
    """Squared Wasserstein-2 distance of N(0, a) and N(0, b)."""
    return (torch.trace(a + b) - 2 * torch.trace(root(root(a) @ b @ root(a)))).clamp(min=0)


def distance(
    means: Tensor, covariance: Tensor, posteriors: list[Correlated], case: Case
) -> tuple[float, float, float]:
    """Wasserstein-2 distance and the mean's error over the root of the posterior's total variance,
    and the spread.
    """
    k, exact = case.unknown, posteriors[0].covariances[0][case.unknown][:, case.unknown]
    total = torch.trace(exact)
    off = (means - torch.cat([p.means for p in posteriors]))[:, k].square().sum(1).mean()
    own = covariance[k][:, k]
    whole = ((off + bures(own, exact)) / total).sqrt()
    return float(whole), float((off / total).sqrt()), float((torch.trace(own) / total).sqrt())


def steps_within(method: str, evaluations: int) -> int:
    """The most steps whose evaluations are no more than these; 0 where one step takes more."""
    costs = {n: build_sampler(method, steps=n).evaluations(None) for n in range(1, evaluations + 1)}
    return max((n for n, cost in costs.items() if cost <= evaluations), default=0)


def table(name: str, methods: list[str], evaluations: list[int], grid: str) -> None:
    """A line a method."""
    case, prior, draws = CASES[name](), gaussian(), torch.Generator().manual_seed(0)
    y = case.measure(prior.sample(ANSWERS, draws))
    posteriors = [prior.posterior(case.matrix, one, 0.0) for one in y]
    floor = [distance(x.mean(0, keepdim=True), x.T.cov(), posteriors[:1], case)
             for x in (posteriors[0].sample(4096, draws) for _ in range(8))]  # fmt: skip
    floor_words = ", ".join(f"{sum(column) / 8:.3f}" for column in zip(*floor, strict=True))
    print(f"\n{name}, grid {grid}; 4,096 samples of the posterior itself: {floor_words}")
    fields = {"": velocity_of(prior), ", map": map_of(prior)}
    for kind, u in fields.items():
        for method in methods:
            if kind and method.startswith("mmps"):
                continue
            cells = []
            for count in evaluations:
                steps = steps_within(method, count)
                if not steps:
                    cells.append(f"{'-':19s}")
                    continue
                times = named_grid(grid)(0.0, 1.0, steps)
                whole, mean, spread = distance(
                    *moments(u, method, case, y, times), posteriors, case
                )
                cells.append(f"{whole:5.3f} ({mean:5.3f}, {spread:4.2f})")
            print(f"  {method + kind:20s}" + "  ".join(cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--methods", default=METHODS_SHOWN)
    parser.add_argument("--evaluations", default="8,16,32,64,256")
    parser.add_argument("--grid", default="uniform")
    args = parser.parse_args()
    methods, evaluations = args.methods.split(","), [int(n) for n in args.evaluations.split(",")]
    print("method".ljust(22) + "  ".join(f"{n:<19d}" for n in evaluations))
    for name in args.cases.split(","):
        table(name, methods, evaluations, args.grid)


if __name__ == "__main__":
    main()
