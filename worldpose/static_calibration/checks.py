"""Checks of clicks and fits, whose errors say which clicks to add."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.pitch.laws import law_points
from worldpose.static_calibration.adjustment import Problem, adjust, camera_of_row
from worldpose.static_calibration.click_outliers import (
    Screened,
    at_noise,
    improbability,
    screen,
    screen_at_best_noise,
)
from worldpose.static_calibration.evidence import Evidence
from worldpose.static_calibration.initialization import from_homographies, plausible_cameras
from worldpose.static_calibration.next_click import most_helpful, off_the_line
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.settings import StaticCalibrationSettings

_POINTS: Final = 4
"""Minimum clicked points without a drawn marking [1]: those of a homography."""
_CONSTRAINTS: Final = 6
"""Minimum constraints with a drawn marking [1]: pose; the prior holds the focal length."""
_LINE: Final = 2
"""Constraints of a straight marking, whatever its drawn length [1]."""
_ARC: Final = 4
"""Constraints of an arc [1]: five of its ellipse, less one for the rotation of the circle."""
_OFF_LINE: Final = 1.0
"""Root mean square distance from a line below which points count as collinear [m]."""
_POSE_SPREAD: Final = np.array([1.0, 1.0, 1.0, 30.0, 30.0, 30.0, 0.7])
"""Spread of pose and focal length without information [rad, m, 1]: the clicks do not determine
directions with a larger standard deviation."""
_UNTOLD: Final = 2
"""Undetermined directions of pose and focal length from which the check fails [1]."""
_MIRRORED_GAIN: Final = 0.25
"""Names count as mirrored if mirroring leaves less than this share of the cost [1]."""
_SUSPICIOUS: Final = 0.2
"""Share of outliers above which the check tries mirrored names [1]."""
_FAR: Final = 4.0
"""Mean loss per observation in the stated noise [1] from which to try other explanations."""
_MANY: Final = 9.0
"""Cauchy scale of clicks [standard deviations] while mirrored names compete."""
_BELIEVED: Final = 0.1
"""Maximum share of outliers of a camera that rests on an assumption [1]."""
_CLOSE: Final = 4.0
"""Maximum mean loss per observation of such a camera [1]: twice the stated noise."""
_SAME_SIZE: Final = 0.5
"""Difference in length or width that clicks cannot resolve [m]."""
_UNIT_GAIN: Final = 14.0
"""Twice the logarithm of the minimum probability ratio in favor of a pitch in yards [1]: a
thousand, since the fault is rare."""
YARD: Final = 0.9144
"""[m]"""


def check_amount(evidence: Evidence, pitch: PitchTemplate, where: str) -> None:
    """Raise InputError when the clicks are too few, or on one line, for any camera."""
    points, found = len(evidence.points), _found(evidence)
    if not evidence.markings:
        if points < _POINTS:
            more = off_the_line(pitch, evidence.points_world)
            new = [name for name in more if name not in evidence.points]
            raise InputError(
                where,
                expected=f"{_POINTS} clicked points or more, better 8, or drawn markings as well",
                found=found,
                todo=f"Add what the picture shows of {', '.join(new)}, far from the others.",
            )
        plan = evidence.points_world[:, :2]
        spread = np.linalg.svd(plan - plan.mean(axis=0), compute_uv=False)[1]
        if spread < _OFF_LINE * np.sqrt(points):
            more = off_the_line(pitch, evidence.points_world)
            raise InputError(
                where,
                expected="points off one line",
                found=f"{found}, all on one line of the pitch",
                todo=f"Add what the picture shows of {', '.join(more)}, off that line.",
            )
        return
    numbers = 2 * points
    for index in range(len(evidence.markings)):
        pixels = int((evidence.drawn_marking == index).sum())
        numbers += min(pixels, _LINE if evidence.straight[index] else _ARC)
    if numbers < _CONSTRAINTS:
        places = np.concatenate([evidence.points_world, evidence.samples_world])
        more = off_the_line(pitch, places)
        raise InputError(
            where,
            expected="three straight markings in two directions, or two points and a marking",
            found=found,
            todo=f"Draw another marking, or add what the picture shows of {', '.join(more)}.",
        )


def has_enough_points(evidence: Evidence) -> bool:
    """Return whether the clicked points alone can determine a camera."""
    plan = evidence.points_world[:, :2]
    if len(plan) < _POINTS:
        return False
    spread = np.linalg.svd(plan - plan.mean(axis=0), compute_uv=False)[1]
    return bool(spread >= _OFF_LINE * np.sqrt(len(plan)))


def is_suspicious(fit: Screened, factor: float) -> bool:
    """Return whether outliers or residuals suggest wrong names or a cropped image.

    Args:
        fit: fit to the clicks.
        factor: its noise over the stated noise.
    """
    return _wrong_share(fit) > _SUSPICIOUS or fit.misfit * factor**2 >= _FAR


def _explains(fit: Screened) -> bool:
    """Return whether a fit has few outliers and small residuals."""
    return _wrong_share(fit) <= _BELIEVED and bool(fit.misfit < _CLOSE)


def check_mirrored(problem: Problem, fit: Screened, settings: StaticCalibrationSettings) -> None:
    """Raise InputError when mirroring the names explains the clicks."""
    if _mirrored_fits(problem, fit, settings):
        raise InputError(
            problem.where,
            expected="names as seen from this camera's side of the pitch",
            found=f"{_found(problem.evidence)} that fit only with left and right exchanged",
            todo="Exchange left and right (or near and far) in all names: left is negative x, "
            "near is negative y, the main camera's side.",
        )


def check_agreement(
    problem: Problem,
    fit: Screened,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
    stated: StaticCalibrationSettings,
) -> None:
    """Raise InputError if no camera explains most clicks, or a pitch of another size does.

    Args:
        problem: the clicks, at the most probable noise.
        fit: fit to them.
        pitch: the template.
        settings: settings at that noise.
        stated: settings as given.
    """
    evidence, wrong = problem.evidence, _wrong_share(fit)
    factor = settings.click_noise / stated.click_noise
    if is_suspicious(fit, factor):
        fitting = _fitting_size(at_noise(problem, 1.0 / factor, settings)[0], pitch, stated)
        if fitting is not None:
            raise _other_size(problem, pitch, *fitting)
    if wrong > settings.max_wrong_share:
        kept = [n for n, inlier in zip(evidence.points, fit.inliers, strict=True) if inlier]
        raise InputError(
            problem.where,
            expected=f"at most {settings.max_wrong_share:.0%} wrong clicks",
            found=f"{wrong:.0%}: no camera sees more of them in place than {', '.join(kept)}",
            todo="Check the names of the others, image_size, and the size of the pitch in "
            "pitch.json.",
        )


def check_unit(
    problem: Problem,
    best: tuple[Problem, Screened, StaticCalibrationSettings],
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
) -> None:
    """Raise InputError when a pitch whose size is in yards explains the clicks far better.

    With lens distortion and one or two outliers, the clicks also fit a pitch that is 9 % too large.

    Args:
        problem: the clicks, at the stated noise.
        best: its best explanation in metres, which may assume a cropped image.
        pitch: the template.
        settings: settings as given.
    """
    size = YARD * pitch.length, YARD * pitch.width
    other = _start_on_size(problem, *size, settings)
    # A score of points alone decides nothing where drawn markings also constrain the camera.
    if other is None or problem.evidence.markings:
        return
    try:
        found = screen_at_best_noise(*other, settings)
    except InputError:
        return
    in_yards, given = (
        improbability(*each, factor=each[2].click_noise / settings.click_noise, with_prior=True)
        for each in (found, best)
    )
    if in_yards < given - _UNIT_GAIN and _wrong_share(found[1]) <= _BELIEVED:
        raise _other_size(problem, pitch, *size, "it seems to be in yards")


def _other_size(
    problem: Problem, pitch: PitchTemplate, length: float, width: float, about: str
) -> InputError:
    return InputError(
        "pitch.json: length, width",
        expected=f"the size of the pitch in metres; the clicks of {problem.where} fit "
        f"{length:.1f} x {width:.1f} m",
        found=f"{pitch.length:g} x {pitch.width:g}",
        todo=f"Correct the size: {about}.",
    )


def _wrong_share(fit: Screened) -> float:
    return 1.0 - float(fit.inliers.mean()) if len(fit.inliers) else 0.0


def _fitting_size(
    problem: Problem, pitch: PitchTemplate, settings: StaticCalibrationSettings
) -> tuple[float, float, str] | None:
    """Return length and width [m] that explain the clicked points, and the likely mistake."""
    sizes = [
        (YARD * pitch.length, YARD * pitch.width, "it seems to be in yards"),
        (105.0, 68.0, "it seems to be another pitch's"),
    ]
    for length, width, about in sizes:
        if abs(length - pitch.length) < _SAME_SIZE and abs(width - pitch.width) < _SAME_SIZE:
            continue
        found = _start_on_size(problem, length, width, settings)
        if found is None:
            continue
        try:
            fit = screen(*found, settings)
        except InputError:
            continue
        if _explains(fit):
            return length, width, about
    return None


def _start_on_size(
    problem: Problem, length: float, width: float, settings: StaticCalibrationSettings
) -> tuple[Problem, NDArray[np.float64]] | None:
    """Return the clicked points on a pitch of another size, and a camera (22,) near the answer.

    Args:
        problem: clicks, noise and prior.
        length: of the other pitch [m].
        width: of the other pitch [m].
        settings: with the prior of cameras.

    Returns:
        None if a point is not in the Laws, or the points determine no camera.
    """
    evidence, laws = problem.evidence, law_points(length, width)
    if not set(evidence.points) <= laws.keys() or not has_enough_points(evidence):
        return None
    world = np.array([laws[name] for name in evidence.points])
    world[:, 2] = evidence.points_world[:, 2]
    points = _points_alone(problem)
    other = replace(points, evidence=replace(points.evidence, points_world=world))
    rows = from_homographies(other, settings.prior, leave_out=False)
    if not len(rows):
        return None
    start = adjust(other, rows, click_loss=_MANY)
    return other, start.rows[np.argmin(start.cost)]


def _points_alone(problem: Problem) -> Problem:
    evidence = problem.evidence
    none = np.zeros(len(evidence.markings), dtype=np.bool_)
    return problem.only(np.ones(len(evidence.points), dtype=np.bool_), none)


def check_determined(
    problem: Problem,
    fit: Screened,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
    where: str,
) -> None:
    """Raise InputError when the prior alone determines several directions of the camera."""
    block = fit.evidence_information[:7, :7] * np.outer(_POSE_SPREAD, _POSE_SPREAD)
    untold = int((np.linalg.eigvalsh(block) < 1.0).sum())
    if untold < _UNTOLD:
        return
    evidence = problem.evidence
    estimate = CameraEstimate(camera_of_row(fit.row, problem.image_size), fit.covariance)
    clicked = (*evidence.points, *evidence.markings)
    more = most_helpful(estimate, pitch, clicked, settings.click_noise)
    if not more:
        more = off_the_line(pitch, np.concatenate([evidence.points_world, evidence.samples_world]))
    raise InputError(
        where,
        expected="clicks that determine where the camera stands and looks",
        found=f"{_found(evidence)}, which leave {untold} of its 7 degrees of freedom open",
        todo=f"Add what the picture shows of {', '.join(more)}: these would tell most.",
    )


def _mirrored_fits(problem: Problem, fit: Screened, settings: StaticCalibrationSettings) -> bool:
    flip = np.array([-1.0, 1.0, 1.0])
    evidence = replace(
        problem.evidence,
        points_world=problem.evidence.points_world * flip,
        samples_world=problem.evidence.samples_world * flip,
    )
    mirrored = replace(problem, evidence=evidence)
    rows = from_homographies(mirrored, settings.prior, leave_out=False)
    if not len(rows):
        rows = plausible_cameras(mirrored, settings.prior)
        weighed = adjust(mirrored, rows, click_loss=_MANY, iterations=0)
        rows = rows[np.argsort(weighed.cost, kind="stable")[: settings.search_cameras]]
    best = adjust(mirrored, rows, click_loss=_MANY).cost.min()
    given = adjust(problem, fit.row[None], click_loss=_MANY).cost[0]
    return bool(best < _MIRRORED_GAIN * given)


def _found(evidence: Evidence) -> str:
    parts = []
    if evidence.points:
        parts.append(f"{len(evidence.points)} points ({', '.join(evidence.points)})")
    if evidence.markings:
        parts.append(f"{len(evidence.markings)} markings ({', '.join(evidence.markings)})")
    return " and ".join(parts)
