"""Points besides COCO-17 as evidence about bodies: heels, toes and landmarks of the surface.

A point is a vertex of the body model. A detector's point lies near it, at an offset that is fixed
to the segment of the body, the same for all persons and mirrored left to right: shoes, and another
definition. The offsets are learned from residuals, like those of joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import (
    JOINT_NAMES,
    LANDMARKS,
    VERTEX_OF_POINT,
    fold_keypoints,
    point_segments,
)
from worldpose.body.model import SMPL_VERTICES, BodyModel, BodyParameters
from worldpose.body_fitting.evidence import PersonEvidence
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.results import ExtraFit
from worldpose.body_fitting.shapes import Shapes
from worldpose.compiled import map_in_threads
from worldpose.triangulation.results import ExtraJoints

MIRROR: Final = np.array([-1.0, 1.0, 1.0])
"""Of vectors in the axes of the unposed body: left, up, forward."""


def known_points(model: BodyModel, points: Sequence[str]) -> tuple[str, ...]:
    """Return those of a detector's points that a body model has."""
    if len(model.template) != SMPL_VERTICES:
        return ()
    return tuple(point for point in points if point in VERTEX_OF_POINT)


def select_points(extra: ExtraJoints, points: tuple[str, ...]) -> ExtraJoints:
    """Return the triangulated points with these names, in this order."""
    kept = [extra.points.index(point) for point in points]
    return ExtraJoints(
        points,
        extra.joints[:, :, kept],
        extra.covariance[:, :, kept],
        extra.views[:, :, kept],
        extra.common_bias[kept],
    )


def move_points(solver: PoseSolver, points: tuple[str, ...], offsets: Floats) -> PoseSolver:
    """Return a solver that knows these points with them where the detector has them."""
    its = point_segments(solver.chained.model, points)
    return replace(solver, chained=solver.chained.move_points(len(COCO17), its, offsets))


def perceived_points(
    model: BodyModel, points: tuple[str, ...], parameters: BodyParameters, offsets: Floats
) -> Floats:
    """Return vectors (..., points, 3) [m], world, from the body's points to the detector's.

    Bodies are (...), offsets (points, 3) [m] as in `ExtraFit`.
    """
    turned = model.articulate(parameters).rotations[..., point_segments(model, points), :, :]
    moved: Floats = np.einsum("...pab,pb->...pa", turned, offsets)
    return moved


def learn_point_offsets(
    solver: PoseSolver,
    points: tuple[str, ...],
    people: Mapping[int, PersonEvidence],
    shapes: Shapes,
    fps: float,
) -> tuple[Floats, Floats, Floats]:
    """Return the offsets of a detector's points, their variance, and the variance around them.

    All are (points, 3) [m, m^2, m^2]. The last is the mean over persons of the squared spread in
    time, from the median absolute deviation: errors that views share and that differ by pose. The
    solver knows the points; people have joints and points of some seconds.
    """
    model = solver.chained.model
    offsets = np.zeros((len(points), 3))
    # Expected offset of a detector's point from the body's, per axis of the segment [m]: soles and
    # toe caps of shoes are 1 to 3 cm thick.
    offset_std_m = 0.02
    variance = np.full(offsets.shape, offset_std_m**2)

    def residuals(person: int) -> Floats:
        part = people[person]
        pose, _ = moved.solve_poses(part, shapes.people[person], shapes.offsets, fps)
        parameters = pose.parameters()
        places = solver.chained.place(parameters)[:, len(COCO17) :]
        turned = model.articulate(parameters).rotations[:, point_segments(model, points)]
        away: Floats = part.joints[:, len(COCO17) :] - places
        return np.asarray(np.einsum("fpba,fpb->fpa", turned, away))

    own_std_m = 0.01  # Difference of that offset between persons, per axis [m].
    # Estimates of the offsets, each from poses that know the one before.
    for _ in range(2):
        moved = move_points(solver, points, offsets)
        medians, spreads = [], []
        for own in map_in_threads(residuals, people):
            median, spread = _describe_residuals(own)
            medians.append(median)
            spreads.append(spread)
        each, around = np.array(medians), np.array(spreads)
        for place in range(len(points)):
            values = each[:, place]
            other = _mirror_place(points, place)
            if other is not None:
                values = np.concatenate([values, each[:, other] * MIRROR])
            values = values[np.isfinite(values[:, 0])]
            weight = len(values) / own_std_m**2 + 1.0 / offset_std_m**2
            offsets[place] = values.sum(axis=0) / own_std_m**2 / weight
            variance[place] = 1.0 / weight
    with np.errstate(invalid="ignore"):
        varying = np.nan_to_num(np.nansum(around, axis=0) / np.isfinite(around).sum(axis=0))
    return offsets, variance, varying


def _describe_residuals(own: Floats) -> tuple[Floats, Floats]:
    """Return median and robust variance (points, 3) of residuals (frames, points, 3)."""
    seen = np.isfinite(own[..., 0])
    median, spread = (np.full(own.shape[1:], np.nan) for _ in range(2))
    for point in np.flatnonzero(seen.any(axis=0)):
        its = own[seen[:, point], point]
        median[point] = np.median(its, axis=0)
        # Standard deviation of a normal distribution over its median absolute deviation [1].
        spread[point] = (1.4826 * np.median(np.abs(its - median[point]), axis=0)) ** 2
    return median, spread


def _kept_variance(
    model: BodyModel, points: tuple[str, ...], varying: Floats, common_bias: Floats
) -> Floats:
    """Return the part of the points' common bias that stays in their covariance (points, 3) [m^2].

    A net errs alike in the landmarks of one segment, in all views and for many frames: together
    they count as one, whose error is that of residuals over time.
    """
    # Least part of the points' common bias that stays in their covariance per axis [m].
    kept_bias_m = 0.01
    least = np.maximum(varying, kept_bias_m**2)
    if not any(point in LANDMARKS for point in points):
        usual = np.minimum(kept_bias_m**2, common_bias**2)
        return np.repeat(usual[:, None], 3, axis=1)
    its = point_segments(model, points)
    alike: Floats = (its[:, None] == its).sum(axis=1)[:, None] * least
    return alike


def _mirror_place(points: tuple[str, ...], place: int) -> int | None:
    """Return the place of a point's mirror image among the points."""
    name = points[place]
    one, two = ("left_", "right_") if name.startswith("left_") else ("right_", "left_")
    other = name.replace(one, two, 1)
    return points.index(other) if other != name and other in points else None


def densest_interval(known: NDArray[np.integer], fps: float) -> slice:
    """Return the interval of two seconds with the most of a person's points, `known` (frames,)."""
    total = np.concatenate([[0], np.cumsum(known, dtype=np.int64)])
    # Time of each person from which offsets are learned [s]: they are few numbers.
    length = min(max(3, round(2.0 * fps)), len(known))
    start = int((total[length:] - total[: len(total) - length]).argmax())
    return slice(start, start + length)


def feet_determined(
    model: BodyModel, points: tuple[str, ...], evidence: PersonEvidence, fps: float
) -> NDArray[np.bool_]:
    """Return the frames in which points determine the left and right foot (frames, 2)."""
    its = point_segments(model, points)
    known = evidence.known[:, len(COCO17) :]
    # Time around such a frame for which the motion determines the pose of a foot [s].
    reach = round(0.1 * fps)
    determined = np.zeros((len(known), 2), dtype=np.bool_)
    for side, name in enumerate(("left", "right")):
        foot = [JOINT_NAMES.index(f"{name}_{part}") for part in ("ankle", "foot")]
        # Points that determine the pose of a foot in a frame [1]: a heel and a toe.
        sure = known[:, np.isin(its, foot)].sum(axis=1) >= 2
        near = np.convolve(sure, np.ones(2 * reach + 1), mode="full")
        determined[:, side] = near[reach : reach + len(sure)] > 0.0
    return determined


@dataclass(frozen=True, eq=False)
class PointModel:
    """Points besides COCO-17 of a detector: where it sees them, and how surely.

    Attributes:
        solver: solver of poses that knows the points, where the detector has them.
        offsets: (points, 3) [m], as in `ExtraFit`.
        modelled: (points, 3) [m^2], part of the triangulated points' variance in the offsets.
        systematic: (points, 3, 3) [m^2], covariance of the offsets and of the common bias.
    """

    solver: PoseSolver
    points: tuple[str, ...]
    offsets: Floats
    modelled: Floats
    systematic: Floats

    def add(
        self, person: int, own: PersonEvidence, extra: ExtraJoints, fps: float
    ) -> PersonEvidence:
        """Return a person's evidence with the points, in the frames of both."""
        covariance = extra.covariance[:, person] - self.modelled[..., None] * np.eye(3)
        return own.add_points(extra.joints[:, person], covariance, fps, self.solver.settings)

    def empty_fit(self, frames: int, persons: int) -> ExtraFit:
        """Return arrays without any point."""
        shape = (frames, persons, len(self.points), 3)
        return ExtraFit(
            self.points, np.full(shape, np.nan), np.full((*shape, 3), np.nan), self.offsets
        )


def learn_points(
    solver: PoseSolver,
    people: Mapping[int, tuple[PersonEvidence, ExtraJoints]],
    shapes: Shapes,
    fps: float,
) -> PointModel:
    """Return the model of a detector's points, learned from some seconds of each person.

    Each has joints, and the points that the body model has, (frames, 1, points).
    """
    found = next(iter(people.values()))[1]
    points, settings = found.points, solver.settings
    # It also bends ankles and toes.
    chained = ChainedKeypoints.of(fold_keypoints(solver.chained.model, (*COCO17, *points)))
    solver = replace(solver, chained=chained, prior=solver.prior.add_feet())
    # With the bias in their covariance the points hardly move the bodies: residuals show it.
    whole = {
        person: own.add_points(extra.joints[:, 0], extra.covariance[:, 0], fps, settings)
        for person, (own, extra) in people.items()
    }
    offsets, variance, varying = learn_point_offsets(solver, points, whole, shapes, fps)
    common = found.common_bias[:, None] ** 2
    kept = _kept_variance(solver.chained.model, points, varying, found.common_bias)
    systematic = (common + variance + settings.own_bias_std_m**2)[..., None] * np.eye(3)
    solver = move_points(solver, points, offsets)
    return PointModel(solver, points, offsets, common - kept, systematic)
