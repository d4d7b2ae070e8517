"""Adjustment of cameras to people and markings, with acceptance per camera (B1-B3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.bundle_adjustment.clip import (
    Clip,
    Observations,
    learn_confidence,
    propose_frames,
    select_observations,
)
from worldpose.bundle_adjustment.held_out_validation import (
    CHANCE,
    Contradictions,
    Evidence,
    HeldOutErrors,
    Verdict,
    compare_errors,
    find_contradictions,
    held_out_errors,
    judge_cameras,
    pool_evidence,
)
from worldpose.bundle_adjustment.problems import (
    MARKINGS_SOLVER,
    KeypointNoise,
    camera_knowledge,
    estimate_noise,
    estimate_variance_factor,
    keypoint_information,
    markings_problem,
    players_problem,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solver import Solution, solve
from worldpose.bundle_adjustment.uncertainty import (
    add_shared_errors,
    align_points,
    relative_covariance,
    survey_response,
)
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.estimate import triangulate_joints

_SMALL_RIG: Final = 4
"""Maximum cameras of a rig in which cameras with a covariance change together or not at all [1]:
each joint of a held-out person then has at most three other views, whose errors do not average
out."""


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Cameras of a clip after adjustment.

    Attributes:
        clip: the input, with the noise of its detector in its confidences.
        cameras: (cameras,) batch; unchanged where the change was refused.
        covariance: (cameras, 12, 12) covariance of a step; as calibrated where the change was
            refused.
        accepted: (cameras,) bool.
        reasons: why each camera was accepted or refused.
        proposed: match frames best suited to adjustment.
        used: match frames that supplied people.
        judged: match frames for held-out validation.
        noise: noise of keypoints, as measured.
        verdict: held-out errors with calibrated and with changed cameras, also where refused.
        evidence: result of all held-out people together for the proposed change.
        motion: (cameras, 3) motion of the accepted cameras: of the center [m], of the axes [rad],
            of the focal length [1]; 0 where refused.
        refused: (cameras,) batch as it would be without held-out validation.
    """

    clip: Clip
    cameras: Camera
    covariance: Floats
    accepted: Flags
    reasons: tuple[str, ...]
    proposed: Integers
    used: Integers
    judged: Integers
    noise: KeypointNoise
    verdict: Verdict
    evidence: Evidence
    motion: Floats
    refused: Camera


def adjust_cameras(
    clip: Clip,
    settings: BundleAdjustmentSettings = BundleAdjustmentSettings(),  # noqa: B008
) -> BundleAdjustment:
    """Return cameras adjusted to markings and people, where held-out people confirm the change.

    People are split into groups. Each group in turn is held out of an adjustment and validates its
    cameras: keypoints of the group in a camera against its joints from the other cameras, in frames
    that are held out too. A camera whose held-out loss rises stays unchanged, and so does a
    calibrated camera of a rig of more than four whose loss falls by no more than chance explains.
    Where a calibrated camera's loss rises by more, or too few keypoints judge it, the others are
    adjusted without it. Finally the accepted cameras are adjusted to all people.

    Args:
        clip: calibrated cameras and triangulated people.
        settings: evidence, weights, acceptance.

    Note:
        B1-B3; paper section "Bundle Adjustment".
    """
    other = "refused: this camera shows other people than the other cameras under the same ids"
    proposed = propose_frames(
        clip, settings.max_frames, settings.min_frame_gap_s, settings.min_views
    )
    used = np.flatnonzero(np.isin(clip.detections.frame, settings.chosen_frames))
    used = used if settings.chosen_frames else proposed
    judged = propose_frames(
        clip, settings.max_frames, settings.min_frame_gap_s, settings.min_views, used
    )
    judged = judged if len(judged) else used
    placed = _place_people(clip, used)
    clip = learn_confidence(clip, np.union1d(used, judged))
    adjuster = _Adjuster(clip, settings, used, judged, placed)
    count = len(clip.clicks)
    if settings.evidence == "markings_and_players" and not len(adjuster.observations.points):
        return _refuse_all(clip, "no person has enough inlier cameras", proposed, used, judged)
    if settings.evidence == "markings" and not any(c.inlier.any() for c in clip.clicks):
        return _refuse_all(clip, "no camera has a clicked marking", proposed, used, judged)
    before, other_people = adjuster.before, adjuster.other_people
    fixed = other_people.copy()
    first: Verdict | None = None
    objection = ""
    while True:
        after = adjuster.held_out_errors(fixed)
        comparison = compare_errors(before, after)
        first = first or comparison
        evidence = pool_evidence(before, after, ~other_people)
        confirmed, agrees = judge_cameras(comparison, adjuster.stand_alone, settings.min_judges)
        if (confirmed | fixed).all():
            raised = adjuster.find_objection(before, after, fixed)
            if not raised:
                break
            objection = raised
            # Markings hold calibrated cameras, which may still change without the others.
            confirmed = adjuster.stand_alone
        if settings.evidence == "markings_and_players":
            adjuster.consistent |= agrees & ~fixed & ~other_people
        fixed |= ~confirmed
        # People need a second camera, and without them one camera's markings are no evidence.
        if fixed.all() or (~fixed | adjuster.consistent & adjuster.stand_alone).sum() < 2:
            fixed[:] = True
            break
    freely = adjuster.adjust(other_people)
    last = freely if fixed.all() or (fixed == other_people).all() else adjuster.adjust(fixed)
    own = adjuster.uncertainty(last)
    cameras = _merge_cameras(~fixed, last.cameras, clip.cameras)
    motion = np.where(fixed[:, None], 0.0, camera_motion(clip.cameras, cameras))
    return BundleAdjustment(
        clip=clip,
        cameras=cameras,
        covariance=np.where(fixed[:, None, None], clip.covariance, own),
        accepted=~fixed,
        reasons=tuple(
            other
            if other_people[c]
            else _explain_decision(
                first, c, not fixed[c], settings, objection, adjuster.stand_alone[c]
            )
            + ("" if fixed[c] else _describe_motion(motion[c]))
            for c in range(count)
        ),
        proposed=clip.detections.frame[proposed],
        used=clip.detections.frame[used],
        judged=clip.detections.frame[judged],
        noise=adjuster.noise,
        verdict=first,
        evidence=evidence,
        motion=motion,
        refused=freely.cameras,
    )


def camera_motion(before: Camera, after: Camera) -> Floats:
    """Return the motion (cameras, 3) of cameras: of center [m], axes [rad] and focal length [1]."""
    turned = before.cam_from_world.rotation @ after.cam_from_world.rotation.swapaxes(1, 2)
    # Use the chord: the trace loses half of the digits of a small angle.
    chord = np.linalg.norm(turned - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return np.stack(
        [
            np.linalg.norm(after.center - before.center, axis=1),
            2.0 * np.arcsin(np.clip(chord, 0.0, 1.0)),
            after.focal[:, 0] / before.focal[:, 0] - 1.0,
        ],
        axis=1,
    )


class _Adjuster:
    """Solver for all people or without one group, with held-out validation."""

    def __init__(
        self,
        clip: Clip,
        settings: BundleAdjustmentSettings,
        used: Integers,
        judged: Integers,
        placed: Floats,
    ) -> None:
        self.clip, self.settings, self.used, self.judged = clip, settings, used, judged
        self.placed = placed
        self.stand_alone = ~clip.given & (len(clip.given) > _SMALL_RIG)
        people = np.ones(clip.detections.detection_index.shape[2], dtype=np.bool_)
        self.observations = select_observations(
            clip, used, people, clip.cameras, settings.min_views
        )
        self.noise = KeypointNoise()
        self.before = self.held_out_errors(None)
        found = Contradictions.none(len(clip.clicks))
        if settings.evidence == "markings_and_players":
            found = find_contradictions(clip, judged, self.before, settings)
        self.other_people, self.variance_factor, self.offset = (
            found.other_people,
            found.variance_factor,
            found.offset,
        )
        self.consistent = clip.given & ~self.other_people
        if clip.given.all():
            # If no camera states a covariance, the wrong one cannot be identified.
            self.variance_factor, self.offset = (
                np.ones(len(self.variance_factor)),
                np.zeros_like(self.offset),
            )
        if settings.evidence == "markings_and_players" and len(self.observations.points):
            self._learn()

    def _learn(self) -> None:
        """Estimate the keypoint noise, and the factor on the stated variance of calibration."""
        other_people, settings = self.other_people, self.settings
        for _ in range(3):
            observed = _select_observations(
                self.observations, ~other_people[self.observations.camera_of]
            )
            if not len(observed.points):
                return  # No person is in two consistent cameras.
            problem = players_problem(
                self.clip, observed, self.noise, other_people, settings, self.variance_factor
            )
            rough = solve(problem, settings.solver, self.offset)
            # The next solution starts here and needs two or three steps.
            self.offset, self.observations = rough.offset, observed._replace(points=rough.points)
            self.noise = estimate_noise(
                rough.cameras, rough.points, self.observations, settings.loss_scale
            )
        # A stated covariance never shrinks; the prior of given cameras may. Update only once: after
        # more updates, one camera that shows other people would free all the others.
        min_factor = np.where(self.clip.given, 0.01, 1.0)
        self.variance_factor = self.variance_factor * np.maximum(
            estimate_variance_factor(problem, rough), min_factor
        )

    def find_objection(self, before: HeldOutErrors, after: HeldOutErrors, fixed: Flags) -> str:
        """Return the reason to refuse the whole change; empty without one.

        Cameras with their own covariance, in a rig of more than `_SMALL_RIG`, need only
        `judge_cameras`.
        """
        changed = ~fixed
        given = self.clip.given & changed
        if not given.any() and self.stand_alone.any():
            return ""
        judged = given if given.any() else changed
        evidence = pool_evidence(before, after, judged)
        settings = self.settings
        if evidence.significance < settings.min_significance:
            return (
                f"the loss of all of them falls by {evidence.significance:.1f} standard errors, "
                f"at least {settings.min_significance:g} are required"
            )
        needed = settings.given.min_gain / max(len(given) - 1, 1)
        if given.any() and evidence.gain < needed:
            return (
                f"the loss of all of them falls by {100.0 * evidence.gain:.1f} %, "
                f"at least {100.0 * needed:.1f} % are required with {len(given)} given cameras"
            )
        if self.clip.given.all():
            deviation = float(
                np.sqrt(np.median(self.variance_factor)) * np.nanmedian(self.clip.distance)
            )
            max_shift = settings.given.center * deviation
            if evidence.shift > max_shift:
                return (
                    f"held-out people move together by {1e3 * evidence.shift:.1f} mm, which no "
                    f"keypoint can confirm; at most {1e3 * max_shift:.1f} mm are allowed"
                )
        return ""

    def adjust(self, fixed: Flags, without: int | None = None) -> Solution:
        """Return the adjustment to all people, or to all but one group; fixed cameras unchanged."""
        if self.settings.evidence == "markings":
            return solve(markings_problem(self.clip, fixed, self.settings), MARKINGS_SOLVER)
        observed = self.observations
        # A refused calibrated camera contributes only where it is found to agree with the others:
        # elsewhere its markings contradict people. A refused given camera without contradictions
        # contributes. In a small rig it is fixed and the others adapt to it. In a larger one a
        # refused camera moves with them here and is put back, because it is no more exact than they
        # are, and two fixed cameras would pull all others to their own errors.
        consistent = self.consistent
        kept = (~fixed | consistent)[observed.camera_of]
        held = fixed if len(fixed) <= _SMALL_RIG else fixed & ~consistent
        if without is not None:
            groups = self._groups(len(self.used))
            row = np.searchsorted(self.used, observed.frame_of)
            kept &= groups[row, observed.person_of] != without
        observed = _select_observations(observed, kept)
        problem = players_problem(
            self.clip, observed, self.noise, held, self.settings, self.variance_factor
        )
        solution = solve(problem, self.settings.solver, self.offset, covariance=without is None)
        if self.clip.given.all() and not (held & consistent).any():
            solution = self._align_to_initial_people(solution, observed)
        cameras = _merge_cameras(~fixed, solution.cameras, self.clip.cameras)
        return replace(solution, cameras=cameras)

    def _align_to_initial_people(self, solution: Solution, observed: Observations) -> Solution:
        """Return the solution, aligned to the people as the given cameras have them.

        A similarity transform of all cameras and people changes no residual: only the given cameras
        determine it, and people stay where all of them together put them.
        """
        first = np.searchsorted(observed.point_of, np.arange(len(solution.points)))
        person, joint = observed.person_of[first], observed.joint_of[first]
        row = np.searchsorted(self.used, observed.frame_of[first])
        before = self.placed[row, person, joint]
        found = np.isfinite(before).all(axis=1)
        back = align_points(solution.points[found], before[found])
        cameras, points = back.move_cameras(solution.cameras), back.move_points(solution.points)
        return replace(solution, cameras=cameras, points=points)

    def uncertainty(self, adjusted: Solution) -> Floats:
        """Return the covariance (cameras, 12, 12) of adjusted cameras.

        If only given cameras define the world frame, it is relative to all of them together: their
        common error shifts no person in one image against the others.
        """
        if self.clip.given.all() and self.settings.evidence == "markings_and_players":
            points = self.observations.points
            weight = keypoint_information(adjusted.cameras, self.observations)
            origin = np.median(points, axis=0)
            return relative_covariance(
                adjusted.camera_covariance, adjusted.cameras, weight, origin
            )[0]
        information, _ = camera_knowledge(self.clip, self.settings)
        factor = self.variance_factor[:, None, None]
        response = survey_response(self.clip, self.settings.survey_error_m)
        return add_shared_errors(
            adjusted.camera_covariance,
            information / factor,
            np.sqrt(factor) * response,
        )

    def held_out_errors(self, fixed: Flags | None) -> HeldOutErrors:
        """Return held-out errors by cameras adjusted without each group; None = initial cameras."""
        robust = self.settings.loss_scale
        groups = self._groups(len(self.judged))
        if fixed is None or self.settings.evidence == "markings":
            cameras = self.clip.cameras if fixed is None else self.adjust(fixed).cameras
            return held_out_errors(self.clip, cameras, self.judged, groups >= 0, robust)
        loss = error = joints = np.full((1, 1, 1, 1), np.nan)
        names = np.unique(groups).tolist()
        solved = map_in_threads(lambda group: self.adjust(fixed, without=group), names)
        for group, cameras in zip(names, [each.cameras for each in solved], strict=True):
            held = held_out_errors(self.clip, cameras, self.judged, groups == group, robust)
            loss = np.where(np.isnan(loss), held.loss, loss)
            error = np.where(np.isnan(error), held.error, error)
            joints = np.where(np.isnan(joints), held.joints, joints)
        return HeldOutErrors(loss, error, joints)

    def _groups(self, frames: int) -> Integers:
        """Return the group (frames, persons) of each person; time intervals for a single person."""
        persons = self.clip.detections.detection_index.shape[2]
        folds = self.settings.folds
        if persons > 1:
            return np.tile(np.arange(persons) % min(folds, persons), (frames, 1))
        return np.repeat((np.arange(frames) * folds // max(frames, 1))[:, None], persons, axis=1)


def _place_people(clip: Clip, frames: Integers) -> Floats:
    """Return joints (k, persons, 17, 3) [m] by the given cameras; NaN if any is calibrated.

    The clip's own joints are by cameras of the last iteration: to keep people there would add the
    shifts of all iterations.
    """
    if not clip.given.all():
        return np.full((len(frames), *clip.joints.shape[1:]), np.nan)
    return triangulate_joints(clip.cameras, clip.detections[frames], clip.triangulation).joints


def _select_observations(observed: Observations, kept: Flags) -> Observations:
    """Return the observations (n,) that are kept, with renumbered points.

    A point left with a single observation carries no information and is dropped.
    """
    kept = kept & (
        np.bincount(observed.point_of[kept], minlength=len(observed.points))[observed.point_of] > 1
    )
    return observed.select(kept)


def _merge_cameras(changed: Flags, new: Camera, old: Camera) -> Camera:
    """Return the batch of new cameras where they changed and of old ones elsewhere."""
    return Camera.stack([(new if take else old)[c] for c, take in enumerate(changed)])


def _explain_decision(
    comparison: Verdict,
    c: int,
    accepted: bool,
    settings: BundleAdjustmentSettings,
    objection: str,
    stands_alone: bool,
) -> str:
    """Return why a camera's change was accepted or refused, with the deciding numbers."""
    judges = int(comparison.judges[c])
    if judges < settings.min_judges:
        return f"refused: {judges} held-out keypoints, at least {settings.min_judges} are required"
    before, after = comparison.loss[c]
    change = f"the loss of {judges} held-out keypoints goes from {before:.3f} to {after:.3f}"
    if accepted:
        return f"accepted: {change}"
    if after > before:
        return f"refused: {change}"
    if stands_alone and comparison.significance[c] < CHANCE:
        return (
            f"refused: {change}; person by person it falls by {comparison.significance[c]:.1f} "
            f"standard errors, at least {CHANCE:g} are required"
        )
    if objection and not stands_alone:
        return f"refused: {change}, but {objection}"
    return f"refused: {change}, but no more after other cameras were refused"


def _describe_motion(motion: Floats) -> str:
    """Return the description of a camera's motion."""
    center, rotation, focal = motion.tolist()
    return (
        f"; the camera moves {100.0 * center:.1f} cm and {np.degrees(rotation):.3f} degrees, "
        f"the focal length changes {100.0 * focal:+.2f} %"
    )


def _refuse_all(
    clip: Clip, reason: str, proposed: Integers, used: Integers, judged: Integers
) -> BundleAdjustment:
    """Return the clip's cameras unchanged, with one reason for all of them."""
    count = len(clip.clicks)
    nan = np.full((count, 2), np.nan)
    return BundleAdjustment(
        clip=clip,
        cameras=clip.cameras,
        covariance=clip.covariance,
        accepted=np.zeros(count, dtype=np.bool_),
        reasons=(f"refused: {reason}",) * count,
        proposed=clip.detections.frame[proposed],
        used=clip.detections.frame[used],
        judged=clip.detections.frame[judged],
        noise=KeypointNoise(),
        verdict=Verdict(np.zeros(count, dtype=np.int64), nan, nan, np.zeros(count)),
        evidence=Evidence(0.0, 0.0, 0.0),
        motion=np.zeros((count, 3)),
        refused=clip.cameras,
    )
