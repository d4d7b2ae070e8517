"""Points and markings that the rules of a game prescribe, by template."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.pitch import ArcSpec, LineSpec, PitchSpec

SIDES = {"left": -1.0, "right": 1.0}
ENDS = {"near": -1.0, "far": 1.0}

Place = tuple[float, float, float]
Sizes = Mapping[str, float]
"""Dimensions of the markings [m] by name."""


@dataclass(frozen=True)
class Markings:
    """What the rules of a game prescribe on a pitch or court.

    Attributes:
        points: (x, y, height above the surface) [m], world, by name.
        lines: straight markings on the surface.
        arcs: curved ones.
        goals: straight and white, but not painted: posts, crossbars, backboards, a net.
    """

    points: dict[str, Place] = field(default_factory=dict)
    lines: dict[str, LineSpec] = field(default_factory=dict)
    arcs: dict[str, ArcSpec] = field(default_factory=dict)
    goals: dict[str, LineSpec] = field(default_factory=dict)

    def without_missing(self, sizes: Sizes) -> Markings:
        """Return the markings without those that have a dimension of 0, and what rests on them."""
        kinds = ("_radius", "_depth", "_width", "_distance", "_height", "_top")
        gone = [
            name.removesuffix(kind)
            for name, size in sizes.items()
            for kind in kinds
            if size == 0.0 and name.endswith(kind)
        ]
        resting = {
            "goal": ["goal_post"],
            "attack_line": ["attack"],
            "restricted_area": ["restricted_area", "free_throw"],
            "basket": ["basket", "three_point", "no_charge"],
        }
        gone = [each for stem in gone for each in resting.get(stem, [stem])]

        def is_there(name: str) -> bool:
            return not any(name == stem or name.startswith(f"{stem}_") for stem in gone)

        points = {name: place for name, place in self.points.items() if is_there(name)}

        def keep(lines: dict[str, LineSpec]) -> dict[str, LineSpec]:
            return {
                name: line
                for name, line in lines.items()
                if is_there(name) and {line.start, line.end} <= points.keys()
                if points[line.start] != points[line.end]
            }

        arcs = {n: arc for n, arc in self.arcs.items() if is_there(n) and arc.center in points}
        return Markings(points, keep(self.lines), arcs, keep(self.goals))

    def place(self, name: str, size: tuple[float, float], at: Place) -> None:
        """Add points at (inwards from the goal line, off the long axis, height) [m].

        `{side}` and `{end}` in the name stand for all sides and ends; a name without a side lies on
        the halfway line. The size is length and width [m].
        """
        for out, toward, named in _spread(name):
            x = out * (0.5 * size[0] - at[0])
            self.points[named(name)] = (x, toward * at[1] + 0.0, at[2])

    def add_line(self, name: str, start: str, end: str, *, painted: bool = True) -> None:
        """Add straight markings between points, for all sides and ends in the names."""
        for _, _, named in _spread(name):
            line = LineSpec(start=named(start), end=named(end))
            (self.lines if painted else self.goals)[named(name)] = line

    def add_arc(self, name: str, center: str, radius: float, start: float, end: float) -> None:
        """Add arcs, for all sides and ends, with the angles [rad] of the left near one."""
        for out, toward, named in _spread(name):
            first, last = start, end
            if out > 0.0:
                first, last = math.pi - last, math.pi - first
            if toward > 0.0:
                first, last = -last, -first
            turn = 2.0 * math.pi if last <= 0.0 else 0.0
            self.arcs[named(name)] = ArcSpec(
                center=named(center), radius=radius, start_angle=first + turn, end_angle=last + turn
            )


def _spread(name: str) -> Iterator[tuple[float, float, Callable[[str], str]]]:
    """Yield the signs of x and y of every side and end that a name stands for, and the names."""
    seen = set()
    corners = (("left", "near"), ("right", "near"), ("right", "far"), ("left", "far"))
    for side, end in corners:
        named = functools.partial(str.format, side=side, end=end)
        if named(name) not in seen:
            seen.add(named(name))
            yield SIDES[side] if "{side}" in name else 0.0, ENDS[end], named


def prescribed_markings(spec: PitchSpec, size: tuple[float, float] | None = None) -> Markings:
    """Return the markings of a pitch's template, at the length and width of the spec, or [m]."""
    sizes = spec.sizes
    found = Markings()
    size = size or (spec.length, spec.width)
    _draw_border(found, size)
    {
        "football": _draw_football,
        "football_9v9": _draw_football,
        "futsal": _draw_futsal,
        "handball": _draw_handball,
        "basketball": _draw_basketball,
        "volleyball": _draw_volleyball,
    }[spec.template](found, size, sizes)
    points = dict(sorted(found.points.items(), key=lambda item: _rank(item[0])))
    lines, goals = (
        dict(sorted(each.items(), key=lambda item: _rank(item[0])[0]))
        for each in (found.lines, found.goals)
    )
    return Markings(points, lines, found.arcs, goals).without_missing(sizes)


def prescribed_points(spec: PitchSpec, size: tuple[float, float] | None = None) -> dict[str, Place]:
    """Return the points of `prescribed_markings`."""
    return prescribed_markings(spec, size).points


def places_by_size(
    spec: PitchSpec, size: tuple[float, float], names: Sequence[str]
) -> tuple[Floats, Floats]:
    """Return points (n, 3) [m] at a size, and the change (n, 2) of x by length and y by width [1].

    Points that are not prescribed are at the origin, and do not change.
    """
    length, width = size
    step, origin = 1e-4, (0.0, 0.0, 0.0)
    at, longer, wider = (
        np.array([points.get(name, origin) for name in names]).reshape(-1, 3)
        for points in (
            prescribed_points(spec, each)
            for each in (size, (length + step, width), (length, width + step))
        )
    )
    change = np.stack([longer[:, 0] - at[:, 0], wider[:, 1] - at[:, 1]], axis=1) / step
    return at, change


def _rank(name: str) -> tuple[int, int]:
    """Return the order of a name: by side, then by end."""
    words = name.split("_")
    side = next((n for n, side in enumerate(SIDES, 1) if side in words), 0)
    return side, next((n for n, end in enumerate(ENDS, 1) if end in words), 0)


def least_size(spec: PitchSpec) -> tuple[float, float]:
    """Return the length and the width [m] below which the prescribed markings do not fit."""
    inner, other = (prescribed_markings(spec, size) for size in ((0.0, 0.0), (1.0, 1.0)))
    length, reach, width = [0.0], [0.0], [0.0]
    drawn = {arc.center for arc in inner.arcs.values()}
    drawn.update(*((line.start, line.end) for line in inner.lines.values()))
    for name, (x, y, _) in inner.points.items():
        if other.points[name][0] == x:
            length.append(2.0 * abs(x))
        elif name in drawn:
            reach.append(-SIDES[_side(name)] * x)
        else:  # a mark alone may lie inside the centre circle
            length.append(-2.0 * SIDES[_side(name)] * x)
        width.append(2.0 * abs(y) if other.points[name][1] == y else 0.0)
    for arc in inner.arcs.values():
        x = inner.points[arc.center][0]
        reach.append(abs(x) + arc.radius if _side(arc.center) else 0.0)
    reach = [each + spec.sizes.get("center_circle_radius", 0.0) for each in reach]
    return max(*length, 2.0 * max(reach)), max(width)


def _side(name: str) -> str:
    return next((side for side in SIDES if side in name.split("_")), "")


Size = tuple[float, float]


def _draw_border(found: Markings, size: Size) -> None:
    """Add touch lines, goal lines and the halfway line."""
    found.place("halfway_{end}", size, (0.0, 0.5 * size[1], 0.0))
    found.place("corner_{side}_{end}", size, (0.0, 0.5 * size[1], 0.0))
    found.add_line("halfway_line", "halfway_near", "halfway_far")
    found.add_line("touch_line_{end}", "corner_left_{end}", "corner_right_{end}")
    found.add_line("goal_line_{side}", "corner_{side}_near", "corner_{side}_far")


def _draw_circle(found: Markings, size: Size, sizes: Sizes) -> None:
    """Add the centre mark with its circle."""
    radius = sizes["center_circle_radius"]
    found.place("center_mark", size, (0.0, 0.0, 0.0))
    found.place("center_circle_{end}", size, (0.0, radius, 0.0))
    if radius:
        found.add_arc("center_circle", "center_mark", radius, 0.0, 2.0 * math.pi)


def _draw_goals(found: Markings, size: Size, sizes: Sizes) -> None:
    """Add the frames of the goals."""
    for part, height in (("bottom", 0.0), ("top", sizes["goal_height"])):
        found.place(
            f"goal_post_{{side}}_{{end}}_{part}", size, (0.0, 0.5 * sizes["goal_width"], height)
        )
    post = "goal_post_{side}_{end}"
    found.add_line(post, f"{post}_bottom", f"{post}_top", painted=False)
    found.add_line(
        "crossbar_{side}", "goal_post_{side}_near_top", "goal_post_{side}_far_top", painted=False
    )


def _draw_area(found: Markings, name: str, size: Size, depth: float, across: float) -> None:
    """Add a rectangle on the goal lines."""
    corner = f"{name}_{{side}}_{{end}}"
    found.place(f"{corner}_back", size, (0.0, 0.5 * across, 0.0))
    found.place(f"{corner}_front", size, (depth, 0.5 * across, 0.0))
    ends = (f"{name}_{{side}}_{end}_front" for end in ENDS)
    found.add_line(f"{name}_{{side}}_front", *ends)
    found.add_line(corner, f"{corner}_back", f"{corner}_front")


def _draw_round_area(found: Markings, name: str, size: Size, radius: float, front: float) -> None:
    """Add two quarter circles on the goal lines, and the line of a length that joins them.

    Where they leave the court, they end at the touch lines.
    """
    corner = f"{name}_{{side}}_{{end}}"
    reach = min(radius, max(0.5 * (size[1] - front), 0.0))
    start = math.acos(reach / radius) if radius else 0.0
    found.place(f"{corner}_center", size, (0.0, 0.5 * front, 0.0))
    found.place(f"{corner}_back", size, (radius * math.sin(start), 0.5 * front + reach, 0.0))
    found.place(f"{corner}_front", size, (radius, 0.5 * front, 0.0))
    ends = (f"{name}_{{side}}_{end}_front" for end in ENDS)
    found.add_line(f"{name}_{{side}}_front", *ends)
    if radius:
        found.add_arc(corner, f"{corner}_center", radius, start - 0.5 * math.pi, 0.0)


def _draw_football(found: Markings, size: Size, sizes: Sizes) -> None:
    """Law 1 of the Game, with the dimensions of the template."""
    depth, mark = sizes["penalty_area_depth"], sizes["penalty_mark_distance"]
    _draw_circle(found, size, sizes)
    found.place("penalty_mark_{side}", size, (mark, 0.0, 0.0))
    _draw_area(found, "penalty_area", size, depth, sizes["penalty_area_width"])
    _draw_area(found, "goal_area", size, sizes["goal_area_depth"], sizes["goal_area_width"])
    _draw_corner_arcs(found, sizes)
    radius = sizes["penalty_arc_radius"]
    # An arc that does not cross the line of the area is not painted.
    if mark and depth and radius > abs(depth - mark):
        half = math.acos((depth - mark) / radius)
        at = (depth, radius * math.sin(half), 0.0)
        found.place("penalty_arc_{side}_{end}", size, at)
        found.add_arc("penalty_arc_{side}", "penalty_mark_{side}", radius, -half, half)
    _draw_goals(found, size, sizes)


def _draw_corner_arcs(found: Markings, sizes: Sizes) -> None:
    """Add the quarter circles at the corners."""
    if radius := sizes["corner_arc_radius"]:
        corner = "{side}_{end}"
        found.add_arc(f"corner_arc_{corner}", f"corner_{corner}", radius, 0.0, 0.5 * math.pi)


def _draw_futsal(found: Markings, size: Size, sizes: Sizes) -> None:
    """Futsal: areas of quarter circles about the outsides of the posts, and two penalty marks."""
    _draw_circle(found, size, sizes)
    for name in ("penalty_mark", "second_penalty_mark"):
        found.place(f"{name}_{{side}}", size, (sizes[f"{name}_distance"], 0.0, 0.0))
    area = sizes["penalty_area_radius"], sizes["penalty_area_front"]
    _draw_round_area(found, "penalty_area", size, *area)
    _draw_corner_arcs(found, sizes)
    _draw_goals(found, size, sizes)


def _draw_handball(found: Markings, size: Size, sizes: Sizes) -> None:
    """Handball: the goal area, the broken free-throw line around it, and the 7 m line."""
    _draw_circle(found, size, sizes)
    for name in ("goal_area", "free_throw"):
        _draw_round_area(found, name, size, sizes[f"{name}_radius"], sizes["goal_area_front"])
    at = (sizes["seven_meter_distance"], 0.5 * sizes["seven_meter_width"], 0.0)
    found.place("seven_meter_{side}_{end}", size, at)
    found.add_line("seven_meter_{side}", "seven_meter_{side}_near", "seven_meter_{side}_far")
    _draw_goals(found, size, sizes)


def _draw_basketball(found: Markings, size: Size, sizes: Sizes) -> None:
    """Basketball: restricted and three-point areas, and the edges of the backboards."""
    _draw_circle(found, size, sizes)
    depth, ring = sizes["restricted_area_depth"], sizes["basket_distance"]
    _draw_area(found, "restricted_area", size, depth, sizes["restricted_area_width"])
    found.place("basket_{side}", size, (ring, 0.0, 0.0))
    found.place("free_throw_{side}_center", size, (depth, 0.0, 0.0))
    quarter = 0.5 * math.pi
    for name, center in (
        ("free_throw", "free_throw_{side}_center"),
        ("no_charge", "basket_{side}"),
    ):
        if radius := sizes[f"{name}_radius"]:
            found.add_arc(f"{name}_arc_{{side}}", center, radius, -quarter, quarter)
    radius = sizes["three_point_radius"]
    aside = min(0.5 * size[1] - sizes["three_point_margin"], radius)
    if aside > 0.0:
        half, corner = math.asin(aside / radius), "three_point_{side}_{end}"
        found.place(f"{corner}_back", size, (0.0, aside, 0.0))
        found.place(f"{corner}_front", size, (ring + radius * math.cos(half), aside, 0.0))
        found.add_line(corner, f"{corner}_back", f"{corner}_front")
        found.add_arc("three_point_arc_{side}", "basket_{side}", radius, -half, half)
    board, across = "backboard_{side}_{end}", 0.5 * sizes["backboard_width"]
    for part in ("bottom", "top"):
        at = (sizes["backboard_distance"], across, sizes[f"backboard_{part}"])
        found.place(f"{board}_{part}", size, at)
        ends = (f"backboard_{{side}}_{end}_{part}" for end in ENDS)
        found.add_line(f"backboard_{{side}}_{part}", *ends, painted=False)
    found.add_line(board, f"{board}_bottom", f"{board}_top", painted=False)


def _draw_volleyball(found: Markings, size: Size, sizes: Sizes) -> None:
    """Volleyball: attack lines, and the upper edge of the net above the side lines."""
    at = (0.5 * size[0] - sizes["attack_line_distance"], 0.5 * size[1], 0.0)
    found.place("attack_{side}_{end}", size, at)
    found.add_line("attack_line_{side}", "attack_{side}_near", "attack_{side}_far")
    found.place("net_{end}_top", size, (0.0, 0.5 * size[1], sizes["net_height"]))
    found.add_line("net_top", "net_near_top", "net_far_top", painted=False)
