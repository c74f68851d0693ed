"""Real scans against real ones: how near to them a generator could come at all."""

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError


def floor_sets(real: ScanSet, generated: ScanSet | None = None) -> dict[str, tuple[ScanSet, ScanSet]]:
    """Two halves of the real scans, and one drive against another where there are two; by name.

    Halves are contiguous blocks: neighbours in a drive are near-duplicates, and random halves would share places. The
    two drives are those with most scans. Generated scans, where they need not be drawn again, are set against the first
    half too, as many as the second half has: distances fall with the number of scans, and this one is like for like.

    Raises:
        InputError: fewer than two real scans.
    """
    count = len(real)
    if count < 2:
        raise InputError(f"{real.label} holds {count} scan; a floor needs at least two real ones.")
    first, second = range(count // 2), range(count // 2, count)
    half, other = real.part(first, "first half"), real.part(second, "second half")
    found = {"real halves": (half, other)}
    if generated is not None and not generated.source.drawn and len(generated) >= len(other):
        found["generated, as many"] = half, generated.limited(len(other))
    largest = sorted(real.drives, key=lambda drive: -len(real.drives[drive]))[:2]
    if len(largest) == 2:
        a, b = (real.part(list(real.drives[drive]), f"drive {drive}") for drive in sorted(largest))
        found["real drives"] = a, b
    return found
