"""The page of `r2flow report savings`: what was measured, in sentences, tables and two figures."""

from collections.abc import Callable, Sequence
from typing import Any

from r2flow.checkpoints import Checkpoint
from r2flow.reports.pages import Page, blank_figure
from r2flow.reports.savings import (
    ELEMENTS,
    EULER,
    FIXED,
    LEAVING,
    LONE,
    MIXED,
    ONE_STATE,
    STAYING,
    STRAIGHT,
    TOLERANCES,
    Row,
    channel_rows,
    exact_rows,
    region_rows,
    scene_rows,
)
from r2flow.reports.tables import shown, table

KIND_NAMES = {"straight": "straight", "gaussian": "smooth", "two_modes": "two modes", "ray_drop": "ray-drop"}
# Told apart without colour.
HATCHES = {
    "straight": ("#d9d9d9", ""),
    "gaussian": ("#9ecae1", "//"),
    "two_modes": ("#4a90c2", ".."),
    "ray_drop": ("#1b3a57", ""),
}


def savings_page(
    checkpoint: Checkpoint | None,
    num: int = 4,
    steps: int = 16,
    tolerance: float = 1e-3,
    seed: int = 0,
    command: str = "",
    advance: Callable[[], None] = lambda: None,
) -> Page:
    """All of it as a page, still to be written.

    Args:
        checkpoint: None leaves out what needs one.
        num: Scenes of the checkpoint's flow.
        steps: AB2 steps of the regions.
        tolerance: Of the checkpoint's adaptive solutions.
        advance: Called after every evaluation of the checkpoint's network.
    """
    mixed = exact_rows(MIXED, "mixed", TOLERANCES, seed)
    lone = [row for row in exact_rows(LONE, "one among 255", (1e-3,), seed) if row["tolerance"]]
    text = [_says_mixed(mixed), _mixed_table(mixed), _says_lone(lone), _lone_table(lone)]
    figures = {"savings_scenes": scenes_figure(mixed)}
    rows, device = [*mixed, *lone], "cpu"
    if checkpoint is not None:
        device = str(checkpoint.generator.device)
        scenes = scene_rows(checkpoint, num, tolerance, seed, advance)
        regions = region_rows(checkpoint, num, steps, seed, advance)
        channels = channel_rows(checkpoint)
        name = f"{checkpoint.config['backbone']['name']} at {'x'.join(map(str, checkpoint.sensor.shape))}"
        text += [_says_scenes(scenes, name, num), _scenes_table(scenes)]
        text += [_says_regions(regions, name, num, steps), _regions_table(regions)]
        text += [_says_channels(channels), _channels_table(channels)] if channels else []
        figures["savings_regions"] = regions_figure(regions)
        rows += scenes + regions + channels
    return Page("savings", "What a scene need not cost", text, rows, figures, command, {"noise": seed}, device)


def evaluations_of_page(num: int, steps: int) -> int:
    """About how many evaluations `savings_page` takes of a checkpoint: for a progress bar."""
    return 2 * FIXED + 270 + num * 7 * steps


def _of(rows: Sequence[Row], way: str, tolerance: float | None) -> Row:
    return next(row for row in rows if row["way"] == way and row["tolerance"] == tolerance)


def _says_mixed(rows: Sequence[Row]) -> str:
    parts = []
    for tolerance in TOLERANCES:
        base, ours = _of(rows, ONE_STATE, tolerance), _of(rows, LEAVING, tolerance)
        straight = _of(rows, STRAIGHT, tolerance)
        parts.append(
            f"At tolerance {tolerance:g}, own steps and leaving take {ours['evaluations'] / base['evaluations']:.2f} "
            "of the evaluations of a batch solved as one state, one step for the straight makes it "
            f"{straight['evaluations'] / base['evaluations']:.2f}; the hardest scene's error is "
            f"{shown(ours['worst_error'])} against {shown(base['worst_error'])}."
        )
    kinds = ", ".join(f"{count} {KIND_NAMES[kind]}" for kind, count in MIXED.items())
    return (
        f"## Easy and hard scenes in one batch\n\nExact problems, {ELEMENTS} elements a scene, float64: {kinds}. "
        + " ".join(parts)
        + " Seconds here are the solvers' own work, not a network's."
    )


def _mixed_table(rows: Sequence[Row]) -> str:
    columns = {"way": "way", "tolerance": "tolerance", "evaluations": "evaluations, all 16"}
    columns |= {f"evaluations_{kind}": f"a {KIND_NAMES[kind]} scene" for kind in MIXED}
    columns |= {f"error_{kind}": f"error, {KIND_NAMES[kind]}" for kind in MIXED}
    return table(rows, {**columns, "seconds": "seconds"})


def _says_lone(rows: Sequence[Row]) -> str:
    base, ours, straight = (_of(rows, way, 1e-3) for way in (ONE_STATE, LEAVING, STRAIGHT))
    return (
        "### One hard scene among 255 easy ones\n\n"
        f"At tolerance 1e-3 the batch's error norm hides it: its error is {shown(base['error_ray_drop'])} where the "
        f"batch is one state and {shown(ours['error_ray_drop'])} with steps of its own, at "
        f"{ours['evaluations'] / base['evaluations']:.2f} of the evaluations "
        f"({straight['evaluations'] / base['evaluations']:.2f} with one step for the straight)."
    )


def _lone_table(rows: Sequence[Row]) -> str:
    columns = {"way": "way", "evaluations": "evaluations, all 256", "evaluations_straight": "a straight scene"}
    columns |= {"evaluations_ray_drop": "the ray-drop scene", "error_ray_drop": "its error"}
    return table(rows, {**columns, "seconds": "seconds"})


def _says_scenes(rows: Sequence[Row], name: str, num: int) -> str:
    base, ours, straight = (next(row for row in rows if row["way"] == way) for way in (ONE_STATE, LEAVING, STRAIGHT))
    return (
        f"## Scenes of the flow\n\n{name}, {num} scenes in one batch, tolerance {ours['tolerance']:g}, errors in model "
        "space against the flow's own dopri5 solution at 1e-6. Own steps take "
        f"{ours['evaluations'] / base['evaluations']:.2f} of the evaluations and "
        f"{ours['seconds'] / base['seconds']:.2f} of the seconds of a batch as one state, with a worst error of "
        f"{shown(ours['worst_error'])} against {shown(base['worst_error'])}. {straight['straight']} of {num} scenes "
        "were straight to the tolerance; having looked for them, it is "
        f"{straight['evaluations'] / base['evaluations']:.2f}."
    )


def _scenes_table(rows: Sequence[Row]) -> str:
    columns = {"way": "way", "evaluations": "evaluations", "seconds": "seconds"}
    return table(rows, {**columns, "median_error": "median error", "worst_error": "worst error"})


def _says_regions(rows: Sequence[Row], name: str, num: int, steps: int) -> str:
    by_name = {row["way"]: row for row in rows}
    quarter, margin = by_name["sector of 90 degrees"], by_name["90 degrees out of 180 generated"]
    unrelated = quarter["unrelated"]
    against = f" ({quarter['error'] / unrelated:.0%} of the way to an unrelated scene)" if unrelated else ""
    return (
        f"## A part of the image\n\n{name}, {num} scenes, {steps} AB2 steps; the part against the same pixels of the "
        "whole image from the same noise. Seconds are an evaluation's, the least of several, times the steps. "
        "Attention and convolutions that are cut know the part alone, which makes it another scene, the more so the "
        f"more is cut. A sector of 90 degrees takes {quarter['time']:.2f} of the time and is {shown(quarter['error'])} "
        f"away in model space{against}; with a margin of 45 degrees on either side it takes "
        f"{margin['time']:.2f} and is {shown(margin['error'])} away. "
        "Whether the part is as good a scan as the whole one's is not measured here."
    )


def _regions_table(rows: Sequence[Row]) -> str:
    columns = {"way": "region", "share": "of the pixels", "seconds": "seconds a scan", "time": "of the time"}
    columns |= {"error": "RMS, model space", "unrelated": "unrelated scenes", "median_m": "median, m"}
    return table(rows, {**columns, "dropped": "rays lost or gained"})


def _says_channels(rows: Sequence[Row]) -> str:
    both, alone = rows
    saved = {
        key: f"{1 - alone[key] / both[key]:.0%}" if alone[key] < 0.95 * both[key] else "nothing measurable"
        for key in ("decoding", "writing", "bytes")
    }
    return (
        "## One channel\n\nBoth channels share their tokens: a network for the range alone takes "
        f"{alone['network'] / both['network']:.2f} of the time of one for both, so that `--channels range` saves "
        f"nothing there. Of the decoding it saves {saved['decoding']}, of the writing {saved['writing']}, of the bytes "
        f"{saved['bytes']} (PLY and range image). A model trained on range alone has no reflectance to compute."
    )


def _channels_table(rows: Sequence[Row]) -> str:
    columns = {"way": "channels", "network": "network, s", "decoding": "decoding, s", "writing": "writing, s"}
    return table(rows, {**columns, "bytes": "bytes"})


def scenes_figure(rows: Sequence[Row]) -> Any:
    """Evaluations of the mixed batch by way and kind of scene, the worst error beside them."""
    figure = blank_figure(11, 4.4, "8 straight, 4 smooth, 3 two-mode scenes and 1 of ray-drop in one batch")
    panels = figure.subplots(1, len(TOLERANCES), sharey=True)
    ways = [EULER, ONE_STATE, STAYING, LEAVING, STRAIGHT]
    for axes, tolerance in zip(panels, TOLERANCES, strict=True):
        chosen = [_of(rows, way, None if way == EULER else tolerance) for way in ways]
        begin = [0.0] * len(ways)
        for kind, count in MIXED.items():
            length = [count * row[f"evaluations_{kind}"] for row in chosen]
            colour, hatch = HATCHES[kind]
            label = f"{count} {KIND_NAMES[kind]}"
            axes.barh(range(len(ways)), length, left=begin, color=colour, hatch=hatch, edgecolor="black", lw=0.5,
                      height=0.62, label=label)  # fmt: skip
            begin = [a + b for a, b in zip(begin, length, strict=True)]
        for place, row in enumerate(chosen):
            axes.annotate(f" {row['evaluations']}; worst error {shown(row['worst_error'])}", (begin[place], place),
                          va="center", fontsize=8)  # fmt: skip
        axes.set(xlabel="evaluations, all 16 scenes", xlim=(0, 1.65 * max(begin)), title=f"tolerance {tolerance:g}")
        axes.set_yticks(range(len(ways)), ways, fontsize=8)
        axes.grid(alpha=0.3, axis="x")
        axes.set_axisbelow(True)
    panels[0].invert_yaxis()  # shared: the first way on top
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(MIXED), fontsize=8)
    return figure


def regions_figure(rows: Sequence[Row]) -> Any:
    """Share of the time and distance from the whole image, region by region."""
    figure = blank_figure(10, 3.6, "A part of the image instead of the whole")
    left, right = figure.subplots(1, 2, sharey=True)
    places = range(len(rows))
    left.barh(places, [row["time"] for row in rows], color="#9ecae1", edgecolor="black", lw=0.5, height=0.6)
    for place, row in zip(places, rows, strict=True):
        left.annotate(f" {row['time']:.2f}", (row["time"], place), va="center", fontsize=8)
    left.set(xlabel="share of the whole image's time", xlim=(0, 1.15))
    left.set_yticks(places, [row["way"] for row in rows], fontsize=8)
    left.invert_yaxis()
    errors = [row.get("error", 0.0) for row in rows]
    right.barh(places, errors, color="#d9d9d9", edgecolor="black", hatch="//", lw=0.5, height=0.6)
    for place, row in zip(places, rows, strict=True):
        metres = f", median {row['median_m']:.2g} m" if "median_m" in row else ""
        right.annotate(f" {shown(row.get('error', 0.0))}{metres}", (errors[place], place), va="center", fontsize=8)
    unrelated = [(row["unrelated"], place) for place, row in enumerate(rows) if row.get("unrelated")]
    if unrelated:
        right.plot(*zip(*unrelated, strict=True), "k|", ms=13, mew=1.6, label="two unrelated scenes")
        right.legend(fontsize=8, loc="upper right")
    furthest = max([*errors, *(value for value, _ in unrelated), 1e-9])
    right.set(xlabel="RMS distance from the whole image, model space", xlim=(0, 1.3 * furthest))
    for axes in (left, right):
        axes.grid(alpha=0.3, axis="x")
        axes.set_axisbelow(True)
    return figure
