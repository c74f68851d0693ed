"""What --error saves: each scan its own number of steps, against equal steps with the same worst error.

Equal steps are given the least number that keeps the worst error of these very scans below the bound, which nobody
knows beforehand. On a mixed batch of exact problems, whose errors are measured on other noise, and on calibrated flows.

r2flow calibrate -c runs/demo/rf1 && python benchmarks/levels.py runs/demo/rf1
"""

import argparse
from dataclasses import replace

import torch
from torch import Tensor

from r2flow.accuracy import STEPS
from r2flow.errors import InputError
from r2flow.flow.problems import Gaussian, Mixed, RayDrop, Straight, TwoModes
from r2flow.flow.solvers import solve
from r2flow.generators import Budget, Field, Flow, Sampler, levels
from r2flow.inversion import rms
from r2flow.model.checkpoint import load_checkpoint
from r2flow.noise import Draws


def budgets(flow: Flow, sampler: Sampler, x_0: Tensor, exact: Tensor) -> list[Budget]:
    """Errors and corrections at all numbers of steps."""
    found = []
    for steps in STEPS:
        solution = flow.solve(x_0, sampler=replace(sampler, steps=steps))
        assert solution.correction is not None
        errors = tuple(rms(solution.x - exact).tolist())
        found.append(Budget(steps, errors, errors, tuple(solution.correction.tolist())))
    return found


def compare(name: str, flow: Flow, sampler: Sampler, known: list[Budget], x_0: Tensor, exact: Tensor) -> None:
    """A line for each bound."""
    own = budgets(flow, sampler, x_0, exact)
    print(f"{name}, {len(x_0)} scans")
    for bound in (0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3):
        equal = next((budget.steps for budget in own if max(budget.errors) <= bound), None)
        try:
            steps, limits = levels(known, bound)
        except InputError:
            continue
        found = flow.solve(x_0, sampler=replace(sampler, levels=steps, limits=limits))
        worst, mean = rms(found.x - exact).max().item(), found.evaluations.double().mean().item()
        share = "" if equal is None else f", {mean / equal:.2f} of them"
        print(
            f"  {bound:g}: {mean:.1f} evaluations, worst {worst:.1e}, levels {steps}; equal steps {equal}{share}",
            flush=True,
        )


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flows", nargs="*", help="calibrated run folders or checkpoints")
    parser.add_argument("--num", type=int, default=16)
    args = parser.parse_args()
    usual = Sampler("adams3", grid="power:1.75")
    batch = Mixed([Straight()] * 8 + [Gaussian()] * 4 + [TwoModes()] * 3 + [RayDrop()])
    flow = Field(batch, (256,))
    other, x_0 = (Draws(seed, range(16)).start((256,)).double() for seed in (1, 0))
    known = budgets(flow, usual, other, batch.solution(other, 1.0))
    compare("mixed batch of exact problems", flow, usual, known, x_0, batch.solution(x_0, 1.0))
    for path in args.flows:
        loaded = load_checkpoint(path)
        generator = loaded.generator
        assert isinstance(generator, Flow)
        x_0 = Draws(0, range(args.num)).start(generator.noise_shape)
        exact = solve(generator.velocity, x_0.double(), method="dopri5", tolerance=1e-6).x
        compare(path, generator, generator.sampler, list(loaded.accuracy), x_0, exact)


if __name__ == "__main__":
    main()
