"""The error of a flow's samples: which time grid makes it least, and which number of steps keeps it below a bound."""

import math
from dataclasses import replace

import torch

from r2flow.errors import InputError
from r2flow.flow.solvers import SOLVERS, FixedStep, check_method, fixed_step
from r2flow.generators import Budget, FlowMap, Sampler, as_flow, levels
from r2flow.generators.base import Progress
from r2flow.inversion import metres_apart, rms
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws

GRIDS = ("uniform", *(f"power:{p}" for p in (1.25, 1.5, 1.75, 2, 2.5, 3)), "power-start:1.5", "power-start:2")
STEPS = (4, 6, 8, 12, 16, 24, 32, 48, 64)
EXACT = Sampler("dopri5", tolerance=1e-6)


@torch.no_grad()
def calibrate(
    checkpoint: Checkpoint, steps: int = 16, method: str = "adams3", num: int = 4, progress: Progress = None
) -> Checkpoint:
    """The checkpoint with the sampler whose time grid suits its flow best, and with the errors that it has.

    Of `GRIDS` the one is taken whose median error of an element, against a tight solution, is least in this number of
    steps. A mean would be that of rays at edges and of scans that come to another end: long steps near t = 1, where
    surfaces become smooth, hardly count in it (docs/models/street.md). The scans are other ones than those of
    `r2flow.model.sampling.sample`.

    Args:
        method: A predictor-corrector: adams2, adams3 or adams4.
        num: Scans.
        progress: Called after every evaluation; there are about `evaluations_of_calibration`.

    Raises:
        InputError: another method, fewer than one step, a flow that has learned its steps, or that cannot be solved.
    """
    check_predictor_corrector(method)
    check_calibrates(checkpoint)
    flow = as_flow(checkpoint.generator, "a time grid")
    x_0 = Draws(0, range(num), "validation").start(flow.noise_shape).to(flow.device)
    exact = flow.solve(x_0.double(), sampler=EXACT, progress=progress)
    if not exact.converged.all():
        raise InputError("dopri5 does not solve this flow at a tolerance of 1e-6: there is nothing to measure against.")

    def typical(grid: str) -> float:
        found = flow.solve(x_0, sampler=Sampler(method, steps, grid=grid), progress=progress)
        return float((found.x - exact.x).abs().median()) if found.converged.all() else math.inf

    sampler = Sampler(method, steps, grid=min(GRIDS, key=typical))
    decoded = checkpoint.encoding.decode(exact.x.float())
    budgets = []
    for count in STEPS:
        found = flow.solve(x_0, sampler=replace(sampler, steps=count), progress=progress)
        assert found.correction is not None
        _, metres, _ = metres_apart(checkpoint.encoding.decode(found.x), decoded)
        budgets.append(Budget(count, *(_plain(x) for x in (rms(found.x - exact.x), metres, found.correction))))
    flow.sampler = sampler
    return replace(checkpoint, accuracy=tuple(budgets))


def check_calibrates(checkpoint: Checkpoint) -> None:
    """Refuse a generator that has learned its steps.

    Raises:
        InputError: it has, or it is no flow.
    """
    flow = as_flow(checkpoint.generator, "a time grid")
    if flow.sampler.fixed or isinstance(flow, FlowMap):
        raise InputError(
            f"{checkpoint.path} holds a {'flow map' if isinstance(flow, FlowMap) else 'flow'} that has learned its "
            "steps: there is no time grid to find, and its error is not known beforehand; give --steps."
        )


def _plain(x: torch.Tensor) -> tuple[float, ...]:
    return tuple(x.nan_to_num(math.inf).tolist())


def check_predictor_corrector(method: str) -> None:
    """Refuse another solver than a predictor-corrector.

    Raises:
        InputError: it is none.
    """
    check_method(method)
    found = fixed_step(method)
    if found is None or not found.corrects:
        known = ", ".join(n for n, solver in SOLVERS.items() if isinstance(solver, FixedStep) and solver.corrects)
        raise InputError(f"only predictor-correctors are calibrated: {known}; found {method!r}.")


def evaluations_of_calibration(steps: int) -> int:
    """About how many evaluations `calibrate` takes."""
    return 200 + len(GRIDS) * steps + sum(STEPS)


def sampler_within(checkpoint: Checkpoint, error: str) -> Sampler:
    """The flow's sampler with the number of steps that each scan needs for an error.

    Args:
        error: The largest one of a scan, root mean square: in metres of range as 0.05m, or in model space as 0.002.

    Raises:
        InputError: no such number, one that is out of reach, or a flow that has not been calibrated.
    """
    metres = error.endswith("m")
    try:
        value = float(error.removesuffix("m"))
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(f"--error must be metres of range, as 0.05m, or a number in model space; found {error!r}.")
    if not checkpoint.accuracy:
        check_calibrates(checkpoint)
        raise InputError(f"the errors of {checkpoint.path} are not known yet; measure them: r2flow calibrate -c RUN.")
    steps, limits = levels(checkpoint.accuracy, value, metres)
    # The errors were measured in float32.
    return replace(checkpoint.generator.sampler, levels=steps, limits=limits, precision="32-true")
