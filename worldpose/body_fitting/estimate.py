"""Order of body fitting: the objective is in `residuals`.

1. Shapes, from bone lengths, then together with the detector's offsets and coarse poses of some
   seconds of each person (`shapes`).
2. Offsets of points besides COCO-17, from the poses of two seconds (`extra_points`).
3. Poses of all frames with fixed shapes and offsets, in windows (`poses`): from hips and torso, by
   Gauss-Newton steps; feet stand from the middle of the steps on.
4. Poses again, of people with few well-determined joints, towards monocular poses (`monocular`).
5. Covariance of the keypoints; gaps that are too long are dropped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import Ground, PersonEvidence, random_covariance
from worldpose.body_fitting.extra_points import (
    PointModel,
    densest_interval,
    feet_determined,
    known_points,
    learn_points,
    select_points,
)
from worldpose.body_fitting.monocular import MonocularPrior, monocular_priors
from worldpose.body_fitting.pose_space import load_pose_prior, nearest_matrices
from worldpose.body_fitting.poses import PoseSolver, pose_covariance
from worldpose.body_fitting.results import BodyFit, ClipEvidence, EvidenceSource, FittedArrays
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shapes import Shapes, fit_shapes, spread_intervals
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError

WINDOW_FRAMES = 3000
"""Frames that are solved together: a person's equations take 60 KB per frame."""


def fit_bodies(
    model: BodyModel,
    evidence: EvidenceSource,
    settings: BodyFittingSettings = BodyFittingSettings(),  # noqa: B008
    ground: Ground | None = None,
    known_shapes: Mapping[int, Shape] | None = None,
) -> BodyFit:
    """Return the bodies that fit the triangulated joints of all persons.

    Args:
        model: the body.
        evidence: triangulated joints, and other observations of the same clip.
        settings: expected errors of detectors, bodies and motion.
        ground: height of the surface under the feet, in a world with z up; None where unknown.
        known_shapes: shapes of people from other clips, by their index in the joints.

    Raises:
        InputError: a covariance is smaller than the square of `common_bias`, its part, or
            `settings.method` is not ours.
    """
    if settings.method != "worldpose":
        raise InputError(
            "fit_bodies: method",
            expected="worldpose: the paper's method fits 2D poses, which joints do not have",
            found=settings.method,
            todo="Call `worldpose.body_fitting.paper_variant.fit_in_windows`, or set "
            "body_fitting.method of a run.",
        )
    parts = fit_in_windows(model, evidence, settings, ground, known_shapes)
    return BodyFit.concatenate([fit for _, fit in parts])


def fit_in_windows(
    model: BodyModel,
    evidence: EvidenceSource,
    settings: BodyFittingSettings = BodyFittingSettings(),  # noqa: B008
    ground: Ground | None = None,
    known_shapes: Mapping[int, Shape] | None = None,
) -> Iterator[tuple[slice, BodyFit]]:
    """Yield the bodies of `fit_bodies` for consecutive frames of a clip of any length, with these.

    Shape starts from bone lengths, poses from hips and torso; then betas, coarse poses and the
    detector's shared offsets are estimated together from some seconds of each person, and last the
    poses of all frames with fixed betas and offsets.
    """
    clip = _learn_clip(
        evidence,
        PoseSolver(
            ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior(), settings, ground
        ),
        known_shapes or {},
    )
    for window, kept in split_windows(evidence.size[0], evidence.fps, settings):
        # Not bound here, so that its memory is free while the next window is fitted.
        yield kept, clip.fit(evidence.read(window), window, kept)


def _learn_clip(
    evidence: EvidenceSource, solver: PoseSolver, known_shapes: Mapping[int, Shape]
) -> _ClipBodies:
    """Return the shapes and offsets of a clip."""
    (frames, persons), fps = evidence.size, evidence.fps
    parts = [kept for _, kept in split_windows(frames, fps, solver.settings)]
    seen = np.zeros((frames, persons), dtype=np.bool_)
    number = np.zeros((frames, persons), dtype=np.int16)
    points: dict[str, None] = {}
    for part in parts:
        some = evidence.read_joints(part)
        some.require_bias()
        seen[part] = some.joint_seen.any(-1)
        if some.extra is not None:
            names = known_points(solver.chained.model, some.extra.points)
            extra = select_points(some.extra, names)
            there = np.isfinite(extra.joints[..., 0])
            number[part] = there.sum(axis=-1)
            points |= dict.fromkeys(np.array(names)[there.any(axis=(0, 1))].tolist())
    spans = {
        person: slice(int(here[0]), int(here[-1]) + 1)
        for person in range(persons)
        if len(here := np.flatnonzero(seen[:, person]))
    }
    sampled = {
        person: [
            slice(span.start + part.start, span.start + part.stop)
            for part in spread_intervals(span.stop - span.start, fps, solver.settings)
        ]
        for person, span in spans.items()
    }
    shapes = fit_shapes(solver, _read_samples(evidence, parts, sampled), known_shapes, fps)
    if not points or not spans:
        return _ClipBodies(solver, shapes, spans, fps)
    samples = {}
    for person, span in spans.items():
        part = densest_interval(number[span, person], fps)
        some = evidence.read(slice(span.start + part.start, span.start + part.stop))
        assert some.extra is not None
        covariance = random_covariance(some.covariance, some.bias)
        own, _ = _gather_evidence(some, covariance, {person: slice(None)}, solver.settings)
        extra = select_points(some.extra, tuple(points))
        alone = replace(
            extra,
            joints=extra.joints[:, [person]],
            covariance=extra.covariance[:, [person]],
            views=extra.views[:, [person]],
        )
        samples[person] = own[person], alone
    return _ClipBodies(solver, shapes, spans, fps, learn_points(solver, samples, shapes, fps))


def _read_samples(
    evidence: EvidenceSource, parts: Sequence[slice], sampled: Mapping[int, Sequence[slice]]
) -> dict[int, list[tuple[Floats, Floats]]]:
    """Return joints and covariance of each person in some intervals, which parts of a clip hold."""
    read: dict[int, list[tuple[Floats, Floats]]] = {
        person: [
            (
                np.empty((each.stop - each.start, 17, 3)),
                np.empty((each.stop - each.start, 17, 3, 3)),
            )
            for each in intervals
        ]
        for person, intervals in sampled.items()
    }
    for part in parts:
        some = evidence.read_joints(part)
        for person, intervals in sampled.items():
            for each, (joints, covariance) in zip(intervals, read[person], strict=True):
                first, last = max(each.start, part.start), min(each.stop, part.stop)
                if first < last:
                    to = slice(first - each.start, last - each.start)
                    of = slice(first - part.start, last - part.start)
                    joints[to] = some.joints[of, person]
                    covariance[to] = random_covariance(some.covariance[of, person], some.bias)
    return read


@dataclass(frozen=True, eq=False)
class _ClipBodies:
    """Shapes, offsets and spans from a person's first joint to the last, which all frames share.

    `points` are those besides COCO-17; None without evidence about any.
    """

    solver: PoseSolver
    shapes: Shapes
    spans: Mapping[int, slice]
    fps: float
    points: PointModel | None = None

    def fit(self, evidence: ClipEvidence, window: slice, kept: slice) -> BodyFit:
        """Return the bodies in some frames, fitted in a window around them.

        Where the window begins or ends without any observation of a person, or the frames to keep
        have none, the person is missing.
        """
        settings, bias, fps = self.solver.settings, evidence.bias, self.fps
        covariance = random_covariance(evidence.covariance, bias)
        joint_seen = evidence.joint_seen
        seen = np.asarray(joint_seen.any(-1))
        spans = {
            person: slice(max(span.start, window.start) - window.start, last - window.start)
            for person, span in self.spans.items()
            if (last := min(span.stop, window.stop)) > max(span.start, window.start)
        }
        people, present = _gather_evidence(evidence, covariance, spans, settings)
        model = self.solver.chained.model
        result = FittedArrays.empty(model, *evidence.size)
        if self.points is not None and evidence.extra is not None:
            result = replace(result, extra=self.points.empty_fit(*evidence.size))
            extra = select_points(evidence.extra, self.points.points)
            people = {
                person: self.points.add(person, own, extra[spans[person]], fps)
                for person, own in people.items()
            }
        core = slice(kept.start - window.start, kept.stop - window.start)
        spans, people = trim_people(spans, people, core.start, core.stop)
        solver = self.solver if self.points is None else self.points.solver

        def fit_person(person: int, prior: MonocularPrior | None = None) -> None:
            own, span = people[person], spans[person]
            shape = self.shapes.people[person]
            pose, track = solver.solve_poses(own, shape, self.shapes.offsets, fps, prior)
            places, random = pose_covariance(track, pose, self.shapes.offsets)
            spread = random[:, :17] + bias[:, None, None] ** 2 * np.eye(3)
            determined = None
            if self.points is not None:
                determined = feet_determined(model, self.points.points, own, fps)
            bodies = result.put(
                solver, person, span, pose, (places[:, :17], spread), self.shapes, determined
            )
            if self.points is not None and result.extra is not None:
                keypoints = fold_keypoints(model, self.points.points)
                result.extra.joints[span, person] = keypoints(bodies)
                result.extra.covariance[span, person] = random[:, 17:] + self.points.systematic

        for _ in map_in_threads(fit_person, spans):
            pass
        if evidence.monocular_poses is not None:
            priors = monocular_priors(
                (result.orient, result.body_pose),
                joint_seen,
                covariance,
                evidence.monocular_poses,
                spans,
                fps,
            )
            for person, prior in priors.items():
                fit_person(person, prior)
                result.guided[spans[person], person] = prior.used
        for person, span in spans.items():
            result.filled[span, person] = ~seen[span, person]
            gone = long_gaps(present[span, person], settings.max_filled_gap_s * fps)
            shared = evidence.shared_covariance
            moving = None if shared is None else nearest_matrices(shared[span, person])[:, None]
            result.drop(person, span, gone)
            if moving is not None:
                result.covariance[span, person] += moving
                if result.extra is not None:
                    result.extra.covariance[span, person] += moving
        for person in self.spans:  # also of people who are not in this window
            result.betas[person] = self.shapes.people[person].betas
            result.betas_covariance[person] = self.shapes.people[person].covariance
        fit = BodyFit.of(result, self.shapes)
        return fit if kept == window else fit[core]


def _gather_evidence(
    evidence: ClipEvidence,
    covariance: Floats,
    spans: Mapping[int, slice],
    settings: BodyFittingSettings,
) -> tuple[dict[int, PersonEvidence], Flags]:
    """Return each person's joints and lines of sight, and the frames (frames, persons) with any."""
    fps, present = evidence.fps, np.asarray(evidence.joint_seen.any(-1))
    for view in evidence.ray_constraints:
        present = present | view.seen

    def gather(person: int) -> PersonEvidence:
        span = spans[person]
        joints = evidence.joints[span, person]
        own = PersonEvidence.of(joints, covariance[span, person], fps, settings)
        for view in evidence.ray_constraints:
            points, across = view.points[span, person], view.across[span, person]
            own = own.add_rays(points, across, fps, settings)
        return own

    by_person = dict(zip(spans, map_in_threads(gather, spans), strict=True))
    return by_person, present


def split_windows(
    frames: int, fps: float, settings: BodyFittingSettings
) -> Iterator[tuple[slice, slice]]:
    """Yield frames that are solved together, and those of them that are kept."""
    # Motion ties a pose to those within some tenths of a second.
    margin = math.ceil(max(3.0, 2.0 * settings.max_filled_gap_s) * fps)
    size = max(WINDOW_FRAMES, 2 * margin)
    starts = range(0, frames, size) if frames > size + margin else (0,)
    for start in starts:
        stop = start + size if len(starts) > 1 and start + size < frames else frames
        first, last = max(0, start - margin), min(frames, stop + margin)
        yield slice(first, last), slice(start, stop)


def trim_people(
    spans: Mapping[int, slice], people: Mapping[int, PersonEvidence], first: int, last: int
) -> tuple[dict[int, slice], dict[int, PersonEvidence]]:
    """Return frames and evidence of people from their first observation in a window to the last.

    People without any observation in the frames from `first` to `last` are left out.
    """
    trimmed, evidence = {}, {}
    for person, span in spans.items():
        here = np.flatnonzero(people[person].known.any(axis=1))
        if ((here + span.start >= first) & (here + span.start < last)).any():
            own = slice(int(here[0]), int(here[-1]) + 1)
            trimmed[person] = slice(span.start + own.start, span.start + own.stop)
            its = people[person]
            evidence[person] = PersonEvidence(its.joints[own], its.information[own])
    return trimmed, evidence


def long_gaps(seen: NDArray[np.bool_], max_frames: float) -> NDArray[np.bool_]:
    """Return the frames in gaps of more than `max_frames` frames."""
    places = np.flatnonzero(seen)
    long = np.zeros(len(seen), dtype=bool)
    for first, last in itertools.pairwise(places):
        if last - first - 1 > max_frames:
            long[first + 1 : last] = True
    return long
