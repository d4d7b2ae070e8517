"""An adjustment, its decisions in words, and its stored arrays and attributes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.bundle_adjustment.clip import Clicks, Clip, project_joints
from worldpose.bundle_adjustment.held_out_validation import PooledEvidence, Verdict
from worldpose.bundle_adjustment.residuals import KeypointNoise
from worldpose.bundle_adjustment.settings import CHANCE, BundleAdjustmentSettings
from worldpose.bundle_adjustment.uncertainty import weak_direction
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.static_calibration.parameters import project_with_jacobian
from worldpose.static_calibration.report import image_problems
from worldpose.triangulation.estimate import triangulate_frames


def adjustment_arrays(
    adjusted: BundleAdjustment, settings: BundleAdjustmentSettings, person: NDArray[np.integer[Any]]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the stored arrays and attributes by name of adjusted cameras, without the people.

    Camera ids are no such attribute; `person` (persons,) are ids.
    """
    clip = adjusted.clip
    outliers = keypoint_outliers(
        clip, adjusted.cameras, adjusted.noise, settings.wrong_keypoint, settings.max_review_items
    )
    clicks = review_clicks(clip.clicks, adjusted.cameras, adjusted.covariance, adjusted.accepted)
    weak = [
        weak_direction(adjusted.cameras[c], adjusted.covariance[c]) for c in range(len(clip.clicks))
    ]
    errors = [marking_errors(clip, cameras) for cameras in (clip.cameras, adjusted.cameras)]
    arrays = {
        **camera_arrays(adjusted.cameras),
        "camera_covariance": adjusted.covariance,
        "accepted": adjusted.accepted,
        "moved_center": adjusted.motion[:, 0],
        "moved_rotation": adjusted.motion[:, 1],
        "moved_focal": adjusted.motion[:, 2],
        "judges": adjusted.verdict.judges,
        "held_out_loss": adjusted.verdict.loss,
        "held_out_error": adjusted.verdict.error,
        "marking_error": np.stack(errors, axis=1),
        "weak_step": np.stack([direction.step for direction in weak]),
        "outlier_frame": clip.frame[outliers.frame],
        "outlier_camera": outliers.camera,
        "outlier_person": person[outliers.person].astype(np.int64),
        "outlier_joint": outliers.joint,
        "outlier_surprise": outliers.surprise,
        "click_camera": clicks.camera,
        "click_residual": clicks.residual,
        "click_surprise": np.where(np.isfinite(clicks.surprise), clicks.surprise, np.nan),
        "click_wrong": clicks.surprise > settings.wrong_click,
    }
    attributes = {
        "reasons": list(adjusted.reasons),
        "held_out_gain": adjusted.evidence.gain,
        "held_out_significance": adjusted.evidence.significance,
        "people_shift": adjusted.evidence.shift,
        "weak": [direction.about for direction in weak],
        "proposed_frames": adjusted.proposed.tolist(),
        "used_frames": adjusted.used.tolist(),
        "judged_frames": adjusted.judged.tolist(),
        "noise_scale": adjusted.noise.scale,
        "noise_correlation": adjusted.noise.correlation,
        "outliers_found": outliers.found,
        "click": list(clicks.name),
        "click_problem": list(clicks.problem),
    }
    return arrays, attributes


def marking_errors(clip: Clip, cameras: Camera) -> Floats:
    """Return root mean square errors per axis (cameras,) [px] of clicks of calibration, or NaN."""
    errors = np.full(len(clip.clicks), np.nan)
    for c, clicks in enumerate(clip.clicks):
        if clicks.inlier.any():
            pixels = cameras[c].project(clicks.points_world[clicks.inlier])
            off = pixels - clicks.points_image[clicks.inlier]
            errors[c] = np.sqrt(np.mean(off**2))
    return errors


@dataclass(frozen=True, eq=False)
class KeypointOutliers:
    """Review list of people's keypoints, by descending Mahalanobis distance.

    Attributes:
        frame: (n,) index into the clip's frames.
        camera: (n,)
        person: (n,) index into the clip's people.
        joint: (n,) -1 where most keypoints of this person in this image are outliers.
        surprise: (n,) Mahalanobis distance [1]; the median over keypoints for a whole person.
        found: number of outliers, including those beyond the list.
    """

    frame: Integers
    camera: Integers
    person: Integers
    joint: Integers
    surprise: Floats
    found: int


@dataclass(frozen=True, eq=False)
class ClickReview:
    """All clicked points against the adjusted cameras, by descending Mahalanobis distance.

    Attributes:
        camera: (n,)
        name: name of each point of the pitch.
        residual: (n, 2) [px], projected minus clicked; NaN where the camera cannot image the point.
        surprise: (n,) Mahalanobis distance from the prediction of all other data [1], the
            calibration's own for a camera that did not change; infinite where the camera cannot
            image the point.
        problem: reason why the camera cannot image each point; empty where it can.
    """

    camera: Integers
    name: tuple[str, ...]
    residual: Floats
    surprise: Floats
    problem: tuple[str, ...]


def keypoint_outliers(
    clip: Clip, cameras: Camera, noise: KeypointNoise, limit: float, longest: int
) -> KeypointOutliers:
    """Return keypoints beyond a Mahalanobis distance of all cameras' joints, the worst first."""
    block = 256  # frames at a time: limits the memory, not the result
    last = len(clip.frame)

    def find(first: int) -> Floats:
        frames = np.arange(first, min(first + block, last))
        return _find_outliers(clip, cameras, noise, limit, frames)

    parts = list(map_in_threads(find, range(0, last, block)))
    rows = np.concatenate([np.empty((0, 5)), *parts])
    order = np.lexsort((*rows[:, 3::-1].T, -rows[:, 4]))[:longest]
    frame, camera, person, joint = rows[order, :4].astype(np.int64).T
    return KeypointOutliers(frame, camera, person, joint, rows[order, 4], len(rows))


def _find_outliers(
    clip: Clip, cameras: Camera, noise: KeypointNoise, limit: float, frames: Integers
) -> Floats:
    """Return rows (n, 5) of frame, camera, person, joint and Mahalanobis distance."""
    detections = clip.detections[frames]
    joints = triangulate_frames(cameras, detections, clip.triangulation).joints
    image, weight = detections.by_person()
    predicted, stated = project_joints(cameras, joints, weight, clip.triangulation)
    off = np.linalg.norm(predicted - image, axis=-1) / (noise.scale * stated)
    off[~np.isfinite(off)] = np.nan
    wrong = off > limit
    # Most keypoints of another person, or after a left-right swap, are outliers.
    together = wrong.sum(axis=-1) > 0.5 * np.maximum(np.isfinite(off).sum(axis=-1), 2)
    f, c, p = np.nonzero(together)
    middle = np.nanmedian(off[together], axis=-1) if len(f) else np.empty(0)
    whole = np.column_stack([frames[f], c, p, np.full(len(f), -1), middle])
    f, c, p, j = np.nonzero(wrong & ~together[..., None])
    return np.concatenate([whole, np.column_stack([frames[f], c, p, j, off[f, c, p, j]])])


def review_clicks(
    clicks: tuple[Clicks, ...], cameras: Camera, covariance: Floats, changed: Flags
) -> ClickReview:
    """Return every clicked point's residual and its Mahalanobis distance.

    The residual of a click that pulled its camera has the covariance s^2 - J C J^T, with the noise
    s that made C. Where little of s^2 remains, the click alone determines the camera, and no error
    of it can be seen. Steps of a batch (cameras,) have the covariance (cameras, 12, 12); `changed`
    (cameras,) is whether a camera differs from its calibration.
    """
    camera: list[int] = []
    name: list[str] = []
    problem: list[str] = []
    residual, surprise = [np.empty((0, 2))], [np.empty(0)]
    for c, clicked in enumerate(clicks):
        if not clicked.names:
            continue
        pixel, by_step = project_with_jacobian(cameras[c], clicked.points_world)
        problems = image_problems(cameras[c], clicked.points_world)
        imaged = np.array([not each for each in problems], dtype=np.bool_)
        off = pixel - clicked.points_image
        by_step = np.where(imaged[:, None, None], by_step, 0.0)
        spread = np.einsum("nij,jk,nlk->nil", by_step, covariance[c], by_step)
        sign = np.where(clicked.inlier, -1.0, 1.0)[:, None, None]
        variance = clicked.noise_px**2
        values, vectors = np.linalg.eigh(variance * np.eye(2) + sign * spread)
        along = np.einsum("nij,ni->nj", vectors, off)
        values = np.where(values < 0.1 * variance, np.inf, values)
        own = np.sqrt((along**2 / values).sum(axis=1)) if changed[c] else clicked.surprise
        camera += [c] * len(clicked.names)
        name += clicked.names
        problem += problems
        residual.append(off)
        surprise.append(np.where(imaged, own, np.inf))
    order = np.argsort(-np.concatenate(surprise), kind="stable")
    return ClickReview(
        camera=np.array(camera, dtype=np.int64)[order],
        name=tuple(name[index] for index in order),
        residual=np.concatenate(residual)[order],
        surprise=np.concatenate(surprise)[order],
        problem=tuple(problem[index] for index in order),
    )


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Cameras of a clip after adjustment.

    Attributes:
        clip: the input, with the noise of its detector in its confidences.
        cameras: (cameras,) batch; unchanged where the change was refused.
        covariance: (cameras, 12, 12) covariance of a step; as calibrated where the change was
            refused.
        accepted: (cameras,) bool.
        reasons: why each camera was accepted or refused.
        proposed: match frames best suited to adjustment.
        used: match frames that supplied people.
        judged: match frames for held-out validation.
        noise: noise of keypoints, as measured.
        verdict: held-out errors with calibrated and with changed cameras, also where refused.
        evidence: result of all held-out people together for the proposed change.
        motion: (cameras, 3) motion of the accepted cameras: of the center [m], of the axes [rad],
            of the focal length [1]; 0 where refused.
        refused: (cameras,) batch as it would be without held-out validation.
    """

    clip: Clip
    cameras: Camera
    covariance: Floats
    accepted: Flags
    reasons: tuple[str, ...]
    proposed: Integers
    used: Integers
    judged: Integers
    noise: KeypointNoise
    verdict: Verdict
    evidence: PooledEvidence
    motion: Floats
    refused: Camera


def explain_decision(
    comparison: Verdict,
    c: int,
    accepted: bool,
    settings: BundleAdjustmentSettings,
    objection: str,
    stands_alone: bool,
) -> str:
    """Return why a camera's change was accepted or refused, with the deciding numbers."""
    judges = int(comparison.judges[c])
    if judges < settings.min_judges:
        return f"refused: {judges} held-out keypoints, at least {settings.min_judges} are required"
    before, after = comparison.loss[c]
    change = f"the loss of {judges} held-out keypoints goes from {before:.3f} to {after:.3f}"
    if accepted:
        return f"accepted: {change}"
    if after > before:
        return f"refused: {change}"
    if stands_alone and comparison.significance[c] < CHANCE:
        return (
            f"refused: {change}; person by person it falls by {comparison.significance[c]:.1f} "
            f"standard errors, at least {CHANCE:g} are required"
        )
    if objection and not stands_alone:
        return f"refused: {change}, but {objection}"
    return f"refused: {change}, but no more after other cameras were refused"


def camera_motion(before: Camera, after: Camera) -> Floats:
    """Return the motion (cameras, 3) of cameras: of center [m], axes [rad] and focal length [1]."""
    turned = before.cam_from_world.rotation @ after.cam_from_world.rotation.swapaxes(1, 2)
    # Use the chord: the trace loses half of the digits of a small angle.
    chord = np.linalg.norm(turned - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return np.stack(
        [
            np.linalg.norm(after.center - before.center, axis=1),
            2.0 * np.arcsin(np.clip(chord, 0.0, 1.0)),
            after.focal[:, 0] / before.focal[:, 0] - 1.0,
        ],
        axis=1,
    )


def describe_motion(motion: Floats) -> str:
    """Return the description of a camera's motion."""
    center, rotation, focal = motion.tolist()
    return (
        f"; the camera moves {100.0 * center:.1f} cm and {np.degrees(rotation):.3f} degrees, "
        f"the focal length changes {100.0 * focal:+.2f} %"
    )


def refuse_all(
    clip: Clip, reason: str, proposed: Integers, used: Integers, judged: Integers
) -> BundleAdjustment:
    """Return the clip's cameras unchanged, with one reason for all of them."""
    count = len(clip.clicks)
    nan = np.full((count, 2), np.nan)
    return BundleAdjustment(
        clip=clip,
        cameras=clip.cameras,
        covariance=clip.covariance,
        accepted=np.zeros(count, dtype=np.bool_),
        reasons=(f"refused: {reason}",) * count,
        proposed=clip.frame[proposed],
        used=clip.frame[used],
        judged=clip.frame[judged],
        noise=KeypointNoise(),
        verdict=Verdict(np.zeros(count, dtype=np.int64), nan, nan, np.zeros(count)),
        evidence=PooledEvidence(0.0, 0.0, 0.0),
        motion=np.zeros((count, 3)),
        refused=clip.cameras,
    )
