"""Metrics of fitted bodies, which need no ground truth."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.conventions import COCO17, COCO17_RIGID_BONES
from data_contracts.keypoints import KeypointDetections, TrackedFrames
from data_contracts.records import Record
from worldpose.body_fitting.evidence import ANKLES, perceived_joints
from worldpose.body_fitting.results import BodyFit
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera


class BodyFittingReport(Record):
    """Metrics of one clip, and of each person in the order of the persons; None without data.

    Medians and spreads of a long clip are those of evenly chosen values.
    """

    bodies: int
    """Fitted bodies, one per frame and person [1]."""
    filled: int
    """Fitted bodies in frames without any joint of the person [1]."""
    guided: int
    """Bodies fitted with a monocular pose [1]."""
    offset_rms_m: float | None
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


class FitMetrics:
    """Metrics of consecutive parts of a clip, whose memory does not grow with the clip.

    Of `stride` values of a part, medians and spreads use one.
    """

    def __init__(self, fps: float, stride: int = 1) -> None:
        self._fps, self._stride = fps, stride
        self._counts = np.zeros(3, dtype=np.int64)
        self._offsets = np.zeros((17, 3))
        self._values: dict[str, dict[int, list[AnyFloats]]] = {}
        self._persons = 0

    def add(
        self, fit: BodyFit, joints: Floats, seen: tuple[Camera, TrackedFrames] | None = None
    ) -> None:
        """Add the next frames' bodies, with the joints (frames, persons, 17, 3) [m] of the fit.

        `seen` are static cameras (cameras,), or each frame's camera (frames, 1), and the detections
        behind the joints, left-right swaps undone.
        """
        self._offsets, self._persons = fit.offsets, joints.shape[1]
        self._counts += (
            np.isfinite(fit.joints[:, :, 0, 0]).sum(),
            fit.filled.sum(),
            fit.guided.sum(),
        )
        perceived = perceived_joints(fit.joints, fit.offsets)
        ends = np.array(COCO17_RIGID_BONES)
        limbs = np.linalg.norm(joints[:, :, ends[:, 1]] - joints[:, :, ends[:, 0]], axis=-1)
        step = np.linalg.norm(np.diff(fit.joints[:, :, ANKLES], axis=0), axis=-1)
        jerk = np.linalg.norm(np.diff(fit.joints, n=3, axis=0), axis=-1) * self._fps**3
        slow = np.where(step * self._fps < 0.5, step, np.nan)
        away = np.linalg.norm(joints - perceived, axis=-1)
        columns = {"residual": away, "limbs": limbs, "skating": slow}
        for person in range(self._persons):
            for name, values in columns.items():
                self._keep(name, person, values[:: self._stride, person])
            squares = jerk[:, person][np.isfinite(jerk[:, person])] ** 2
            self._keep("jerk", person, np.array([[squares.sum(), len(squares)]]))
        if seen is None:
            return
        block = 256  # Frames of detections in memory at a time.
        for first in range(0, len(joints), block * self._stride):
            rows = slice(first, min(first + block, len(joints)))
            distances = _reprojection(perceived[rows], seen, rows)
            for person, values in enumerate(distances):
                self._keep("reprojection", person, values.astype(np.float32))

    def _keep(self, name: str, person: int, values: AnyFloats) -> None:
        self._values.setdefault(name, {}).setdefault(person, []).append(values)

    def _all(self, name: str, person: int) -> AnyFloats:
        return np.concatenate(self._values[name][person])

    def report(self) -> BodyFittingReport:
        """Return the metrics of all parts."""
        bodies, filled, guided = self._counts.tolist()
        persons = range(self._persons)
        seen = "reprojection" in self._values
        return BodyFittingReport(
            bodies=bodies,
            filled=filled,
            guided=guided,
            offset_rms_m=float(np.sqrt(np.mean(self._offsets**2))) if bodies else None,
            residual_m=tuple(_median(self._all("residual", person)) for person in persons),
            reprojection_px=tuple(
                _median(self._all("reprojection", person)) if seen else None for person in persons
            ),
            bone_spread_m=tuple(_spread(self._all("limbs", person)) for person in persons),
            skating_m=tuple(_median(self._all("skating", person)) for person in persons),
            jerk_m_s3=tuple(
                float(np.sqrt(total / count)) if count else None
                for total, count in (self._all("jerk", person).sum(axis=0) for person in persons)
            ),
        )


def report_fit(
    fit: BodyFit, joints: Floats, fps: float, seen: tuple[Camera, KeypointDetections] | None = None
) -> BodyFittingReport:
    """Return the metrics of one clip's fit; arguments as of `FitMetrics.add`."""
    metrics = FitMetrics(fps)
    metrics.add(fit, joints, seen)
    return metrics.report()


def _reprojection(
    perceived: Floats, seen: tuple[Camera, TrackedFrames], rows: slice
) -> list[Floats]:
    """Return distances of each person's seen keypoints (n,) [px] in some frames."""
    cameras, reader = seen
    detections = reader[rows]
    index = detections.detection_index
    if len(cameras.batch_shape) > 1:
        cameras = cameras[rows]

    def measure(person: int) -> Floats:
        place = index[:, :, person]
        frame, camera = np.nonzero(place >= 0)
        own = np.full((*place.shape, 17, 2), np.nan)
        own[frame, camera] = detections.keypoints[frame, camera, place[frame, camera]]
        away: Floats = np.linalg.norm(cameras.project(perceived[:, None, person]) - own, axis=-1)
        return away[np.isfinite(away)]

    return list(map_in_threads(measure, range(index.shape[2])))


def _median(values: AnyFloats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _spread(lengths: AnyFloats) -> float | None:
    spreads = [
        float(known.std()) for limb in lengths.T if len(known := limb[np.isfinite(limb)]) > 1
    ]
    return float(np.median(spreads)) if spreads else None


def far_offsets(offsets: Floats, common_bias: Floats) -> dict[str, tuple[float, float]]:
    """Return the joints of bodies with unusually large offsets (17, 3) [m].

    Shape and offsets together follow the detector: an offset much larger than a detector's common
    bias (17,) per axis [m], 0 = not known, means that either the joints or the bodies are wrong.
    Returned are, left and right as one, length of the offset and its usual maximum [m].
    """
    length = np.linalg.norm(offsets, axis=-1)
    # Standard deviations that one of the nine joints exceeds by chance in one clip of a thousand:
    # each, by chi-square with three degrees of freedom, in one of 9,000.
    max_offset = 4.57
    far = (length > max_offset * common_bias) & (common_bias > 0.0)
    return {
        COCO17[joint].removeprefix("left_"): (
            float(length[joint]),
            max_offset * float(common_bias[joint]),
        )
        for joint in np.flatnonzero(far)
        if not COCO17[joint].startswith("right")
    }
