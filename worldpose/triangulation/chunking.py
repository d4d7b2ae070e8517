"""Chunked reconstruction of a clip of any length, with models learned from sample frames.

Triangulation of a frame needs no other frame. Smoothing needs neighbouring frames, so each chunk is
smoothed together with a margin on either side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Floats
from worldpose.geometry import Camera
from worldpose.triangulation.batched_gauss_newton import LANES
from worldpose.triangulation.clocks import CameraClocks, Moved, estimate_clocks, moved_in_time
from worldpose.triangulation.left_right_swaps import undo_swaps
from worldpose.triangulation.motion_model import MotionModel, choose_stretches, learn_motion
from worldpose.triangulation.observations import Rig, person_observations
from worldpose.triangulation.robust import (
    DetectorModel,
    Triangulation,
    learn_detector,
    sample_frames,
    triangulate_joints,
)
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import Smoothing, smooth_joints

PART: Final = 512
"""Frames per chunk: some hundred megabytes with 25 people in 16 cameras."""
MARGIN: Final = 2.0
"""Margin on either side for smoothing [s]: frames farther away move a joint by less than the step
that ends the iteration, across gaps too."""


@dataclass(frozen=True, eq=False)
class ClipModel:
    """Noise model and clock offsets of a clip, estimated from sample frames.

    Attributes:
        clocks: clock offsets of the cameras.
        detector: error model of detector and calibration.
        motion: motion prior of smoothing.
    """

    clocks: CameraClocks
    detector: DetectorModel
    motion: MotionModel


@dataclass(frozen=True, eq=False)
class Chunk:
    """Joints of one chunk of frames.

    Attributes:
        frames: its frames in the clip.
        triangulation: each frame on its own.
        smoothing: as part of whole tracks.
    """

    frames: slice
    triangulation: Triangulation
    smoothing: Smoothing


@dataclass(frozen=True, eq=False)
class ClipDetections:
    """Detections of tracked people, loaded one chunk of frames at a time.

    Attributes:
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        detection_index: (frames, cameras, persons).
        late: (cameras,) [frame], clock offsets to correct; None = no correction.
    """

    keypoints: ClipArray
    confidence: ClipArray
    detection_index: ClipArray
    late: Floats | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.confidence.shape[0]

    def between(self, first: int, last: int) -> Moved:
        """Return keypoints, confidence and index of the frames from `first` to before `last`."""
        late = np.zeros(1) if self.late is None else np.nan_to_num(self.late)
        reach = math.ceil(float(np.abs(late).max(initial=0.0)))
        start = max(0, first - reach)
        wide = slice(start, last + reach)
        arrays = (self.keypoints[wide], self.confidence[wide], self.detection_index[wide])
        if reach:
            arrays = moved_in_time(*arrays, late)
        inner = slice(first - start, last - start)
        return arrays[0][inner], arrays[1][inner], arrays[2][inner]

    def at(self, frames: NDArray[np.int64]) -> Moved:
        """Return keypoints, confidence and index of single frames."""
        each = [self.between(frame, frame + 1) for frame in frames.tolist()]
        keypoints, confidence, index = zip(*each, strict=True)
        return np.concatenate(keypoints), np.concatenate(confidence), np.concatenate(index)

    def seen(self, views: int) -> NDArray[np.bool_]:
        """Return whether at least `views` cameras saw each person (frames, persons)."""
        parts = [
            (self.detection_index[start : start + PART] >= 0).sum(axis=1) >= views
            for start in range(0, max(1, self.frames), PART)
        ]
        return np.concatenate(parts)


def learn_clip(
    cameras: Camera,
    detections: ClipDetections,
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> tuple[ClipModel, ClipDetections]:
    """Return the clip's model, and its detections with clocks corrected if the settings say so.

    Args:
        cameras: batch (cameras,).
        detections: of the clip.
        fps: frames per second [1/s].
        settings: of the stage.
        camera_covariance: (cameras, 12, 12) as in `triangulate_joints`.
    """
    given = (detections.keypoints, detections.confidence, detections.detection_index)
    clocks = estimate_clocks(cameras, *given, fps, settings)
    if settings.correct_clocks:
        detections = replace(detections, late=clocks.late)
    joints = detections.confidence.shape[-1]
    chosen = sample_frames(detections.detection_index.shape, joints)
    some = detections.at(chosen) if len(chosen) else detections.between(0, 0)
    detector = learn_detector(cameras, *some, settings, camera_covariance)
    rig = Rig.of(cameras)

    def stretch(person: int, frames: slice) -> tuple[Floats, Floats, Floats]:
        keypoints, confidence, index = detections.between(frames.start, frames.stop)
        alone = (keypoints, confidence, index[:, :, person : person + 1])
        known = detector.of_person(person)
        raw = triangulate_joints(cameras, *alone, settings, camera_covariance, known)
        keypoints, confidence = undo_swaps(*alone, raw.exchanged)
        arrays = (keypoints, raw.noise.precision(confidence), alone[2], raw.offsets)
        return (*person_observations(arrays, 0), raw.joints[:, 0])

    stretches = choose_stretches(detections.seen(settings.min_views), fps)
    motion = learn_motion(rig, (stretch(*each) for each in stretches), joints, fps, settings)
    return ClipModel(clocks, detector, motion), detections


def reconstruct_chunks(
    cameras: Camera,
    detections: ClipDetections,
    model: ClipModel,
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
    length: int = PART,
) -> Iterator[Chunk]:
    """Yield a clip's joints, one chunk of `length` frames at a time.

    Triangulated joints equal those of the whole clip at once, smoothed joints to within 0.1 mm.

    Args:
        cameras: batch (cameras,).
        detections: of the clip, as `learn_clip` returned them.
        model: of the clip.
        fps: frames per second [1/s].
        settings: of the stage.
        camera_covariance: (cameras, 12, 12) as in `triangulate_joints`.
        length: frames per chunk; rounded up to the margin and whole tiles of the solver.
    """
    frames, margin = detections.frames, round(MARGIN * fps)
    # Joints of a tile share their number of steps: equal tiles give bit-identical joints.
    length = LANES * -(-max(1, length, margin) // LANES)
    parts = [
        slice(first, min(first + length, frames)) for first in range(0, max(1, frames), length)
    ]
    triangulated = (
        triangulate_joints(
            *(cameras, *detections.between(part.start, part.stop), settings),
            *(camera_covariance, model.detector),
        )
        for part in parts
    )
    before, here = None, next(triangulated)
    for part in parts:
        after = next(triangulated, None)
        first, last = max(0, part.start - margin), min(frames, part.stop + margin)
        smooth = smooth_joints(
            *(cameras, *detections.between(first, last), _around(before, here, after, margin)),
            *(fps, settings, model.motion, slice(part.start - first, part.stop - first)),
        )
        yield Chunk(part, here, smooth)
        if after is not None:
            before, here = here, after


def _around(
    before: Triangulation | None, here: Triangulation, after: Triangulation | None, margin: int
) -> Triangulation:
    """Return the triangulation of a chunk with `margin` frames on either side."""

    def joined(name: str) -> NDArray[Any]:
        parts = [getattr(before, name)[-margin:]] if before is not None and margin else []
        parts.append(getattr(here, name))
        if after is not None:
            parts.append(getattr(after, name)[:margin])
        return np.concatenate(parts)

    return replace(
        here,
        joints=joined("joints"),
        covariance=joined("covariance"),
        calibration_covariance=joined("calibration_covariance"),
        exchanged=joined("exchanged"),
        offsets=joined("offsets"),
    )
