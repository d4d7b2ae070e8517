"""Chunked reconstruction of a clip of any length, with models learned from sample frames.

Triangulation of a frame needs no other frame. Smoothing needs neighbouring frames, so each chunk is
smoothed together with a margin on either side.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Flags, Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.batched_gauss_newton import LANES
from worldpose.triangulation.clocks import CameraClocks, estimate_clocks, read_frames
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.observations import PersonTrack, Rig, observe_person
from worldpose.triangulation.passes import (
    DetectorModel,
    Triangulation,
    check_shapes,
    concatenate_frames,
    learn_detector,
    sample_frames,
    triangulate_joints,
)
from worldpose.triangulation.reports import TriangulationReport
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import (
    MotionModel,
    Smoothing,
    choose_stretches,
    learn_motion,
    smooth_joints,
)

CHUNK: Final = 512
"""Frames per chunk: some hundred megabytes with 25 people in 16 cameras."""
MARGIN: Final = 2.0
"""Margin on either side for smoothing [s]: frames farther away move a joint by less than the step
that ends the iteration, across gaps too."""


@dataclass(frozen=True, eq=False)
class ClipModel:
    """A clip's noise model and clock offsets, estimated from sample frames.

    Attributes:
        clocks: clock offsets of the cameras.
        corrected: (cameras,) [frame], the offsets to correct; None = none, by the settings.
        detector: error model of detector and calibration.
        motion: motion prior of smoothing.
    """

    clocks: CameraClocks
    corrected: Floats | None
    detector: DetectorModel
    motion: MotionModel


@dataclass(frozen=True, eq=False)
class Chunk:
    """Joints of one chunk of frames.

    Attributes:
        frames: its place among the computed frames of the clip.
        triangulation: joints of each frame on its own.
        smoothing: joints as parts of whole tracks.
    """

    frames: slice
    triangulation: Triangulation
    smoothing: Smoothing


def learn_clip(
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> ClipModel:
    """Return the clip's model, learned from sample frames.

    Args:
        cameras: batch (cameras,).
        detections: detections of the clip.
        fps: frames per second [1/s].
        settings: settings of the stage.
        camera_covariance: (cameras, 12, 12) covariance as in `triangulate_joints`.
    """
    clocks = estimate_clocks(cameras, detections, fps, settings)
    late = clocks.late if settings.correct_clocks else None
    joints = detections.confidence.shape[-1]
    chosen = sample_frames(detections.detection_index.shape, joints)
    sample = read_frames(detections, chosen, late)
    detector = learn_detector(cameras, sample, settings, camera_covariance)

    def read_track(person: int, frames: slice) -> PersonTrack:
        alone = read_frames(detections, frames, late).select_person(person)
        known = detector.select_person(person)
        raw = triangulate_joints(cameras, alone, settings, camera_covariance, known)
        unswapped = undo_swaps(alone, raw.exchanged)
        precision = raw.noise.precision(unswapped.confidence)
        return observe_person(unswapped, precision, raw.offsets, raw.joints, person=0)

    intervals = choose_stretches(_have_views(detections, settings.min_views), fps)
    tracks = (read_track(person, frames) for person, frames in intervals)
    motion = learn_motion(Rig.from_cameras(cameras), tracks, joints, fps, settings)
    return ClipModel(clocks, late, detector, motion)


def _have_views(detections: KeypointDetections[ClipArray], views: int) -> Flags:
    """Return whether at least `views` cameras saw each person (frames, persons)."""
    index = detections.detection_index
    parts = [
        (index[start : start + CHUNK] >= 0).sum(axis=1) >= views
        for start in range(0, max(1, len(index)), CHUNK)
    ]
    return np.concatenate(parts)


def reconstruct_chunks(
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    model: ClipModel,
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
    length: int = CHUNK,
    stride: int = 1,
) -> Iterator[Chunk]:
    """Yield a clip's joints, one chunk of `length` frames at a time.

    Triangulated joints equal those of the whole clip at once, smoothed joints to within 0.1 mm.

    Args:
        cameras: batch (cameras,).
        detections: detections of the clip, as detected.
        model: model of the clip, from `learn_clip`.
        fps: frames per second [1/s].
        settings: settings of the stage.
        camera_covariance: (cameras, 12, 12) covariance as in `triangulate_joints`.
        length: frames per chunk; rounded up to the margin and whole tiles of the solver.
        stride: only every such frame is computed; a chunk's `frames` count those.
    """
    every = np.arange(0, detections.confidence.shape[0], stride)
    frames, fps = len(every), fps / stride
    margin = round(MARGIN * fps)
    # Joints of a tile share their number of steps: equal tiles give bit-identical joints.
    length = LANES * -(-max(1, length, margin) // LANES)
    parts = [
        slice(first, min(first + length, frames)) for first in range(0, max(1, frames), length)
    ]
    # Halves of chunks, which two threads triangulate.
    half = LANES * -(-length // (2 * LANES))
    halves = [
        slice(first, min(first + half, part.stop))
        for part in parts
        for first in range(part.start, max(part.stop, part.start + 1), half)
    ]

    def read(some: slice) -> KeypointDetections:
        chosen = some if stride == 1 else every[some]
        return read_frames(detections, chosen, model.corrected)

    def triangulate(some: KeypointDetections) -> Triangulation:
        return triangulate_joints(cameras, some, settings, camera_covariance, model.detector)

    triangulated = _join_halves(parts, halves, map_in_threads(triangulate, map(read, halves)))
    before, here = None, next(triangulated)
    for part in parts:
        after = next(triangulated, None)
        first, last = max(0, part.start - margin), min(frames, part.stop + margin)
        smooth = smooth_joints(
            cameras,
            read(slice(first, last)),
            _add_margins(before, here, after, margin),
            fps,
            settings,
            model.motion,
            slice(part.start - first, part.stop - first),
        )
        yield Chunk(part, here, smooth)
        if after is not None:
            before, here = here, after


def _join_halves(
    parts: list[slice], halves: list[slice], found: Iterator[Triangulation]
) -> Iterator[Triangulation]:
    """Yield the triangulation of each chunk from those of its parts of frames."""
    for part in parts:
        own = [next(found) for half in halves if part.start <= half.start < max(part.stop, 1)]
        yield own[0] if len(own) == 1 else concatenate_frames(own)


def _add_margins(
    before: Triangulation | None, here: Triangulation, after: Triangulation | None, margin: int
) -> Triangulation:
    """Return the triangulation of a chunk with `margin` frames on either side."""

    def join(name: str) -> NDArray[Any]:
        parts = [getattr(before, name)[-margin:]] if before is not None and margin else []
        parts.append(getattr(here, name))
        if after is not None:
            parts.append(getattr(after, name)[:margin])
        return np.concatenate(parts)

    return replace(
        here,
        joints=join("joints"),
        covariance=join("covariance"),
        calibration_covariance=join("calibration_covariance"),
        exchanged=join("exchanged"),
        offsets=join("offsets"),
    )


@dataclass(frozen=True)
class Reconstruction:
    """Joints of one clip over time, what they were made from, and clock offsets.

    Attributes:
        triangulation: joints of each frame on its own, as `triangulate_joints` gives them.
        smoothing: the same joints smoothed over time.
        clocks: clock offsets; corrected if the settings say so.
    """

    triangulation: Triangulation
    smoothing: Smoothing
    clocks: CameraClocks

    @property
    def joints(self) -> Floats:
        """(frames, persons, 17, 3) [m], world, smoothed over time; NaN where not determined."""
        return self.smoothing.joints

    @property
    def covariance(self) -> Floats:
        """(frames, persons, 17, 3, 3) [m^2], of `joints`."""
        return self.smoothing.covariance

    @property
    def views(self) -> NDArray[np.uint8]:
        """(frames, persons, 17), inlier cameras; 0 where a joint is interpolated or missing."""
        return self.triangulation.views

    @property
    def report(self) -> TriangulationReport:
        """The metrics of the triangulation in each frame."""
        return self.triangulation.report


def reconstruct_joints(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    settings: TriangulationSettings = TriangulationSettings(),  # noqa: B008
    camera_covariance: NDArray[np.float64] | None = None,
) -> Reconstruction:
    """Return a clip's joints smoothed over time, and its cameras' clock offsets.

    `Reconstruction.joints` and `.covariance` are smoothed; `.triangulation` has each frame on its
    own.

    Args:
        cameras: batch (cameras,).
        detections: detections of all tracked people.
        fps: frames per second [1/s].
        settings: settings of the stage.
        camera_covariance: (cameras, 12, 12) covariance as in `triangulate_joints`.

    Raises:
        InputError: the shapes do not match.
    """
    check_shapes(cameras, detections, camera_covariance)
    model = learn_clip(cameras, detections, fps, settings, camera_covariance)
    chunks = reconstruct_chunks(
        cameras, detections, model, fps, settings, camera_covariance, len(detections.keypoints)
    )
    (chunk,) = chunks
    return Reconstruction(chunk.triangulation, chunk.smoothing, model.clocks)
