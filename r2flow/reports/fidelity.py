"""One set of scans beside real ones: next to other real drives, and next to controls that know nothing of scenes."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2flow.data.opening import open_scans, refuse_parts
from r2flow.data.reading import Reading
from r2flow.data.sources import spread
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.fidelity import PANEL, PER_PIXEL, controls, distances, nearest, panel
from r2flow.metrics.scans import check_values
from r2flow.progress import track
from r2flow.reports.tables import table

Statistics = Mapping[str, np.ndarray]
Distances = Mapping[str, Mapping[str, float]]

MEMBERS = PANEL | PER_PIXEL
DRIVE = 4  # scans: fewer are no drive that another can be compared to
CLEARLY = 0.5  # a member tells controls from real scans where the floor is below this share of the nearest control
WITHIN = 2.0  # floors: as near to the real scans as can be asked of scans of other places
# What the floor is, the first that there is.
FLOORS = {
    "other real scans": "the distance of the real scans given as --floor",
    "training scans": "the distance of the training scans",
    "drive against drive": "the mean distance of two of the real drives",
}


def load_scans(spec: str | Path, reading: Reading, most: int = 1000) -> tuple[np.ndarray, list[str]]:
    """At most `most` of the scans that a name stands for (`open_scans`), evenly spread, and the drive of each.

    Returns:
        Images, (N, 2 or 1, H, W), and names, (N,).

    Raises:
        InputError: no scan there, one that is not of the reading's sensor, or values that no scan has.
    """
    whole = open_scans(spec, reading)
    refuse_parts(spec)
    scans = whole.spread(most)
    numbers = track(range(len(scans)), f"reading {spec}", "scans", least=32)
    images = np.stack([scans.source[number] for number in numbers])
    check_values(torch.from_numpy(images), [f"{number} of {spec}" for number in spread(len(whole), most)])
    drives = {number: f"{spec}: {drive}" for drive, held in scans.drives.items() for number in held}
    return images, [drives.get(number, str(spec)) for number in range(len(scans))]


def joined(sets: Sequence[np.ndarray]) -> np.ndarray:
    """Sets of images as one set; with reflectance where all have it."""
    channels = min(images.shape[1] for images in sets)
    return np.concatenate([images[:, :channels] for images in sets])


def compare_sets(
    real: np.ndarray,
    other: np.ndarray,
    sensor: Sensor,
    training: np.ndarray | None = None,
    seed: int = 0,
    floor: np.ndarray | None = None,
    drives: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, Statistics]]:
    """Distances from `real` of `other`, of other real scans where there are any, and of four controls.

    The controls are made of the training scans; without these of the floor's; without these of the real ones, which
    flatters them. The floor is the distance between real scans of different places: that of the `floor` scans; without
    these that of the training scans; without these the mean distance of two of the real drives.

    Args:
        floor: Further real scans, of other places than `real`.
        drives: For each real scan the name of its drive; drives of fewer than 4 scans are not compared.

    Returns:
        `{sets: {name: {line: distance}}, floor: {line: distance}, floor_is: name, blind: [line], won: [line],
        lost: [line], beyond: [line], per_pixel: {name: {line: distance}}, nearest: {name: (median, least)}}`, and the
        statistics of every set. A line is won where `other` is nearer to `real` than every control, and beyond where
        it is more than twice the floor away; lines that do not tell the floor from the controls are blind and neither
        won nor lost.
    """
    given = {"real": real, "other": other, "other real scans": floor, "training scans": training}
    sets = {name: images for name, images in given.items() if images is not None}
    channels = min(images.shape[1] for images in sets.values())
    sets = {name: images[:, :channels] for name, images in sets.items()}
    base = next(sets[name] for name in ("training scans", "other real scans", "real") if name in sets)
    made = controls(base, sensor, max(len(other), 8), seed)
    statistics: dict[str, Statistics] = {name: panel(images, sensor, MEMBERS) for name, images in (sets | made).items()}
    apart = {name: distances(found, statistics["real"]) for name, found in statistics.items() if name != "real"}
    if between := _between_drives(sets["real"], drives, sensor):
        apart = {"other": apart.pop("other"), "drive against drive": between, **apart}
    judged, per_pixel = (
        {name: {line: value for line, value in d.items() if line in members} for name, d in apart.items()}
        for members in (PANEL, PER_PIXEL)
    )
    result: dict[str, Any] = {
        "sizes": {name.removesuffix(" scans"): len(images) for name, images in sets.items()},
        "sets": judged,
        **_verdicts(judged, list(made)),
        "per_pixel": per_pixel,
    }
    if training is not None:
        compared = {"other": other, "real": real, "training scans": training, **made}
        found = {n: nearest(images, training, sensor, n == "training scans") for n, images in compared.items()}
        result["nearest"] = {name: (float(np.median(d)), float(d.min())) for name, d in found.items()}
    return result, statistics


def _verdicts(table: Distances, made: Sequence[str]) -> dict[str, Any]:
    """The floor, and the lines that are blind, won, lost and beyond it."""
    floor_is = next((name for name in FLOORS if name in table), None)
    found, floor = table["other"], dict(table[floor_is]) if floor_is else {}
    least = {line: min(table[name][line] for name in made) for line in found}
    blind = [line for line in floor if floor[line] > CLEARLY * least[line]]
    seeing = [line for line in found if line not in blind]
    return {
        "floor_is": floor_is,
        "floor": floor,
        "blind": blind,
        "won": [line for line in seeing if found[line] < least[line]],
        "lost": [line for line in seeing if found[line] >= least[line]],
        "beyond": [line for line in seeing if floor and found[line] > WITHIN * floor[line]],
    }


def _between_drives(real: np.ndarray, drives: Sequence[str], sensor: Sensor) -> dict[str, float]:
    """The mean distance of two drives, over all pairs of them; empty where there are not two."""
    names = [name for name in dict.fromkeys(drives) if drives.count(name) >= DRIVE]
    found = [panel(real[[d == name for d in drives]], sensor, MEMBERS) for name in names]
    pairs = [distances(a, b) for a, b in combinations(found, 2)]
    return {line: float(np.mean([pair[line] for pair in pairs])) for line in pairs[0]} if pairs else {}


def markdown(result: Mapping[str, Any], name: str = "other") -> str:
    """The result as Markdown tables; `name` stands for the set that was judged."""
    sets, floor = result["sets"], result["floor"]
    rows = []
    for line, own in sets["other"].items():
        cells = [f"{found[line]:.4f}" for found in sets.values()]
        if line in result["won"]:
            cells[0] = f"**{cells[0]}**"
        rows.append([line, *cells, *([f"{own / max(floor[line], 1e-9):.2f}"] if floor else [])])
    headings = ["distance to the real scans", *_named(sets, name), *([f"{name} / floor"] if floor else [])]
    lists = {key: "; ".join(result[key]) or "nowhere" for key in ("won", "lost", "beyond", "blind")}
    about = "No floor: give --floor OTHER_REAL, or real scans of several drives, to see what real scans come to."
    if floor:
        about = f"The floor is {FLOORS[result['floor_is']]}. Farther than twice the floor: {lists['beyond']}."
    if result["blind"]:
        about += f"\nNot judged, as they hardly tell this floor from the controls: {lists['blind']}."
    parts = [
        table(rows, headings),
        f"Nearer to the real scans than every control (bold): {lists['won']}.\nNot yet: {lists['lost']}.",
        about,
    ]
    if "nearest" in result:
        near = zip(_named(result["nearest"], name), result["nearest"].values(), strict=True)
        rows = [[key, f"{median:.3f}", f"{least:.3f}"] for key, (median, least) in near]
        parts.append(table(rows, ["distance to the nearest training scan (RMS in model space)", "median", "least"]))
    sizes = ", ".join(f"{count} {key}" for key, count in result["sizes"].items() if count)
    return "\n\n".join([*parts, f"Scans: {sizes}."])


def per_pixel_table(result: Mapping[str, Any], name: str = "other") -> str:
    """The statistics of single pixels, which judge nothing, as a Markdown table."""
    sets = result["per_pixel"]
    rows = [[line, *(f"{found[line]:.4f}" for found in sets.values())] for line in sets["other"]]
    return table(rows, ["distance to the real scans", *_named(sets, name)])


def _named(sets: Mapping[str, Any], name: str) -> list[str]:
    return [name if key == "other" else key for key in sets]
