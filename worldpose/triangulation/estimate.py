"""Order of triangulation: the objective is in `residuals`.

1. Clocks: every camera's clock offset, from moving people.
2. Joints of single frames, in passes (`_Passes`): each solves all joints and learns from the
   residuals, and the next pass uses it: noise, left-right swaps, calibration's share, offsets of
   people, limb lengths.
3. Joints of whole tracks, smoothed over time.

All models are learned from sample frames of the whole clip. So frames can be computed in chunks,
and a clip may have any length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Flags, Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, Cameras
from worldpose.ingest.clock import row_rate
from worldpose.reference_method import require_torch
from worldpose.tracking.ray_matching import require_clip
from worldpose.triangulation.clocks import estimate_clocks, read_frames
from worldpose.triangulation.limb_lengths import (
    find_swaps,
    limb_lengths,
    repair_limb_lengths,
    undo_swaps,
)
from worldpose.triangulation.noise_model import (
    NoiseModel,
    conditions,
    learn_common_bias,
    learn_noise,
    shared_variance,
)
from worldpose.triangulation.person_offsets import (
    estimate_midhip_shift,
    estimate_offsets,
    learn_factor,
    stated_errors,
)
from worldpose.triangulation.report import Histogram, count_agreement
from worldpose.triangulation.residuals import LANES, Observations, Rig, no_shift
from worldpose.triangulation.results import (
    Chunk,
    ClipModel,
    DetectorModel,
    ExtraJoints,
    Reconstruction,
    Triangulation,
    add_margins,
    concatenate_frames,
)
from worldpose.triangulation.samples import choose_stretches, have_views, sample_frames
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import learn_motion, smooth_joints
from worldpose.triangulation.solve import SolvedJoints, solve_joints
from worldpose.triangulation.track_solver import PersonKeypoints, select_person

CHUNK: Final = 512
"""Frames per chunk: some hundred megabytes with 25 people in 16 cameras."""
MARGIN: Final = 2.0
"""Margin on either side for smoothing [s]: frames farther away move a joint by less than the step
that ends the iteration, across gaps too."""


def reconstruct_joints(
    cameras: Cameras,
    detections: KeypointDetections,
    fps: float,
    settings: TriangulationSettings = TriangulationSettings(),  # noqa: B008
    camera_covariance: NDArray[np.float64] | None = None,
) -> Reconstruction:
    """Return a clip's joints smoothed over time, and its cameras' clock offsets.

    `Reconstruction.joints` and `.covariance` are smoothed; `.triangulation` has each frame on its
    own.

    Args:
        cameras: batch (cameras,), each camera, or the cameras of `read_cameras`.
        detections: detections of all tracked people; their frame numbers rise in equal steps.
        fps: frame numbers per second [1/s].
        settings: settings of the stage.
        camera_covariance: (cameras, 12, 12) covariance as in `triangulate_joints`.

    Raises:
        InputError: the shapes do not match, or frames or `fps` are invalid.
    """
    cameras = Camera.batch(cameras)
    check_shapes(cameras, detections, camera_covariance)
    fps = row_rate("reconstruct_joints", fps, detections.frame)
    model = learn_clip(cameras, detections, fps, settings, camera_covariance)
    chunks = reconstruct_chunks(
        cameras, detections, model, fps, settings, camera_covariance, len(detections.keypoints)
    )
    (chunk,) = chunks
    return Reconstruction(chunk.triangulation, chunk.smoothing, model.clocks)


def learn_clip(
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> ClipModel:
    """Return the clip's model, learned from sample frames; arguments as of `reconstruct_joints`."""
    clocks = estimate_clocks(cameras, detections, fps, settings)
    late = clocks.late if settings.correct_clocks else None
    joints, there = detections.confidence.shape[-1], have_views(detections, settings.min_views)
    chosen = sample_frames(there, joints)
    sample = read_frames(detections, chosen, late)
    detector = learn_detector(cameras, sample, settings, camera_covariance)

    def read_track(person: int, frames: slice) -> PersonKeypoints:
        alone = read_frames(detections, frames, late).select_person(person)
        known = detector.select_person(person)
        raw = triangulate_frames(cameras, alone, settings, camera_covariance, known)
        unswapped = undo_swaps(alone, raw.exchanged)
        precision = raw.noise.precision(unswapped.confidence, conditions(unswapped.keypoints))
        return select_person(unswapped, precision, raw.offsets, raw.joints, person=0)

    intervals = choose_stretches(there, fps)
    tracks = (read_track(person, frames) for person, frames in intervals)
    motion = learn_motion(Rig.from_cameras(cameras), tracks, joints, fps, settings)
    return ClipModel(clocks, late, detector, motion)


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
    Arguments are as of `reconstruct_joints`, and the model is from `learn_clip`. `length` is
    rounded up to the margin and whole tiles of the solver; only every `stride`-th frame is
    computed, and a chunk's `frames` count those.
    """
    every = np.arange(0, detections.confidence.shape[0], stride)
    frames, fps = len(every), fps / stride
    # Errors last for a time: frames that are farther apart share less of them.
    motion = replace(model.motion, repeated=1.0 + (model.motion.repeated - 1.0) / stride)
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
        return triangulate_frames(cameras, some, settings, camera_covariance, model.detector)

    triangulated = _join_halves(parts, halves, map_in_threads(triangulate, map(read, halves)))
    before, here = None, next(triangulated)
    for part in parts:
        after = next(triangulated, None)
        first, last = max(0, part.start - margin), min(frames, part.stop + margin)
        smooth = smooth_joints(
            cameras,
            read(slice(first, last)),
            add_margins(before, here, after, margin),
            fps,
            settings,
            motion,
            slice(part.start - first, part.stop - first),
        )
        placed = here
        if settings.method != "worldpose":
            require_torch()
            from worldpose.triangulation.paper_variant import replace_joints

            middle = settings.method == "paper_midhip"
            placed, smooth = replace_joints(cameras, read(part), here, smooth, about_mid_hip=middle)
        yield Chunk(part, placed, smooth)
        if after is not None:
            before, here = here, after


def triangulate_joints(
    cameras: Cameras,
    detections: KeypointDetections,
    settings: TriangulationSettings = TriangulationSettings(),  # noqa: B008
    camera_covariance: Floats | None = None,
    model: DetectorModel | None = None,
) -> Triangulation:
    """Return every joint of every tracked person, triangulated from its inlier views.

    Each joint is the weighted least-squares point on reprojection over the inlier cameras
    (`consensus`). Nothing is filled in. Frames influence each other only through the model, which
    is learned from frames all over the clip.

    Args:
        cameras: batch (cameras,), each camera, or the cameras of `read_cameras`.
        detections: detections of all tracked people.
        settings: noise, inlier limit and minimum views.
        camera_covariance: (cameras, 12, 12) covariance of steps in the order of
            `static_calibration.parameters.PARAMETERS`; None = not known.
        model: result of `learn_detector` for the clip of these frames; None = these frames are the
            clip.

    Raises:
        InputError: the shapes do not match, or `settings.method` is not ours.

    Note:
        Residuals are pixels to first order in their length: the lens is linearised at the
        observation, accurate enough for any inlier residual.
    """
    if settings.method != "worldpose":
        raise InputError(
            "triangulate_joints: method",
            expected="worldpose, whose joints the paper's method starts from",
            found=settings.method,
            todo="Call reconstruct_joints; its `triangulation.joints` are the paper's.",
        )
    return triangulate_frames(cameras, detections, settings, camera_covariance, model)


def triangulate_frames(
    cameras: Cameras,
    detections: KeypointDetections,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
    model: DetectorModel | None = None,
) -> Triangulation:
    """Return `triangulate_joints` by our method, whatever `settings.method` says."""
    cameras = Camera.batch(cameras)
    check_shapes(cameras, detections, camera_covariance)
    if model is None and (
        settings.learn_noise or settings.offsets == "body" or settings.repair_limb_lengths
    ):
        there = have_views(detections, settings.min_views)
        chosen = sample_frames(there, detections.confidence.shape[-1])
        model = learn_detector(cameras, detections[chosen], settings, camera_covariance)
    passes = _Passes(cameras, detections, settings, camera_covariance, model)
    learned, solved = passes.run(), passes.solved
    bias = learned.common_bias
    index, shift = detections.detection_index, passes.shift
    seen = (index >= 0).sum(axis=1)
    bias_variance = shared_variance(bias, solved.views, seen)[..., None, None]
    lasting = passes.offset_covariance + bias_variance * np.eye(3)
    covariance = solved.covariance + lasting
    found = Triangulation(
        joints=solved.joints,
        covariance=covariance,
        views=solved.views,
        spread=solved.spread,
        reprojection_error=solved.reprojection_error,
        inliers=solved.inliers,
        exchanged=passes.exchanged,
        offsets=shift[..., :2] if len(shift) else np.zeros((*index.shape, 2)),
        lasting_covariance=lasting,
        bias_variance=bias_variance[..., 0, 0],
        common_bias=bias,
        noise=learned.last_noise,
        agreement=count_agreement(solved, covariance, index, passes.exchanged, passes.misplaced),
    )
    if passes.extra is None:
        return found
    # Calibration moves all points of a person together, as it does the joints.
    shared, points = np.nan_to_num(found.shared_covariance), passes.extra
    usual = np.full(len(detections.points), settings.common_bias_m)
    bias_variance = shared_variance(usual, points.views, seen)[..., None, None]
    extra = ExtraJoints(
        detections.points,
        points.joints,
        points.covariance + shared[:, :, None] + bias_variance * np.eye(3),
        points.views,
        usual,
    )
    return replace(found, extra=extra)


def learn_detector(
    cameras: Camera,
    detections: KeypointDetections,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> DetectorModel:
    """Return the error model from sample frames; arguments as in `triangulate_joints`."""
    return _Passes(cameras, detections, settings, camera_covariance, None).run()


class _Passes:
    """Passes over the joints of some frames, with a known model or with what they learn.

    Attributes:
        solved: joints of the last pass.
        exchanged: (frames, cameras, persons, parts), left-right swaps undone.
        shift: (frames, cameras, persons, 3) offsets and variance as in `Observations`.
        offset_covariance: contribution of the offsets to the joints' covariance [m^2].
        misplaced: displacement of people by each camera's calibration [m].
        extra: points besides COCO-17; None without any.
    """

    def __init__(
        self,
        cameras: Camera,
        detections: KeypointDetections,
        settings: TriangulationSettings,
        camera_covariance: Floats | None,
        known: DetectorModel | None,
    ) -> None:
        self._cameras, self._detections, self._settings = cameras, detections, settings
        self._condition = conditions(detections.keypoints)
        self._covariance, self._known = camera_covariance, known
        self._rig, self._limit = Rig.from_cameras(cameras), settings.max_deviation**2
        self._noise: dict[str, NoiseModel] = {}
        self.solved: SolvedJoints
        self._observations: Observations
        index = detections.detection_index
        self.exchanged: Flags = np.zeros((*index.shape, len(EXCHANGED_PARTS)), np.bool_)
        self.shift = no_shift()
        self.offset_covariance: Floats | float = 0.0
        self.misplaced = (Histogram.of(np.empty(0)),) * len(self._rig.cameras)
        self.extra: SolvedJoints | None = None

    def run(self) -> DetectorModel:
        """Run all passes in order; return the known model, or what they learned."""
        settings, known = self._settings, self._known
        if settings.offsets == "midhip":
            self.shift = estimate_midhip_shift(self._rig, self._detections, settings)
        self._solve("detected")
        if settings.undo_swaps:
            self._undo_swaps()
        if self._covariance is not None and settings.offsets != "midhip":
            self._admit_calibration_errors(self._covariance)
        factor = 1.0 if known is None else known.factor
        if settings.offsets == "body":
            factor = self._shift_people(factor)
        lengths = limb_lengths(self.solved) if known is None else known.lengths
        if settings.repair_limb_lengths:
            repair_limb_lengths(self._observations, settings, self.solved, lengths)
        bias = self._find_common_bias()
        if self._detections.points:
            points = self._detections.select_points()
            self.extra = solve_joints(self._observe("extra", points), settings)
        return DetectorModel(self._noise, factor, lengths, bias)

    def _solve(self, name: str) -> None:
        """Solve all joints with the noise of this pass and the present shift."""
        self._observations = self._observe(name, self._detections)
        self.solved = solve_joints(self._observations, self._settings)

    def _observe(self, name: str, points: KeypointDetections) -> Observations:
        """Return points, weighted by the noise of a pass, which is known or learned from them."""
        settings, known = self._settings, self._known
        if name not in self._noise:
            if known is not None and name in known.noise:
                self._noise[name] = known.noise[name]
            elif settings.learn_noise:
                self._noise[name] = learn_noise(
                    self._rig, points, self.shift, settings.noise, self._limit
                )
            else:
                self._noise[name] = NoiseModel.nominal(
                    points.confidence.shape[-1], len(self._rig.cameras)
                )
        own = points is self._detections
        condition = self._condition if own else conditions(points.keypoints)
        precision = self._noise[name].precision(points.confidence, condition)
        index = points.detection_index
        return Observations.of(self._rig, points.keypoints, precision, index, self.shift)

    def _undo_swaps(self) -> None:
        """Find and undo left-right swaps; the next pass, if there is none this one, uses it."""
        settings = self._settings
        self.exchanged = find_swaps(self._observations, settings.noise, self._limit, self.solved)
        self._detections = undo_swaps(self._detections, self.exchanged)
        self._condition = conditions(self._detections.keypoints)
        self._observations = self._observe("detected", self._detections)
        is_last = self._covariance is None or settings.offsets == "midhip"
        if self.exchanged.any() and is_last:
            self.solved = solve_joints(self._observations, settings)

    def _admit_calibration_errors(self, covariance: Floats) -> None:
        """Solve with the calibration's variance: its errors are no reason to reject a view."""
        stated = stated_errors(self._cameras, self.solved.joints, self._settings, covariance)
        self.shift = np.zeros((*stated.variance.shape, 3))
        self.shift[..., 2] = stated.variance
        self._solve("calibrated")

    def _shift_people(self, factor: float) -> float:
        """Solve with the offset of each person in each image; return the calibration's factor."""
        settings = self._settings
        stated = stated_errors(self._cameras, self.solved.joints, settings, self._covariance)
        if self._known is None and self._covariance is None:
            factor = learn_factor(self._observations, settings.noise, self.solved, stated.variance)
        self.shift, self.offset_covariance = estimate_offsets(
            self._observations, settings.noise, self.solved, factor * stated.variance
        )
        self.misplaced = stated.position_std(factor, self._detections.detection_index >= 0)
        self._solve("shifted")
        return factor

    def _find_common_bias(self) -> Floats:
        """Return the error (joints,) per axis that all views share [m]."""
        settings, solved = self._settings, self.solved
        if self._known is not None:
            return self._known.common_bias
        count, bias = self._detections.confidence.shape[-1], settings.common_bias_m
        if settings.learn_noise and count == len(COCO17):
            covariance = solved.covariance + self.offset_covariance
            bias = learn_common_bias(solved.joints, covariance, bias)
        return np.full(count, bias)


def _join_halves(
    parts: list[slice], halves: list[slice], found: Iterator[Triangulation]
) -> Iterator[Triangulation]:
    """Yield the triangulation of each chunk from those of its parts of frames."""
    for part in parts:
        own = [next(found) for half in halves if part.start <= half.start < max(part.stop, 1)]
        yield own[0] if len(own) == 1 else concatenate_frames(own)


def check_shapes(
    cameras: Camera, detections: KeypointDetections, camera_covariance: Floats | None
) -> None:
    """Raise InputError unless arrays have matching shapes, and indices are valid."""
    require_clip("triangulation", cameras, detections, tracked=True)
    detection_index = detections.detection_index
    if camera_covariance is not None and camera_covariance.shape != (*cameras.batch_shape, 12, 12):
        raise InputError(
            "triangulation: camera_covariance",
            expected=f"shape {(*cameras.batch_shape, 12, 12)}",
            found=f"{camera_covariance.shape}",
            todo="Give the covariance of every camera's calibration, or none.",
        )
    most = detections.confidence.shape[2]
    if detection_index.size and not -1 <= detection_index.min() <= detection_index.max() < most:
        raise InputError(
            "triangulation: detection_index",
            expected=f"-1 or the place of one of {most} detections",
            found=f"{detection_index.min()} to {detection_index.max()}",
            todo="Give the index that was made from these detections.",
        )
