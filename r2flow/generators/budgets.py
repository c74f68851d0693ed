"""How accurate a flow's samples are for how many steps, as measured on a few scans and kept with the flow."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from r2flow.errors import InputError
from r2flow.registry import Count, check_options

MARGIN = 2.0  # of 12 other scans of a flow that was measured on 4, the worst was up to 2.0 times as far off


@dataclass(frozen=True)
class Budget:
    """What a number of steps of the flow's own sampler gives, a value for each scan.

    Attributes:
        steps: Of a predictor-corrector.
        errors: Root mean square difference to the exact end in model space.
        metres: The same of the range, over the rays that both return.
        corrections: `r2flow.flow.solvers.Solution.correction`.
    """

    steps: Count
    errors: tuple[float, ...]
    metres: tuple[float, ...]
    corrections: tuple[float, ...]

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """From plain values, as a checkpoint holds them.

        Raises:
            InputError: they are none.
        """
        check_options("accuracy", cls, values)
        lists = {key: tuple(values[key]) for key in ("errors", "metres", "corrections")}
        return cls(int(values["steps"]), **lists)

    def asdict(self) -> dict[str, Any]:
        """Plain values, as a checkpoint holds them."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}


def levels(budgets: Sequence[Budget], error: float, metres: bool = False) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """`levels` and `limits` of a sampler whose scans shall have at most this error.

    Half of the error is aimed at (`MARGIN`), for a correction is an estimate and no bound. It passes where even the
    scan whose correction was smallest for its error has at most that. The first number of steps is the one with the
    fewest evaluations for all measured scans together; then comes the one at which all of them arrived, then twice as
    many and more, for scans that are unlike them.

    Raises:
        InputError: no number of steps is enough.
    """
    values = [budget.metres if metres else budget.errors for budget in budgets]
    aim = error / MARGIN
    whole = next((i for i, value in enumerate(values) if max(value) <= aim), None)
    if whole is None:
        best = MARGIN * min(map(max, values), default=float("inf"))
        raise InputError(
            f"an error of {error:g}{' m' * metres} is less than this flow's sampler reaches in {budgets[-1].steps} "
            f"steps, {best:.2g}; give a larger one, or --solver dopri5 and a --tolerance."
        )
    limits = [
        aim * min((c / e for c, e in zip(budget.corrections, value, strict=True) if e > 0), default=0.0)
        for budget, value in zip(budgets, values, strict=True)
    ]

    def evaluations(first: int) -> int:
        again = sum(correction > limits[first] for correction in budgets[first].corrections)
        return budgets[first].steps * len(values[first]) + again * budgets[whole].steps * (first != whole)

    first = min(range(whole + 1), key=evaluations)
    chosen = [first] if first == whole else [first, whole]
    for i in range(whole + 1, len(budgets)):
        if budgets[i].steps >= 2 * budgets[chosen[-1]].steps:
            chosen.append(i)
    return tuple(budgets[i].steps for i in chosen), tuple(limits[i] for i in chosen[:-1])
