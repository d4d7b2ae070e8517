"""Input of bundle adjustment: a clip's most informative frames and their keypoints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rows import take_rows
from worldpose.ingest.clock import row_rate
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.report import StaticCalibration
from worldpose.triangulation.estimate import triangulate_frames
from worldpose.triangulation.noise_model import conditions
from worldpose.triangulation.settings import TriangulationSettings


@dataclass(frozen=True, eq=False)
class Clicks:
    """The clicked points of one camera.

    Attributes:
        names: names of points of the pitch template.
        points_world: (n, 3) [m], world.
        points_image: (n, 2) [px].
        inlier: (n,) bool, whether the calibration uses it.
        surprise: (n,) Mahalanobis distance from the prediction by the calibration's other evidence.
        noise_px: standard deviation of a click in the calibration, each axis [px].
    """

    names: tuple[str, ...]
    points_world: Floats
    points_image: Floats
    inlier: Flags
    surprise: Floats
    noise_px: float

    @classmethod
    def of(
        cls, calibration: StaticCalibration, pitch: PitchTemplate, stated_px: float = 1.0
    ) -> Clicks:
        """Return all clicked points of a camera, which was calibrated with a stated noise [px]."""
        points = calibration.report.points
        names = tuple(point.name for point in points)
        return cls(
            names=names,
            points_world=pitch.positions(names),
            points_image=np.array([point.pixel for point in points]).reshape(-1, 2),
            inlier=np.array([point.inlier for point in points], dtype=np.bool_),
            surprise=np.array([point.mahalanobis for point in points], dtype=np.float64),
            noise_px=stated_px * calibration.report.noise_scale,
        )

    @classmethod
    def none(cls) -> Clicks:
        """Return the clicks of a camera without any."""
        return cls((), np.empty((0, 3)), np.empty((0, 2)), np.empty(0, np.bool_), np.empty(0), 1.0)


@dataclass(frozen=True, eq=False)
class Clip:
    """Calibrated cameras and triangulated people of one clip.

    Attributes:
        cameras: (cameras,) batch, as they were calibrated or given.
        covariance: (cameras, 12, 12) covariance of a step, in the order of `PARAMETERS`; all zero
            for a given camera.
        clicks: clicks of every camera.
        fps: frame numbers per second [1/s].
        detections: (frames, cameras, detections) detections of tracked people, with match frames.
        joints: (frames, persons, 17, 3) [m], world, as triangulated; NaN where not determined.
        views: (frames, persons, 17) inlier cameras.
        triangulation: settings that made the joints.
        pitch: the pitch as surveyed; None = not known.
        on_lines: (cameras,) bool, whether it was calibrated on painted lines; None = no camera.
        names: names of the cameras, for messages; empty = not known.

    Raises:
        InputError: the shapes do not fit together, or `fps` is not positive.
    """

    cameras: Camera
    covariance: Floats
    clicks: tuple[Clicks, ...]
    fps: float
    detections: KeypointDetections
    joints: Floats
    views: NDArray[np.integer]
    triangulation: TriangulationSettings
    pitch: PitchTemplate | None = None
    on_lines: Flags | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        row_rate("bundle adjustment", self.fps)
        (count,), (frames, _, persons) = (
            self.cameras.batch_shape,
            self.detections.detection_index.shape,
        )
        found = (self.covariance.shape, len(self.clicks), self.joints.shape, self.views.shape)
        wanted = ((count, 12, 12), count, (frames, persons, 17, 3), (frames, persons, 17))
        if found != wanted:
            raise InputError(
                "bundle adjustment",
                expected="covariance, number of clicks, joints and views of all cameras, frames "
                f"and persons: {wanted}",
                found=f"{found}",
                todo="Give arrays of the same clip and cameras.",
            )

    @cached_property
    def frame(self) -> Integers:
        """Match frame of each row (frames,)."""
        return self.detections.numbers

    @cached_property
    def given(self) -> Flags:
        """Return whether each camera (cameras,) comes from a file that states no covariance."""
        return np.asarray(~self.covariance.any(axis=(1, 2)))

    @cached_property
    def distance(self) -> Floats:
        """Median depth (cameras,) of people in each camera [m]; NaN without people."""
        frame, camera, person = np.nonzero(self.detections.detection_index >= 0)
        found = np.isfinite(self.joints[..., 0])
        number = np.maximum(found.sum(axis=-1), 1)[..., None]
        place = np.where(found[..., None], self.joints, 0.0).sum(axis=-2) / number
        pose = self.cameras.cam_from_world
        depth = np.einsum("ni,ni->n", place[frame, person], pose.rotation[camera, 2])
        depth += pose.translation[camera, 2]
        known = np.asarray(found.any(axis=-1))[frame, person]
        depth[~known | (depth <= 0.0)] = np.nan
        out = np.full(len(pose.rotation), np.nan)
        for c in range(len(out)):
            seen = depth[camera == c]
            if np.isfinite(seen).any():
                out[c] = np.nanmedian(seen)
        return out


class Observations(NamedTuple):
    """Keypoints of people in frames, sorted by point: one joint of one person in one frame."""

    points: Floats
    """(points, 3) [m], world, as triangulated."""
    point_of: Integers
    """(n,)"""
    camera_of: Integers
    """(n,)"""
    frame_of: Integers
    """(n,) index into the clip's frames."""
    person_of: Integers
    """(n,) index into the clip's people."""
    joint_of: Integers
    """(n,)"""
    image: Floats
    """(n, 2) [px]."""
    noise: Floats
    """(n,) stated standard deviation per axis [px]."""

    def select(self, kept: Flags) -> Observations:
        """Return the observations (n,) that are kept, with renumbered points."""
        used, number = np.unique(self.point_of[kept], return_inverse=True)
        rows = take_rows(self, kept, "points")
        return rows._replace(points=self.points[used], point_of=number)


def select_observations(
    clip: Clip, frames: Integers, people: Flags, cameras: Camera, min_views: int
) -> Observations:
    """Return the keypoints of joints with enough inlier cameras, in some frames (k,) of a clip.

    People are (persons,) or (k, persons); the cameras predict their size in the image.
    """
    image, confidence = clip.detections[frames].by_person()
    joints = clip.joints[frames]
    good = np.isfinite(joints[..., 0]) & (clip.views[frames] >= min_views)
    good &= np.broadcast_to(people, good.shape[:2])[..., None]
    predicted, noise = project_joints(cameras, joints, confidence, clip.triangulation)
    seen = good[:, None] & (confidence > 0.0) & np.isfinite(predicted).all(axis=-1)
    # A joint that only one of these cameras can use carries no information.
    seen &= (seen.sum(axis=1) >= 2)[:, None]
    by_point = seen.transpose(0, 2, 3, 1)
    frame, person, joint, camera = np.nonzero(by_point)
    used = by_point.any(axis=-1)
    number = np.cumsum(used).reshape(used.shape) - 1
    return Observations(
        points=joints[used],
        point_of=number[frame, person, joint],
        camera_of=camera,
        frame_of=frames[frame],
        person_of=person,
        joint_of=joint,
        image=image[frame, camera, person, joint],
        noise=noise[frame, camera, person, joint],
    )


def learn_confidence(clip: Clip, frames: Integers) -> Clip:
    """Return the clip with the noise of its detector in some frames (k,) in its confidences.

    The variance of a keypoint is then the stated one over its confidence, and triangulation treats
    cameras as exact, because adjustment must see their errors.
    """
    settings, detections = clip.triangulation, clip.detections
    if settings.learn_noise and len(frames):
        noise = triangulate_frames(clip.cameras, detections[frames], settings).noise
        precision = noise.precision(detections.confidence, conditions(detections.keypoints))
    else:
        precision = np.where(detections.confidence > 0.0, detections.confidence, 0.0)
    max_precision = max(float(precision.max(initial=0.0)), 1e-12)
    exact = {
        "learn_noise": False,
        "offsets": "none",
        "pixel_noise_px": settings.pixel_noise_px / np.sqrt(max_precision),
        "joint_noise_m": settings.joint_noise_m / np.sqrt(max_precision),
    }
    return replace(
        clip,
        detections=replace(detections, confidence=precision / max_precision),
        triangulation=settings.model_copy(update=exact),
    )


def project_joints(
    cameras: Camera, joints: Floats, confidence: Floats, settings: TriangulationSettings
) -> tuple[Floats, Floats]:
    """Return projections of joints, and the standard deviation of keypoints there per axis [px].

    Of a batch (cameras,), joints (frames, persons, 17, 3) [m], world, and confidence (frames,
    cameras, persons, 17), they are (frames, cameras, persons, 17, 2) and (frames, cameras, persons,
    17). They are NaN and infinite without an image. The settings have the stated noise.
    """
    count = len(cameras.focal)
    shape = (count, *joints.shape[:3])
    flat = joints.reshape(-1, 3)
    predicted = np.stack([cameras[c].project(flat) for c in range(count)])
    pose = cameras.cam_from_world
    depth = flat @ pose.rotation[:, 2].T + pose.translation[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        size = cameras.focal.mean(axis=-1)[:, None] / depth.T
        size = size.reshape(shape).swapaxes(0, 1)
        variance = settings.pixel_noise_px**2 + (settings.joint_noise_m * size) ** 2
        noise = np.sqrt(variance / confidence)
    noise[~np.isfinite(noise)] = np.inf
    return predicted.reshape((*shape, 2)).swapaxes(0, 1), noise


def propose_frames(
    clip: Clip, count: int, gap: float, min_views: int, taken: Integers | None = None
) -> Integers:
    """Return indices of the most informative frames for all cameras, ascending.

    Each frame adds keypoints of joints with enough views to cells of the pitch, per camera; further
    keypoints of a cell have diminishing value (the sum of logarithms). A greedy search takes the
    frame that adds most, `gap` [s] away from those before, up to `count` and without those `taken`
    (k,).
    """
    offered = _count_keypoints(clip, min_views)
    left: Flags = np.asarray(offered.any(axis=1))
    left[[] if taken is None else taken] = False
    collected = np.zeros(offered.shape[1])
    chosen: list[int] = []
    while len(chosen) < count and left.any():
        rest = np.flatnonzero(left)
        gain = np.log1p(offered[rest] / (17.0 + collected)).sum(axis=1)
        best = int(rest[np.argmax(gain)])
        chosen.append(best)
        collected += offered[best]
        near = np.abs(clip.frame - clip.frame[best]) < gap * clip.fps - 1e-9
        left[near] = False
        left[best] = False
    return np.array(sorted(chosen), dtype=np.int64)


def _count_keypoints(clip: Clip, min_views: int) -> Floats:
    """Return keypoint counts (frames, cells) of every camera's cells; only cells with people."""
    good = np.isfinite(clip.joints[..., 0]) & (clip.views >= min_views)
    number = good.sum(axis=-1)
    place = np.where(good[..., None], clip.joints, 0.0)[..., :2].sum(axis=-2)
    place /= np.maximum(number, 1)[..., None]
    cell = np.floor(place / 8.0).astype(np.int64)
    _, cell_of = np.unique(cell.reshape(-1, 2), axis=0, return_inverse=True)
    cell_of = cell_of.reshape(number.shape)
    frames, cameras, _ = clip.detections.detection_index.shape
    offered = np.zeros((frames, cameras, int(cell_of.max(initial=0)) + 1))
    f, c, p = np.nonzero(clip.detections.detection_index >= 0)
    np.add.at(offered, (f, c, cell_of[f, p]), number[f, p])
    return offered.reshape(frames, cameras * offered.shape[2])
