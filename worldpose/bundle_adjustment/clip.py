"""Input of bundle adjustment: one clip, and the keypoints of some of its people."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.triangulation import TriangulationSettings, triangulate_joints


@dataclass(frozen=True, eq=False)
class Clicks:
    """The clicked points of one camera.

    Attributes:
        names: of points of the pitch template.
        points_world: (n, 3) [m], world.
        points_image: (n, 2) [px].
        inlier: (n,) bool, whether the calibration uses it.
    """

    names: tuple[str, ...]
    points_world: NDArray[np.float64]
    points_image: NDArray[np.float64]
    inlier: NDArray[np.bool_]

    @classmethod
    def none(cls) -> Clicks:
        """Return the clicks of a camera without any."""
        return cls((), np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.bool_))


@dataclass(frozen=True, eq=False)
class Clip:
    """Calibrated cameras and triangulated people of one clip.

    Attributes:
        cameras: (cameras,) batch, as they were calibrated or given.
        covariance: (cameras, 12, 12) of a step, in the order of `PARAMETERS`; all zero for a given
            camera.
        clicks: of every camera.
        frame: (frames,) match frames.
        fps: frames per second.
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17); NaN where not found.
        detection_index: (frames, cameras, persons); -1 = not seen.
        joints: (frames, persons, 17, 3) [m], world, as triangulated; NaN where not determined.
        views: (frames, persons, 17) inlier cameras.
        triangulation: settings that made the joints.
        pitch: as surveyed; None = not known.
        on_lines: (cameras,) bool, whether it was calibrated on painted lines; None = no camera.
        names: of the cameras, for messages; empty = not known.
    """

    cameras: Camera
    covariance: NDArray[np.float64]
    clicks: tuple[Clicks, ...]
    frame: NDArray[np.int64]
    fps: float
    keypoints: NDArray[np.float64]
    confidence: NDArray[np.float64]
    detection_index: NDArray[np.int64]
    joints: NDArray[np.float64]
    views: NDArray[np.int64]
    triangulation: TriangulationSettings
    pitch: PitchTemplate | None = None
    on_lines: NDArray[np.bool_] | None = None
    names: tuple[str, ...] = ()

    @cached_property
    def given(self) -> NDArray[np.bool_]:
        """Whether each camera (cameras,) comes from a file that states no covariance."""
        return np.asarray(~self.covariance.any(axis=(1, 2)))

    @cached_property
    def distance(self) -> NDArray[np.float64]:
        """Median depth (cameras,) of people in each camera [m]; NaN without people."""
        frame, camera, person = np.nonzero(self.detection_index >= 0)
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


class Observed(NamedTuple):
    """Keypoints of some people in some frames, sorted by point.

    A point is one joint of one person in one frame.
    """

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


def keypoints_of(
    keypoints: NDArray[np.float64],
    confidence: NDArray[np.float64],
    detection_index: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return keypoints (frames, cameras, persons, 17, 2) and their confidence, by person.

    NaN and 0 where the person is not seen.

    Args:
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        detection_index: (frames, cameras, persons).
    """
    frames, cameras = np.ogrid[: len(keypoints), : keypoints.shape[1]]
    place = (frames[..., None], cameras[..., None], detection_index)
    seen = (detection_index >= 0)[..., None] & (confidence[place] > 0.0)
    seen &= np.isfinite(keypoints[place]).all(axis=-1)
    return (
        np.where(seen[..., None], keypoints[place], np.nan),
        np.where(seen, confidence[place], 0.0),
    )


def observe(
    clip: Clip, frames: Integers, people: NDArray[np.bool_], cameras: Camera, min_views: int
) -> Observed:
    """Return the keypoints of joints with enough inlier cameras.

    Args:
        clip: the clip.
        frames: (k,) indices of its frames.
        people: (persons,) or (k, persons) bool, persons to include.
        cameras: (cameras,) batch that predicts the size of people in the image.
        min_views: minimum inlier cameras of a joint.
    """
    index = clip.detection_index[frames]
    image, confidence = keypoints_of(clip.keypoints[frames], clip.confidence[frames], index)
    joints = clip.joints[frames]
    good = np.isfinite(joints[..., 0]) & (clip.views[frames] >= min_views)
    good &= np.broadcast_to(people, good.shape[:2])[..., None]
    predicted, noise = predict(cameras, joints, confidence, clip.triangulation)
    seen = good[:, None] & (confidence > 0.0) & np.isfinite(predicted).all(axis=-1)
    # A joint that only one of these cameras can use carries no information.
    seen &= (seen.sum(axis=1) >= 2)[:, None]
    by_point = seen.transpose(0, 2, 3, 1)
    frame, person, joint, camera = np.nonzero(by_point)
    used = by_point.any(axis=-1)
    number = np.cumsum(used).reshape(used.shape) - 1
    return Observed(
        points=joints[used],
        point_of=number[frame, person, joint],
        camera_of=camera,
        frame_of=frames[frame],
        person_of=person,
        joint_of=joint,
        image=image[frame, camera, person, joint],
        noise=noise[frame, camera, person, joint],
    )


def with_learned_noise(clip: Clip, frames: Integers) -> Clip:
    """Return the clip with the noise of its detector in its confidences.

    The variance of a keypoint is then the stated one over its confidence, and triangulation treats
    cameras as exact, because adjustment must see their errors.

    Args:
        clip: the clip.
        frames: (k,) indices of frames to learn the noise from.
    """
    settings = clip.triangulation
    if settings.learn_noise and len(frames):
        seen = (clip.keypoints[frames], clip.confidence[frames])
        index = clip.detection_index[frames].astype(np.int16)
        noise = triangulate_joints(clip.cameras, *seen, index, settings).noise
        precision = noise.precision(clip.confidence)
    else:
        precision = np.where(clip.confidence > 0.0, clip.confidence, 0.0)
    most = max(float(precision.max(initial=0.0)), 1e-12)
    exact = {
        "learn_noise": False,
        "offsets": "none",
        "pixel_noise": settings.pixel_noise / np.sqrt(most),
        "joint_noise": settings.joint_noise / np.sqrt(most),
    }
    return replace(
        clip, confidence=precision / most, triangulation=settings.model_copy(update=exact)
    )


def predict(
    cameras: Camera,
    joints: NDArray[np.float64],
    confidence: NDArray[np.float64],
    settings: TriangulationSettings,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return projections of joints, and the standard deviation of keypoints there per axis [px].

    Args:
        cameras: (cameras,) batch.
        joints: (frames, persons, 17, 3) [m], world.
        confidence: (frames, cameras, persons, 17).
        settings: of triangulation, with the stated noise.

    Returns:
        (frames, cameras, persons, 17, 2) and (frames, cameras, persons, 17); NaN and infinite
        without an image.
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
        variance = settings.pixel_noise**2 + (settings.joint_noise * size) ** 2
        noise = np.sqrt(variance / confidence)
    noise[~np.isfinite(noise)] = np.inf
    return predicted.reshape(*shape, 2).swapaxes(0, 1), noise
