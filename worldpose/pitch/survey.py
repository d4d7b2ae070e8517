"""Survey of a pitch: its CSV file of named points, and its alignment with the world frame.

The alignment gives a rigid transform, length, width, crown and residuals. Checks before and after
it reject surveys in another unit, in a mirrored frame, or with wrong names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from pydantic import Field

from data_contracts.arrays import Floats
from data_contracts.pitch import PitchSpec, TemplateName
from data_contracts.records import Record
from worldpose.errors import InputError
from worldpose.parsing import read_cells
from worldpose.pitch.laws import places_by_size, prescribed_markings, prescribed_points

COLUMNS: Final[Mapping[str, str]] = {
    "x": "x",
    "y": "y",
    "z": "z",
    "easting": "x",
    "northing": "y",
    "height": "z",
    "elevation": "z",
}
"""Axis of each column; a grid's easting and northing make a right-handed frame whatever their order
in the file."""


@dataclass(frozen=True, eq=False)
class Survey:
    """Surveyed positions of named points, in the surveyor's own frame.

    Attributes:
        where: the file, for messages.
        names: names of the pitch template's points, each once.
        places: (n, 3) [m]; z is up, NaN without a height.
    """

    where: str
    names: tuple[str, ...]
    places: Floats
    template: TemplateName = "football"

    @property
    def usual(self) -> PitchSpec:
        """The pitch with the dimensions of the template."""
        return PitchSpec(template=self.template)


def read_survey(path: Path, template: TemplateName = "football") -> Survey:
    """Read the positions in a CSV file with the columns name, x, y and, if heights are known, z.

    A name is a point of the pitch template, or an end of a line as `<line>.start` or `<line>.end`.
    `easting`, `northing` and `height` or `elevation` may replace x, y and z, and `point` name; a
    unit `(m)` or `[m]` may follow. `read_cells` says how the text may be saved. InputError names
    file and row of a missing or unknown column, an unknown or repeated name, or text that is no
    number.
    """
    most = 1 << 20  # all named points take 3 kB
    rows, has_commas = read_cells(path, most, "Correct the survey file.")
    if not rows:
        raise _wrong(str(path), "a header and one row for each point", "nothing")
    header = [re.sub(r"\s*[\[(]m[\])]$", "", title.strip().lower()) for title in rows[0][1]]
    header = ["name" if title == "point" else title for title in header]
    axes = [COLUMNS.get(title) for title in header if title != "name"]
    if (
        header.count("name") != 1
        or None in axes
        or sorted(map(str, axes)) not in (["x", "y"], ["x", "y", "z"])
    ):
        raise _wrong(
            f"{path}: row 1",
            "the columns name, x, y and, where there are heights, z (or easting, northing, height)",
            ", ".join(rows[0][1]),
        )
    ends = line_ends(template)
    known = [*prescribed_points(PitchSpec(template=template)), *ends]
    places: dict[str, list[float]] = {}
    for number, row in rows[1:]:
        where = f"{path}: row {number}"
        if len(row) != len(header):
            raise _wrong(where, f"{len(header)} columns", f"{len(row)}")
        values = {title: text.strip() for title, text in zip(header, row, strict=True)}
        given = values.pop("name")
        if given not in known:
            close = get_close_matches(given, known, n=1)
            todo = f"Did you mean {close[0]!r}?" if close else f"Known: {', '.join(known)}."
            raise _wrong(f"{where}: name", "a point, or an end of a line", repr(given), todo)
        name = ends.get(given, given)
        if name in places:
            raise _wrong(f"{where}: name", "every point once", f"{given!r}, which is {name} again")
        if has_commas:
            values = {title: text.replace(",", ".") for title, text in values.items()}
        place = {COLUMNS[title]: _number(f"{where}: {title}", title, values) for title in values}
        places[name] = [place["x"], place["y"], place.get("z", math.nan)]
    return Survey(
        str(path), tuple(places), np.array(list(places.values())).reshape(-1, 3), template
    )


def line_ends(template: TemplateName) -> dict[str, str]:
    """Return the point for every `<line>.start` and `<line>.end`."""
    lines = prescribed_markings(PitchSpec(template=template)).lines
    starts = {f"{name}.start": line.start for name, line in lines.items()}
    return starts | {f"{name}.end": line.end for name, line in lines.items()}


def _number(where: str, title: str, values: Mapping[str, str]) -> float:
    """Return the finite number in a column of one row; NaN for an empty height."""
    text = values[title]
    if COLUMNS[title] == "z" and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _wrong(where, "a number", repr(text))
    return value


def _wrong(
    where: str, expected: str, found: str, todo: str = "Correct the survey file."
) -> InputError:
    return InputError(where, expected=expected, found=found, todo=todo)


class SurveySettings(Record):
    """Plausible properties of a survey, and priors where it determines nothing."""

    left_handed: bool = False
    """Whether x, y and height of the survey are a left-handed frame, such as x north and y east."""
    fit_scale: bool = False
    """Divide by the survey's scale, as of a map projection, instead of only reporting it."""
    accuracy_m: float = Field(default=0.03, ge=1e-6, le=10)
    """Standard deviation of painted markings from the rules [m]: a quarter of a line."""
    max_offset_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Offset beyond which a point's name is wrong [m]: no painter errs by that much."""
    max_scale_error: float = Field(default=0.08, ge=1e-6, le=10)
    """Deviation of the scale from 1 beyond which lengths have another unit [1]: yards differ by 9
    %; a survey of the corners alone passes for pitches of 97 to 113 m by 63 to 73 m."""
    length_std_m: float = Field(default=5.0, ge=1e-6, le=1000)
    """Standard deviation of lengths around the template's [m]: prior of a length not surveyed."""
    width_std_m: float = Field(default=4.0, ge=1e-6, le=1000)
    """Standard deviation of widths around the template's [m]: as `length_std_m`."""
    crown_std_m: float = Field(default=0.1, ge=1e-6, le=10)
    """Standard deviation of crowns around the template's [m]: as `length_std_m`."""
    slope_std: float = Field(default=0.01, ge=1e-6, le=1)
    """Standard deviation of the pitch's slope across it [1]: 1 %, the most on sport grounds."""


def _usual_size(survey: Survey) -> tuple[float, float]:
    """Return the initial length and width of a pitch [m]."""
    return survey.usual.length, survey.usual.width


def _nominal_places(survey: Survey) -> Floats:
    """Return the points' positions in plan (n, 2) [m] on a pitch of the usual size."""
    return places_by_size(survey.usual, _usual_size(survey), survey.names)[0][:, :2]


def _best_rotation(centred: Floats, places: Floats) -> Floats:
    """Return the rotation (2, 2) that brings centred points nearest to others."""
    (a, b), (c, d) = centred.T @ (places - places.mean(axis=0))
    return _plane_rotation(float(np.arctan2(b - c, a + d)))


def _plane_rotation(angle: float) -> Floats:
    """Return the rotation (2, 2) by an angle [rad], from x towards y."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def _require_spread(survey: Survey) -> None:
    """Reject fewer than four points, or points near one line."""
    enough = len(survey.names) >= 4
    for places in (survey.places[:, :2], _nominal_places(survey)) if enough else ():
        extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        enough = enough and extents[1] > 0.05 * extents[0]
    if not enough:
        raise InputError(
            survey.where,
            expected="at least four points that do not lie near one line",
            found=f"{len(survey.names)}: {', '.join(survey.names) or 'none'}",
            todo="Survey the four corners, and the penalty areas if there is time.",
        )


def _require_orientation(survey: Survey, places: Floats, settings: SurveySettings) -> None:
    """Reject a survey whose mirror image fits far better than the survey."""
    nominal = _nominal_places(survey)
    target = nominal - nominal.mean(axis=0)
    errors = []
    for mirror in ((1.0, 1.0), (1.0, -1.0)):
        centred = (places - places.mean(axis=0)) * mirror
        centred = centred * np.linalg.norm(target) / np.linalg.norm(centred)
        off = centred @ _best_rotation(centred, target).T - target
        errors.append(float(np.median(np.linalg.norm(off, axis=-1))))
    if errors[1] < 0.5 * errors[0]:
        raise InputError(
            survey.where,
            expected="left and right, near and far as seen from the main camera",
            found="a mirror image of the pitch",
            todo="Exchange left and right in the names, or say that the frame is "
            f"{'right' if settings.left_handed else 'left'}-handed (x north and y east are "
            "left-handed; columns named easting and northing need not say so).",
        )


def _require_names(survey: Survey, offsets: Floats, settings: SurveySettings) -> None:
    """Reject points that are far from the positions of their names."""
    offset = np.linalg.norm(offsets, axis=-1)
    far = [
        f"{survey.names[n]} ({offset[n]:.2f} m)"
        for n in np.argsort(-offset)
        if offset[n] > settings.max_offset_m
    ]
    if far:
        raise InputError(
            survey.where,
            expected=f"every point within {settings.max_offset_m:g} m of the place of its name",
            found=f"farther off: {', '.join(far[:6])}",
            todo="Exchange or correct these names, or remove the points from the file; markings of "
            "other rules have `dimensions` in pitch.json.",
        )


@dataclass(frozen=True, eq=False)
class SurveyFit:
    """A surveyed pitch, and its residuals from the rules of the game.

    Attributes:
        pitch: length, width, crown and the surveyed points in the world frame.
        names: names of the points, as in the survey.
        offset_plan: (n,) distance in plan between survey and law [m].
        offset_height: (n,) height of the survey above the crowned surface [m]; NaN without height.
        scale: survey lengths over true ones, from markings of prescribed size [1].
        slope: slope of the pitch's plane before levelling, along x and y of the world [1].
        measured: which of length, width and crown the survey determined; others are standard.
    """

    pitch: PitchSpec
    names: tuple[str, ...]
    offset_plan: Floats
    offset_height: Floats
    scale: float
    slope: tuple[float, float]
    measured: tuple[str, ...]


def fit_survey(survey: Survey, settings: SurveySettings | None = None) -> SurveyFit:
    """Fit the pitch to a survey in any frame with heights upwards, and move it to the world.

    The names determine the orientation: left and right, near and far are those of a person at the
    main camera, which stands at negative y. The frame is rotated, shifted and levelled, and scaled
    only with `fit_scale`. Length, width and crown are fitted by least squares; values that the
    survey does not determine stay near those of the template.

    InputError for fewer than four points, or all near one line; another unit than metres; a mirror
    image; points far from the positions of their names.
    """
    settings = settings or SurveySettings()
    _require_spread(survey)
    places = survey.places * (1.0, -1.0 if settings.left_handed else 1.0, 1.0)
    places = places - np.append(places[:, :2].mean(axis=0), 0.0)  # a grid's numbers are large
    _require_orientation(survey, places[:, :2], settings)
    scale = _estimate_scale(survey, places[:, :2], settings)
    if settings.fit_scale:
        places = places / scale
    level = np.eye(3)
    for _ in range(2):
        plan, heights = _fit_plan_and_heights(survey, _rotate_to_level(places, level), settings)
        level = _leveling_rotation(plan.turn.T @ heights.slope) @ level
    plan, heights = _fit_plan_and_heights(survey, _rotate_to_level(places, level), settings)
    _require_names(survey, plan.places - plan.law, settings)
    world = np.column_stack([plan.places, heights.places])
    pitch = PitchSpec(
        template=survey.template,
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


class _Plan(NamedTuple):
    """The survey in plan, in the world: survey and law (n, 2) [m], and the rotation."""

    places: Floats
    law: Floats
    turn: Floats
    length: float
    width: float
    measured: tuple[str, ...]


class _Heights(NamedTuple):
    """Heights in the world and over the crowned surface (n,) [m]."""

    places: Floats
    offset: Floats
    crown: float
    slope: Floats
    measured: bool


def _fit_plan_and_heights(
    survey: Survey, places: Floats, settings: SurveySettings
) -> tuple[_Plan, _Heights]:
    plan = _fit_plan(survey, places[:, :2], settings)
    return plan, _fit_heights(survey, plan, places[:, 2], settings)


def _rotate_to_level(places: Floats, level: Floats) -> Floats:
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
    survey: Survey, places: Floats, settings: SurveySettings, stretch: bool = False
) -> _Plan:
    """Fit rotation, shift, length and width by robust least squares, with `stretch` the scale."""
    middle = places.mean(axis=0)
    centred = places - middle
    usual, gross = _usual_size(survey), _gross_scale(survey, places)
    # The fit converges over a third; a smaller pitch starts at the size that it seems to have.
    size = np.array(usual) * (gross if gross <= 0.7 else 1.0)
    law = _nominal_places(survey)
    turn, shift = _best_rotation(centred, law), law.mean(axis=0)
    spreads = np.array([settings.length_std_m, settings.width_std_m])
    scale = 1.0
    # The loss has its final width after ten iterations.
    for iteration in range(30):
        turned = centred @ turn.T
        given = float(size[0]), float(size[1])
        law, change = places_by_size(survey.usual, given, survey.names)
        residual = scale * turned + shift - law[:, :2]
        # Wide at first: the start may be metres off if the pitch has another size.
        loss = max(3.0 * settings.accuracy_m, 3.0 * 0.7**iteration)
        weight = 1.0 / (1.0 + np.sum(residual**2, axis=-1) / loss**2)
        jacobian = np.zeros((len(places), 2, 6))
        jacobian[..., 0] = scale * turned @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        jacobian[:, [0, 1], [1, 2]] = 1.0
        jacobian[:, [0, 1], [3, 4]] = -change
        jacobian[..., 5] = turned if stretch else 0.0
        root = np.sqrt(weight)[:, None] / settings.accuracy_m
        rows = np.concatenate([(jacobian * root[..., None]).reshape(-1, 6), np.zeros((2, 6))])
        rows[[-2, -1], [3, 4]] = 1.0 / spreads
        right = np.concatenate([(residual * root).ravel(), (size - usual) / spreads])
        step = -np.linalg.lstsq(rows, right, rcond=None)[0]
        turn = _plane_rotation(step[0]) @ turn
        shift, size, scale = shift + step[1:3], size + step[3:5], scale + step[5]
    covariance = np.linalg.pinv(rows[:, :5].T @ rows[:, :5])
    known = np.sqrt(np.diagonal(covariance))[3:] < 0.5 * spreads
    return _Plan(
        places=scale * centred @ turn.T + shift,
        law=law[:, :2] + change * step[3:5],
        turn=scale * turn,
        length=float(size[0]),
        width=float(size[1]),
        measured=tuple(
            n for n, is_known in zip(("length", "width"), known, strict=True) if is_known
        ),
    )


def _fit_heights(
    survey: Survey, plan: _Plan, heights: Floats, settings: SurveySettings
) -> _Heights:
    """Fit level, slope and crown by least squares to the points with a height."""
    above = places_by_size(survey.usual, _usual_size(survey), survey.names)[0][:, 2]
    ridge = -((plan.places[:, 1] / (0.5 * plan.width)) ** 2)
    taken = np.isfinite(heights)
    if not taken.any():
        crown = survey.usual.crown
        return _Heights(above + crown * ridge, heights, crown, np.zeros(2), False)
    base = float(heights[taken].mean())
    rows = np.column_stack([np.ones(len(ridge)), plan.places, ridge])[taken] / settings.accuracy_m
    prior = np.zeros((3, 4))
    prior[[0, 1, 2], [1, 2, 3]] = 1.0 / np.array(
        [settings.slope_std, settings.slope_std, settings.crown_std_m]
    )
    right = (heights - base - above)[taken] / settings.accuracy_m
    right = np.concatenate([right, prior @ (0.0, 0.0, 0.0, survey.usual.crown)])
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
        measured=bool(spread < 0.5 * settings.crown_std_m),
    )


def _leveling_rotation(slope: Floats) -> Floats:
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


def _gross_scale(survey: Survey, places: Floats) -> float:
    """Return the extent of surveyed points over that on a pitch of the usual size [1]."""
    nominal = _nominal_places(survey)
    extents = [np.linalg.norm(each - each.mean(axis=0)) for each in (places, nominal)]
    return float(extents[0] / extents[1])


def _estimate_scale(survey: Survey, places: Floats, settings: SurveySettings) -> float:
    """Return the ratio of lengths in the survey to true ones; reject that of another unit."""
    gross = scale = _gross_scale(survey, places)
    if 0.3 < gross < 1.3:  # no unit is as near, and the fit converges: prescribed markings decide
        turn = _fit_plan(survey, places, settings, stretch=True).turn
        scale = 1.0 / float(np.sqrt(np.linalg.det(turn)))
    if abs(scale - 1.0) <= settings.max_scale_error:
        return scale
    units = {"feet": 1 / 0.3048, "yards": 1 / 0.9144, "centimetres": 100.0, "millimetres": 1000.0}
    near = [name for name, unit in units.items() if abs(scale / unit - 1.0) < 0.06]
    raise InputError(
        survey.where,
        expected="metres",
        found=f"lengths {scale:.4g} {'of' if scale < 1.0 else 'times'} the true length"
        + (f", as {near[0]} are" if near else ""),
        todo="Convert the file to metres. Corners alone do not tell another size than about "
        f"{survey.usual.length:g} x {survey.usual.width:g} m: add markings of prescribed size, "
        "such as penalty areas.",
    )
