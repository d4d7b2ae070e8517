"""Quality metrics of a fit without ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.records import Record
from worldpose.body_fitting.body_fit import BodyFit
from worldpose.body_fitting.bones import BONES
from worldpose.body_fitting.objective import ANKLES
from worldpose.body_fitting.shared_bias import body_axes
from worldpose.geometry import Camera


class BodyFittingReport(Record):
    """Metrics of one clip, and of each person in the order of the persons; None without data."""

    bodies: int
    """Fitted bodies, one per frame and person [1]."""
    filled: int
    """Of these, in frames without any joint of the person [1]."""
    guided: int
    """Of these, fitted with a monocular pose [1]."""
    offset_rms_m: float
    """Root mean square offset per axis from a body's joint to the detector's [m]."""
    residual_m: tuple[float | None, ...]
    """Median distance of triangulated joints, minus those offsets, from the body's [m]."""
    reprojection_px: tuple[float | None, ...]
    """Median image distance of seen keypoints, minus those offsets, from the body's [px]; None
    without cameras."""
    bone_spread_m: tuple[float | None, ...]
    """Standard deviation of triangulated limbs' lengths, median over limbs [m]; bodies have 0."""
    skating_m: tuple[float | None, ...]
    """Median motion of an ankle per frame while it is slower than 0.5 m/s [m]."""
    jerk_m_s3: tuple[float | None, ...]
    """Root mean square third derivative of the body's keypoints [m/s^3]."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Detections of tracked people in static cameras."""

    cameras: Camera
    """Batch (cameras,)."""
    keypoints: NDArray[np.floating]
    """(frames, cameras, detections, 17, 2) [px], left-right swaps undone; NaN where not found."""
    detection_index: NDArray[np.integer]
    """(frames, cameras, persons), index of the detection; -1 = not seen."""


def report_fit(
    fit: BodyFit, joints: Floats, fps: float, pictures: Pictures | None = None
) -> BodyFittingReport:
    """Return the metrics of a fit.

    Args:
        fit: bodies of one clip.
        joints: (frames, persons, 17, 3) [m], world, input of the fit.
        fps: [1/s].
        pictures: detections behind the joints.
    """
    perceived = fit.joints + np.einsum("fpab,jb->fpja", body_axes(fit.joints), fit.offsets)
    away = np.linalg.norm(joints - perceived, axis=-1)
    step = np.linalg.norm(np.diff(fit.joints[:, :, ANKLES], axis=0), axis=-1)
    jerk = np.linalg.norm(np.diff(fit.joints, n=3, axis=0), axis=-1) * fps**3
    persons = range(joints.shape[1])
    ends = np.array(BONES)
    limbs = np.linalg.norm(joints[:, :, ends[:, 1]] - joints[:, :, ends[:, 0]], axis=-1)
    return BodyFittingReport(
        bodies=int(np.isfinite(fit.joints[:, :, 0, 0]).sum()),
        filled=int(fit.filled.sum()),
        guided=int(fit.guided.sum()),
        offset_rms_m=float(np.sqrt(np.mean(fit.offsets**2))),
        residual_m=tuple(_median(away[:, person]) for person in persons),
        reprojection_px=tuple(
            None if pictures is None else _median(_reprojection(perceived, pictures, person))
            for person in persons
        ),
        bone_spread_m=tuple(_spread(limbs[:, person]) for person in persons),
        skating_m=tuple(
            _median(np.where(step[:, person] * fps < 0.5, step[:, person], np.nan))
            for person in persons
        ),
        jerk_m_s3=tuple(_root_mean_square(jerk[:, person]) for person in persons),
    )


def _reprojection(perceived: Floats, pictures: Pictures, person: int) -> Floats:
    """Return distances of one person's keypoints (frames, cameras, 17) [px]; NaN where not seen."""
    place = pictures.detection_index[:, :, person]
    frame, camera = np.nonzero(place >= 0)
    seen = np.full((*place.shape, 17, 2), np.nan)
    seen[frame, camera] = pictures.keypoints[frame, camera, place[frame, camera]]
    image = pictures.cameras.project(perceived[:, None, person])
    return np.asarray(np.linalg.norm(image - seen, axis=-1))


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _spread(lengths: Floats) -> float | None:
    spreads = [
        float(known.std()) for limb in lengths.T if len(known := limb[np.isfinite(limb)]) > 1
    ]
    return float(np.median(spreads)) if spreads else None


def _root_mean_square(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None
