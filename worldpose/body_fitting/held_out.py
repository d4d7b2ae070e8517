"""Comparison of fitted bodies with their input, triangulated joints, in held-out cameras.

It shows where bodies lose to the joints. One quarter of the cameras after the other is held out.
The others triangulate all people, bodies are fitted to these joints, and both are compared with the
keypoints of the held-out cameras. The errors of these keypoints raise both mean squares alike, so
that their difference is that of the joints' own errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17, JOINT_GROUPS
from data_contracts.keypoints import KeypointDetections, TrackedFrames
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import (
    Ground,
    PersonEvidence,
    perceived_joints,
    random_covariance,
)
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.ray_constraints import RayConstraints, find_ray_constraints
from worldpose.body_fitting.results import BodyFit
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.estimate import learn_detector, triangulate_frames
from worldpose.triangulation.results import Triangulation
from worldpose.triangulation.settings import TriangulationSettings

_GROUP_OF: Final = np.array(
    [
        next(g for g, parts in enumerate(JOINT_GROUPS.values()) if any(p in name for p in parts))
        for name in COCO17
    ]
)


@dataclass(frozen=True, eq=False)
class SeenClip:
    """Detections of static cameras in a clip, and how its joints were triangulated.

    Attributes:
        cameras: batch (cameras,).
        camera_covariance: (cameras, 12, 12) as in `triangulate_frames`, or None.
        detections: detections of the tracked people, left-right swaps undone.
    """

    cameras: Camera
    camera_covariance: Floats | None
    detections: TrackedFrames
    settings: TriangulationSettings
    fps: float


@dataclass(frozen=True, eq=False)
class HeldOutComparison:
    """Distances of joints to the keypoints of held-out cameras, by joint group; (7,) each.

    NaN for a group without enough keypoints.

    Attributes:
        fitted: root mean square distance of the bodies' joints, at the person's depth [m].
        triangulated: the same of the triangulated joints.
        standard_error: of `excess` [m], from intervals of persons and from cameras.
        certain_excess: root of the mean square error of bodies' joints beyond that of triangulated
            joints [m], its lower limit.
        keypoints: number of compared keypoints.
    """

    fitted: Floats
    triangulated: Floats
    standard_error: Floats
    certain_excess: Floats
    keypoints: NDArray[np.int64]

    @property
    def excess(self) -> Floats:
        """(7,) how much farther the bodies' joints are [m]; negative where they are nearer."""
        return self.fitted - self.triangulated

    def figures(self) -> dict[str, float]:
        """Return the metrics by joint group: `held_out_fitted_m.knee` and the like."""
        columns = {
            "fitted": self.fitted,
            "triangulated": self.triangulated,
            "excess": self.excess,
            "excess_error": self.standard_error,
            "certain_excess": self.certain_excess,
        }
        return {
            f"held_out_{name}_m.{group}": float(value)
            for name, values in columns.items()
            for group, value in zip(JOINT_GROUPS, values, strict=True)
            if np.isfinite(value)
        }


def compare_held_out(
    model: BodyModel,
    settings: BodyFittingSettings,
    ground: Ground | None,
    clip: SeenClip,
    fit: BodyFit,
) -> HeldOutComparison | None:
    """Compare fitted and triangulated joints with the keypoints of held-out cameras.

    Shapes, the detector's offsets and noise are those of the whole clip: few numbers, which
    thousands of keypoints determine. Joints and poses know nothing of the held-out cameras. None
    without people, or if too few cameras remain to triangulate.
    """
    count, frames = clip.cameras.batch_shape[0], len(clip.detections.detection_index)
    known = np.flatnonzero(np.isfinite(fit.betas).all(-1))
    folds = 4  # Groups of cameras; each is held out once.
    if count - max(1, count // folds) < clip.settings.min_views or not len(known):
        return None
    pieces = _choose_pieces(frames, len(known), clip.fps)
    chosen = np.concatenate([np.arange(piece.start, piece.stop) for piece in pieces])
    length = pieces[0].stop - pieces[0].start
    detections = clip.detections[chosen].with_points(())
    solver = PoseSolver(
        ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior(), settings, ground
    )
    detector = learn_detector(clip.cameras, detections, clip.settings, clip.camera_covariance)
    fold = np.arange(count) % folds
    rows: list[tuple[NDArray[np.int64], ...]] = []
    for left_out in range(min(folds, count)):
        index = np.where((fold == left_out)[:, None], np.int16(-1), detections.detection_index)
        others = replace(detections, detection_index=index.astype(np.int16))
        placed = triangulate_frames(
            clip.cameras, others, clip.settings, clip.camera_covariance, detector
        )
        alone = find_ray_constraints(clip.cameras, others, placed.joints)
        bodies = _fit_poses(solver, placed, alone, fit, length, clip.fps)
        rows.extend(
            _compare(clip.cameras, int(camera), detections, (bodies, placed.joints), length)
            for camera in np.flatnonzero(fold == left_out)
        )
    return _summarize(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _fit_poses(
    solver: PoseSolver,
    placed: Triangulation,
    alone: RayConstraints,
    fit: BodyFit,
    length: int,
    fps: float,
) -> Floats:
    """Return the detector's joints of bodies with known shapes (frames, persons, 17, 3) [m]."""
    covariance = random_covariance(placed.covariance, placed.common_bias)
    bodies = np.full(placed.joints.shape, np.nan)

    def fit_person(person: int) -> None:
        shape = Shape(fit.betas[person], fit.betas_covariance[person])
        for first in range(0, len(bodies), length):
            part = slice(first, first + length)
            joints = placed.joints[part, person]
            if not np.isfinite(joints).any():
                continue
            evidence = PersonEvidence.of(
                joints, covariance[part, person], fps, solver.settings
            ).add_rays(alone.points[part, person], alone.across[part, person], fps, solver.settings)
            pose, _ = solver.solve_poses(evidence, shape, fit.offsets, fps)
            bodies[part, person] = solver.chained.place(pose.parameters())

    for _ in map_in_threads(fit_person, np.flatnonzero(np.isfinite(fit.betas).all(-1)).tolist()):
        pass
    return perceived_joints(bodies, fit.offsets)


def _choose_pieces(frames: int, persons: int, fps: float) -> list[slice]:
    """Return evenly spread intervals of a clip's frames."""
    # Length of the compared intervals [s]: errors of neighbouring frames are alike, so that many
    # short intervals say more than few long ones.
    length = min(frames, max(3, round(0.5 * fps)))
    # Bodies fitted for each group of cameras [1]: about half a second of one core.
    count = int(np.clip(400 // (persons * length), 1, frames // length))
    starts = np.linspace(0, frames - length, count).astype(np.int64)
    return [slice(int(start), int(start) + length) for start in starts]


def _compare(
    cameras: Camera,
    camera: int,
    detections: KeypointDetections,
    both: tuple[Floats, Floats],
    length: int,
) -> tuple[NDArray[np.int64], ...]:
    """Return joint, interval of a person, camera and two squared distances [m^2] of keypoints."""
    index = detections.detection_index[:, camera]
    frame, person = np.nonzero(index >= 0)
    seen = np.asarray(detections.keypoints[frame, camera, index[frame, person]], dtype=np.float64)
    squares = []
    view = cameras[camera]
    place = both[1][frame, person]
    axis, depth = view.cam_from_world.rotation[2], view.cam_from_world.translation[2]
    scale = view.focal.mean() / np.maximum(place @ axis + depth, 1e-3)
    for joints in both:
        away = np.linalg.norm(view.project(joints[frame, person]) - seen, axis=-1) / scale
        # A keypoint farther than this from a joint counts as this far [m]: it shows something else.
        squares.append(np.minimum(away, 0.2) ** 2)
    row, joint = np.nonzero(np.isfinite(squares[0]) & np.isfinite(squares[1]))
    persons = detections.detection_index.shape[2]
    return (
        joint,
        frame[row] // length * persons + person[row],
        np.full(len(row), camera),
        squares[0][row, joint],
        squares[1][row, joint],
    )


def _summarize(
    joint: NDArray[np.int64],
    interval: NDArray[np.int64],
    camera: NDArray[np.int64],
    fitted: Floats,
    triangulated: Floats,
) -> HeldOutComparison:
    """Return the comparison of rows of keypoints."""
    found = np.full((4, len(JOINT_GROUPS)), np.nan)
    number = np.zeros(len(JOINT_GROUPS), dtype=np.int64)
    for group in range(len(JOINT_GROUPS)):
        mine = _GROUP_OF[joint] == group
        number[group] = mine.sum()
        clusters = min(len(np.unique(each[mine])) for each in (interval, camera))
        # Intervals of persons, and cameras, needed for a standard error [1].
        if clusters < 3:
            continue
        squares = fitted[mine] - triangulated[mine]
        deviation = np.sqrt(_clustered_variance(squares, interval[mine], camera[mine]))
        # Probability of `certain_excess`, by Student's distribution of the smaller number of
        # clusters.
        certain = squares.mean() - stdtrit(clusters - 1, 0.975) * deviation
        one, two = np.sqrt(fitted[mine].mean()), np.sqrt(triangulated[mine].mean())
        # The difference of roots is the difference of the squares over their sum.
        found[:, group] = one, two, deviation / max(one + two, 1e-9), np.sqrt(max(certain, 0.0))
    return HeldOutComparison(found[0], found[1], found[2], found[3], number)


def _clustered_variance(
    values: Floats, interval: NDArray[np.int64], camera: NDArray[np.int64]
) -> float:
    """Return the variance of a mean of values correlated within intervals and within cameras.

    Cameron, Gelbach and Miller, Journal of Business and Economic Statistics 29, 2011.
    """
    away = values - values.mean()

    def of(cluster: NDArray[np.int64]) -> float:
        _, own = np.unique(cluster, return_inverse=True)
        sums = np.bincount(own, away)
        few = len(sums) / max(len(sums) - 1, 1)
        return few * float((sums**2).sum()) / len(values) ** 2

    by_interval, by_camera = of(interval), of(camera)
    together = of(interval * (int(camera.max()) + 1) + camera)
    return max(by_interval + by_camera - together, by_interval, by_camera)
