"""Non-planar pitch template: named points, markings and the crowned surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Integers
from data_contracts.pitch import ArcSpec, LineSpec, PitchSpec
from worldpose.errors import InputError
from worldpose.pitch.laws import (
    ENDS,
    SIDES,
    least_size,
    places_by_size,
    prescribed_markings,
    prescribed_points,
)


@dataclass(frozen=True, eq=False)
class MarkingSamples:
    """Points (n, 3) along the painted markings [m], world, with their marking (n,) in `names`."""

    points_world: Floats
    marking: Integers
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PitchTemplate:
    """One pitch in the world frame: the markings of its game, surveyed points, a crown.

    Note:
        The surface falls from the origin by one parabola across and another along, so that
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
    points: dict[str, Floats]
    """(3,) [m], world, by name. Football has, for side in left (negative x), right and end in near
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
    spec: PitchSpec = field(default_factory=PitchSpec)
    """pitch.json: its template, and dimensions without a surface that images have shown."""
    surveyed: frozenset[str] = frozenset()
    """Names of the points with a surveyed position; the others have that of the Laws."""
    leveled: frozenset[str] = frozenset()
    """Names of those with a surveyed height; the others lie on the surface."""
    assumed: frozenset[str] = frozenset()
    """Those of `length`, `width`, `crown`, `end_fall` without a measurement: surveyed points do not
    determine them, and they have the values of the standard pitch."""

    @classmethod
    def standard(cls) -> PitchTemplate:
        """Return the pitch of a match without pitch.json: 105 x 68 m, a crown of 0.2 m."""
        return cls.from_spec(PitchSpec())

    @classmethod
    def from_spec(cls, spec: PitchSpec, where: str = "pitch") -> PitchTemplate:
        """Return the pitch of pitch.json.

        Args:
            spec: its content.
            where: the file, for messages.

        Raises:
            InputError: the markings do not fit, a marking names an unknown point, or an arc
                does not run forward by at most a full circle.
        """
        _check_size(spec, where)
        size, shape = (spec.length, spec.width), (spec.crown, spec.end_fall)
        prescribed = prescribed_markings(spec)
        points = {
            name: np.array([x, y, above + float(surface_shape(x, y, size) @ shape)])
            for name, (x, y, above) in prescribed.points.items()
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
        every = {**prescribed.lines, **edges, **spec.lines}
        lines = {name: line for name, line in every.items() if line.painted}
        unpainted = {name: line for name, line in every.items() if not line.painted}
        arcs = {**prescribed.arcs, **spec.arcs}
        _check_markings(points, every, arcs, where)
        usual = PitchSpec(template=spec.template)
        # Floors of halls are level.
        sizes = ("length", "width", *(() if spec.is_level else ("crown", "end_fall")))
        assumed = {name for name in sizes if getattr(spec, name) == getattr(usual, name)}
        return cls(
            length=spec.length,
            width=spec.width,
            crown=spec.crown,
            end_fall=spec.end_fall,
            points=points,
            lines=lines,
            arcs=arcs,
            goals=prescribed.goals,
            unpainted=unpainted,
            spec=spec,
            surveyed=frozenset(spec.points),
            leveled=frozenset(name for name, place in spec.points.items() if len(place) == 3),
            assumed=frozenset(assumed - _measured(spec)),
        )

    def height(self, x: ArrayLike, y: ArrayLike) -> Floats:
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
    def surface(self) -> Floats:
        """(2,) crown and end fall [m]."""
        return np.array([self.crown, self.end_fall])

    def with_surface(self, surface: ArrayLike) -> PitchTemplate:
        """Return the pitch with another crown and end fall (2,) [m]; surveyed heights stay.

        Raises:
            InputError: these are not two finite numbers.
        """
        given = np.asarray(surface, dtype=np.float64)
        is_known = given.shape == (2,) and bool(np.isfinite(given).all())
        _require(is_known, "with_surface", "a finite crown and end fall [m]", surface)
        crown, end_fall = given.tolist()
        change = (crown - self.crown, end_fall - self.end_fall)
        points = {}
        for name, place in self.points.items():
            points[name] = place.copy()
            if name not in self.leveled:
                rise = surface_shape(place[0], place[1], (self.length, self.width)) @ change
                points[name][2] += float(rise)
            points[name].setflags(write=False)
        assumed = self.assumed - {"crown", "end_fall"}
        return replace(self, points=points, crown=crown, end_fall=end_fall, assumed=assumed)

    def positions(self, names: Sequence[str]) -> Floats:
        """Return named points (n, 3) [m], world.

        Raises:
            InputError: a name is unknown.
        """
        for name in names:
            if name not in self.points:
                raise _unknown_point("PitchTemplate.positions", name, self.points)
        return np.array([self.points[name] for name in names], dtype=np.float64).reshape(-1, 3)

    def by_surface(self, names: Sequence[str]) -> Floats:
        """Return derivatives (n, 2) of points' heights by crown and end fall [m/m].

        Raises:
            InputError: a name is unknown.
        """
        at = self.positions(names)
        shape = surface_shape(at[:, 0], at[:, 1], (self.length, self.width))
        free = np.array([name not in self.leveled for name in names], dtype=np.bool_)
        return np.asarray(shape * free[:, None])

    def marking_by_surface(self, name: str, spacing: float) -> Floats:
        """Return derivatives (n, 2) of the heights of `marking_points`, as `by_surface`."""
        return self._difference(lambda pitch: pitch.marking_points(name, spacing))

    def samples_by_surface(self, spacing: float) -> Floats:
        """Return derivatives (n, 2) of the heights of `sample_lines`, as `by_surface`."""
        return self._difference(lambda pitch: pitch.sample_lines(spacing).points_world)

    def _difference(self, places: Callable[[PitchTemplate], Floats]) -> Floats:
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

    def marking_points(self, name: str, spacing: float) -> Floats:
        """Return points (n, 3) [m], world, along one marking, both ends included.

        Args:
            name: one of `marking_names`; a full circle ends where it begins.
            spacing: largest distance between neighbours [m].

        Raises:
            InputError: the name is unknown, or the spacing is not positive.
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
        goal = self.goals[name]
        start, end = self.points[goal.start], self.points[goal.end]
        share = _shares(float(np.linalg.norm(end - start)), spacing)
        return np.asarray((1.0 - share) * start + share * end)

    def sample_lines(self, spacing: float) -> MarkingSamples:
        """Return points along all markings, both ends included, evenly spaced in plan.

        Between its ends a marking follows the crown. Where surveyed ends lie above or below the
        crown, the offset of the marking is interpolated linearly between its ends.

        Args:
            spacing: largest distance in plan between neighbours on one marking [m].

        Raises:
            InputError: the spacing is not positive.
        """
        samples = [self._line_points(line, spacing) for line in self.lines.values()]
        samples += [self._arc_points(arc, spacing) for arc in self.arcs.values()]
        counts = [len(points) for points in samples]
        return MarkingSamples(
            points_world=np.concatenate(samples),
            marking=np.repeat(np.arange(len(samples)), counts),
            names=(*self.lines, *self.arcs),
        )

    def _line_points(self, line: LineSpec, spacing: float) -> Floats:
        start, end = self.points[line.start], self.points[line.end]
        share = _shares(float(np.linalg.norm(end[:2] - start[:2])), spacing)
        points = (1.0 - share) * self._above_surface(start) + share * self._above_surface(end)
        points[:, 2] += self.height(points[:, 0], points[:, 1])
        return points

    def _arc_points(self, arc: ArcSpec, spacing: float) -> Floats:
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

    def _above_surface(self, point: Floats) -> Floats:
        """Return (3,) x, y and the height above the crowned surface [m]."""
        x, y, z = point
        return np.array([x, y, z - float(self.height(x, y))])


def surface_shape(x: ArrayLike, y: ArrayLike, size: tuple[float, float]) -> Floats:
    """Return the derivatives (..., 2) of the surface's height by crown and end fall [m/m].

    Places x, y (...) [m] are in the world; `size` is length, width of the pitch [m].
    """
    along = np.asarray(x, dtype=np.float64) / (0.5 * size[0])
    across = np.asarray(y, dtype=np.float64) / (0.5 * size[1])
    # 0 - keeps the long axis free of negative zero.
    return 0.0 - np.stack([across**2, along**2], axis=-1)


def _shares(extent: float, spacing: float) -> Floats:
    """Return evenly spaced shares (n, 1) of a straight marking [1], both ends included."""
    return np.linspace(0.0, 1.0, _steps(extent, spacing) + 1)[:, None]


def _steps(extent: float, spacing: float) -> int:
    _require(spacing > 0.0, "spacing of samples", "a positive distance [m]", spacing)
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


def _require(
    holds: bool, where: str, expected: str, found: object, todo: str = "Give such a value."
) -> None:
    if not holds:
        raise InputError(where, expected=expected, found=f"{found}", todo=todo)


def _check_size(spec: PitchSpec, where: str) -> None:
    """Raise InputError unless the prescribed markings fit into the pitch, and into each other."""
    length, width = least_size(spec)
    _require(
        spec.length > length and spec.width > width,
        f"{where}: length and width",
        f"more than {length:g} x {width:g} m, room for the markings",
        f"{spec.length:g} x {spec.width:g}",
        "Give metres between the centres of the outer lines.",
    )
    todo = "Correct the dimensions, in metres; 0 is for what is not painted."
    for names in _RISING:
        given = {name: spec.sizes[name] for name in names if spec.sizes.get(name)}
        _require(
            [*given.values()] == sorted(given.values()),
            f"{where}: dimensions",
            f"{', '.join(given)} in rising order",
            ", ".join(f"{size:g}" for size in given.values()),
            todo,
        )
    for name, most in _largest(spec).items():
        size = spec.sizes.get(name, 0.0)
        expected = f"at most {most:g} m, where other markings begin"
        _require(size <= most, f"{where}: dimensions.{name}", expected, f"{size:g}", todo)


_RISING: Final = (
    ("goal_width", "goal_area_width", "penalty_area_width"),
    ("goal_width", "penalty_area_front"),
    ("goal_width", "goal_area_front"),
    ("goal_area_depth", "penalty_mark_distance", "penalty_area_depth"),
    ("penalty_mark_distance", "second_penalty_mark_distance"),
    ("goal_area_radius", "seven_meter_distance", "free_throw_radius"),
    ("backboard_distance", "basket_distance", "restricted_area_depth"),
    ("backboard_bottom", "backboard_top"),
    ("no_charge_radius", "three_point_radius"),
)
"""Dimensions of which each is at least the one before, where both are painted."""


def _largest(spec: PitchSpec) -> dict[str, float]:
    """Return the dimensions [m] at which markings would meet others or the middle of the court."""
    sizes, width = spec.sizes, spec.width
    area = max(sizes.get(name, 0.0) for name in ("penalty_area_width", "goal_width"))
    found = {"corner_arc_radius": 0.5 * (width - area)}
    if "three_point_radius" in sizes:
        inside = min(0.5 * width - sizes["three_point_margin"], sizes["three_point_radius"])
        found["three_point_margin"] = 0.5 * width
        found["three_point_radius"] = 0.5 * spec.length - sizes["basket_distance"]
        if sizes["three_point_radius"]:
            found["restricted_area_width"] = 2.0 * inside
    return found


def _check_markings(
    points: dict[str, Floats], lines: dict[str, LineSpec], arcs: dict[str, ArcSpec], where: str
) -> None:
    """Raise InputError unless markings name known points and arcs run once around at most."""
    for name, line in lines.items():
        for point in (line.start, line.end):
            if point not in points:
                raise _unknown_point(f"{where}: lines.{name}", point, points)
    for name, arc in arcs.items():
        if arc.center not in points:
            raise _unknown_point(f"{where}: arcs.{name}", arc.center, points)
        if not 0.0 < arc.end_angle - arc.start_angle <= 2.0 * math.pi + 1e-6:
            raise InputError(
                f"{where}: arcs.{name}",
                expected="end_angle above start_angle by at most 2 pi",
                found=f"{arc.start_angle:g} to {arc.end_angle:g} rad",
                todo="Measure angles in radians from x towards y; add 2 pi to the end if needed.",
            )


def _unknown_point(where: str, name: str, points: dict[str, Floats]) -> InputError:
    return InputError(
        where,
        expected="the name of a point",
        found=repr(name),
        todo=f"Add it to points, or use one of {', '.join(sorted(points))}.",
    )


PRIOR_STD_M: Final = np.array([0.1, 0.25])
"""Standard deviations of the crown about that of pitch.json, as in surveys, and of the end fall
[m]: 0.5 m are 1 % of half the length."""


def _measured(spec: PitchSpec) -> set[str]:
    """Return those of length, width, crown and end fall that surveyed points of the Laws determine.

    As in a survey, its frame may be rotated, shifted and tilted: points of one end say no length.
    """
    laws, size = prescribed_points(spec) if spec.points else {}, (spec.length, spec.width)
    places = {name: place for name, place in spec.points.items() if name in laws}
    x, y = np.array([place[:2] for place in places.values()]).reshape(-1, 2).T
    longer, wider = places_by_size(spec, size, list(places))[1].T
    one, none = np.ones(len(x)), np.zeros(len(x))
    # Rotation, two shifts, length and width; and level, two slopes, crown and end fall.
    plan = np.c_[[-y, one, none, -longer, none], [x, none, one, none, -wider]].T
    leveled = np.array([len(place) == 3 for place in places.values()], dtype=np.bool_)
    heights = np.c_[one, x, y, surface_shape(x, y, size)][leveled] / 0.03  # accuracy of paint [m]
    found = set[str]()
    for names, rows, prior in (
        (("length", "width"), plan / 0.03, np.array([10.0, 1e3, 1e3, 5.0, 4.0])),
        (("crown", "end_fall"), heights, np.array([1e3, 0.01, 0.01, *PRIOR_STD_M])),
    ):
        std = np.sqrt(np.diagonal(np.linalg.inv(rows.T @ rows + np.diag(prior**-2.0))))
        found |= {name for name, known in zip(names, (std < 0.5 * prior)[3:], strict=True) if known}
    return found


@dataclass(frozen=True, eq=False)
class Surface:
    """Crown and end fall of a pitch, with what is known about them.

    The Laws say nothing about slopes. Builders let a pitch fall by 0.5 to 1 % from the center spot,
    to the touch lines or to all sides, so that it drains. Where a survey has heights, they tell the
    shape; otherwise painted lines in the images of a venue's static cameras do, for all together.

    Attributes:
        shape: (2,) crown: height of the long axis above the touch lines; end fall: height of the
            halfway line above the goal lines [m].
        covariance: (2, 2) [m^2].
    """

    shape: Floats
    covariance: Floats

    @classmethod
    def of(cls, pitch: PitchTemplate) -> Surface:
        """Return what is known of a pitch before any image: its template, and surveyed heights."""
        level_std_m = 0.02  # ground is uneven by 1 to 3 cm
        level = 0.01 if pitch.spec.is_level else 1.0  # millimetres on the floor of a hall
        stated, information = pitch.surface, np.diag((level * PRIOR_STD_M) ** -2.0)
        laws = prescribed_points(pitch.spec)
        names = sorted(pitch.leveled & laws.keys())
        places = pitch.positions(names)
        rows = surface_shape(places[:, 0], places[:, 1], (pitch.length, pitch.width))
        above = places[:, 2] - [laws[name][2] for name in names] - rows @ stated
        covariance = np.asarray(np.linalg.inv(information + rows.T @ rows / level_std_m**2))
        return cls(stated + covariance @ rows.T @ above / level_std_m**2, covariance)

    def whiten(self, shape: Floats) -> tuple[Floats, Floats]:
        """Return whitened residuals (2,) of a shape (2,), and derivatives (2, 2) by it."""
        rows: Floats = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return rows @ (shape - self.shape), rows
