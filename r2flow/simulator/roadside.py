"""Roadsides: houses, gardens, street furniture, parked and moving vehicles, people."""

from math import pi
from typing import Any, NamedTuple

from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.kinds import KINDS, draw_ground
from r2flow.simulator.lasers import RIGS
from r2flow.simulator.objects import ObjectBuilder
from r2flow.simulator.scene import Scene
from r2flow.simulator.streets import Pose, Street

_END = 82.0  # metres: maximum distance of objects from the sensor
_CLEAR = 3.2  # metres around the sensor that stay empty


class _Strip(NamedTuple):
    """A strip along a side of a street, `length` metres from u on."""

    street: Street
    sign: int  # +1 for the left side, -1 for the right
    u: float
    length: float

    @property
    def stop(self) -> float:
        return self.u + self.length

    def place(self, u: float, out: float) -> Pose:
        """The point at u metres along the street and `out` metres from its centre line."""
        return self.street.place(u, self.sign * out)

    def middle(self, out: float, shift: float = 0.0) -> Pose:
        return self.place(self.u + self.length / 2 + shift, out)

    def ends(self, out: float) -> list[Pose]:
        return [self.place(self.u, out), self.place(self.stop, out)]

    def _anywhere(self, draws: ScalarDraws, edge: float, low: float, high: float) -> Pose:
        """A random place, low to high metres beyond the edge."""
        return self.place(self.u + draws.uniform(0, self.length), edge + draws.uniform(low, high))


class StreetBuilder(ObjectBuilder):
    """Draws the streets of a kind of place, with all that is beside and on them."""

    def draw(self) -> Scene:
        self.kind = self.pick(KINDS, [kind.share for kind in KINDS])
        self.ground = draw_ground(self, self.kind)
        streets = self.ground.streets
        for street in streets:
            start = max(-_END, street.start)
            for side in (1, -1):
                strip = _Strip(street, side, start, min(_END, street.stop) - start)
                self._line(strip)
                self._park(strip)
                self._furnish(strip)
            self._close_street(street)
        self._close_view()
        self._drive(streets[0])
        self._walk(streets[0])
        if self.kind.highway:
            self._guard(streets[0])
        return self.build(rig=self.pick(range(len(RIGS)), (0.7, 0.3)))

    def _free(self, room: float, *poses: Pose) -> bool:
        """Whether positions are `room` metres off all carriageways and pavements, within reach and
        not too near.
        """
        room += self.ground.pavement
        return all(
            _CLEAR < pose.away < _END + 5 and self.ground.off_street(pose.x, pose.y) > room
            for pose in poses
        )

    def _clear(self, street: Street, pose: Pose, room: float) -> bool:
        """Whether a position next to a street is within reach, not too near, and `room` metres off
        other streets.
        """
        others = (other for other in self.ground.streets if other != street)
        return 2.6 < pose.away < _END and all(other.away(pose.x, pose.y) > room for other in others)

    def _line(self, side: _Strip) -> None:
        """Place plots along a side of a street."""
        setback = self.uniform(*self.kind.setback)
        edge = side.street.half_width + side.street.pavement
        u = side.u + self.uniform(-4, 6)
        while u < side.stop:
            plot = side._replace(
                u=u, length=self.uniform(7, 16 if self.kind.storeys[0] < 3 else 24)
            )
            back = max(setback + self.normal(0, 0.2 * setback + 0.1), 0.2)
            if self.chance(self.kind.built) and self._house(plot, edge + back):
                self._garden(plot, edge, back)
            elif self.chance(0.2):
                self._car_park(plot, edge)
            else:
                self._green(plot, edge + 0.5)
            gap = side._replace(u=plot.stop, length=self.exponential(self.kind.gap))
            if gap.length > 2.5:  # a gate or wall, with trees behind
                pose = gap.middle(edge + back + 0.5)
                if self.chance(0.4) and self._free(gap.length / 2, pose):
                    self.fence(pose, gap.length * 0.9)
                self._green(gap, edge + back + 2)
            u = gap.stop

    def _house(self, plot: _Strip, edge: float) -> bool:
        """A house, if there is room, usually with an object behind it that limits the view."""
        width = self.uniform(8, 12)
        middle = plot.middle(edge + width / 2)
        if not self._free(0.3, *plot.ends(edge), *plot.ends(edge + width), middle):
            return False
        height = 2.9 * self.whole(*self.kind.storeys) + 0.3
        built = self.house(middle.turned(self.normal(0, 0.03)), plot.length, width, height)
        if built and self.chance(0.75):
            self._beyond(plot, edge + width)
        return built

    def _garden(self, plot: _Strip, edge: float, back: float) -> None:
        """Hedge or fence and plants between pavement and house."""
        if back > 1.2 and self._free(0.1, *plot.ends(edge + 0.6)):
            pose = plot.middle(edge + 0.6)
            if self.chance(self.kind.hedges):
                self.hedge(pose, plot.length * self.uniform(0.5, 1.0), self.uniform(0.8, 2.4))
            elif self.chance(self.kind.fences):
                self.fence(pose, plot.length * self.uniform(0.5, 1.0))
        for _ in range(self.poisson(self.kind.plants * plot.length / 10)):
            out = edge + self.uniform(0.3, max(back - 0.4, 0.6))
            self._plant(plot.place(plot.u + self.uniform(0, plot.length), out))

    def _plant(self, pose: Pose) -> None:
        if not self._free(0.2, pose):
            return
        if self.chance(0.5):
            self.tree(pose, self.uniform(0.7, 1.3))
        else:
            self.bush(pose, self.uniform(0.5, 1.3))

    def _green(self, plot: _Strip, edge: float) -> None:
        """A plot without a house: trees, bushes, thickets."""
        if self.chance(0.35):
            pose = plot.middle(edge + self.uniform(0.5, 3))
            half = plot.length / 2
            if self._free(0.1, pose.shifted(-half), pose.shifted(half)):
                self.hedge(pose, plot.length, self.uniform(1.0, 2.6))
        for _ in range(self.poisson(plot.length / 2.2)):
            self._plant(plot._anywhere(self, edge, 0.3, 14))
        for _ in range(self.poisson(plot.length / 6)):
            pose = plot._anywhere(self, edge, 7, 22)
            if self._free(3.5, pose):
                self.thicket(pose)

    def _car_park(self, plot: _Strip, edge: float) -> None:
        """A car park on a green plot: two rows of cars at right angles to the street."""
        for row in (3.5, 11.0):
            for slot in range(-3, 4):
                pose = plot.middle(edge + row, 2.7 * slot)
                if self.chance(0.6) and self._free(2.5, pose) and pose.away > _CLEAR + 2:
                    self.car(pose.turned(pi / 2 * self.side() + self.normal(0, 0.03)))
        self._beyond(plot, edge + 10)

    def _beyond(self, plot: _Strip, edge: float) -> None:
        """The second row: a house or tall trees that limit the view."""
        shift = self.uniform(-8, 8)
        pose = plot.middle(edge + self.uniform(12, 28), shift)
        if self.chance(0.5) and self._free(9, pose):
            self.house(pose, self.uniform(10, 20), self.uniform(8, 11), self.uniform(6, 12))
        elif self._free(4, pose):
            self.thicket(pose)

    def _close_street(self, street: Street) -> None:
        """Houses or trees across the far ends of a street, as at a bend."""
        for end, limit in ((-1, street.start), (1, street.stop)):
            if abs(limit) < _END:
                continue
            pose = street.place(end * self.uniform(50, 76), self.normal(0, 3))
            if self.chance(0.45):
                self.house(pose.turned(pi / 2), self.uniform(14, 26), 9, self.uniform(6, 11))
            elif self.chance(0.75):
                for _ in range(self.whole(1, 3)):
                    self.thicket(Pose(pose.x + self.normal(0, 3), pose.y + self.normal(0, 6), 0.0))

    def _close_view(self) -> None:
        """Distant woods and houses on all sides, off the streets."""
        for _ in range(22):
            pose = Pose(0.0, 0.0, self.uniform(-pi, pi)).shifted(self.uniform(38, 78))
            if self.chance(0.3) and self._free(12, pose):
                pose = pose._replace(yaw=self.uniform(0, pi))
                self.house(pose, self.uniform(12, 24), 9, self.uniform(5, 11))
            elif self._free(6, pose):
                self.woods(pose._replace(yaw=0.0))

    def _park(self, side: _Strip) -> None:
        """Parked cars along the kerb, partly on it, with gaps; or side by side, facing the kerb."""
        if self.chance(0.2) or self.kind.parked == 0:
            return
        street = side.street
        main = self.ground.streets[0]
        nose_in = self.chance(0.12)
        taken = self.kind.parked * self.uniform(0.3, 2.2)
        step, edge = (2.6, self.uniform(1.5, 2.5)) if nose_in else (5.5, self.uniform(-1.0, 0.7))
        u = side.u + self.uniform(0, 6)
        while u < side.stop:
            u += step + self.uniform(0, 0.15 * step)
            pose = street.lane(u, side.sign * (street.half_width + edge) + self.normal(0, 0.12))
            if not self._clear(street, pose, 5.0) or pose.away < _CLEAR:
                continue
            ahead, lateral = main.locate(pose.x, pose.y)
            in_ego_path = abs(lateral + main.offset) < 2.6 and abs(ahead) < 30
            if in_ego_path or not self.chance(taken):
                continue
            if self.chance(0.04) and not nose_in:
                self.truck(pose)
                u += 4
                continue
            turn = pi / 2 * self.side()
            self.car(pose.turned((turn if nose_in else 0) + self.normal(0, 0.03)))

    def _furnish(self, side: _Strip) -> None:
        """Lamp posts, signs, rows of trees, bollards, bins and bicycles along the kerb."""
        street = side.street
        edge = street.half_width + min(0.5, street.pavement / 2 + 0.2)
        u = side.u + self.uniform(0, 25)
        spacing = self.uniform(16, 37)
        alley = self.chance(0.3)
        while u < side.stop:
            pose = side.place(u, edge)
            if self._clear(street, pose, 0.6):
                if self.chance(0.7):
                    self.pole(pose)
                if self.chance(0.5):
                    place = side.place(u + self.uniform(-1, 1), edge + 0.2)
                    facing = pose.yaw + (pi if side.sign < 0 else 0)
                    self.sign(place._replace(yaw=facing + self.normal(0, 0.15)))
                if alley:
                    place = side.place(u + spacing / 2, edge + 0.3)
                    if self._free(-street.pavement, place):
                        self.tree(place, self.uniform(0.8, 1.4))
            u += spacing * self.uniform(0.7, 1.3)
        if street.pavement > 0:
            self._clutter(side, edge)

    def _clutter(self, side: _Strip, edge: float) -> None:
        if self.chance(0.25):
            start = self.uniform(-30, 20)
            for step in range(self.whole(3, 8)):
                pose = side.place(start + 2.2 * step, edge - 0.1)
                if self._clear(side.street, pose, 0.5):
                    self.bollard(pose)
        for _ in range(self.poisson(2.0)):
            pose = side.place(self.uniform(-40, 40), edge + side.street.pavement - 0.4)
            if self._clear(side.street, pose, 0.5):
                build: Any = self.pick((self.bin, self.bicycle, self.cabinet), (0.5, 0.25, 0.25))
                build(pose)

    def _drive(self, main: Street) -> None:
        """Moving vehicles: ahead and behind in the ego lane, oncoming in the other."""
        for _ in range(self.poisson(self.kind.traffic)):
            lane = -1 if self.chance(0.5) else 1
            u = self.uniform(8, 65) * (1 if self.chance(0.6) else -1)
            if main.start < u < main.stop:
                pose = main.lane(u, lane * main.half_width / 2)
                if self.chance(0.1):
                    self.truck(pose, "moving-truck")
                else:
                    self.car(pose, "moving-car")

    def _walk(self, main: Street) -> None:
        """People on the pavements, cyclists on the carriageway."""
        for _ in range(self.poisson(self.kind.people)):
            lateral = self.side() * (main.half_width + self.uniform(0.3, max(main.pavement, 0.6)))
            pose = main.place(self.uniform(-35, 35), lateral)
            if pose.away > _CLEAR:
                pose = pose.turned(pi if self.chance(0.5) else 0.0)
                self.person(pose, "moving-person" if self.chance(0.7) else "person")
        for _ in range(self.poisson(0.25 * self.kind.people)):
            lateral = self.side() * (main.half_width - 0.7)
            self.cyclist(main.lane(self.uniform(6, 40) * self.side(), lateral))

    def _guard(self, main: Street) -> None:
        """Guard rails on both sides."""
        for side in (1, -1):
            for u in range(-80, 80, 8):
                site = self.site(main.place(u + 4, side * (main.half_width + 0.8)))
                site.box(0, 0, 8.1, 0.12, 0.45, 0.78, "fence", "metal", 0.4)
