"""Calibration of one static camera from clicks in its image."""

from __future__ import annotations

from itertools import compress

import numpy as np

from data_contracts.arrays import Floats, Image
from data_contracts.cameras import LensCalibration
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.click_outliers import Explanation
from worldpose.static_calibration.evidence import (
    ClickEvidence,
    check_amount,
    describe_clicks,
    gather_evidence,
)
from worldpose.static_calibration.explanations import (
    check_determined,
    find_explanation,
    fit_level_or_rolled,
    try_k3,
)
from worldpose.static_calibration.fit import CameraProblem, build_problem
from worldpose.static_calibration.initialization import find_start, fit_from_starts
from worldpose.static_calibration.lens_choice import choose_lens, widen_by_lenses
from worldpose.static_calibration.line_refinement import refine_and_judge
from worldpose.static_calibration.report import StaticCalibration, build_report
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.static_calibration.sides import tells_side, turn_camera, turn_name


def calibrate_camera(
    pitch: PitchTemplate,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    *,
    picture: Image | None = None,
    settings: StaticCalibrationSettings | None = None,
    where: str = "clicked markings",
    lens: LensCalibration | None = None,
    start: Camera | Floats | None = None,
) -> StaticCalibration:
    """Return the camera of an image, its covariance and its report.

    Stage 1 finds starts: homographies of the flattened pitch, or plausible cameras where clicks
    are too few for one. Stage 2 fits pose, focal length, principal point and distortion on the
    crowned pitch, and excludes outliers among the clicks. Stage 3 refines on the painted lines of
    the image, if there is one.

    Args:
        pitch: the stadium's template.
        clicked: named points, and pixels along named markings.
        image_size: width, height [px].
        picture: (height, width) or (height, width, 3); without it there is no stage 3.
        settings: noise, prior and thresholds; the defaults if None.
        where: file or camera, for messages.
        lens: a calibrated lens, the prior; k1, k2 and k3 are then solved for. None = not known.
        start: a camera near the answer, which replaces stage 1, or (3,) its rough place [m], world.
            Where the markings are their own image after half a turn, either decides the side.

    Raises:
        InputError: `method` is `paper`, `start` images no click, the lens is of another image size,
            a name is unknown, a pixel lies outside the image, names are mirrored, the clicks
            contradict each other, or they do not determine the camera or its side; the message
            says which clicks to add.

    Note:
        Paper section "Static Camera Calibration".
    """
    stated = settings or StaticCalibrationSettings()
    if stated.method == "paper":
        raise InputError(
            f"{where}: method",
            expected="worldpose, on whose inliers the paper's method follows",
            found="paper",
            todo="Give its result to `worldpose.reference_method.static_calibration.calibrate`, or "
            "click the camera in a match folder.",
        )
    own = {} if lens is None else {"distortion": "k1_k2_k3"}
    stated = stated.model_copy(update={"prior": stated.prior.beside(pitch.spec), **own})
    evidence = gather_evidence(pitch, clicked, image_size, stated.sample_spacing_m, where)
    check_amount(evidence, pitch, where)
    if isinstance(start, Camera):
        _check_start(start, evidence, where)
    problem = build_problem(evidence, image_size, stated, where=where, lens=lens)

    def explain(start: Camera | Floats | None) -> Explanation:
        def begin(problem: CameraProblem) -> Floats:
            if isinstance(start, Camera):
                return fit_from_starts(problem, start.numbers[None], stated.wrong_click)[0]
            return find_start(problem, stated)

        found = choose_lens(fit_level_or_rolled(problem, begin, stated), stated)
        found = find_explanation(found, pitch, stated)
        check_determined(found, pitch)
        return found

    found = explain(start)
    if not isinstance(start, Camera) and not _tells_side(found):
        found = explain(_choose_side(found, pitch, start))
    found = try_k3(found)
    lines = None
    if picture is not None and stated.lines:
        found, lines = refine_and_judge(found, pitch, picture)
    if lines is None or lines.venue is None:
        found = widen_by_lenses(found, pitch, stated)
        estimate = found.estimate
    else:
        estimate, pitch = lines.estimate.estimate, pitch.with_surface(lines.estimate.surface)
    report = build_report(estimate, found, lines, pitch, stated.click_noise_px)
    return StaticCalibration(estimate, report)


def _tells_side(found: Explanation) -> bool:
    """Return whether names of inliers are those of other markings after half a turn."""
    evidence, fit = found.problem.evidence, found.fit
    names = (*compress(evidence.points, fit.inliers), *compress(evidence.markings, fit.markings))
    return any(map(tells_side, names))


def _choose_side(found: Explanation, pitch: PitchTemplate, place: Floats | None) -> Camera:
    """Return the camera, or itself after half a turn, on the side of a place (3,) [m]."""
    camera = found.estimate.camera
    if place is not None:
        along = float(camera.center[:2] @ place[:2] / np.linalg.norm(place[:2]))
        if abs(along) > 0.05 * np.linalg.norm(camera.center[:2]):  # else it lies between the two
            return turn_camera(camera) if along < 0.0 else camera
    names = [name for name in pitch.points if turn_name(name) != name]
    names.sort(key=lambda name: float(np.linalg.norm(pitch.points[name])))
    raise InputError(
        found.problem.where,
        expected="clicks that tell the side on which the camera stands",
        found=f"{describe_clicks(found.problem.evidence)}, which look the same from both sides",
        todo="Click one more point or marking with a side in its name, such as "
        f"{names[0]} or {names[1]}.",
    )


def _check_start(start: Camera, evidence: ClickEvidence, where: str) -> None:
    """Raise InputError unless a start is one camera that images something of the clicks."""
    places = np.concatenate([evidence.points_world, evidence.samples_world])
    found = f"cameras of shape {start.batch_shape}"
    if start.batch_shape or not np.isfinite(start.project(places)).any():
        raise InputError(
            f"{where}: start",
            expected="one camera near the answer",
            found=found if start.batch_shape else "a camera that images no clicked marking",
            todo="Give a single camera that looks at the markings, or none.",
        )
