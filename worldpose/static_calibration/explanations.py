"""Explanations of clicks that contradict each other: wrong names, a crop, another pitch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.pitch.laws import prescribed_points
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.click_outliers import (
    CLEAR_GAIN,
    Explanation,
    InlierFit,
    fit_inliers,
    fit_inliers_at_best_noise,
    held_out_error,
    negative_log_posterior,
    scale_noise,
)
from worldpose.static_calibration.evidence import describe_clicks, has_enough_points
from worldpose.static_calibration.fit import CameraProblem, fit_cameras
from worldpose.static_calibration.ground_error import points_off_line, propose_clicks
from worldpose.static_calibration.initialization import (
    cameras_from_homographies,
    find_start,
    fit_from_starts,
    plausible_cameras,
)
from worldpose.static_calibration.parameters import PARAMETERS
from worldpose.static_calibration.settings import StaticCalibrationSettings

_COMPARISON_LOSS: Final = 9.0
"""Cauchy scale of clicks [standard deviations] while mirrored names compete."""
_MAX_OUTLIER_SHARE: Final = 0.1
"""Maximum share of outliers of a camera that rests on an assumption [1]."""


def fit_level_or_rolled(
    problem: CameraProblem,
    begin: Callable[[CameraProblem], Floats],
    stated: StaticCalibrationSettings,
) -> Explanation:
    """Return the explanation of the clicks by a camera of any roll, level if that is as probable.

    Before clicks count as outliers or as noisier than stated, and where the prior of the roll holds
    a camera, a fit with a free roll competes. `begin` returns the start (WIDTH,) of a problem.
    InputError as of `fit_inliers`.
    """
    free_std, off_level = 1.0, 3.0  # of the sine of the roll; of its prior [standard deviations]
    enough, far_off = 12, 25.0  # constraints; mean loss beyond that of level cameras
    level_std, prior = float(problem.prior[13]), problem.prior.copy()
    prior[13] = max(free_std, level_std)
    rolled = replace(problem, prior=prior)

    def search() -> Explanation | None:
        evidence = problem.evidence
        every = np.ones(len(evidence.points), np.bool_), np.ones(len(evidence.markings), np.bool_)
        if evidence.count_constraints(*every) >= enough:
            with suppress(InputError):
                other = fit_inliers_at_best_noise(rolled, begin(rolled), stated)
                kept = evidence.count_constraints(other.fit.inliers, other.fit.markings)
                if kept >= enough and abs(other.fit.row[11]) > off_level * level_std:
                    return other
        return None

    try:
        found = fit_inliers_at_best_noise(problem, begin(problem), stated)
    except InputError:
        if (other := search()) is None:
            raise
        return other
    fit, row = found.fit, found.fit.row[None]
    if _outlier_share(fit) <= 0.2 and fit.misfit * found.noise_factor(stated) ** 2 < far_off:
        # A robust fit takes a hundredth of the time of a search.
        given, free = (fit_cameras(each, row, click_loss=3.0).cost[0] for each in (problem, rolled))
        if 2.0 * (given - free) < CLEAR_GAIN:
            return found
    if (other := search()) is not None:
        own, level = (
            negative_log_posterior(each, factor=each.noise_factor(stated), with_prior=True)
            for each in (other, found)
        )
        if own + 2.0 * np.log(prior[13] / level_std) < level - CLEAR_GAIN:
            return other
    return found


def find_explanation(
    found: Explanation, pitch: PitchTemplate, stated: StaticCalibrationSettings
) -> Explanation:
    """Return the most probable explanation of consistent clicks.

    The image may be a crop, so that the principal point lies elsewhere: pose and focal length
    absorb most of it, and the residuals do not tell. Before many clicks count as outliers, or as
    far noisier than stated, the search is wider, and drawn markings may be wrong.
    """
    max_crop = 0.5  # in widths and heights: a corner of an image of twice its size
    fit, factor = found.fit, found.noise_factor(stated)
    as_stated = scale_noise(found.problem, 1.0 / factor, found.settings)[0]
    problem, best, suspicious = found.problem, found, is_suspicious(fit, factor)
    lowest = negative_log_posterior(best, factor=factor, with_prior=True) - CLEAR_GAIN
    if suspicious:
        check_mirrored(found)
    for row in _other_starts(as_stated, stated) if suspicious else ():
        try:
            other = fit_inliers_at_best_noise(as_stated, row, stated)
        except InputError:
            continue
        factor = other.noise_factor(stated)
        own = negative_log_posterior(other, factor=factor, with_prior=True)
        if own < lowest + CLEAR_GAIN:
            lowest, best = own - CLEAR_GAIN, other
    for assumed, describe in _alternatives(as_stated, suspicious):
        try:
            start = find_start(assumed, stated) if suspicious else fit.row
            other = fit_inliers_at_best_noise(assumed, start, stated)
        except InputError:
            continue
        shift = np.abs(other.fit.row[2:4] - problem.prior[2:4])
        if np.any(shift > max_crop * np.array(problem.image_size)):
            continue
        factor = other.noise_factor(stated)
        own = negative_log_posterior(other, factor=factor, with_prior=True)
        if own < lowest:
            other = replace(other, assumptions=(*found.assumptions, describe(other.fit)))
            lowest, best = own, _extend_to_all(as_stated, assumed, other, factor)
    if suspicious:
        check_agreement(best, pitch, stated)
    noise = best.noise_factor(stated) * best.fit.noise_scale
    if suspicious or best is not found or not best.fit.inliers.all() or noise > 1.0:
        check_unit(as_stated, best, pitch, stated)
    return best


def _other_starts(problem: CameraProblem, settings: StaticCalibrationSettings) -> list[Floats]:
    """Return starts (WIDTH,) without one click each: one wrong name may hold a fit in a minimum."""
    count = len(problem.evidence.points)
    if count > 16:
        return []
    every = np.ones(len(problem.evidence.markings), dtype=np.bool_)
    found = []
    for index in range(count):
        fewer = problem.select(np.arange(count) != index, every)
        rows = cameras_from_homographies(fewer, settings.prior, leave_out=False)
        if len(rows):
            found.append(fit_from_starts(fewer, rows, settings.wrong_click))
    return [row for row, _ in sorted(found, key=lambda one: one[1])[:2]]


def _extend_to_all(
    problem: CameraProblem, assumed: CameraProblem, found: Explanation, factor: float
) -> Explanation:
    """Return an explanation applied to the whole problem: markings that it lacks are outliers."""
    if len(assumed.evidence.drawn_image) == len(problem.evidence.drawn_image):
        return found
    none = np.zeros(len(problem.evidence.markings), dtype=np.bool_)
    whole = scale_noise(problem, factor, found.settings)[0]
    whole = whole.with_survey_error(found.fit.row, found.settings)
    return replace(found, problem=whole, fit=replace(found.fit, markings=none))


def _alternatives(
    problem: CameraProblem, suspicious: bool
) -> Iterator[tuple[CameraProblem, Callable[[InlierFit], str]]]:
    """Yield alternative problems, and functions that describe them; if not suspicious, a crop."""
    evidence, prior = problem.evidence, problem.prior.copy()
    # In widths: covers crops of half the size.
    prior[4] = 0.15 * problem.image_size[0]
    middle = problem.prior[2:4]

    def shift(fit: InlierFit) -> str:
        x, y = fit.row[2:4] - middle
        return (
            f"the principal point lies {x:+.0f}, {y:+.0f} px off the image's center: the image "
            "seems to be cropped"
        )

    names = ", ".join(evidence.markings)
    if suspicious and evidence.markings and has_enough_points(evidence):
        points = np.ones(len(evidence.points), dtype=np.bool_)
        alone = problem.select(points, np.zeros(len(evidence.markings), dtype=np.bool_))
        yield alone, lambda fit: f"{names} left out: drawn elsewhere than the points say"
    # Fewer points or markings do not distinguish a crop from wrong names, nor do markings alone
    # distinguish it from a lens whose axis is oblique.
    if max(len(evidence.points), len(evidence.markings) if suspicious else 0) >= 7:
        yield replace(problem, prior=prior), shift


def try_k3(found: Explanation) -> Explanation:
    """Return the explanation with k3 if it lowers the held-out error, and the decisions."""
    min_residuals = 24  # twice the parameters
    problem, fit, settings = found.problem, found.fit, found.settings
    before = held_out_error(problem, fit)
    decisions = (*found.assumptions, f"held-out error {before:.2f} px with {settings.distortion}")
    count = 2 * int(fit.inliers.sum()) + len(problem.evidence.drawn_image)
    if settings.distortion != "k1_k2":
        return replace(found, assumptions=decisions)
    if count < min_residuals:
        decision = f"k3 kept 0: {count} residuals, tried from {min_residuals}"
        return replace(found, assumptions=(*decisions, decision))
    wider = replace(problem, free=np.arange(len(PARAMETERS)) < len(PARAMETERS))
    more = fit_inliers(wider, fit.row, settings)
    after = held_out_error(wider, more)
    same = bool((more.inliers == fit.inliers).all() and (more.markings == fit.markings).all())
    if same and after < (1.0 - settings.k3_gain) * before:
        decision = f"k3 solved for: held-out error {before:.2f} to {after:.2f} px"
        return Explanation(wider, more, settings, (*decisions, decision))
    decision = f"k3 kept 0: held-out error {before:.2f} px without, {after:.2f} px with it"
    return replace(found, assumptions=(*decisions, decision))


def is_suspicious(fit: InlierFit, factor: float) -> bool:
    """Return whether outliers or residuals suggest wrong names or a cropped image."""
    return _outlier_share(fit) > 0.2 or fit.misfit * factor**2 >= 4.0


def check_mirrored(found: Explanation) -> None:
    """Raise InputError when mirroring the names explains the clicks."""
    if _is_mirrored(found):
        evidence = found.problem.evidence
        raise InputError(
            found.problem.where,
            expected="names as seen from this camera's side of the pitch",
            found=f"{describe_clicks(evidence)} that fit only with left and right exchanged",
            todo="Are the names right and the image is mirrored? Then mirror the video back. Else "
            "exchange left and right (or near and far) in all names: left is negative x, near is "
            "negative y, the main camera's side. If the image is mirrored, people then tell it.",
        )


def check_agreement(
    found: Explanation, pitch: PitchTemplate, stated: StaticCalibrationSettings
) -> None:
    """Raise InputError if no camera explains most clicks, or a pitch of another size does."""
    problem, fit, settings = found.problem, found.fit, found.settings
    evidence, wrong = problem.evidence, _outlier_share(fit)
    factor = found.noise_factor(stated)
    if is_suspicious(fit, factor):
        exact = scale_noise(problem, 1.0 / factor, settings)[0]
        size = _find_size(exact, pitch, stated)
        # Without outliers, clicks that are less exact than stated fit another size by chance.
        if size is not None and (wrong > 0.2 or _fits_better(exact, pitch, size, found, stated)):
            raise _size_error(problem, pitch, size)
    if wrong > settings.max_wrong_share:
        kept = [n for n, inlier in zip(evidence.points, fit.inliers, strict=True) if inlier]
        raise InputError(
            problem.where,
            expected=f"at most {settings.max_wrong_share:.0%} wrong clicks",
            found=f"{wrong:.0%}: no camera sees more of them in place than {', '.join(kept)}",
            todo="Check the names of the others, image_size, and the size of the pitch in "
            "pitch.json.",
        )


class _PitchSize(NamedTuple):
    """Length and width [m] that the clicks may have been made on, and the likely mistake."""

    length: float
    width: float
    mistake: str


def _size_in_yards(pitch: PitchTemplate) -> _PitchSize:
    yard_m = 0.9144
    return _PitchSize(yard_m * pitch.length, yard_m * pitch.width, "it seems to be in yards")


def check_unit(
    problem: CameraProblem,
    best: Explanation,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
) -> None:
    """Raise InputError when a pitch whose size is in yards explains the clicks far better.

    With lens distortion and one or two outliers, the clicks also fit a pitch that is 9 % too large.
    """
    size = _size_in_yards(pitch)
    if _fits_better(problem, pitch, size, best, settings):
        raise _size_error(problem, pitch, size)


def _fits_better(
    problem: CameraProblem,
    pitch: PitchTemplate,
    size: _PitchSize,
    best: Explanation,
    settings: StaticCalibrationSettings,
) -> bool:
    """Return whether a pitch of another size is far more probable than the best explanation."""
    start = _start_on_pitch(problem, pitch, size, settings)
    # A score of points alone decides nothing where drawn markings also constrain the camera.
    if start is None or problem.evidence.markings:
        return False
    points, row = start
    try:
        found = fit_inliers_at_best_noise(points, row, settings)
    except InputError:
        return False
    other, given = (
        negative_log_posterior(each, factor=each.noise_factor(settings), with_prior=True)
        for each in (found, best)
    )
    # Twice the logarithm of a probability ratio of a thousand, since the fault is rare.
    return other < given - 14.0 and _outlier_share(found.fit) <= _MAX_OUTLIER_SHARE


def _size_error(problem: CameraProblem, pitch: PitchTemplate, size: _PitchSize) -> InputError:
    return InputError(
        "pitch.json: length, width",
        expected=f"the size of the pitch in metres; the clicks of {problem.where} fit "
        f"{size.length:.1f} x {size.width:.1f} m",
        found=f"{pitch.length:g} x {pitch.width:g}",
        todo=f"Correct the size: {size.mistake}.",
    )


def _outlier_share(fit: InlierFit) -> float:
    return 1.0 - float(fit.inliers.mean()) if len(fit.inliers) else 0.0


def _find_size(
    problem: CameraProblem, pitch: PitchTemplate, settings: StaticCalibrationSettings
) -> _PitchSize | None:
    """Return another size that explains the clicked points, if there is one."""
    usual = PitchSpec(template=pitch.spec.template)
    another = _PitchSize(usual.length, usual.width, "it seems to be another pitch's")
    sizes = (_size_in_yards(pitch), another)
    for size in sizes:
        other = abs(size.length - pitch.length), abs(size.width - pitch.width)
        # Clicks do not resolve half a metre.
        if max(other) < 0.5:
            continue
        found = _start_on_pitch(problem, pitch, size, settings)
        if found is None:
            continue
        points, row = found
        try:
            fit = fit_inliers(points, row, settings)
        except InputError:
            continue
        # Few outliers, and twice the stated noise at most.
        if _outlier_share(fit) <= _MAX_OUTLIER_SHARE and fit.misfit < 4.0:
            return size
    return None


def _start_on_pitch(
    problem: CameraProblem,
    pitch: PitchTemplate,
    size: _PitchSize,
    settings: StaticCalibrationSettings,
) -> tuple[CameraProblem, Floats] | None:
    """Return clicked points on a pitch of another size, and a camera (WIDTH,); None if unknown."""
    evidence, laws = problem.evidence, prescribed_points(pitch.spec, size[:2])
    if not set(evidence.points) <= laws.keys() or not has_enough_points(evidence):
        return None
    world = np.array([laws[name] for name in evidence.points])
    world[:, 2] = evidence.points_world[:, 2]
    none = np.zeros(len(evidence.markings), dtype=np.bool_)
    points = problem.select(np.ones(len(evidence.points), dtype=np.bool_), none)
    other = replace(points, evidence=replace(points.evidence, points_world=world))
    rows = cameras_from_homographies(other, settings.prior, leave_out=False)
    if not len(rows):
        return None
    start = fit_cameras(other, rows, click_loss=_COMPARISON_LOSS)
    return other, start.rows[np.argmin(start.cost)]


def check_determined(found: Explanation, pitch: PitchTemplate) -> None:
    """Raise InputError when the prior alone determines several directions of the camera."""
    # Without information [rad, m, 1]: clicks do not determine directions of a larger deviation.
    spread = np.array([1.0, 1.0, 1.0, 30.0, 30.0, 30.0, 0.7])
    block = found.fit.evidence_information[:7, :7] * np.outer(spread, spread)
    unknown = int((np.linalg.eigvalsh(block) < 1.0).sum())
    if unknown < 2:
        return
    evidence = found.problem.evidence
    clicked = (*evidence.points, *evidence.markings)
    more = propose_clicks(found.estimate, pitch, clicked, found.settings.click_noise_px)
    if not more:
        places = np.concatenate([evidence.points_world, evidence.samples_world])
        more = points_off_line(pitch, places)
    raise InputError(
        found.problem.where,
        expected="clicks that determine where the camera stands and looks",
        found=f"{describe_clicks(evidence)}, which leave {unknown} of its 7 degrees of freedom "
        "open",
        todo=f"Click more of what the image shows. The most helpful are {', '.join(more)}.",
    )


def _is_mirrored(found: Explanation) -> bool:
    """Return whether the clicks fit far better with mirrored names."""
    problem, settings = found.problem, found.settings
    flip = np.array([-1.0, 1.0, 1.0])
    evidence = replace(
        problem.evidence,
        points_world=problem.evidence.points_world * flip,
        samples_world=problem.evidence.samples_world * flip,
    )
    mirrored = replace(problem, evidence=evidence)
    rows = cameras_from_homographies(mirrored, settings.prior, leave_out=False)
    if not len(rows):
        rows = plausible_cameras(mirrored, settings.prior)
        weighed = fit_cameras(mirrored, rows, click_loss=_COMPARISON_LOSS, iterations=0)
        rows = rows[np.argsort(weighed.cost, kind="stable")[: settings.search_cameras]]
    best = fit_cameras(mirrored, rows, click_loss=_COMPARISON_LOSS).cost.min()
    given = fit_cameras(problem, found.fit.row[None], click_loss=_COMPARISON_LOSS).cost[0]
    return bool(best < 0.25 * given)
