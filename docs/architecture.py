"""Draws docs/images/architecture.svg from the imports: python docs/architecture.py [--check]

Where a room stands is written here; the lines between rooms are what grimp finds.
"""

import sys
from pathlib import Path

import grimp

PICTURE = Path(__file__).parent / "images" / "architecture.svg"

# Rooms from the top down: row, column, modules, and what happens there.
ROOMS = {
    "cli": (0, 1, ("cli", "launch"), "verbs and processes"),
    "training": (1, 1, ("training", "chain", "composing"), "from a config to a run"),
    "export": (1, 2, ("export", "onnx_graphs", "hub"), "a flow for other programs"),
    "callbacks": (2, 1, ("callbacks",), "when things happen in a run"),
    "reports": (3, 1, ("reports", "accuracy", "inversion"), "tables, pictures, pages"),
    "evaluation": (4, 0, ("evaluation",), "sets of scans compared"),
    "runs": (4, 1, ("runs", "lineage"), "run folders"),
    "stages": (5, 1, ("stages",), "how a generator is learned"),
    "checkpoints": (
        6,
        1,
        ("model", "growing"),
        "a generator on disk; its scans",
    ),
    "data": (7, 1, ("data",), "data sets, pairs, batches"),
    "metrics": (8, 0, ("metrics",), "distances, their networks"),
    "simulator": (8, 1, ("simulator",), "street scenes, ray-cast"),
    "systems": (7, 2, ("systems",), "GANs, diffusions, latents, scores"),
    "generators": (8, 2, ("generators", "samplers"), "noise in, scan out"),
    "lidar": (9, 0, ("lidar",), "sensors, range images, files"),
    "flow": (10, 1, ("flow",), "path, times, losses, solvers"),
    "backbones": (9, 2, ("backbones",), "networks v(t, x)"),
}
# What all rooms stand on; lines to it would cover the others.
GROUND = (
    "config", "plugins", "store", "processes", "registry", "models", "devices", "memory", "noise", "files", "hashing",
    "progress", "signals", "errors",
)  # fmt: skip

WIDE, HIGH, ACROSS, DOWN, EDGE = 206, 52, 232, 88, 26  # size of a room, from one to the next, margin
SIZE = (2 * EDGE + 2 * ACROSS + WIDE, 2 * EDGE + 11 * DOWN + HIGH - 18)


def imports() -> dict[str, set[str]]:
    """Which rooms each room imports directly."""
    room_of = {module: room for room, (_, _, modules, _) in ROOMS.items() for module in modules}
    graph = grimp.build_graph("r2flow")
    found: dict[str, set[str]] = {room: set() for room in ROOMS}
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            here, there = (name.partition("r2flow.")[2].partition(".")[0] for name in (module, imported))
            unknown = {here, there} - {*room_of, *GROUND, ""}
            if unknown:
                sys.exit(f"docs/architecture.py has no room for r2flow/{min(unknown)}: enter it into ROOMS or GROUND.")
            if {here, there} <= room_of.keys() and room_of[here] != room_of[there]:
                found[room_of[here]].add(room_of[there])
    return found


def lines() -> list[tuple[str, str]]:
    """The imports between rooms without those that follow from others."""
    direct = imports()

    def below(room: str) -> set[str]:
        return direct[room].union(*map(below, direct[room]))

    return [(room, other) for room in ROOMS for other in ROOMS
            if other in direct[room] and not any(other in below(between) for between in direct[room])]  # fmt: skip


def corner(room: str) -> tuple[int, int]:
    row, column, *_ = ROOMS[room]
    return EDGE + column * ACROSS, EDGE + row * DOWN


def box(x: int, y: int, wide: int, name: str, subject: str, fill: str, edge: str) -> list[str]:
    middle = x + wide / 2
    return [
        f'<rect x="{x}" y="{y}" width="{wide}" height="{HIGH}" rx="8" fill="{fill}" stroke="{edge}"/>',
        f'<text x="{middle:g}" y="{y + 22}" font-size="16" font-weight="600" fill="#1c2733">{name}</text>',
        f'<text x="{middle:g}" y="{y + 41}" font-size="13" fill="#44525f">{subject}</text>',
    ]


def drawn() -> str:
    """The picture as SVG."""
    width, height = SIZE
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="system-ui, sans-serif" text-anchor="middle">',
        f'<rect width="{width}" height="{height}" rx="12" fill="#f7f8fa"/>',
    ]
    for room, other in lines():
        (x_0, y_0), (x_1, y_1) = corner(room), corner(other)
        row, column, *_ = ROOMS[room]
        passed = {(between, column) for between in range(row + 1, ROOMS[other][0])}
        if y_0 >= y_1 or passed & {place[:2] for place in ROOMS.values()}:
            sys.exit(f"the line from {room} to {other} does not fall, or crosses rooms: change their places in ROOMS.")
        x_0, y_0, x_1, turn = x_0 + WIDE // 2, y_0 + HIGH, x_1 + WIDE // 2, y_1 - (DOWN - HIGH)
        middle = (turn + y_1) // 2  # down its own column, and over to the other one in the last gap
        parts.append(
            f'<path d="M{x_0} {y_0} V{turn} C{x_0} {middle} {x_1} {middle} {x_1} {y_1}" fill="none" '
            'stroke="#7d8a99" stroke-width="1.6"/>'
        )
    for room, (_, _, _, subject) in ROOMS.items():
        parts += box(*corner(room), WIDE, room, subject, "#dbe9fb", "#4a7fc1")
    ground = "config, registry, noise, files, errors, ..."
    parts += box(
        EDGE, height - EDGE - HIGH, width - 2 * EDGE, ground, "every room may import these", "#e9ebee", "#9aa3ad"
    )
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    if "--check" not in sys.argv:
        PICTURE.write_text(drawn())
    elif PICTURE.read_text() != drawn():
        sys.exit(f"{PICTURE.name} is not that of today's imports: python docs/architecture.py")
