"""The adaptive solvers beside torchdiffeq, scipy and diffrax: error at t = 1 against evaluations of
the velocity.

Mixed batch: 16 scenes of exact problems (8 straight, 4 smooth, 3 two-mode, 1 ray-drop), evaluations
summed over scenes, against torchdiffeq's dopri5 on the batch as one state. Single scenes: scipy and
diffrax, which get the same relative and absolute tolerance and choose their own first step. Errors
are RMS in model space, against the exact end; for a trained flow against dopri5 at 1e-6.

python -m pip install scipy diffrax
python benchmarks/solvers.py                                        # exact problems alone, a minute
python benchmarks/solvers.py --checkpoint runs/demo/rf1 --num 2     # minutes on one core
"""

import argparse
import statistics
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from r2flow.base.noise import Draws, standard_normal
from r2flow.flow.problems import Discontinuous, Gaussian, Problem, RayDrop, Straight, TwoModes
from r2flow.flow.solvers import Velocity, solve
from r2flow.model.checkpoint import load_checkpoint
from r2flow.reports.tables import markdown

ELEMENTS = 256
TOLERANCES = (1e-2, 1e-3, 1e-4)
PROBLEMS: dict[str, Problem] = {
    "Gaussian": Gaussian(),
    "two modes": TwoModes(),
    "ray-drop": RayDrop(),
}
# of (velocity, x_0, tolerance): x_1 and evaluations
Solve = Callable[[Velocity, Tensor, float], tuple[Tensor, int]]


class Mixed(Problem):
    """A batch in which every scene has a problem of its own; `select` is for solvers whose scenes
    leave the batch.

    Args:
        problems: One for each scene.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        groups: dict[Problem, list[int]] = {}
        for scene, problem in enumerate(self.problems):
            groups.setdefault(problem, []).append(scene)
        self._groups = [(problem, torch.tensor(scenes)) for problem, scenes in groups.items()]

    def select(self, scenes: Tensor) -> "Mixed":
        """The problem of some of the scenes, indices (N,)."""
        return type(self)([self.problems[scene] for scene in scenes.tolist()])

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        v = torch.empty_like(x)
        for problem, scenes in self._groups:
            v[scenes] = problem(t[scenes] if t.ndim else t, x[scenes])
        return v

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        x_t = torch.empty_like(x_0, dtype=torch.float64)
        for problem, scenes in self._groups:
            x_t[scenes] = problem.solution(x_0[scenes], t[scenes] if t.ndim else t)
        return x_t


class Counted:
    """A velocity of flat arrays, and how often it was called."""

    def __init__(self, velocity: Velocity, x: Tensor) -> None:
        self.velocity, self.like, self.calls = velocity, x, 0

    def __call__(self, t: float, y: object) -> object:
        self.calls += 1
        x = torch.as_tensor(y).to(self.like.dtype).reshape(self.like.shape)
        with torch.no_grad():
            v = self.velocity(torch.full((len(x),), float(t), dtype=x.dtype), x)
        return v.reshape(-1).double().numpy()


def ours(method: str) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        solution = solve(velocity, x, method=method, tolerance=tolerance)
        return solution.x, int(solution.evaluations.sum())

    return run


def by_torchdiffeq(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
    """dopri5 with one step and one error norm for the whole batch; its last step ends at t = 1."""
    import torchdiffeq

    field, span = Counted(velocity, x), torch.tensor([0.0, 1.0], dtype=x.dtype)

    def flat(t: Tensor, y: Tensor) -> Tensor:
        return torch.as_tensor(field(float(t), y)).to(y)

    end = torchdiffeq.odeint(
        flat,
        x.reshape(-1),
        span,
        rtol=tolerance,
        atol=tolerance,
        method="dopri5",
        options={"step_t": span[1:]},
    )[-1]
    return end.reshape(x.shape), field.calls * len(x)


def by_scipy(method: str) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        from scipy.integrate import solve_ivp

        field, start = Counted(velocity, x), x.reshape(-1).double().numpy()
        end = solve_ivp(field, (0.0, 1.0), start, method, rtol=tolerance, atol=tolerance).y[:, -1]
        return torch.from_numpy(end).reshape(x.shape), field.calls

    return run


def by_diffrax(solver: str) -> Solve:
    def run(velocity: Velocity, x: Tensor, tolerance: float) -> tuple[Tensor, int]:
        import diffrax
        import jax
        import jax.numpy as jnp
        import numpy as np

        jax.config.update("jax_enable_x64", True)
        field, shape = Counted(velocity, x), jax.ShapeDtypeStruct((x.numel(),), jnp.float64)
        term = diffrax.ODETerm(
            lambda t, y, _: jax.pure_callback(lambda t, y: field(t, np.array(y)), shape, t, y)
        )
        end = diffrax.diffeqsolve(
            term, getattr(diffrax, solver)(), 0.0, 1.0, None, jnp.asarray(x.reshape(-1).double().numpy()),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=None,
        )  # fmt: skip
        return torch.from_numpy(np.array(end.ys[-1])).reshape(x.shape), field.calls

    return run


SOLVERS: dict[str, Solve] = {
    "dopri5": ours("dopri5"),
    "scipy RK23": by_scipy("RK23"),
    "scipy RK45": by_scipy("RK45"),
    "scipy LSODA": by_scipy("LSODA"),
}
if find_spec("diffrax"):
    SOLVERS |= {f"diffrax {name}": by_diffrax(name) for name in ("Bosh3", "Dopri5", "Tsit5")}


def errors(x: Tensor, exact: Tensor) -> Tensor:
    """Root mean square over the elements of each scene."""
    return (x.double() - exact.double()).flatten(1).square().mean(1).sqrt()


def mixed_batch(last: list[Problem], seeds: int) -> list[list[str]]:
    """Share of torchdiffeq's evaluations, and the error of the hardest scene, medians over the
    seeds.
    """
    batch = Mixed([Straight()] * 8 + [Gaussian()] * 4 + [TwoModes()] * (4 - len(last)) + last)
    rows = []
    for tolerance in (1e-3, 1e-5):
        shares, pairs = [], []
        for seed in range(seeds):
            x_0 = torch.stack(
                [standard_normal((ELEMENTS,), seed, "evaluation", scene) for scene in range(16)]
            )
            exact = batch.solution(x_0, 1.0)
            (a, spent), (b, usual) = (
                ours("dopri5")(batch, x_0, tolerance),
                by_torchdiffeq(batch, x_0, tolerance),
            )
            shares.append(spent / usual)
            pairs.append([errors(x, exact).max().item() for x in (a, b)])
        hardest = [f"{statistics.median(side):.1e}" for side in zip(*pairs, strict=True)]
        rows.append(["dopri5", f"{tolerance:g}", f"{statistics.median(shares):.2f}", *hardest])
    return rows


def single_scenes(velocity: Velocity, scenes: list[tuple[Tensor, Tensor]]) -> list[list[str]]:
    """Evaluations and error of each solver at each tolerance, medians over (start, end) of each
    scene.
    """
    rows = []
    for name, run in SOLVERS.items():
        cells = []
        for tolerance in TOLERANCES:
            ends = [(run(velocity, start, tolerance), exact) for start, exact in scenes]
            error = statistics.median(errors(x, exact).item() for (x, _), exact in ends)
            cells.append(f"{statistics.median(spent for (_, spent), _ in ends):.0f}: {error:.1e}")
        rows.append([name, *cells])
    return rows


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--checkpoint", type=Path, default=None)
    parser.add_argument("--num", type=int, default=8, help="Scenes.")
    parser.add_argument("--seeds", type=int, default=20, help="Of the mixed batch.")
    given = parser.parse_args()
    heading = [
        "solver",
        "tolerance",
        "evaluations / torchdiffeq's",
        "error of the hardest scene",
        "torchdiffeq's",
    ]
    for name, last in {
        "mixed batch": [RayDrop()],
        "with a jump in time": [RayDrop(), Discontinuous()],
    }.items():
        print(f"\n{name}\n{markdown(mixed_batch(last, given.seeds), heading)}", flush=True)
    heading = ["solver", *(f"{tolerance:g}, evaluations: error" for tolerance in TOLERANCES)]
    for name, problem in PROBLEMS.items():
        starts = [
            standard_normal((ELEMENTS,), 0, "evaluation", k)[None].double()
            for k in range(given.num)
        ]
        rows = single_scenes(problem, [(x, problem.solution(x, 1.0)) for x in starts])
        print(f"\n{name}\n{markdown(rows, heading)}", flush=True)
    if given.checkpoint:
        flow = load_checkpoint(given.checkpoint).generator
        velocity: Velocity = flow.velocity  # type: ignore[assignment]
        starts = [Draws(0, range(k, k + 1)).start(flow.noise_shape) for k in range(given.num)]
        scenes = [(x, solve(velocity, x, method="dopri5", tolerance=1e-6).x) for x in starts]
        print(
            f"\n{given.checkpoint}\n{markdown(single_scenes(velocity, scenes), heading)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
