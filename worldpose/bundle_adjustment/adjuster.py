"""Adjustment of a clip's cameras to all people or without a group, and held-out validation."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.bundle_adjustment.clip import Clip, Observations, select_observations
from worldpose.bundle_adjustment.held_out_validation import (
    Contradictions,
    HeldOutErrors,
    find_contradictions,
    held_out_errors,
    pool_evidence,
)
from worldpose.bundle_adjustment.residuals import (
    MARKINGS_SOLVER,
    AdjustmentSolution,
    KeypointNoise,
    camera_knowledge,
    estimate_noise,
    estimate_variance_factor,
    keypoint_information,
    markings_problem,
    players_problem,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.bundle_adjustment.uncertainty import (
    add_shared_errors,
    align_points,
    relative_covariance,
    survey_response,
)
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.estimate import triangulate_frames
from worldpose.triangulation.world import move_cameras

_SMALL_RIG: Final = 4
"""Maximum cameras of a rig in which cameras with a covariance change together or not at all [1]:
each joint of a held-out person then has at most three other views, whose errors do not average
out."""


class Adjuster:
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

        Cameras with their own covariance, in a rig above `_SMALL_RIG`, need only `judge_cameras`.
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

    def adjust(self, fixed: Flags, without: int | None = None) -> AdjustmentSolution:
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
        cameras = merge_cameras(~fixed, solution.cameras, self.clip.cameras)
        return replace(solution, cameras=cameras)

    def _align_to_initial_people(
        self, solution: AdjustmentSolution, observed: Observations
    ) -> AdjustmentSolution:
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
        cameras, points = move_cameras(back, solution.cameras), back.apply(solution.points)
        return replace(solution, cameras=cameras, points=points)

    def uncertainty(self, adjusted: AdjustmentSolution) -> Floats:
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
            adjusted.camera_covariance, information / factor, np.sqrt(factor) * response
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


def place_people(clip: Clip, frames: Integers) -> Floats:
    """Return joints (k, persons, 17, 3) [m] by the given cameras; NaN if any is calibrated.

    The clip's own joints are by cameras of the last iteration: to keep people there would add the
    shifts of all iterations.
    """
    if not clip.given.all():
        return np.full((len(frames), *clip.joints.shape[1:]), np.nan)
    return triangulate_frames(clip.cameras, clip.detections[frames], clip.triangulation).joints


def _select_observations(observed: Observations, kept: Flags) -> Observations:
    """Return the observations (n,) that are kept, renumbered, without points of a single one."""
    kept = kept & (
        np.bincount(observed.point_of[kept], minlength=len(observed.points))[observed.point_of] > 1
    )
    return observed.select(kept)


def merge_cameras(changed: Flags, new: Camera, old: Camera) -> Camera:
    """Return the batch of new cameras where they changed and of old ones elsewhere."""
    return Camera.stack([(new if take else old)[c] for c, take in enumerate(changed)])
