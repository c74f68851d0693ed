"""Vehicles: cars of several shapes, vans, lorries, bicycles."""

import math
from typing import NamedTuple

from r2flow.simulator.scene import BODY, CABIN, SceneBuilder
from r2flow.simulator.shapes import Boxes, Frusta


class Form(NamedTuple):
    """Dimensions of a car in metres; leans are metres inwards per metre of height."""

    share: float
    length: float
    width: float
    waist: float  # height of the lower edge of the panes
    roof: float
    screen: float  # lean of the windscreen
    rear: float  # lean of the rear window
    cabin: float  # share of the length that is cabin
    shift: float  # of the cabin's middle to the back, as a share of the length


_CARS = (
    Form(0.32, 4.0, 1.70, 0.90, 1.47, 0.80, 0.25, 0.72, 0.08),  # hatchback
    Form(0.24, 4.6, 1.78, 0.90, 1.43, 0.95, 0.85, 0.62, 0.03),  # saloon
    Form(0.22, 4.7, 1.80, 0.92, 1.47, 0.90, 0.20, 0.72, 0.10),  # estate
    Form(0.12, 4.5, 1.86, 1.00, 1.70, 0.60, 0.20, 0.74, 0.10),  # tall
    Form(0.10, 4.9, 1.92, 1.05, 1.95, 0.50, 0.05, 0.84, 0.08),  # van
)
_SILL, _BONNET = 0.22, 0.70  # metres: heights of the body's lower edge and of the bonnet's front


def car(b: SceneBuilder, x: float, y: float, yaw: float, moving: bool = False) -> None:
    """A body with plates, a bonnet that rises to the windscreen, a cabin with panes, four wheels."""
    draws = b.draws
    form = draws.pick(_CARS, [form.share for form in _CARS])
    length, width = form.length * draws.uniform(0.94, 1.05), form.width * draws.uniform(0.97, 1.03)
    ground, label = b.level(x, y), "moving-car" if moving else "car"
    dark = draws.chance(0.45)
    paint, albedo = ("dark paint", b.albedo("dark paint")) if dark else ("paint", draws.uniform(0.12, 0.62))
    c, s = math.cos(yaw), math.sin(yaw)
    u, long = -form.shift * length, form.cabin * length
    cabin_x, cabin_y, waist = x + u * c, y + u * s, ground + form.waist
    bonnet = (length / 2 - (u + long / 2)) / (form.waist - _BONNET)  # leans all the way to the windscreen
    parts = (
        (Frusta(x, y, yaw, length, width, ground + _SILL, ground + _BONNET, 0.12, 0.08, 0.04), BODY),
        (Frusta(x, y, yaw, length - 0.1, width - 0.04, ground + _BONNET, waist, bonnet, 0.3, 0.10), BODY),
        (
            Frusta(cabin_x, cabin_y, yaw, long, width - 0.10, waist, ground + form.roof, form.screen, form.rear, 0.25),
            CABIN,
        ),
    )
    for part, pattern in parts:
        b.add(part, label, paint, albedo, pattern=pattern, base=ground)
    for i in (-1, 1):
        for j in (-1, 1):
            u, v = i * length * 0.30, j * (width / 2 - 0.10)
            wheel = Boxes(x + u * c - v * s, y + u * s + v * c, yaw, 0.60, 0.22, ground, ground + 0.62)
            b.add(wheel, label, "rubber")


def truck(b: SceneBuilder, x: float, y: float, yaw: float, moving: bool = False) -> None:
    """A delivery van or lorry: cab in front of a box on wheels."""
    length, width, height = b.draws.uniform(5.5, 9.5), b.draws.uniform(2.0, 2.5), b.draws.uniform(2.4, 3.6)
    ground, label = b.level(x, y), "moving-truck" if moving else "truck"
    c, s = math.cos(yaw), math.sin(yaw)
    cab = 1.9
    albedo = b.draws.uniform(0.2, 0.7)
    front, rear = (length - cab) / 2, -cab / 2
    b.add(
        Frusta(x + front * c, y + front * s, yaw, cab, width - 0.1, ground + 0.45, ground + 2.3, 0.25, 0, 0.04),
        label, "paint", albedo, pattern=BODY, base=ground,
    )  # fmt: skip
    b.add(
        Boxes(x + rear * c, y + rear * s, yaw, length - cab, width, ground + 0.75, ground + height),
        label, "paint", b.draws.uniform(0.2, 0.7),
    )  # fmt: skip
    for u in (-0.35 * length, 0.34 * length):
        for v in (-width / 2 + 0.16, width / 2 - 0.16):
            wheel = Boxes(x + u * c - v * s, y + u * s + v * c, yaw, 0.9, 0.3, ground, ground + 0.9)
            b.add(wheel, label, "rubber")


def bicycle(b: SceneBuilder, x: float, y: float, yaw: float, label: str = "bicycle") -> None:
    """Two wheels of spokes and a frame."""
    ground, c, s = b.level(x, y), math.cos(yaw), math.sin(yaw)
    for u in (-0.52, 0.52):
        wheel = Boxes(x + u * c, y + u * s, yaw, 0.62, 0.05, ground, ground + 0.66)
        b.add(wheel, label, "rubber", closed=0.4)
    b.add(Boxes(x, y, yaw, 0.9, 0.06, ground + 0.35, ground + 0.95), label, "metal", closed=0.5)
