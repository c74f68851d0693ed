"""What per-scene steps save on a mixed batch, and what they cost beside the network.

The mixed batch: 16 scenes of exact problems (8 straight, 4 smooth, 3 two-mode, 1 ray-drop), evaluations summed over
scenes against torchdiffeq's dopri5 on the batch as one state; and one hard scene among easy ones. The overhead: the
share of a solution's time that is spent outside the network, medians in one process.

python benchmarks/solvers.py                               # HDiT at 2 x 64 x 1024, some minutes on one core
python benchmarks/solvers.py --device cuda --batch 1 8
python benchmarks/solvers.py --no-overhead                 # the mixed batch alone, seconds
"""

import argparse
import statistics
import time

import torch
from torch import Tensor

from r2flow.backbones import build_backbone
from r2flow.flow.problems import Discontinuous, Gaussian, Mixed, Problem, RayDrop, Straight, TwoModes
from r2flow.flow.solvers import Velocity, solve
from r2flow.generators import Field
from r2flow.lidar.sensors import build_sensor
from r2flow.noise import standard_normal


def noise(scenes: int, elements: int, seed: int) -> Tensor:
    """x_0, (scenes, elements)."""
    return torch.stack([standard_normal((elements,), seed, "evaluation", scene) for scene in range(scenes)])


def errors(x: Tensor, exact: Tensor) -> Tensor:
    """Root mean square over the elements of each scene."""
    return (x.double() - exact).square().mean(1).sqrt()


def one_state(flow: Field, x: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """torchdiffeq's dopri5 as it is usually called: one step and one error norm for the whole batch."""
    import torchdiffeq

    calls, velocity = 0, flow.field()

    def counted(t: Tensor, state: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return velocity(t, state).to(state.dtype)

    span = torch.tensor([0.0, 1.0], dtype=x.dtype, device=x.device)
    end = torchdiffeq.odeint(counted, x, span, rtol=tolerance, atol=tolerance, method="dopri5")[-1]
    return end, torch.full((len(x),), calls)


def mixed_batch(name: str, last: list[Problem], seeds: int, elements: int) -> None:
    """Evaluations and the hardest scene's error against one common step."""
    straight, smooth, modes = Straight(), Gaussian(), TwoModes()
    batch = Mixed([straight] * 8 + [smooth] * 4 + [modes] * (4 - len(last)) + last)
    print(f"{name} of 16, {elements} elements, float32: median (worst) of {seeds} seeds")
    for method in ("bosh3", "dopri5"):
        for tolerance in (1e-3, 1e-5):
            shares, ours, theirs = [], [], []
            for seed in range(seeds):
                x_0 = noise(16, elements, seed)
                exact = batch.solution(x_0, 1.0)
                solution = solve(batch, x_0, method=method, tolerance=tolerance)
                end, evaluations = one_state(Field(batch, (elements,)), x_0, tolerance)
                shares.append(int(solution.evaluations.sum()) / int(evaluations.sum()))
                ours.append(errors(solution.x, exact).max().item())
                theirs.append(errors(end, exact).max().item())
            lower = sum(a < b for a, b in zip(ours, theirs, strict=True))
            print(
                f"  {method:6s} {tolerance:.0e}: evaluations {statistics.median(shares):.2f} ({max(shares):.2f}) of "
                f"torchdiffeq:dopri5's; hardest scene {statistics.median(ours):.1e} ({max(ours):.1e}) against "
                f"{statistics.median(theirs):.1e} ({max(theirs):.1e}), lower in {lower} of {seeds}"
            )


def hard_among_easy(elements: int) -> None:
    """The error of one hard scene in batches of growing size."""
    hard: dict[str, Problem] = {"two modes": TwoModes(), "narrow": Gaussian(std=0.01), "ray-drop": RayDrop()}
    easy = Straight()
    print("one hard scene in a batch of 1, 16, 64, 256, dopri5 at 1e-3: its error, ours / torchdiffeq as one state")
    for name, problem in hard.items():
        found = []
        for size in (1, 16, 64, 256):
            batch = Mixed([problem] + [easy] * (size - 1))
            x_0 = noise(size, elements, 0)
            exact = batch.solution(x_0, 1.0)
            ours = errors(solve(batch, x_0, method="dopri5", tolerance=1e-3).x, exact)[0]
            theirs = errors(one_state(Field(batch, (elements,)), x_0, 1e-3)[0], exact)[0]
            found.append(f"{ours:.1e} / {theirs:.1e}")
        print(f"  {name:10s}" + "   ".join(found))


class Timed:
    """A network's time, beside a velocity that a solver finds its way along."""

    def __init__(self, network: Velocity, device: str) -> None:
        self.network, self.device, self.seconds = network, device, 0.0

    def now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        start = self.now()
        v = Gaussian()(t, x) + 0 * self.network(t, x)
        self.seconds += self.now() - start
        return v


def overhead(device: str, batches: list[int], repeats: int, rows: int, columns: int) -> None:
    """Share of the time outside the network. On a GPU every call is waited for, which no solution does by itself."""
    torch.manual_seed(0)
    network = build_backbone({"name": "hdit"}, build_sensor("hdl64e", rows, columns).rays(), 2).to(device).eval()
    print(f"overhead beside HDiT at 2 x {rows} x {columns}, {device}, {torch.get_num_threads()} threads")
    for method in ("bosh3", "dopri5"):
        for batch in batches:
            x_0 = torch.randn(batch, 2, rows, columns, device=device)
            shares, per_call = [], []
            for repeat in range(repeats + 1):
                timed = Timed(network, device)
                with torch.inference_mode():
                    start = timed.now()
                    solution = solve(timed, x_0, method=method, tolerance=1e-2)
                    whole = timed.now() - start
                if repeat:  # the first one warms up
                    shares.append(whole / timed.seconds - 1)
                    per_call.append(timed.seconds / solution.evaluations.max().item())
            print(
                f"  {method:6s} batch {batch}: {statistics.median(shares):.2%} (of {repeats}: {min(shares):.2%} to "
                f"{max(shares):.2%}), a call of the network {1e3 * statistics.median(per_call):.1f} ms"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--elements", type=int, default=256)
    parser.add_argument("--overhead", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--batch", nargs="+", type=int, default=[1])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rows", type=int, default=64)
    parser.add_argument("--columns", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    mixed_batch("mixed batch", [RayDrop()], options.seeds, options.elements)
    mixed_batch("mixed batch with a jump in time", [RayDrop(), Discontinuous()], options.seeds, options.elements)
    hard_among_easy(options.elements)
    if options.overhead:
        overhead(options.device, options.batch, options.repeats, options.rows, options.columns)


if __name__ == "__main__":
    main()
