"""User inputs of a match: clicks in images, cameras from another calibration, the pitch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.geometry import Camera, Rigid
from worldpose.pitch import PitchTemplate
from worldpose.simulation.foreign.rigs import RigCamera

PAINTING: Final = 0.015
"""Error of painted points against the Laws of the Game, standard deviation along each axis [m]."""
SURVEY: Final = 0.005
"""Of a surveyed point, along each axis [m]."""
TAPE: Final = 0.02
"""Of a length measured by tape [m]."""
CLICK: Final = (0.3, 1.1)
"""Spread of one person's clicks in an image of 1920 px, minimum and maximum [px]."""
CLICK_TAIL: Final = 4.0
"""Degrees of freedom of clicks (Student's t) [1]."""
MISNAMED: Final = 0.04
"""Share of cameras with a click under a wrong name [1]."""
FEW: Final = 9
"""If an image shows fewer points, lines and arcs are drawn, too [1]."""
_CONFUSED: Final = (("left", "right"), ("near", "far"), ("front", "back"))
_MARGIN: Final = 6.0


@dataclass(frozen=True, eq=False)
class Pitch:
    """True and stated positions of a pitch.

    Attributes:
        painted: with the true position of every named point.
        stated: pitch.json.
        how: origin of the statement.
    """

    painted: PitchSpec
    stated: PitchSpec
    how: str


def draw_pitch(rng: np.random.Generator) -> Pitch:
    """Return a pitch of 90 to 120 by 45 to 90 m with a crown of up to 0.4 m."""
    length, width = float(rng.uniform(90.0, 120.0)), float(rng.uniform(45.0, 90.0))
    if rng.random() < 0.4:
        length, width = 105.0, 68.0
    crown = float(rng.uniform(0.0, 0.4)) * float(rng.random() < 0.8)
    law = PitchTemplate.from_spec(PitchSpec(length=length, width=width, crown=crown)).points
    painted = {}
    for name, place in law.items():
        off = PAINTING * rng.standard_normal(3) * [1.0, 1.0, 0.2]
        painted[name] = place + (0.0 if name == "center_mark" else off)
    for name in [name for name in painted if name.endswith("_top")]:
        foot = painted[name.replace("_top", "_bottom")]
        painted[name] = foot + np.array(
            [0.0, 0.0, law[name][2] - law[name.replace("_top", "_bottom")][2]]
        )
    true = PitchSpec(length=length, width=width, crown=crown, points=_points(painted))
    if rng.random() < 0.5:
        surveyed = {n: p + SURVEY * rng.standard_normal(3) for n, p in painted.items()}
        stated = true.model_copy(update={"points": _points(surveyed)})
        return Pitch(true, stated, "survey of all points")
    taped = PitchSpec(
        length=round(length + TAPE * rng.standard_normal(), 2),
        width=round(width + TAPE * rng.standard_normal(), 2),
        crown=max(0.0, round(crown + 0.03 * rng.standard_normal(), 2)),
    )
    return Pitch(true, taped, "length, width and crown by tape")


def _points(places: dict[str, Floats]) -> dict[str, tuple[float, float, float]]:
    return {name: (float(x), float(y), float(z)) for name, (x, y, z) in places.items()}


def visible_points(camera: RigCamera, pitch: PitchTemplate) -> list[str]:
    """Return the named points of the pitch inside a camera's image."""
    names = list(pitch.points)
    pixels = camera.project(pitch.positions(names))
    inside = _is_inside(camera, pixels)
    return [name for name, there in zip(names, inside, strict=True) if there]


def click_points(
    camera: RigCamera, pitch: PitchTemplate, rng: np.random.Generator
) -> tuple[ClickedMarkings, dict[str, str]]:
    """Return a person's clicks, and by wrong name the name of the point under it.

    Args:
        camera: the true one.
        pitch: the painted pitch.
        rng: this camera's own.
    """
    spread = rng.uniform(*CLICK) * np.sqrt(camera.camera.image_size[0] / 1920.0)
    unit = np.sqrt(CLICK_TAIL / (CLICK_TAIL - 2.0))
    there = visible_points(camera, pitch)
    chosen = list(rng.permutation(there)[: int(rng.integers(8, 18))])
    pixels = camera.project(pitch.positions(chosen)).reshape(-1, 2)
    pixels = pixels + spread / unit * rng.standard_t(CLICK_TAIL, pixels.shape)
    names = {name: name for name in chosen}
    if chosen and rng.random() < MISNAMED:
        victim = str(rng.choice(chosen))
        pairs = [*_CONFUSED, *((two, one) for one, two in _CONFUSED)]
        other = [victim.replace(one, two) for one, two in pairs if one in victim]
        other = [name for name in other if name in pitch.points and name not in names]
        if other:
            names[victim] = str(rng.choice(other))
    points = tuple(
        ClickedPoint(name=names[name], xy=_round_click(camera, xy))
        for name, xy in zip(chosen, pixels, strict=True)
    )
    drawn: list[DrawnMarking] = []
    if len(there) < FEW:
        for name in pitch.marking_names:
            course = camera.project(pitch.marking_points(name, 0.3))
            course = course[_is_inside(camera, course)]
            if len(course) < 8 or np.ptp(course, axis=0).max() < 80.0:
                continue
            rows = np.sort(
                rng.choice(len(course), min(len(course), int(rng.integers(4, 11))), False)
            )
            line = course[rows] + 1.3 * spread / unit * rng.standard_t(CLICK_TAIL, (len(rows), 2))
            drawn.append(DrawnMarking(name=name, xy=tuple(_round_click(camera, xy) for xy in line)))
    markings = ClickedMarkings(points=points, drawn=tuple(drawn))
    return markings, {new: name for name, new in names.items() if new != name}


def _is_inside(camera: RigCamera, pixels: Floats) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        inside = (pixels > _MARGIN) & (pixels < camera.camera.image_size - 1.0 - _MARGIN)
    return np.asarray(inside.all(axis=-1))


def _round_click(camera: RigCamera, xy: Floats) -> tuple[float, float]:
    x, y = np.clip(xy, 0.0, camera.camera.image_size - 1.0)
    return round(float(x), 1), round(float(y), 1)


def measure_camera(camera: Camera, accuracy: float, rng: np.random.Generator) -> Camera:
    """Return a camera with the errors of another calibration.

    Args:
        camera: the true one.
        accuracy: 1 = 0.3 mrad, 2 cm, 0.05 % and a thousandth of k1; in proportion.
        rng: this camera's own.
    """
    turn = accuracy * 3e-4 * rng.standard_normal(3)
    center = camera.center + accuracy * 0.02 * rng.standard_normal(3)
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    u, _, vt = np.linalg.svd((np.eye(3) + cross) @ camera.cam_from_world.rotation)
    rotation = u @ vt
    distortion = camera.distortion.copy()
    distortion[0] += accuracy * 1e-3 * rng.standard_normal()
    return Camera(
        focal=camera.focal * (1.0 + accuracy * 5e-4 * rng.standard_normal()),
        principal_point=camera.principal_point,
        distortion=distortion,
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=camera.image_size,
    )
