"""Task of stage `static_calibration`: one camera that is given, clicked, or proposed."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.static_calibration import (
    STATIC_CALIBRATION,
    ClickedMarkings,
    ClickedPoint,
    DrawnMarking,
)
from tasks.unit import UnitInputs, require_registered, unit_task
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, camera_arrays, camera_from_arrays
from worldpose.ingest.clock import camera_frames
from worldpose.ingest.footage import read_still
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method import require_torch
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.proposal import Proposal, calibrate_proposal
from worldpose.static_calibration.report import (
    CalibrationReport,
    StaticCalibration,
    calibration_arrays,
    calibration_attributes,
    uncalibrated_attributes,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.static_calibration.sides import SeenPeople, decide_sides, place_at
from worldpose.store.writer import ResultWriter
from worldpose.video.folder import index_video, median_picture, open_video, some_pictures

STILL_FRAMES: Final = 25
"""Number of video frames for a median still."""


@unit_task
def static_calibration(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the camera, and its uncertainty if calibrated.

    A camera that its clicks do not determine is written as left out, with the reason.
    """
    if inputs.sources["calibration"] is not None:
        given = CameraCalibration.model_validate(inputs.sources["calibration"])
        camera = Camera.from_calibration(given)
        result.write(
            STATIC_CALIBRATION,
            arrays=camera_arrays(camera),
            attributes=uncalibrated_attributes(inputs.unit, "given"),
        )
        result.warnings += [said] if (said := camera.describe_fold(inputs.unit)) else []
        return
    try:
        calibration = _calibrate(inputs)
    except InputError as error:  # a failed calibration of one camera must not end the match
        reason = str(error)
        attributes = uncalibrated_attributes(inputs.unit, "none", reason)
        result.write(STATIC_CALIBRATION, arrays={}, attributes=attributes)
        result.left_out[inputs.unit] = reason
        return
    known = calibration.report.ground_error
    result.write(
        STATIC_CALIBRATION,
        arrays=calibration_arrays(calibration),
        coordinates={"ground_x": known.x, "ground_y": known.y},
        attributes=calibration_attributes(inputs.unit, calibration),
    )
    result.figures.update(_figures(calibration.report))
    if reasons := calibration.report.contradictions:
        result.warnings.append(f"camera {inputs.unit} is weak: {'; '.join(reasons)}.")


def _calibrate(inputs: UnitInputs) -> StaticCalibration:
    """Calibrate a camera from its clicks, or else its proposal; InputError if undetermined."""
    sources, pitch = inputs.sources, inputs.pitch
    assert pitch is not None  # registration requires it
    picture, lens = open_still(inputs), given_lens(sources)
    settings = inputs.settings(StaticCalibrationSettings)
    if sources["clicked"]:
        ((file, clicked),) = sources["clicked"].items()
        (width, height), side = sources["image_size"], sources.get("side")
        by_paper = settings.method == "paper"
        found = calibrate_camera(
            pitch,
            clicked_markings(clicked),
            (width, height),
            picture=None if by_paper else picture,
            settings=settings.model_copy(update={"method": "worldpose"}),
            where=file,
            lens=lens,
            start=side and place_at(side),
        )
        if by_paper:
            require_torch()
            from worldpose.reference_method.static_calibration import calibrate

            found = calibrate(found, pitch, picture if settings.lines else None)
        return found
    where = f"image of {inputs.unit}"
    return calibrate_proposal(
        pitch,
        _open_proposal(inputs, pitch, where),
        require_picture(inputs.unit, picture),
        settings=settings,
        where=where,
        lens=lens,
    )


def _open_proposal(inputs: UnitInputs, pitch: PitchTemplate, where: str) -> Proposal:
    """Return the camera's proposal on its side of the pitch."""
    found = {name.partition("/")[2]: inputs.open(name) for name in inputs.recipe.inputs}
    own = found[inputs.unit]
    if own.attrs["origin"] == "none":
        raise InputError(**own.attrs["problem"])
    proposal = Proposal.from_attributes(camera_from_arrays(own.data_vars), own.attrs)
    proposal.require_clear(where, pitch)
    if len(found) == 1:
        return proposal
    seen = {
        name: SeenPeople(
            camera_from_arrays(each.data_vars),
            each["place"].values,
            each["place_covariance"].values,
        )
        for name, each in found.items()
        if each.attrs["is_clear"]
    }
    stated = [name for name in seen if found[name].attrs["is_stated"]]
    seconds = own["frame"].values / own.attrs["fps"]
    decision = decide_sides(seen, stated, pitch, seconds)[inputs.unit]
    return proposal.turn() if decision.require_side(where) else proposal


def given_lens(sources: Mapping[str, Any]) -> LensCalibration | None:
    """Return the given lens of a recipe, if any."""
    lens = sources.get("lens")
    return None if lens is None else LensCalibration.model_validate(lens)


def require_picture(camera_id: str, picture: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return the camera's image."""
    if picture is None:
        raise InputError(
            f"image of {camera_id}",
            expected="a still, or a readable image in the video",
            found="none",
            todo="Add a still to match.yaml, or click the markings.",
        )
    return picture


def clicked_markings(listed: Mapping[str, Any]) -> ClickedMarkings:
    """Return the clicks of a recipe, by name: their order in the file has no effect."""
    points, drawn = listed["points"], listed["drawn"]
    return ClickedMarkings(
        points=tuple(ClickedPoint(name=name, xy=points[name]) for name in sorted(points)),
        drawn=tuple(DrawnMarking(name=name, xy=drawn[name]) for name in sorted(drawn)),
    )


def open_still(inputs: UnitInputs) -> NDArray[np.uint8] | None:
    """Return the unit's still, or one without people from its video; InputError if it changed."""
    sources = inputs.sources
    if sources["still"] is None:
        filmed = sources["filmed"]
        return None if filmed is None else _filmed_still(Path(inputs.work.folder), filmed)
    width, height = sources["image_size"]
    picture = read_still(inputs.file("still"), (width, height))
    inputs.require_registered("still")
    return picture


def _filmed_still(folder: Path, filmed: Mapping[str, Any]) -> NDArray[np.uint8]:
    """Return the median of images evenly spaced over the clips; motionless people stay in it."""
    path = folder / filmed["video"]
    every = np.concatenate(
        [np.arange(first, first + count) for first, count in sorted(filmed["clips"].values())]
    )
    chosen = every[np.linspace(0, len(every) - 1, min(STILL_FRAMES, len(every))).astype(int)]
    index = index_video(path)
    numbers = camera_frames(chosen, filmed["offset_frames"], filmed["rate"])
    shown = index.shown(numbers, float(filmed["fps"]), str(path))

    with open_video(path, index) as video:
        pictures = some_pictures(video, np.unique(shown[shown >= 0]))
        sound = (each for _, each in pictures if each is not None)
        if (one := next(sound, None)) is None:
            raise InputError(
                str(path),
                expected="images that can be decoded",
                found=f"none in {len(chosen)} frames of the clips",
                todo="Convert the video with any video tool, and give that one.",
            )
        still = median_picture(chain([one], sound), STILL_FRAMES)
    require_registered(path, filmed["video_sha256"])
    return still


def _figures(report: CalibrationReport) -> dict[str, float]:
    """Return metrics of a calibrated camera; those that could not be computed are left out."""
    used = [point.residual for point in report.points if point.inlier]
    figures = {
        "expected_ground_error_median_m": report.ground_error.median,
        "expected_ground_error_p95_m": report.ground_error.p95,
        "reprojection_rms_px": float(np.sqrt(np.mean(np.square(used)) * 2.0)) if used else np.nan,
        "clicks_used": float(len(used)),
        "clicks_wrong": float(len(report.wrong)),
        **{f"wrong_click.{name}": 1.0 for name in report.wrong},
        "weak": float(report.weak),
        "click_noise_px": report.click_noise,
        "click_freedom": report.click_freedom,
    }
    return {name: value for name, value in figures.items() if np.isfinite(value)}
