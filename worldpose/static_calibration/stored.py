"""Conversion of a calibration to the arrays and attributes of the stored data contract."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry.stored import camera_arrays
from worldpose.static_calibration.report import StaticCalibration


def calibration_arrays(calibration: StaticCalibration) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a calibrated camera, by name.

    A given camera has only those of `camera_arrays`.
    """
    report = calibration.report
    surprise = np.array([p.surprise for p in report.points], dtype=np.float64)
    return {
        **camera_arrays(calibration.estimate.camera),
        "covariance": calibration.estimate.covariance,
        "point_pixel": np.array([p.pixel for p in report.points]).reshape(-1, 2),
        "point_residual": np.array([p.residual for p in report.points]).reshape(-1, 2),
        "point_surprise": np.where(np.isfinite(surprise), surprise, np.nan),
        "point_inlier": np.array([p.inlier for p in report.points], dtype=np.bool_),
        "marking_rms": np.array([m.rms for m in report.drawn], dtype=np.float64),
        "marking_worst": np.array([m.worst for m in report.drawn], dtype=np.float64),
        "marking_inlier": np.array([m.inlier for m in report.drawn], dtype=np.bool_),
        "ground_error": report.ground_error.expected,
    }


def calibration_coordinates(calibration: StaticCalibration) -> dict[str, NDArray[Any]]:
    """Return the grid coordinates of the expected ground error; a given camera has none."""
    known = calibration.report.ground_error
    return {"ground_x": known.x, "ground_y": known.y}


def given_attributes(camera_id: str) -> dict[str, Any]:
    """Return the stored attributes of a given camera."""
    return {"camera_id": camera_id, "origin": "given", **_no_evidence()}


def left_out_attributes(camera_id: str, reason: str) -> dict[str, Any]:
    """Return the stored attributes of a camera without calibration; it has no arrays."""
    return {"camera_id": camera_id, "origin": "none", **_no_evidence(), "reasons": [reason]}


def _no_evidence() -> dict[str, Any]:
    lists = ("point", "point_problem", "marking", "free", "decisions", "reasons", "add_next")
    return {**{name: [] for name in lists}, "noise_scale": None, "condition": None}


def calibration_attributes(camera_id: str, calibration: StaticCalibration) -> dict[str, Any]:
    """Return the stored attributes of a calibrated camera."""
    report = calibration.report
    return {
        "camera_id": camera_id,
        "origin": report.stage,
        "point": [point.name for point in report.points],
        "point_problem": [point.problem for point in report.points],
        "marking": [marking.name for marking in report.drawn],
        "free": list(report.free),
        "decisions": list(report.decisions),
        "reasons": list(report.reasons),
        "add_next": list(report.add_next),
        "noise_scale": report.noise_scale,
        "condition": report.condition,
    }
