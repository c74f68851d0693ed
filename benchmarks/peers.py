"""Our adaptive solvers beside scipy's and diffrax's: error at t = 1 against evaluations, one scene at a time.

    python -m pip install scipy diffrax
    python benchmarks/peers.py --checkpoint runs/demo/rf1 --num 2      # minutes on one core
    python benchmarks/peers.py                                         # exact problems alone, seconds

Every solver gets the same relative and absolute tolerance and chooses its own first step. Evaluations are those that
the velocity has seen. The error is the RMS in model space, median over the scenes, against the exact end; for a
trained flow against dopri5 at 1e-6.
"""

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from r2flow.flow.problems import Gaussian, Problem, RayDrop, TwoModes
from r2flow.flow.solvers import Velocity, solve
from r2flow.model.checkpoint import load_checkpoint
from r2flow.noise import Draws, standard_normal
from r2flow.reports.tables import table

jax.config.update("jax_enable_x64", True)
TOLERANCES = (1e-2, 1e-3, 1e-4)
PROBLEMS: dict[str, Problem] = {"Gaussian": Gaussian(), "two modes": TwoModes(), "ray-drop": RayDrop()}
ELEMENTS = 256

Solve = Callable[[Velocity, Tensor, float], tuple[Tensor, int]]


class Counted:
    """A velocity of one scene on flat numpy arrays, and how often it was called."""

    def __init__(self, velocity: Velocity, x: Tensor) -> None:
        self.velocity, self.like, self.calls = velocity, x, 0

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        x = torch.from_numpy(np.array(y)).to(self.like.dtype).reshape(self.like.shape)
        with torch.no_grad():
            v = self.velocity(torch.tensor(float(t), dtype=self.like.dtype), x)
        return v.reshape(-1).double().numpy()


def ours(method: str) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        with torch.no_grad():
            found = solve(velocity, x, method=method, tolerance=tolerance)
        return found.x, int(found.evaluations[0])

    return run


def scipy(method: str) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        field = Counted(velocity, x)
        end = solve_ivp(field, (0.0, 1.0), x.reshape(-1).double().numpy(), method, rtol=tolerance, atol=tolerance).y[
            :, -1
        ]
        return torch.from_numpy(end).reshape(x.shape), field.calls

    return run


def of_diffrax(solver: diffrax.AbstractSolver) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        field = Counted(velocity, x)
        shape = jax.ShapeDtypeStruct((x.numel(),), jnp.float64)
        term = diffrax.ODETerm(lambda t, y, _: jax.pure_callback(field, shape, t, y))
        steps = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        start = jnp.asarray(x.reshape(-1).double().numpy())
        found = diffrax.diffeqsolve(term, solver, 0.0, 1.0, None, start, stepsize_controller=steps, max_steps=None)
        return torch.from_numpy(np.array(found.ys[-1])).reshape(x.shape), field.calls

    return run


SOLVERS: dict[str, Solve] = {
    "bosh3": ours("bosh3"),
    "dopri5": ours("dopri5"),
    "scipy RK23": scipy("RK23"),
    "scipy RK45": scipy("RK45"),
    "scipy LSODA": scipy("LSODA"),
    "diffrax Bosh3": of_diffrax(diffrax.Bosh3()),
    "diffrax Dopri5": of_diffrax(diffrax.Dopri5()),
    "diffrax Tsit5": of_diffrax(diffrax.Tsit5()),
}


def rows(velocity: Velocity, scenes: list[tuple[Tensor, Tensor]]) -> list[list[str]]:
    """Evaluations and error of each solver at each tolerance, medians over (start, end) of each scene."""
    found = []
    for name, run in SOLVERS.items():
        cells = []
        for tolerance in TOLERANCES:
            ends = [run(velocity, start, tolerance) for start, _ in scenes]
            errors = [
                float((x.double() - end.double()).square().mean().sqrt())
                for (x, _), (_, end) in zip(ends, scenes, strict=True)
            ]
            evaluations = statistics.median(count for _, count in ends)
            cells.append(f"{evaluations:.0f}: {statistics.median(errors):.1e}")
        found.append([name, *cells])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, default=None)
    parser.add_argument("--num", type=int, default=8, help="Scenes.")
    given = parser.parse_args()
    heading = ["solver", *(f"{tolerance:g}, evaluations: error" for tolerance in TOLERANCES)]
    for name, problem in PROBLEMS.items():
        starts = [standard_normal((ELEMENTS,), 0, "evaluation", k)[None].double() for k in range(given.num)]
        print(f"\n{name}\n{table(rows(problem, [(x, problem.solution(x, 1.0)) for x in starts]), heading)}", flush=True)
    if given.checkpoint:
        flow = load_checkpoint(given.checkpoint).generator
        velocity: Velocity = flow.velocity  # type: ignore[assignment]
        starts = [Draws(0, range(k, k + 1)).start(flow.noise_shape) for k in range(given.num)]
        with torch.no_grad():
            scenes = [(x, solve(velocity, x, method="dopri5", tolerance=1e-6).x) for x in starts]
        print(f"\n{given.checkpoint}\n{table(rows(velocity, scenes), heading)}", flush=True)


if __name__ == "__main__":
    main()
