"""How far the methods of completion are from the posterior, on problems whose posterior is known.

The prior is a Gaussian with a dense covariance, 32 values on a ring with a standard deviation of 0.5, with its exact
velocity. A method is then affine in all noise that it draws: its mean and its covariance are computed, not sampled.
Columns: evaluations of a scan. Figures: Wasserstein-2 distance of the Gaussians, over the root of the posterior's
total variance; in brackets the error of the mean by the same measure, and the spread (1 is right).
Then a mixture of two modes, where the measurement says which, by 4,096 samples.

python benchmarks/posterior.py                        # some minutes on one core
python benchmarks/posterior.py --cases sector,blur --methods mmps,flowdps
"""

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.flow.maps import MeanVelocity
from r2flow.flow.posterior import METHODS, Measurement, methods_in, parse_method, sample_posterior
from r2flow.flow.problems import Correlated
from r2flow.flow.solvers import named_grid

WIDTH = 32
USUAL = "replace,replace_fresh,repaint:4,repaint:10,flowdps,pnp:1,pnp:5,ot_ode,mmps:1,0,mmps:2,0,mmps:4,0,mmps:2,mmps:4"
JUMPS = ("replace", "repaint", "pnp")  # what gains by a flow map; the others take its velocity
ANSWERS = 16  # measurements of a case, over which the squared error of the mean is averaged


def ring(width: int = WIDTH, std: float = 0.5, length: float = 3.0) -> Tensor:
    """A covariance that falls with the distance on a ring, with a small share of white noise."""
    apart = torch.arange(width, dtype=torch.float64)
    apart = (apart[:, None] - apart).abs()
    near = torch.exp(-torch.minimum(apart, width - apart) / length)
    return std**2 * (0.95 * near + 0.05 * torch.eye(width, dtype=torch.float64))


def gaussian() -> Correlated:
    """The prior."""
    return Correlated(torch.full((1, WIDTH), 0.3, dtype=torch.float64), ring()[None])


class Case:
    """What is measured: A as a matrix, the error, and `Measurement`s of it."""

    def __init__(self, mask: Tensor, sigma: float = 0.0, blur: bool = False) -> None:
        self.mask, self.sigma, self.width = mask.double(), sigma, len(mask)
        eye = torch.eye(self.width, dtype=torch.float64)
        self.blurred = eye / 2 + (eye.roll(1, 0) + eye.roll(-1, 0)) / 4 if blur else None
        self.matrix = (eye if self.blurred is None else self.blurred)[mask > 0]
        self.unknown = self.mask == 0 if sigma == 0 else torch.ones(self.width, dtype=torch.bool)

    def measure(self, x_1: Tensor, draws: torch.Generator) -> Tensor:
        """y, (B, M)."""
        exact = x_1 @ self.matrix.T
        return exact + self.sigma * torch.randn(exact.shape, generator=draws, dtype=torch.float64)

    def measurement(self, y: Tensor) -> Measurement:
        """Of y, (B, M)."""
        whole = torch.zeros(len(y), self.width, dtype=torch.float64)
        whole[:, self.mask > 0] = y
        mask, sigma, a = self.mask.expand(len(y), -1), torch.tensor(self.sigma, dtype=torch.float64), self.blurred
        if a is None:
            return Measurement(whole, mask, sigma)
        return Measurement(whole, mask, sigma, lambda x: x @ a.T, lambda d: d @ a)


CASES: dict[str, Callable[[], Case]] = {
    "rows": lambda: Case(torch.arange(WIDTH) % 4 == 0),
    "sector": lambda: Case(torch.arange(WIDTH) >= 10),
    "noisy": lambda: Case(torch.ones(WIDTH), 0.2),
    "blur": lambda: Case(torch.ones(WIDTH), 0.1, blur=True),
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


def moments(u: MeanVelocity, method: str, case: Case, y: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Means (B, D) for measurements (B, M), and the covariance (D, D), exact for a linear u."""
    drawn = [0]
    nothing = torch.zeros(len(y), case.width, dtype=torch.float64)

    def no_noise(j: int) -> Tensor:
        drawn[0] = max(drawn[0], j)
        return nothing

    means = sample_posterior(u, nothing, case.measurement(y), method, times, no_noise)
    unit = torch.eye(case.width, dtype=torch.float64)
    rows = (1 + drawn[0]) * case.width  # a unit of each value of each noise

    def noise(j: int) -> Tensor:
        e = torch.zeros(rows, case.width, dtype=torch.float64)
        e[j * case.width : (j + 1) * case.width] = unit
        return e

    x_1 = sample_posterior(u, noise(0), case.measurement(y[:1].expand(rows, -1)), method, times, noise)
    effect = x_1 - means[:1]
    return means, effect.T @ effect


def root(matrix: Tensor) -> Tensor:
    """The symmetric root of a positive matrix."""
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp(min=0).sqrt() @ vectors.T


def bures(a: Tensor, b: Tensor) -> Tensor:
    """Squared Wasserstein-2 distance of N(0, a) and N(0, b)."""
    return (torch.trace(a + b) - 2 * torch.trace(root(root(a) @ b @ root(a)))).clamp(min=0)


def distance(means: Tensor, covariance: Tensor, posteriors: list[Correlated], case: Case) -> tuple[float, float, float]:
    """Wasserstein-2 distance and the mean's error over the root of the posterior's total variance, and the spread."""
    k, exact = case.unknown, posteriors[0].covariances[0][case.unknown][:, case.unknown]
    total = torch.trace(exact)
    off = (means - torch.cat([p.means for p in posteriors]))[:, k].square().sum(1).mean()
    own = covariance[k][:, k]
    whole = ((off + bures(own, exact)) / total).sqrt()
    return float(whole), float((off / total).sqrt()), float((torch.trace(own) / total).sqrt())


def steps_within(method: str, evaluations: int) -> int:
    """The most steps whose evaluations are no more than these; 0 where one step takes more."""
    chosen = parse_method(method)
    return max((n for n in range(1, evaluations + 1) if chosen.evaluations(n) <= evaluations), default=0)


def table(name: str, methods: list[str], evaluations: list[int], grid: str) -> None:
    """A line a method."""
    case, prior, draws = CASES[name](), gaussian(), torch.Generator().manual_seed(0)
    y = case.measure(prior.sample(ANSWERS, draws), draws)
    posteriors = [prior.posterior(case.matrix, one, case.sigma) for one in y]
    floor = [distance(x.mean(0, keepdim=True), x.T.cov(), posteriors[:1], case)
             for x in (posteriors[0].sample(4096, draws) for _ in range(8))]  # fmt: skip
    floor_words = ", ".join(f"{sum(column) / 8:.3f}" for column in zip(*floor, strict=True))
    print(f"\n{name}, grid {grid}; 4,096 samples of the posterior itself: {floor_words}")
    fields = {"": velocity_of(prior), ", map": map_of(prior)}
    for kind, u in fields.items():
        for method in methods:
            base = method.partition(":")[0]
            if (METHODS[base].masks and case.blurred is not None) or (kind and base not in JUMPS):
                continue
            cells = []
            for count in evaluations:
                steps = steps_within(method, count)
                if not steps:
                    cells.append(f"{'-':19s}")
                    continue
                times = named_grid(grid)(0.0, 1.0, steps)
                whole, mean, spread = distance(*moments(u, method, case, y, times), posteriors, case)
                cells.append(f"{whole:5.3f} ({mean:5.3f}, {spread:4.2f})")
            print(f"  {method + kind:20s}" + "  ".join(cells), flush=True)


def two_modes() -> tuple[Correlated, Case, Tensor]:
    """A prior of two modes, a mask and a measurement that makes one of them four times as likely."""
    pattern = 0.5 * torch.cos(2 * torch.pi * torch.arange(WIDTH, dtype=torch.float64) / WIDTH)
    prior = Correlated(torch.stack([pattern, -pattern]), 0.1 * ring().repeat(2, 1, 1))
    case = Case(torch.arange(WIDTH) % 8 == 6)
    along = pattern[case.mask > 0]
    low, high = 0.0, 1.0
    for _ in range(60):  # weight of the first mode 0.8
        middle = (low + high) / 2
        weight = prior.posterior(case.matrix, middle * along, 0.0).weights[0]
        low, high = (middle, high) if weight < 0.8 else (low, middle)
    return prior, case, low * along


def weight_of_first(prior: Correlated, x: Tensor) -> float:
    """Share of samples that are nearer to the first mode."""
    apart = torch.cdist(x, prior.means)
    return float((apart[:, 0] < apart[:, 1]).double().mean())


def energy(a: Tensor, b: Tensor) -> float:
    """Root of the energy distance of two sets of samples."""
    n, m = len(a), len(b)
    inner = torch.cdist(a, a).sum() / (n * (n - 1)) + torch.cdist(b, b).sum() / (m * (m - 1))
    return float((2 * torch.cdist(a, b).mean() - inner).clamp(min=0).sqrt())


def modes(methods: list[str], evaluations: list[int], grid: str, num: int) -> None:
    """The mixture: weight of the likelier mode and energy distance to samples of the posterior."""
    prior, case, y = two_modes()
    posterior, draws = prior.posterior(case.matrix, y, 0.0), torch.Generator().manual_seed(1)
    exact, other = posterior.sample(num, draws), posterior.sample(num, draws)
    print(f"\ntwo modes, grid {grid}: weight of the likelier one, {float(posterior.weights[0]):.3f}, energy distance")
    print(f"  {'the posterior':20s}{weight_of_first(prior, other):5.3f} {energy(other, exact):5.3f}")
    for method in methods:
        cells = []
        for count in evaluations:
            steps = steps_within(method, count)
            if not steps:
                cells.append(f"{'-':12s}")
                continue

            def noise(j: int) -> Tensor:
                return torch.randn(num, WIDTH, generator=torch.Generator().manual_seed(j), dtype=torch.float64)

            times = named_grid(grid)(0.0, 1.0, steps)
            measured = case.measurement(y.expand(num, -1))
            x = sample_posterior(velocity_of(prior), noise(0), measured, method, times, noise)
            cells.append(f"{weight_of_first(prior, x):5.3f} {energy(x, exact):5.3f} ")
        print(f"  {method:20s}" + "  ".join(cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--methods", default=USUAL)
    parser.add_argument("--evaluations", default="8,16,32,64,256")
    parser.add_argument("--grid", default="uniform")
    parser.add_argument("--num", type=int, default=4096)
    args = parser.parse_args()
    methods, evaluations = methods_in(args.methods), [int(n) for n in args.evaluations.split(",")]
    print("method".ljust(22) + "  ".join(f"{n:<19d}" for n in evaluations))
    for name in filter(None, args.cases.split(",")):
        table(name, methods, evaluations, args.grid)
    modes(methods, evaluations, args.grid, args.num)


if __name__ == "__main__":
    main()
