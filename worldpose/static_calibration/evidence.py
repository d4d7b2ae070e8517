"""Clicked points and drawn markings, as positions on the template and in the image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.geometry.rigid import unit
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.ground_error import points_off_line

_FEWEST: Final = 4
"""Minimum clicked points without a drawn marking [1]: those of a homography."""


@dataclass(frozen=True, eq=False)
class ClickEvidence:
    """Clicked points and drawn markings with their places on the template.

    Attributes:
        points: names of the clicked points.
        points_world: (n, 3) [m], world.
        points_image: (n, 2) [px].
        points_by_surface: (n, 2) derivatives of heights by the pitch's crown and end fall [m/m].
        markings: names of the drawn markings, each once.
        samples_world: (s, 3) [m], world, along the drawn markings one after another.
        samples_by_surface: (s, 2) the same as `points_by_surface` for samples.
        bounds: (m + 1,) first sample of each marking, and the end.
        drawn_image: (d, 2) [px].
        drawn_marking: (d,) indices into `markings`.
        surface: (2,) crown and end fall at these places [m].
        straight: (m,) whether the marking is a straight line on the pitch surface.
        length: of the pitch [m].
    """

    points: tuple[str, ...]
    points_world: Floats
    points_image: Floats
    points_by_surface: Floats
    markings: tuple[str, ...]
    samples_world: Floats
    samples_by_surface: Floats
    bounds: Integers
    drawn_image: Floats
    drawn_marking: Integers
    surface: Floats
    straight: Flags
    length: float

    def select(self, points: Flags, markings: Flags) -> ClickEvidence:
        """Return the evidence restricted to some clicked points (n,) and drawn markings (m,)."""
        keep, on = points, markings[self.drawn_marking]
        return replace(
            self,
            points=tuple(name for name, kept in zip(self.points, keep, strict=True) if kept),
            points_world=self.points_world[keep],
            points_image=self.points_image[keep],
            points_by_surface=self.points_by_surface[keep],
            drawn_image=self.drawn_image[on],
            drawn_marking=self.drawn_marking[on],
        )

    def count_constraints(self, points: Flags, markings: Flags) -> int:
        """Return how many numbers of a camera clicks (n,) and drawn markings (m,) can tell."""
        return 2 * int(points.sum()) + int(np.where(self.straight, 2, 4)[markings].sum())

    def on_surface(self, surface: Floats) -> ClickEvidence:
        """Return the evidence at its places on another surface (2,), crown and end fall [m]."""
        change = surface - self.surface
        points, samples = self.points_world.copy(), self.samples_world.copy()
        points[:, 2] += self.points_by_surface @ change
        samples[:, 2] += self.samples_by_surface @ change
        return replace(self, points_world=points, samples_world=samples, surface=surface)


def gather_evidence(
    pitch: PitchTemplate,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    spacing: float,
    where: str,
) -> ClickEvidence:
    """Return the evidence of one image, with samples along markings at a spacing [m].

    InputError if there are no clicks, a name is unknown or given twice, or a pixel lies outside the
    image of a width and height [px].
    """
    if not clicked.points and not clicked.drawn:
        raise InputError(
            where,
            expected="clicked points or drawn markings",
            found="none",
            todo="Click four or more named points of the pitch, spread over the image, such as "
            "penalty_area_left_near_front, and draw the lines between them.",
        )
    names = [point.name for point in clicked.points]
    for index, point in enumerate(clicked.points):
        place = f"{where}: points[{index}] {point.name}"
        if point.name not in pitch.points:
            raise _unknown(place, point.name, tuple(pitch.points))
        if point.name in names[:index]:
            raise InputError(
                place,
                expected="every point once",
                found=f"{point.name} clicked {names.count(point.name)} times",
                todo="Delete all but the best click, or give the others their own names.",
            )
        _check_inside(place, point.xy, image_size)
    pixels: dict[str, list[tuple[float, float]]] = {}
    for index, marking in enumerate(clicked.drawn):
        place = f"{where}: drawn[{index}] {marking.name}"
        if marking.name not in pitch.marking_names:
            raise _unknown(place, marking.name, pitch.marking_names)
        for pixel in marking.xy:
            _check_inside(place, pixel, image_size)
        pixels.setdefault(marking.name, []).extend(marking.xy)
    pixels = {name: _thin(drawn) for name, drawn in pixels.items()}
    samples = [pitch.marking_points(name, spacing) for name in pixels]
    shapes = [pitch.marking_by_surface(name, spacing) for name in pixels]
    counts = [len(drawn) for drawn in pixels.values()]
    return ClickEvidence(
        points=tuple(names),
        points_world=pitch.positions(names),
        points_image=np.array([point.xy for point in clicked.points]).reshape(-1, 2),
        points_by_surface=pitch.by_surface(names),
        markings=tuple(pixels),
        samples_world=np.concatenate([np.empty((0, 3)), *samples]),
        samples_by_surface=np.concatenate([np.empty((0, 2)), *shapes]),
        bounds=np.cumsum([0, *(len(part) for part in samples)]),
        drawn_image=np.array([xy for drawn in pixels.values() for xy in drawn]).reshape(-1, 2),
        drawn_marking=np.repeat(np.arange(len(pixels)), counts),
        surface=pitch.surface,
        straight=np.array(
            [name in pitch.lines or name in pitch.unpainted for name in pixels], dtype=np.bool_
        ),
        length=pitch.length,
    )


def count_neighbors(evidence: ClickEvidence, reach: float) -> Floats:
    """Return per drawn pixel (d,) the count of its marking's pixels within `reach` [px].

    Errors of hand drawing are correlated along a line: pixels within `reach` count as one.
    """
    count = np.ones(len(evidence.drawn_image))
    for index in range(len(evidence.markings)):
        on = evidence.drawn_marking == index
        pixels = evidence.drawn_image[on]
        apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
        count[on] = (apart <= reach).sum(axis=1)
    return count


def _thin(pixels: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return at most `_MAX_DRAWN` of a marking's pixels, evenly spaced in their order."""
    chosen = np.linspace(0, len(pixels) - 1, min(len(pixels), 200)).astype(np.int64)
    return [pixels[index] for index in chosen]


def _check_inside(where: str, pixel: tuple[float, float], image_size: tuple[int, int]) -> None:
    width, height = image_size
    # Rounding at the border.
    inside = all(-1.0 <= v <= n for v, n in zip(pixel, (width, height), strict=True))
    if not inside:
        raise InputError(
            where,
            expected=f"a pixel of the image, 0 to {width - 1} by 0 to {height - 1}",
            found=f"{pixel[0]:g}, {pixel[1]:g}",
            todo="Click it again, or check that the image has the camera's image_size.",
        )


def _unknown(where: str, name: str, known: tuple[str, ...]) -> InputError:
    return InputError(
        where,
        expected="a name of the pitch template",
        found=repr(name),
        todo=f"Use one of {', '.join(sorted(known))}.",
    )


def check_amount(evidence: ClickEvidence, pitch: PitchTemplate, where: str) -> None:
    """Raise InputError when the clicks are too few, or on one line, for any camera."""
    points, found = len(evidence.points), describe_clicks(evidence)
    if not evidence.markings:
        if points < _FEWEST:
            more = points_off_line(pitch, evidence.points_world)
            new = [name for name in more if name not in evidence.points]
            raise InputError(
                where,
                expected=f"{_FEWEST} clicked points or more, better 8, or drawn markings as well",
                found=found,
                todo=f"Click further points, far from the others, for example {', '.join(new)}.",
            )
        if not has_enough_points(evidence):
            more = points_off_line(pitch, evidence.points_world)
            raise InputError(
                where,
                expected="points off one line",
                found=f"{found}, all on one line of the pitch",
                todo=f"Click points off that line, for example {', '.join(more)}.",
            )
        return
    numbers = 2 * points
    for index in range(len(evidence.markings)):
        pixels = int((evidence.drawn_marking == index).sum())
        # An arc has five constraints of its ellipse, less one for the rotation of the circle.
        numbers += min(pixels, 2 if evidence.straight[index] else 4)
    firsts, stops = evidence.bounds[:-1], evidence.bounds[1:]
    ways = unit(evidence.samples_world[stops - 1] - evidence.samples_world[firsts])
    # Along parallel lines alone, a camera slides.
    slides = not points and evidence.straight.all() and np.linalg.matrix_rank(ways, tol=0.1) < 2
    # The pose; the prior holds the focal length.
    if numbers < 6 or slides:
        places = np.concatenate([evidence.points_world, evidence.samples_world])
        more = points_off_line(pitch, places)
        raise InputError(
            where,
            expected="three straight markings in two directions, or two points and a marking",
            found=found,
            todo=f"Draw another marking, or click points, for example {', '.join(more)}.",
        )


def has_enough_points(evidence: ClickEvidence) -> bool:
    """Return whether the clicked points alone can determine the camera."""
    places = evidence.points_world
    if len(places) < _FEWEST:
        return False
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1]
    # Within a metre of a line, root mean square, points of a football pitch are collinear.
    return bool(spread >= np.sqrt(len(places)) * evidence.length / 105.0)


def describe_clicks(evidence: ClickEvidence) -> str:
    """Return the number and the names of the clicked points and drawn markings."""
    parts = []
    if evidence.points:
        parts.append(f"{len(evidence.points)} points ({', '.join(evidence.points)})")
    if evidence.markings:
        parts.append(f"{len(evidence.markings)} markings ({', '.join(evidence.markings)})")
    return " and ".join(parts)
