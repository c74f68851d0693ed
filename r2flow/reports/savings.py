"""What a flow's scans can leave out: evaluations and seconds, in `r2flow report solvers`."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.flow.solvers import TORCHDIFFEQ, solve
from r2flow.generators import Flow, Generator, as_flow
from r2flow.lidar.region import MARGIN, region
from r2flow.model.sampling import evaluated_region
from r2flow.reports.backbones import timed
from r2flow.reports.tables import Part, Row, Table

_TOLERANCE = 1e-3
_END = 1 / 32  # before t = 1, where one Euler step ends
_SECTOR = (-45.0, 45.0)  # degrees
_COLUMNS = {
    "saving": "left out",
    "whole_evaluations": "evaluations of all",
    "evaluations": "without it",
    "seconds_share": "share of the time",
}


@torch.inference_mode()
def savings(generator: Generator, num: int, seed: int = 0) -> list[Row]:
    """Evaluations a scan with and without each saving, and its share of the time, by dopri5."""
    flow = as_flow(generator, "report solvers")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    flow.velocity(x_0.new_zeros(()), x_0[:1])  # warm up

    def solved(method: str, t_1: float = 1.0) -> tuple[float, float]:
        """Mean evaluations and seconds a scan."""
        run = partial(solve, flow.velocity, x_0, t_1=t_1, method=method, tolerance=_TOLERANCE)
        solution, seconds = timed(run, x_0.device)
        return float(solution.evaluations.double().mean()), seconds / num

    own = solved("dopri5")
    common = solved(f"{TORCHDIFFEQ}dopri5")
    evaluations, seconds = solved("dopri5", 1 - _END)
    early = evaluations + 1, seconds * (evaluations + 1) / evaluations
    rows = [
        _row(f"steps of {num} scans in one size (torchdiffeq)", common, own),
        _row(f"steps after t = {1 - _END:.3f}: one Euler step", own, early),
    ]
    rows += _of_region(flow, x_0[:1])
    rows.append(_row("reflectance: the network computes both channels", own, own))
    return rows


def _of_region(flow: Flow, x: Tensor) -> list[Row]:
    """Time of an evaluation on a quarter of the turn; none of a network that cannot be cropped."""
    wanted = region(flow.space.shape[1:], _SECTOR, None, MARGIN)
    try:
        part = evaluated_region(flow, wanted)
        cropped = as_flow(flow.part(part), "a region")
    except InputError:
        return []
    t = x.new_zeros(())
    cropped.velocity(t, part.crop(x))  # warm up
    whole = [timed(partial(flow.velocity, t, x), x.device)[1] for _ in range(5)]
    parts = [timed(partial(cropped.velocity, t, part.crop(x)), x.device)[1] for _ in range(5)]
    return [_row("three quarters of the turn: --sector -45,45", (1, min(whole)), (1, min(parts)))]


def _row(saving: str, whole: tuple[float, float], left: tuple[float, float]) -> Row:
    return {
        "saving": saving,
        "whole_evaluations": whole[0],
        "evaluations": left[0],
        "seconds_share": left[1] / whole[1],
    }


def savings_text(rows: Sequence[Row]) -> list[Part]:
    """Section of the report; none without rows."""
    if not rows:
        return []
    return [
        "## Savings",
        f"What scans of this flow can leave out, by dopri5 at tolerance {_TOLERANCE:g}:",
        Table(rows, _COLUMNS),
    ]
