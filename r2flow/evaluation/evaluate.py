"""Evaluate generated scans: comparisons with real ones, references, baselines and copies."""

from collections.abc import Mapping

from r2flow.base.processes import rank_and_world_size
from r2flow.data.sets import ScanSet
from r2flow.evaluation.comparing import Comparer, Comparison, pairs_of, with_equal_panels
from r2flow.evaluation.copies import find_nearest, with_copies

_REAL = "the real scans"


def evaluate(
    real: ScanSet,
    judged: Mapping[str, ScanSet],
    compare: Comparer,
    training: ScanSet | None = None,
    reference: bool | None = None,
    baselines: bool | None = None,
    device: str = "cpu",
) -> list[Comparison]:
    """Compare sets of scans with real ones. Processes share the work; the first has the copies.

    Args:
        judged: The sets by name, as of `r2flow.evaluation.sets.sampled_set`.
        compare: Metrics, their protocol, and where results are kept.
        training: Scans of which copies are looked for; None: copies are not.
        reference: Whether real scans are compared with each other; None: if any set is judged.
        baselines: The same of noise, flat ground, mean scan, shuffled pixels.

    Raises:
        InputError: a set without what a metric needs, or without returns.
    """
    compare.check([real, *judged.values()])
    compare.rules.check(real)
    pairs = pairs_of(real, judged, reference, baselines)
    comparisons = with_equal_panels([compare(*pair) for pair in pairs])
    if training and rank_and_world_size()[0] == 0:
        nearest = find_nearest({**judged, _REAL: real}, training, compare.work, device)
        comparisons = with_copies(comparisons, nearest, nearest.pop(_REAL))
    return comparisons
