"""The floor of a distance: what it is between real scans, which a generator cannot be expected to go below."""

from collections.abc import Mapping

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError


def floor_sets(real: ScanSet, generated: Mapping[str, ScanSet] | None = None) -> dict[str, tuple[ScanSet, ScanSet]]:
    """The two halves of the real scans, and two drives where there are two; by name.

    Halves are contiguous blocks: neighbouring scans of a drive are near-duplicates, and random halves would share
    places. The two drives are those with most scans. Distances fall with the number of scans, so generated scans that
    need not be sampled again are compared with the first half as well, as many as the second half has.

    Raises:
        InputError: fewer than two real scans.
    """
    count = len(real)
    if count < 2:
        raise InputError(f"{real.label} holds {count} scan; --floor needs at least two real ones.")
    first, second = range(count // 2), range(count // 2, count)
    half, other = real.part(first, "first half"), real.part(second, "second half")
    found = {"real halves": (half, other)}
    for name, one in (generated or {}).items():
        if not one.source.drawn and len(one) >= len(other):
            found[f"{name}, as many"] = half, one.limited(len(other))
    largest = sorted(real.drives, key=lambda drive: -len(real.drives[drive]))[:2]
    if len(largest) == 2:
        a, b = (real.part(list(real.drives[drive]), f"drive {drive}") for drive in sorted(largest))
        found["real drives"] = a, b
    return found
