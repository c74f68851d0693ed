"""Times for a flow's fixed steps: found once, kept in a file, used by `r2flow sample --grid`."""

import json
import logging
from pathlib import Path

import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint, weights_hash
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.flow.solvers import GRIDS, SOLVERS, TORCHDIFFEQ, FixedStep, calibrated_grid, check_method
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.noise import Draws

log = logging.getLogger(__name__)


def calibrate(
    checkpoint: Checkpoint, steps: int, method: str = "euler", num: int = 4, progress: Progress = None
) -> Tensor:
    """Times that suit a flow better than equal steps (`r2flow.flow.solvers.calibrated_grid`), (steps + 1,) float64.

    They are found on other scans than those of `r2flow.sampling.sample`.

    Args:
        method: One of ours of fixed steps; its order decides the weight of a step.
        num: Scans.
        progress: Called after every evaluation (`evaluations_of_calibration`).

    Raises:
        InputError: another method, or fewer than one step.
    """
    solver = check_grid_solver(method)
    flow = as_flow(checkpoint.generator, "a time grid")
    x_0 = Draws(0, range(num), "validation").start(flow.noise_shape).to(flow.device)

    def velocity(t: Tensor, x: Tensor) -> Tensor:
        v = flow.velocity(t, x)
        if progress is not None:
            progress()
        return v

    with torch.no_grad():
        return calibrated_grid(velocity, x_0, steps, order=solver.order, fine=evaluations_of_calibration(steps))


def check_grid_solver(method: str) -> FixedStep:
    """The solver that a grid can be found for.

    Raises:
        InputError: it is none of ours, or chooses its own steps.
    """
    check_method(method)
    solver = None if method.startswith(TORCHDIFFEQ) else SOLVERS[method]
    if not isinstance(solver, FixedStep):
        raise InputError(f"a time grid is for one of our solvers of fixed steps, euler, ab2, rk4; found {method!r}.")
    return solver


def evaluations_of_calibration(steps: int) -> int:
    """How many evaluations `calibrate` takes."""
    return max(256, 8 * steps)


def write_grid(path: str | Path, times: Tensor, checkpoint: Checkpoint, method: str) -> None:
    """Times as JSON, with the flow and the solver that they are for."""
    content = {"steps": len(times) - 1, "times": times.tolist(), "method": method}
    content["checkpoint"] = weights_hash(checkpoint)
    with atomic_write(Path(path), "w") as file:
        file.write(json.dumps(content, indent=2) + "\n")


def read_grid(path: str | Path, checkpoint: Checkpoint) -> Tensor:
    """Times that `write_grid` has written, (N + 1,) float64; warns where they were found on another flow.

    Raises:
        InputError: a file that holds something else.
    """
    try:
        content = json.loads(Path(path).read_text("utf-8"))
        times = torch.tensor([float(t) for t in content["times"]], dtype=torch.float64)
        steps, owner = content["steps"], content["checkpoint"]
    except (ValueError, KeyError, TypeError, OverflowError):
        raise InputError(f"{path} is no time grid; 'r2flow calibrate' makes one.") from None
    rises = len(times) > 1 and bool((times.diff() > 0).all()) and times[0] == 0 and times[-1] == 1
    if not rises or steps != len(times) - 1:
        raise InputError(f"{path} is no time grid: its {len(times)} times must rise from 0 to 1 in {steps} steps.")
    if owner != weights_hash(checkpoint):
        log.warning("%s was calibrated on another flow than %s.", path, checkpoint.path)
    return times


def grid_of(text: str, checkpoint: Checkpoint) -> str | list[float]:
    """A grid by its name, or the times in a file of `write_grid`.

    Raises:
        InputError: neither.
    """
    if text.endswith(".json") or (text not in GRIDS and Path(text).exists()):
        return read_grid(text, checkpoint).tolist()
    GRIDS[text]
    return text
