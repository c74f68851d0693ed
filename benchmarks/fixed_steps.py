"""Error after few evaluations: our solvers of fixed steps beside UniPC and DPM-Solver++, on trained and exact flows.

Root mean square in model space, median over scans, against dopri5 at a tolerance of 1e-6 or the exact end. Each method
on the grid that suits it best at each number of evaluations, and the default sampler; * is the least of a column.
UniPC-2 (Zhao and others, 2023, data prediction, B_2) and DPM-Solver++ 2M (Lu and others, 2022) are written from their
papers, with alpha_t = t, sigma_t = 1 - t and D(t, x) = x + (1 - t) v(t, x).

python benchmarks/fixed_steps.py runs/demo/rf1 runs/demo/rf2            # some minutes on one core
python benchmarks/fixed_steps.py --problems two_modes,ray_drop          # seconds
"""

import argparse
import math
from collections.abc import Callable, Sequence
from itertools import product

import torch
from torch import Tensor

from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import Velocity, named_grid, solve
from r2flow.inversion import rms
from r2flow.model.checkpoint import load_checkpoint
from r2flow.noise import Draws


def coefficients(times: Sequence[float], i: int) -> tuple[float, float, float]:
    """sigma_i / sigma_(i-1), e^-h and h of a step in lambda = log(t / (1 - t)); h is infinite at both ends of time."""
    t, s = times[i], times[i - 1]
    decay = (1 - t) * s / (t * (1 - s)) if s > 0 else 0.0
    return (1 - t) / (1 - s), decay, -math.log(decay) if decay > 0 else math.inf


def dpm_solver_2m(v: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """DPM-Solver++ 2M; its first and last steps are of first order."""
    before, h_before = None, math.inf
    for i in range(1, len(times)):
        data = x + (1 - times[i - 1]) * v(torch.tensor(times[i - 1]), x)
        ratio, decay, h = coefficients(times, i)
        mixed = data
        if before is not None and math.isfinite(h) and math.isfinite(h_before):
            r = h_before / h
            mixed = (1 + 1 / (2 * r)) * data - 1 / (2 * r) * before
        x = ratio * x - times[i] * (decay - 1) * mixed
        before, h_before = data, h
    return x


def unipc_2(v: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """UniPC of order 2 with B(h) = e^h - 1; the last step is of first order and is not corrected."""
    data = x + (1 - times[0]) * v(torch.tensor(times[0]), x)
    before, h_before = None, math.inf
    for i in range(1, len(times)):
        ratio, decay, h = coefficients(times, i)
        b = decay - 1
        base = ratio * x - times[i] * b * data
        second = before is not None and math.isfinite(h) and math.isfinite(h_before)
        r = -h_before / h if second else math.nan
        difference = (before - data) / r if second and before is not None else None
        predicted = base if difference is None else base - times[i] * b * 0.5 * difference
        if i == len(times) - 1:
            return predicted
        new = predicted + (1 - times[i]) * v(torch.tensor(times[i]), predicted)
        if difference is None:
            x = base - times[i] * b * 0.5 * (new - data)
        else:
            phi_1 = b / -h - 1  # h phi of the paper, for e^-h
            phi_2 = phi_1 / -h - 0.5
            weights = torch.linalg.solve(
                torch.tensor([[1, 1], [r, 1]], dtype=torch.float64),
                torch.tensor([phi_1 / b, 2 * phi_2 / b], dtype=torch.float64),
            ).tolist()
            x = base - times[i] * b * (weights[0] * difference + weights[1] * (new - data))
        data, before, h_before = new, data, h
    return x


def measured(
    v: Velocity, x_0: Tensor, exact: Tensor, evaluations: Sequence[int], grids: Sequence[str]
) -> dict[tuple[str, str], list[float]]:
    """Error of every method on every grid at every number of evaluations."""

    def ours(method: str, per_step: int, start: int = 0) -> Callable[[str, int], Tensor]:
        return lambda grid, n: solve(v, x_0, method=method, steps=(n - start) // per_step, grid=grid).x

    def theirs(step: Callable[[Velocity, Tensor, Sequence[float]], Tensor]) -> Callable[[str, int], Tensor]:
        return lambda grid, n: step(v, x_0, named_grid(grid)(0.0, 1.0, n).tolist())

    methods = {
        "euler": ours("euler", 1), "midpoint": ours("midpoint", 2), "ab2": ours("ab2", 1),
        "adams2": ours("adams2", 1), "adams3": ours("adams3", 1), "adams4": ours("adams4", 1, 1),
        "UniPC-2": theirs(unipc_2), "DPM-Solver++ 2M": theirs(dpm_solver_2m),
    }  # fmt: skip
    return {
        (name, grid): [rms(method(grid, n) - exact).median().item() for n in evaluations]
        for (name, method), grid in product(methods.items(), grids)
    }


def show(found: dict[tuple[str, str], list[float]], columns: int) -> None:
    """A line a method."""
    lines = {"default: adams3, power:1.75": [(error, "") for error in found.get(("adams3", "power:1.75"), [])]}
    for name in dict.fromkeys(name for name, _ in found):
        own = {grid: errors for (of, grid), errors in found.items() if of == name}
        lines[name] = [min((errors[k], grid) for grid, errors in own.items()) for k in range(columns)]
    best = [min(cells[k][0] for cells in lines.values() if cells) for k in range(columns)]
    for name, cells in lines.items():
        shown = (
            f"{e:.5f}{'*' if e == least else ' '} {grid:10s}" for (e, grid), least in zip(cells, best, strict=False)
        )
        print(f"  {name:28s} {'  '.join(shown)}", flush=True)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flows", nargs="*", help="run folders or checkpoints")
    parser.add_argument("--problems", default="")
    parser.add_argument("--num", type=int, default=4)
    parser.add_argument("--evaluations", default="4,8,16,32")
    parser.add_argument("--grids", default="uniform,power:1.5,power:1.75,power:2")
    args = parser.parse_args()
    evaluations = [int(n) for n in args.evaluations.split(",")]
    subjects: list[tuple[str, Velocity, Tensor, Tensor]] = []
    for path in args.flows:
        generator = load_checkpoint(path).generator
        x_0 = Draws(0, range(args.num)).start(generator.noise_shape)
        exact = solve(generator.velocity, x_0.double(), method="dopri5", tolerance=1e-6)
        print(f"{path}: reference by {exact.evaluations.double().mean():.0f} evaluations a scan", flush=True)
        subjects.append((path, generator.velocity, x_0, exact.x))
    for name in filter(None, args.problems.split(",")):
        problem = PROBLEMS[name]()
        x_0 = Draws(0, range(args.num)).start((256,)).double()
        subjects.append((name, problem, x_0, problem.solution(x_0, 1.0)))
    for name, v, x_0, exact in subjects:
        print(f"{name}, {args.num} scans: {', '.join(map(str, evaluations))} evaluations")
        show(measured(v, x_0, exact, evaluations, args.grids.split(",")), len(evaluations))


if __name__ == "__main__":
    main()
