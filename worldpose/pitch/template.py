"""Non-planar pitch template: named points, markings and the crowned surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.pitch import ArcSpec, LineSpec, PitchSpec
from worldpose.errors import InputError

PENALTY_AREA = (16.5, 40.32)
"""Depth from the goal line, width along it [m]: 16.5 m to either side of the goal of 7.32 m."""
GOAL_AREA = (5.5, 18.32)
"""Depth from the goal line, width along it [m]: 5.5 m to either side of the goal."""
GOAL = (2.44, 7.32)
"""Height of the crossbar's lower edge, width between the posts [m]."""
PENALTY_MARK_DISTANCE = 11.0
"""Distance from the goal line [m]."""
CIRCLE_RADIUS = 9.15
"""Radius of the centre circle, and of the penalty arcs around the penalty marks [m]."""
CORNER_RADIUS = 1.0
"""Radius of the corner arcs [m]."""

SIDES = {"left": -1.0, "right": 1.0}
ENDS = {"near": -1.0, "far": 1.0}

# Half the opening of a penalty arc, where the circle crosses the line of the penalty area.
_ARC_HALF_ANGLE = math.acos((PENALTY_AREA[0] - PENALTY_MARK_DISTANCE) / CIRCLE_RADIUS)

Place = tuple[float, float, float]


def law_points(length: float, width: float) -> dict[str, Place]:
    """Return the named points as (x, y, height above the surface) [m], world.

    Args:
        length: length of the pitch [m].
        width: width of the pitch [m].
    """
    x_goal, y_touch = 0.5 * length, 0.5 * width
    points: dict[str, Place] = {"center_mark": (0.0, 0.0, 0.0)}
    for end, toward in ENDS.items():
        points[f"halfway_{end}"] = (0.0, toward * y_touch, 0.0)
        points[f"center_circle_{end}"] = (0.0, toward * CIRCLE_RADIUS, 0.0)
    for side, out in SIDES.items():
        points[f"penalty_mark_{side}"] = (out * (x_goal - PENALTY_MARK_DISTANCE), 0.0, 0.0)
        for end, toward in ENDS.items():
            points[f"corner_{side}_{end}"] = (out * x_goal, toward * y_touch, 0.0)
            for area, (depth, across) in (("penalty", PENALTY_AREA), ("goal", GOAL_AREA)):
                y = toward * 0.5 * across
                points[f"{area}_area_{side}_{end}_back"] = (out * x_goal, y, 0.0)
                points[f"{area}_area_{side}_{end}_front"] = (out * (x_goal - depth), y, 0.0)
            points[f"penalty_arc_{side}_{end}"] = (
                out * (x_goal - PENALTY_AREA[0]),
                toward * CIRCLE_RADIUS * math.sin(_ARC_HALF_ANGLE),
                0.0,
            )
            y = toward * 0.5 * GOAL[1]
            points[f"goal_post_{side}_{end}_bottom"] = (out * x_goal, y, 0.0)
            points[f"goal_post_{side}_{end}_top"] = (out * x_goal, y, GOAL[0])
    return points


def law_lines() -> dict[str, LineSpec]:
    """Return the straight markings by name."""
    lines = {"halfway_line": LineSpec(start="halfway_near", end="halfway_far")}
    for end in ENDS:
        lines[f"touch_line_{end}"] = LineSpec(start=f"corner_left_{end}", end=f"corner_right_{end}")
    for side in SIDES:
        lines[f"goal_line_{side}"] = LineSpec(start=f"corner_{side}_near", end=f"corner_{side}_far")
        for area in ("penalty_area", "goal_area"):
            corner = f"{area}_{side}"
            lines[f"{corner}_front"] = LineSpec(
                start=f"{corner}_near_front", end=f"{corner}_far_front"
            )
            for end in ENDS:
                lines[f"{corner}_{end}"] = LineSpec(
                    start=f"{corner}_{end}_back", end=f"{corner}_{end}_front"
                )
    return lines


def law_goals() -> dict[str, LineSpec]:
    """Return the goals' posts and crossbars by name: straight and white, but not painted."""
    frames = {}
    for side in SIDES:
        for end in ENDS:
            post = f"goal_post_{side}_{end}"
            frames[post] = LineSpec(start=f"{post}_bottom", end=f"{post}_top")
        frames[f"crossbar_{side}"] = LineSpec(
            start=f"goal_post_{side}_near_top", end=f"goal_post_{side}_far_top"
        )
    return frames


def law_arcs() -> dict[str, ArcSpec]:
    """Return the curved markings by name."""
    arcs = {
        "center_circle": ArcSpec(
            center="center_mark", radius=CIRCLE_RADIUS, start_angle=0.0, end_angle=2.0 * math.pi
        )
    }
    # Each begins at the angle at which it enters the pitch, in the direction from x towards y.
    quarters = (("left_near", 0), ("right_near", 1), ("right_far", 2), ("left_far", 3))
    for corner, quarter in quarters:
        arcs[f"corner_arc_{corner}"] = ArcSpec(
            center=f"corner_{corner}",
            radius=CORNER_RADIUS,
            start_angle=quarter * 0.5 * math.pi,
            end_angle=(quarter + 1) * 0.5 * math.pi,
        )
    for side, middle in (("left", 0.0), ("right", math.pi)):
        arcs[f"penalty_arc_{side}"] = ArcSpec(
            center=f"penalty_mark_{side}",
            radius=CIRCLE_RADIUS,
            start_angle=middle - _ARC_HALF_ANGLE,
            end_angle=middle + _ARC_HALF_ANGLE,
        )
    return arcs


@dataclass(frozen=True, eq=False)
class MarkingSamples:
    """Points along the painted markings, each with the index of its marking."""

    points_world: NDArray[np.float64]
    """(n, 3) [m], world."""
    marking: NDArray[np.int64]
    """(n,) indices into `names`."""
    names: tuple[str, ...]
    """Names of the markings."""


@dataclass(frozen=True, eq=False)
class PitchTemplate:
    """One stadium's pitch in the world frame: Law 1 of the Game, surveyed points, a crown.

    Note:
        C1. The surface falls from the origin by one parabola across and another along, so that
        heights are negative elsewhere; the paper states the crown's size, about 0.2 m, and not its
        profile. Pitches of real cameras also fall towards their goal lines.
    """

    length: float
    """Between the centres of the goal lines [m]."""
    width: float
    """Between the centres of the touch lines [m]."""
    crown: float
    """Height of the long axis above the touch lines [m]."""
    end_fall: float
    """Height of the halfway line above the goal lines [m]."""
    points: dict[str, NDArray[np.float64]]
    """(3,) [m], world, by name. Law 1 gives, for side in left (negative x), right and end in near
    (negative y), far: `center_mark`, `halfway_{end}`, `center_circle_{end}` (its crossings with
    the halfway line), `corner_{side}_{end}`, `penalty_mark_{side}`, `penalty_arc_{side}_{end}`
    (its ends on the penalty area's line), `penalty_area_{side}_{end}_back` (on the goal line) and
    `_front`, `goal_area_{side}_{end}_back` and `_front`, `goal_post_{side}_{end}_bottom` and
    `_top`."""
    lines: dict[str, LineSpec]
    """`touch_line_{end}`, `goal_line_{side}`, `halfway_line`, and for both kinds of area
    `penalty_area_{side}_front`, `penalty_area_{side}_{end}`."""
    arcs: dict[str, ArcSpec]
    """`center_circle`, `penalty_arc_{side}`, `corner_arc_{side}_{end}`."""
    goals: dict[str, LineSpec]
    """`goal_post_{side}_{end}`, `crossbar_{side}`: visible and drawn like markings, but not painted
    on the surface."""
    unpainted: dict[str, LineSpec]
    """Lines on the surface without paint, such as edges of mowing stripes: `stripe_{side}_{n}`."""
    surveyed: frozenset[str] = frozenset()
    """Names of the points with a surveyed position; the others have that of the Laws."""
    leveled: frozenset[str] = frozenset()
    """Names of those with a surveyed height; the others lie on the surface."""
    assumed: frozenset[str] = frozenset()
    """Those of `length`, `width`, `crown`, `end_fall` without a measurement: there is no surveyed
    point, and they have the values of the standard pitch."""

    @classmethod
    def standard(cls) -> PitchTemplate:
        """Return the pitch of a match without pitch.json: 105 x 68 m, a crown of 0.2 m."""
        return cls.from_spec(PitchSpec())

    @classmethod
    def from_spec(cls, spec: PitchSpec) -> PitchTemplate:
        """Return the pitch of pitch.json.

        Raises:
            InputError: the penalty areas do not fit, a marking names an unknown point, or an arc
                does not run forward by at most a full circle.
        """
        _check_size(spec)
        size, shape = (spec.length, spec.width), (spec.crown, spec.end_fall)
        points = {
            name: np.array([x, y, above + float(surface_shape(x, y, size) @ shape)])
            for name, (x, y, above) in law_points(spec.length, spec.width).items()
        }
        stripes = _stripe_edges(spec)
        given = {**stripes, **spec.points}
        for name, place in given.items():
            on_surface = float(surface_shape(*place[:2], size) @ shape)
            points[name] = np.array([*place[:2], *(place[2:] or (on_surface,))])
        for point in points.values():
            point.setflags(write=False)
        edges = {
            near.removesuffix("_near"): LineSpec(start=near, end=far, painted=False)
            for near, far in zip(list(stripes)[::2], list(stripes)[1::2], strict=True)
        }
        every = {**law_lines(), **edges, **spec.lines}
        lines = {name: line for name, line in every.items() if line.painted}
        unpainted = {name: line for name, line in every.items() if not line.painted}
        arcs = {**law_arcs(), **spec.arcs}
        _check_markings(points, every, arcs)
        usual = PitchSpec()
        sizes = ("length", "width", "crown", "end_fall")
        assumed = [name for name in sizes if getattr(spec, name) == getattr(usual, name)]
        return cls(
            spec.length,
            spec.width,
            spec.crown,
            spec.end_fall,
            points,
            lines,
            arcs,
            law_goals(),
            unpainted,
            surveyed=frozenset(spec.points),
            leveled=frozenset(name for name, place in spec.points.items() if len(place) == 3),
            assumed=frozenset(() if spec.points else assumed),
        )

    def height(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Return the height of the surface [m], continued beyond the touch lines.

        Args:
            x: (...) [m], world.
            y: (...) [m], world.
        """
        along, across = np.broadcast_arrays(
            np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        )
        shape = surface_shape(along, across, (self.length, self.width))
        return np.asarray(shape @ (self.crown, self.end_fall))

    @property
    def surface(self) -> NDArray[np.float64]:
        """(2,) crown and end fall [m]."""
        return np.array([self.crown, self.end_fall])

    def with_surface(self, surface: ArrayLike) -> PitchTemplate:
        """Return the pitch with another surface; points of surveyed height keep theirs.

        Args:
            surface: (2,) crown and end fall [m].
        """
        crown, end_fall = np.asarray(surface, dtype=np.float64).tolist()
        change = (crown - self.crown, end_fall - self.end_fall)
        points = {}
        for name, place in self.points.items():
            points[name] = place.copy()
            if name not in self.leveled:
                rise = surface_shape(place[0], place[1], (self.length, self.width)) @ change
                points[name][2] += float(rise)
            points[name].setflags(write=False)
        return replace(
            self,
            points=points,
            crown=crown,
            end_fall=end_fall,
            assumed=self.assumed - {"crown", "end_fall"},
        )

    def positions(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return named points (n, 3) [m], world.

        Raises:
            InputError: a name is unknown.
        """
        for name in names:
            if name not in self.points:
                raise _unknown_point("PitchTemplate.positions", name, self.points)
        return np.array([self.points[name] for name in names], dtype=np.float64).reshape(-1, 3)

    def by_surface(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return derivatives (n, 2) of points' heights by crown and end fall [m/m].

        Raises:
            InputError: a name is unknown.
        """
        at = self.positions(names)
        shape = surface_shape(at[:, 0], at[:, 1], (self.length, self.width))
        free = np.array([name not in self.leveled for name in names], dtype=np.bool_)
        return np.asarray(shape * free[:, None])

    def marking_by_surface(self, name: str, spacing: float) -> NDArray[np.float64]:
        """Return derivatives (n, 2) of the heights of `marking_points`, as `by_surface`."""
        return self._difference(lambda pitch: pitch.marking_points(name, spacing))

    def samples_by_surface(self, spacing: float) -> NDArray[np.float64]:
        """Return derivatives (n, 2) of the heights of `sample_lines`, as `by_surface`."""
        return self._difference(lambda pitch: pitch.sample_lines(spacing).points_world)

    def _difference(
        self, places: Callable[[PitchTemplate], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return derivatives (n, 2) of heights; they are linear in the surface."""
        here = places(self)[:, 2]
        others = [self.with_surface(self.surface + axis) for axis in np.eye(2)]
        return np.stack([places(other)[:, 2] - here for other in others], axis=-1)

    @property
    def marking_names(self) -> tuple[str, ...]:
        """Names of all that can be drawn: lines, arcs, goals' posts and crossbars, stripes."""
        return (*self.white_names, *self.unpainted)

    @property
    def white_names(self) -> tuple[str, ...]:
        """Names of what is white: painted lines, arcs, and the goals' posts and crossbars."""
        return (*self.lines, *self.arcs, *self.goals)

    def marking_points(self, name: str, spacing: float) -> NDArray[np.float64]:
        """Return points (n, 3) [m], world, along one marking, both ends included.

        Args:
            name: one of `marking_names`; a full circle ends where it begins.
            spacing: largest distance between neighbours [m].

        Raises:
            InputError: the name is unknown.
        """
        if name in self.lines or name in self.unpainted:
            return self._line_points({**self.lines, **self.unpainted}[name], spacing)
        if name in self.arcs:
            points = self._arc_points(self.arcs[name], spacing)
            span = self.arcs[name].end_angle - self.arcs[name].start_angle
            full = math.isclose(span, 2.0 * math.pi)
            return np.concatenate([points, points[:1]]) if full else points
        if name not in self.goals:
            raise InputError(
                "PitchTemplate.marking_points",
                expected="the name of a marking",
                found=repr(name),
                todo=f"Use one of {', '.join(sorted(self.marking_names))}.",
            )
        start, end = (self.points[getattr(self.goals[name], key)] for key in ("start", "end"))
        steps = _steps(float(np.linalg.norm(end - start)), spacing)
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]
        bar: NDArray[np.float64] = (1.0 - share) * start + share * end
        return bar

    def sample_lines(self, spacing: float) -> MarkingSamples:
        """Return points along all markings, both ends included, evenly spaced in plan.

        Between its ends a marking follows the crown. Where surveyed ends lie above or below the
        crown, the offset of the marking is interpolated linearly between its ends.

        Args:
            spacing: largest distance in plan between neighbours on one marking [m].

        Raises:
            InputError: the spacing is not positive.
        """
        if not spacing > 0.0:
            raise InputError(
                "PitchTemplate.sample_lines: spacing",
                expected="a positive distance [m]",
                found=f"{spacing}",
                todo="Give for example 0.25.",
            )
        samples = [self._line_points(line, spacing) for line in self.lines.values()]
        samples += [self._arc_points(arc, spacing) for arc in self.arcs.values()]
        counts = [len(points) for points in samples]
        return MarkingSamples(
            points_world=np.concatenate(samples),
            marking=np.repeat(np.arange(len(samples)), counts),
            names=(*self.lines, *self.arcs),
        )

    def _line_points(self, line: LineSpec, spacing: float) -> NDArray[np.float64]:
        start, end = self.points[line.start], self.points[line.end]
        steps = _steps(float(np.linalg.norm(end[:2] - start[:2])), spacing)
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]
        points = (1.0 - share) * self._above_surface(start) + share * self._above_surface(end)
        points[:, 2] += self.height(points[:, 0], points[:, 1])
        return points

    def _arc_points(self, arc: ArcSpec, spacing: float) -> NDArray[np.float64]:
        span = arc.end_angle - arc.start_angle
        steps = _steps(span * arc.radius, spacing)
        angle = np.linspace(arc.start_angle, arc.end_angle, steps + 1)
        if math.isclose(span, 2.0 * math.pi):
            angle = angle[:-1]  # the end equals the start
        points = np.tile(self._above_surface(self.points[arc.center]), (len(angle), 1))
        points[:, 0] += arc.radius * np.cos(angle)
        points[:, 1] += arc.radius * np.sin(angle)
        points[:, 2] += self.height(points[:, 0], points[:, 1])
        return points

    def _above_surface(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (3,) x, y and the height above the crowned surface [m]."""
        x, y, z = point
        return np.array([x, y, z - float(self.height(x, y))])


def surface_shape(x: ArrayLike, y: ArrayLike, size: tuple[float, float]) -> NDArray[np.float64]:
    """Return the derivatives (..., 2) of the surface's height by crown and end fall [m/m].

    Args:
        x: (...) [m], world.
        y: (...) [m], world, of the same shape.
        size: length, width of the pitch [m].
    """
    along = np.asarray(x, dtype=np.float64) / (0.5 * size[0])
    across = np.asarray(y, dtype=np.float64) / (0.5 * size[1])
    # 0 - keeps the long axis free of negative zero.
    return 0.0 - np.stack([across**2, along**2], axis=-1)


def _steps(extent: float, spacing: float) -> int:
    # Rounding errors of the extent must not add a step.
    return max(1, math.ceil(extent / spacing - 1e-9))


def _stripe_edges(spec: PitchSpec) -> dict[str, tuple[float, float]]:
    """Return x, y [m] of the near and the far end of every stripe's edge, in turn, by name."""
    if spec.stripes is None:
        return {}
    spacing = spec.stripes.spacing
    first = spec.stripes.first or spacing
    count = math.ceil((0.5 * spec.length - first) / spacing - 1e-6)
    return {
        f"stripe_{side}_{n + 1}_{end}": (
            sign * (0.5 * spec.length - first - n * spacing),
            0.5 * across * spec.width,
        )
        for side, sign in SIDES.items()
        for n in range(count)
        for end, across in ENDS.items()
    }


def _check_size(spec: PitchSpec) -> None:
    """Raise InputError unless the prescribed markings fit into the pitch."""
    least_length = 2.0 * (PENALTY_MARK_DISTANCE + 2.0 * CIRCLE_RADIUS)
    if spec.length <= least_length or spec.width <= PENALTY_AREA[1]:
        raise InputError(
            "pitch: length and width",
            expected=f"more than {least_length:g} x {PENALTY_AREA[1]:g} m, room for the markings",
            found=f"{spec.length:g} x {spec.width:g}",
            todo="Give metres between the centres of the outer lines.",
        )


def _check_markings(
    points: dict[str, NDArray[np.float64]], lines: dict[str, LineSpec], arcs: dict[str, ArcSpec]
) -> None:
    """Raise InputError unless markings name known points and arcs run once around at most."""
    for name, line in lines.items():
        for point in (line.start, line.end):
            if point not in points:
                raise _unknown_point(f"pitch: lines.{name}", point, points)
    for name, arc in arcs.items():
        if arc.center not in points:
            raise _unknown_point(f"pitch: arcs.{name}", arc.center, points)
        if not 0.0 < arc.end_angle - arc.start_angle <= 2.0 * math.pi + 1e-6:
            raise InputError(
                f"pitch: arcs.{name}",
                expected="end_angle above start_angle by at most 2 pi",
                found=f"{arc.start_angle:g} to {arc.end_angle:g} rad",
                todo="Measure angles in radians from x towards y; add 2 pi to the end if needed.",
            )


def _unknown_point(where: str, name: str, points: dict[str, NDArray[np.float64]]) -> InputError:
    return InputError(
        where,
        expected="the name of a point",
        found=repr(name),
        todo=f"Add it to points, or use one of {', '.join(sorted(points))}.",
    )


PRIOR_STD_M: Final = np.array([0.1, 0.25])
"""Standard deviations of the crown about that of pitch.json, as in surveys, and of the end fall
[m]: 0.5 m are 1 % of half the length."""
_LEVEL_STD_M: Final = 0.02
"""Deviation of a surveyed height from the shape [m]: ground is uneven by 1 to 3 cm."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Crown and end fall of a pitch, with what is known about them (C1).

    The Laws say nothing about slopes. Builders let a pitch fall by 0.5 to 1 % from the center spot,
    to the touch lines or to all sides, so that it drains. Where a survey has heights, they tell the
    shape; otherwise painted lines in the images of static cameras do, and all cameras of a venue
    see the same surface.

    Attributes:
        shape: (2,) crown: height of the long axis above the touch lines; end fall: height of the
            halfway line above the goal lines [m].
        covariance: (2, 2) [m^2].
    """

    shape: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, pitch: PitchTemplate) -> Surface:
        """Return what is known of a pitch before any image: its template, and surveyed heights."""
        stated, information = pitch.surface, np.diag(PRIOR_STD_M**-2.0)
        laws = law_points(pitch.length, pitch.width)
        names = sorted(pitch.leveled & laws.keys())
        places = pitch.positions(names)
        rows = surface_shape(places[:, 0], places[:, 1], (pitch.length, pitch.width))
        above = places[:, 2] - [laws[name][2] for name in names] - rows @ stated
        covariance = np.asarray(np.linalg.inv(information + rows.T @ rows / _LEVEL_STD_M**2))
        return cls(stated + covariance @ rows.T @ above / _LEVEL_STD_M**2, covariance)

    def whiten(self, shape: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return whitened residuals (2,) of a shape (2,), and derivatives (2, 2) by it."""
        rows: NDArray[np.float64] = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return rows @ (shape - self.shape), rows
