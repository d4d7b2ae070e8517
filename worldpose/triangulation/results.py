"""Results of triangulation: joints of single frames, joints of whole tracks, and learned models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry.rows import join_rows, take_rows
from worldpose.triangulation.clocks import CameraClocks
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.report import Agreement, Changes, SmoothingReport, TriangulationReport

FRAME_ARRAYS = (
    *("joints", "covariance", "views", "spread", "reprojection_error", "inliers"),
    *("exchanged", "offsets", "lasting_covariance", "bias_variance"),
)
"""Attributes of `Triangulation` with a dimension of frames."""


@dataclass(frozen=True, eq=False)
class DetectorModel:
    """Error model of a clip's detector and calibration.

    Attributes:
        noise: noise model of each pass by its name: `detected` without calibration's share,
            `calibrated` with it, `shifted` without the offsets, and `extra` of points besides
            COCO-17. The last but `extra` is that of the result.
        factor: on the stated variance of calibration.
        lengths: (persons, limbs) [m], limb lengths; NaN where unknown.
        common_bias: (joints,) per axis, error that all views share [m].
    """

    noise: Mapping[str, NoiseModel]
    factor: float
    lengths: Floats
    common_bias: Floats

    @property
    def last_noise(self) -> NoiseModel:
        """The noise model of the last pass."""
        return [model for name, model in self.noise.items() if name != "extra"][-1]

    def select_person(self, person: int) -> DetectorModel:
        """Return the model for one person alone."""
        return replace(self, lengths=self.lengths[person : person + 1])


@dataclass(frozen=True, eq=False)
class ExtraJoints:
    """Points besides COCO-17 in 3D, with covariance.

    Attributes:
        points: (points,) names.
        joints: (frames, persons, points, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, points, 3, 3) [m^2], of `joints`: noise from their residuals,
            calibration, and the bias that all views share.
        views: (frames, persons, points) uint8, inlier cameras; 0 where not determined.
        common_bias: (points,) per axis, error that all views share [m]; in `covariance`.
    """

    points: tuple[str, ...]
    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    common_bias: Floats

    def __getitem__(self, frames: slice) -> ExtraJoints:
        """Return the points in some frames."""
        return take_rows(self, frames, "points", "common_bias")


@dataclass(frozen=True)
class Triangulation:
    """3D joints with covariance.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`: noise from the residuals,
            calibration, and the bias that all views share.
        views: (frames, persons, 17) uint8, inlier cameras; 0 where not determined.
        spread: (frames, persons, 17) float32 [rad], widest angle between inlier rays, at most a
            right angle; NaN where not determined.
        reprojection_error: (frames, persons, 17) float32 [px], root mean square length over the
            inlier cameras, offsets subtracted.
        inliers: (frames, cameras, persons, 17) bool, whether this camera is an inlier.
        exchanged: (frames, cameras, persons, 3) bool, left-right swaps of the detection's
            `EXCHANGED_PARTS`, already corrected.
        offsets: (frames, cameras, persons, 2) [px], offset of the person in the image from the
            reprojection of all cameras' joints; 0 where unknown.
        lasting_covariance: (frames, persons, 17, 3, 3) [m^2], the part of `covariance` that more
            frames do not reduce: offsets by calibration and `bias_variance`.
        bias_variance: (frames, persons, 17) [m^2] per axis, of the error that all views share
            (`noise_model.shared_variance`).
        common_bias: (17,) per axis, error that all views share [m] where all agree.
        noise: noise model of the detector.
        agreement: counts and histograms behind `report`.
        extra: points besides COCO-17, which influence none of the above; None without any.
    """

    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    spread: NDArray[np.float32]
    reprojection_error: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    exchanged: NDArray[np.bool_]
    offsets: Floats
    lasting_covariance: Floats
    bias_variance: Floats
    common_bias: Floats
    noise: NoiseModel
    agreement: Agreement
    extra: ExtraJoints | None = None

    @property
    def shared_covariance(self) -> Floats:
        """(frames, persons, 3, 3) [m^2], the part of `covariance` that moves all joints together.

        It is that of calibration, mean over the joints; NaN for a person without any.
        """
        found = np.asarray(np.isfinite(self.joints).all(-1))
        own = self.lasting_covariance - self.bias_variance[..., None, None] * np.eye(3)
        count = found.sum(-1)[..., None, None]
        total = np.where(found[..., None, None], own, 0.0).sum(axis=2)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def report(self) -> TriangulationReport:
        """The metrics of these frames."""
        return self.agreement.report(self.noise.factor)


def concatenate_frames(parts: Sequence[Triangulation]) -> Triangulation:
    """Return the triangulation of consecutive parts of a clip, which have one model."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in FRAME_ARRAYS
    }
    extra = [part.extra for part in parts if part.extra is not None]
    return replace(
        parts[0],
        **arrays,
        agreement=reduce(add, (part.agreement for part in parts)),
        extra=join_rows(extra, "points", "common_bias") if extra else None,
    )


def add_margins(
    before: Triangulation | None, here: Triangulation, after: Triangulation | None, margin: int
) -> Triangulation:
    """Return the triangulation of a chunk with `margin` frames on either side."""

    def join(name: str) -> Any:  # noqa: ANN401
        parts = [getattr(before, name)[-margin:]] if before is not None and margin else []
        parts.append(getattr(here, name))
        if after is not None:
            parts.append(getattr(after, name)[:margin])
        return np.concatenate(parts)

    smoothed = ("joints", "covariance", "lasting_covariance", "bias_variance")
    return replace(here, **{name: join(name) for name in (*smoothed, "exchanged", "offsets")})


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Motion prior: standard deviation (joints,) of accelerations per axis [m/s^2].

    Errors of `repeated` frames, at least 1, count as one.
    """

    acceleration: Floats
    repeated: float


@dataclass(frozen=True)
class Smoothing:
    """Smoothed joints of whole tracks.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN outside tracks and in long gaps.
        covariance: (frames, persons, 17, 3, 3) [m^2], growing into gaps.
        filled: (frames, persons, 17) bool, interpolated between two triangulated frames.
        motion: motion prior.
        changes: counts and distances behind `report`.
    """

    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]
    motion: MotionModel
    changes: Changes

    @property
    def report(self) -> SmoothingReport:
        """The metrics of these frames."""
        return self.changes.report(self.motion.acceleration, self.motion.repeated)


@dataclass(frozen=True, eq=False)
class ClipModel:
    """A clip's noise model and clock offsets, estimated from sample frames.

    Attributes:
        clocks: clock offsets of the cameras.
        corrected: (cameras,) [frame], the offsets to correct; None = none, by the settings.
        detector: error model of detector and calibration.
    """

    clocks: CameraClocks
    corrected: Floats | None
    detector: DetectorModel
    motion: MotionModel


@dataclass(frozen=True, eq=False)
class Chunk:
    """Joints of a chunk: its place among the computed frames, and both results."""

    frames: slice
    triangulation: Triangulation
    smoothing: Smoothing


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
