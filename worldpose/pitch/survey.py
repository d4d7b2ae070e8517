"""Alignment of a survey with the world frame: rigid transform, length, width, crown, residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.pitch.survey_checks import (
    STANDARD_SIZE,
    best_turn,
    law_places,
    nominal_places,
    plane_rotation,
    require_names,
    require_orientation,
    require_spread,
)
from worldpose.pitch.survey_file import Survey
from worldpose.pitch.survey_settings import SurveySettings


@dataclass(frozen=True, eq=False)
class SurveyFit:
    """A surveyed pitch, and its residuals from the Laws of the Game.

    Attributes:
        pitch: length, width, crown and the surveyed points in the world frame.
        names: of the points, as in the survey.
        offset_plan: (n,) distance in plan between survey and law [m].
        offset_height: (n,) height of the survey above the crowned surface [m]; NaN without height.
        scale: survey lengths over true ones, from markings of prescribed size [1].
        slope: slope of the pitch's plane before levelling, along x and y of the world [1].
        measured: which of length, width and crown the survey determined; others are standard.
    """

    pitch: PitchSpec
    names: tuple[str, ...]
    offset_plan: NDArray[np.float64]
    offset_height: NDArray[np.float64]
    scale: float
    slope: tuple[float, float]
    measured: tuple[str, ...]


def fit_survey(survey: Survey, settings: SurveySettings | None = None) -> SurveyFit:
    """Fit the pitch to a survey in any frame with heights upwards, and move it to the world frame.

    The names determine the orientation: left and right, near and far are those of a person at the
    main camera, which stands at negative y. The frame is rotated, shifted and levelled, and scaled
    only with `fit_scale`. Length, width and crown are fitted by least squares; values that the
    survey does not determine stay near 105 m, 68 m and 0.2 m.

    Args:
        survey: named positions.
        settings: the defaults if None.

    Raises:
        InputError: fewer than four points, or all near one line; another unit than metres; a
            mirror image; points far from the positions of their names.

    Note:
        C1.
    """
    settings = settings or SurveySettings()
    require_spread(survey)
    places = survey.places * (1.0, -1.0 if settings.left_handed else 1.0, 1.0)
    places = places - np.append(places[:, :2].mean(axis=0), 0.0)  # a grid's numbers are large
    require_orientation(survey, places[:, :2], settings)
    scale = _scale(survey, places[:, :2], settings)
    if settings.fit_scale:
        places = places / scale
    level = np.eye(3)
    for _ in range(2):
        plan, heights = _fit(survey, _levelled(places, level), settings)
        level = _levelling(plan.turn.T @ heights.slope) @ level
    plan, heights = _fit(survey, _levelled(places, level), settings)
    require_names(survey, plan.places - plan.law, settings)
    world = np.column_stack([plan.places, heights.places])
    pitch = PitchSpec(
        length=round(plan.length, 4),
        width=round(plan.width, 4),
        crown=round(max(heights.crown, 0.0), 4),
        points={
            name: (round(x, 4), round(y, 4), round(z, 4))
            for name, (x, y, z) in zip(survey.names, world.tolist(), strict=True)
        },
    )
    fall = plan.turn @ (-level[2, :2] / level[2, 2])
    return SurveyFit(
        pitch=pitch,
        names=survey.names,
        offset_plan=np.linalg.norm(plan.places - plan.law, axis=-1),
        offset_height=heights.offset,
        scale=scale,
        slope=(float(fall[0]), float(fall[1])),
        measured=(*plan.measured, *(("crown",) if heights.measured else ())),
    )


@dataclass(frozen=True, eq=False)
class _Plan:
    """The survey in plan, in the world: survey and law (n, 2) [m], and the rotation."""

    places: NDArray[np.float64]
    law: NDArray[np.float64]
    turn: NDArray[np.float64]
    length: float
    width: float
    measured: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Heights:
    """Heights in the world and over the crowned surface (n,) [m]."""

    places: NDArray[np.float64]
    offset: NDArray[np.float64]
    crown: float
    slope: NDArray[np.float64]
    measured: bool


_ROUNDS: Final = 30
"""Iterations of reweighted Gauss-Newton; the loss has its final width after ten."""


def _fit(
    survey: Survey, places: NDArray[np.float64], settings: SurveySettings
) -> tuple[_Plan, _Heights]:
    plan = _fit_plan(survey, places[:, :2], settings)
    return plan, _fit_heights(survey, plan, places[:, 2], settings)


def _levelled(places: NDArray[np.float64], level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 3) [m] after a rotation; a point without height lies on the plane."""
    taken = np.isfinite(places[:, 2])
    if not taken.any():
        return places
    base, normal = places[taken].mean(axis=0), level[2]
    plane = base[2] - (places[:, :2] - base[:2]) @ normal[:2] / normal[2]
    filled = np.column_stack([places[:, :2], np.where(taken, places[:, 2], plane)])
    turned = filled @ level.T
    turned[~taken, 2] = np.nan
    return np.asarray(turned)


def _fit_plan(
    survey: Survey, places: NDArray[np.float64], settings: SurveySettings, stretch: bool = False
) -> _Plan:
    """Fit rotation, shift, length and width by robust least squares, with `stretch` the scale."""
    law, change = law_places(survey)
    middle = places.mean(axis=0)
    centred = places - middle
    size = np.array(STANDARD_SIZE)
    turn = best_turn(centred, law[:, :2] + change * size)
    shift = (law[:, :2] + change * size).mean(axis=0)
    spreads = np.array([settings.length_spread, settings.width_spread])
    scale = 1.0
    for round_ in range(_ROUNDS):
        turned = centred @ turn.T
        residual = scale * turned + shift - law[:, :2] - change * size
        # Wide at first: the start may be metres off if the pitch is not 105 x 68 m.
        loss = max(3.0 * settings.accuracy, 3.0 * 0.7**round_)
        weight = 1.0 / (1.0 + np.sum(residual**2, axis=-1) / loss**2)
        jacobian = np.zeros((len(places), 2, 6))
        jacobian[..., 0] = scale * turned @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        jacobian[:, [0, 1], [1, 2]] = 1.0
        jacobian[:, [0, 1], [3, 4]] = -change
        jacobian[..., 5] = turned if stretch else 0.0
        root = np.sqrt(weight)[:, None] / settings.accuracy
        rows = np.concatenate([(jacobian * root[..., None]).reshape(-1, 6), np.zeros((2, 6))])
        rows[[-2, -1], [3, 4]] = 1.0 / spreads
        right = np.concatenate([(residual * root).ravel(), (size - STANDARD_SIZE) / spreads])
        step = -np.linalg.lstsq(rows, right, rcond=None)[0]
        turn = plane_rotation(step[0]) @ turn
        shift, size, scale = shift + step[1:3], size + step[3:5], scale + step[5]
    covariance = np.linalg.pinv(rows[:, :5].T @ rows[:, :5])
    known = np.sqrt(np.diagonal(covariance))[3:] < 0.5 * spreads
    return _Plan(
        places=scale * centred @ turn.T + shift,
        law=law[:, :2] + change * size,
        turn=scale * turn,
        length=float(size[0]),
        width=float(size[1]),
        measured=tuple(
            n for n, is_known in zip(("length", "width"), known, strict=True) if is_known
        ),
    )


def _fit_heights(
    survey: Survey, plan: _Plan, heights: NDArray[np.float64], settings: SurveySettings
) -> _Heights:
    """Fit level, slope and crown by least squares to the points with a height."""
    above = law_places(survey)[0][:, 2]
    ridge = -((plan.places[:, 1] / (0.5 * plan.width)) ** 2)
    taken = np.isfinite(heights)
    if not taken.any():
        crown = PitchSpec().crown
        return _Heights(above + crown * ridge, heights, crown, np.zeros(2), False)
    base = float(heights[taken].mean())
    rows = np.column_stack([np.ones(len(ridge)), plan.places, ridge])[taken] / settings.accuracy
    prior = np.zeros((3, 4))
    prior[[0, 1, 2], [1, 2, 3]] = 1.0 / np.array(
        [settings.slope_spread, settings.slope_spread, settings.crown_spread]
    )
    right = (heights - base - above)[taken] / settings.accuracy
    right = np.concatenate([right, prior @ (0.0, 0.0, 0.0, PitchSpec().crown)])
    rows = np.concatenate([rows, prior])
    level, *slope, crown = np.linalg.lstsq(rows, right, rcond=None)[0].tolist()
    spread = np.sqrt(np.linalg.pinv(rows.T @ rows)[3, 3])
    crown = max(crown, 0.0)
    surface = above + crown * ridge
    world = np.where(taken, heights - base - level, surface)
    return _Heights(
        places=world,
        offset=np.where(taken, world - surface, np.nan),
        crown=crown,
        slope=np.array(slope),
        measured=bool(spread < 0.5 * settings.crown_spread),
    )


def _levelling(slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) that makes a plane with this slope horizontal."""
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope @ slope)
    x, y, z = normal
    return np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y],
            [x, y, z],
        ]
    )


def _scale(survey: Survey, places: NDArray[np.float64], settings: SurveySettings) -> float:
    """Return the ratio of lengths in the survey to true ones.

    Raises:
        InputError: the ratio differs from 1 by more than in any grid.
    """
    nominal = nominal_places(survey)
    extents = [np.linalg.norm(each - each.mean(axis=0)) for each in (places, nominal)]
    gross = float(extents[0] / extents[1])
    scale = gross
    if abs(gross - 1.0) < 0.3:  # within the fit's convergence range: prescribed markings decide
        turn = _fit_plan(survey, places, settings, stretch=True).turn
        scale = 1.0 / float(np.sqrt(np.linalg.det(turn)))
    if abs(scale - 1.0) <= settings.largest_scale:
        return scale
    units = {"feet": 1 / 0.3048, "yards": 1 / 0.9144, "centimetres": 100.0, "millimetres": 1000.0}
    near = [name for name, unit in units.items() if abs(scale / unit - 1.0) < 0.06]
    raise InputError(
        survey.where,
        expected="metres",
        found=f"lengths {scale:.4g} times too large" + (f", as {near[0]} are" if near else ""),
        todo="Convert the file to metres; where only corners are surveyed, add penalty areas.",
    )
