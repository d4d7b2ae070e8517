"""How a fit looks without the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import Record
from worldpose.body_fitting.bones import BONES
from worldpose.body_fitting.feet import ANKLES
from worldpose.body_fitting.fitting import BodyFit
from worldpose.body_fitting.shared_bias import body_axes
from worldpose.cameras import Camera

Floats = NDArray[np.float64]


class BodyFittingReport(Record):
    """Figures of a clip, and of each person in the order of the persons; None without any."""

    bodies: int
    """Bodies fitted, one a frame and person [1]."""
    filled: int
    """Of these, in frames without any joint of the person [1]."""
    guided: int
    """Of these, with a monocular pose that had a say [1]."""
    offset_rms_m: float
    """How far, along an axis, what the detector takes for a joint is from it [m]."""
    residual_m: tuple[float | None, ...]
    """Median distance of triangulated joints, less those offsets, from the body's [m]."""
    reprojection_px: tuple[float | None, ...]
    """Median distance in pictures of seen keypoints from the body's, less those offsets [px]; None
    where no cameras were given."""
    bone_spread_m: tuple[float | None, ...]
    """Standard deviation of triangulated limbs' lengths, median over limbs [m]; bodies have 0."""
    skating_m: tuple[float | None, ...]
    """Median way of an ankle in a frame while it is slower than 0.5 m/s [m]."""
    jerk_m_s3: tuple[float | None, ...]
    """Root mean square third derivative of the body's keypoints [m/s^3]."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """What static cameras saw of tracked people."""

    cameras: Camera
    """Batch (cameras,)."""
    keypoints: NDArray[np.floating]
    """(frames, cameras, detections, 17, 2) [px], sides put right; NaN where not found."""
    detection_index: NDArray[np.integer]
    """(frames, cameras, persons), place among the detections; -1 = not seen."""


def report_fit(
    fit: BodyFit, joints: Floats, fps: float, pictures: Pictures | None = None
) -> BodyFittingReport:
    """Return the figures of a fit.

    Args:
        fit: bodies of a clip.
        joints: (frames, persons, 17, 3) [m], world, that it was made from.
        fps: [1/s].
        pictures: what the joints were made from.
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
    """Distances of one person's keypoints (frames, cameras, 17) [px]; NaN where not seen."""
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
