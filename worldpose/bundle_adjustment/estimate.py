"""Adjustment of cameras to people and markings, with acceptance per camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_contracts.arrays import Integers
from worldpose.bundle_adjustment.adjuster import Adjuster, merge_cameras, place_people
from worldpose.bundle_adjustment.clip import (
    Clip,
    learn_confidence,
    propose_frames,
    select_observations,
)
from worldpose.bundle_adjustment.held_out_validation import (
    Verdict,
    compare_errors,
    judge_cameras,
    pool_evidence,
)
from worldpose.bundle_adjustment.report import (
    BundleAdjustment,
    camera_motion,
    describe_motion,
    explain_decision,
    refuse_all,
)
from worldpose.bundle_adjustment.residuals import AdjustmentProblem, markings_problem
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.geometry.camera_model import STEP
from worldpose.reference_method import require_torch


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
        Paper section "Bundle Adjustment".
    """
    other = "refused: this camera shows other people than the other cameras under the same ids"
    proposed = propose_frames(
        clip, settings.max_frames, settings.min_frame_gap_s, settings.min_views
    )
    used = np.flatnonzero(np.isin(clip.frame, settings.chosen_frames))
    used = used if settings.chosen_frames else proposed
    if settings.method == "paper":
        return adjust_unguarded(clip, settings, proposed, used)
    judged = propose_frames(
        clip, settings.max_frames, settings.min_frame_gap_s, settings.min_views, used
    )
    judged = judged if len(judged) else used
    placed = place_people(clip, used)
    clip = learn_confidence(clip, np.union1d(used, judged))
    adjuster = Adjuster(clip, settings, used, judged, placed)
    count = len(clip.clicks)
    if settings.evidence == "markings_and_players" and not len(adjuster.observations.points):
        return refuse_all(clip, "no person has enough inlier cameras", proposed, used, judged)
    if settings.evidence == "markings" and not any(c.inlier.any() for c in clip.clicks):
        return refuse_all(clip, "no camera has a clicked marking", proposed, used, judged)
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
    cameras = merge_cameras(~fixed, last.cameras, clip.cameras)
    motion = np.where(fixed[:, None], 0.0, camera_motion(clip.cameras, cameras))
    return BundleAdjustment(
        clip=clip,
        cameras=cameras,
        covariance=np.where(fixed[:, None, None], clip.covariance, own),
        accepted=~fixed,
        reasons=tuple(
            other
            if other_people[c]
            else explain_decision(
                first, c, not fixed[c], settings, objection, adjuster.stand_alone[c]
            )
            + ("" if fixed[c] else describe_motion(motion[c]))
            for c in range(count)
        ),
        proposed=clip.frame[proposed],
        used=clip.frame[used],
        judged=clip.frame[judged],
        noise=adjuster.noise,
        verdict=first,
        evidence=evidence,
        motion=motion,
        refused=freely.cameras,
    )


def adjust_unguarded(
    clip: Clip, settings: BundleAdjustmentSettings, proposed: Integers, used: Integers
) -> BundleAdjustment:
    """Return arg min of sum I ||Pi(X; Lambda) - x||^2 over cameras, and P if it is used.

    With `method=paper` there is no prior, robust loss or validation (section "Bundle Adjustment").

    S are the clicks that calibration uses, and P the joints in the chosen frames. The paper states
    no covariance: that of calibration stays.

    Args:
        clip: calibrated cameras and triangulated people.
        settings: evidence, and minimum views of a joint.
        proposed: frames best suited, indices into the clip.
        used: chosen frames, indices into the clip.

    Raises:
        InputError: a lens has more than k1, k2 and k3.
    """
    require_torch()
    from worldpose.reference_method.cameras import K1_K2, require_radial

    require_radial(clip.cameras)
    clip, count = learn_confidence(clip, used), len(clip.clicks)
    marks = markings_problem(clip, np.zeros(count, dtype=np.bool_), settings)
    still = len(marks.points)
    parts = [(marks.points, marks.point_of, marks.camera_of, marks.image)]
    if settings.evidence == "markings_and_players":
        everyone = np.ones(clip.joints.shape[1], dtype=np.bool_)
        seen = select_observations(clip, used, everyone, clip.cameras, settings.min_views)
        parts.append((seen.points, still + seen.point_of, seen.camera_of, seen.image))
    points, point_of, camera_of, image = map(np.concatenate, zip(*parts, strict=True))
    unchanged = refuse_all(clip, "it has no observation", proposed, used, used)
    changed = np.isin(np.arange(count), camera_of)
    if not changed.any():
        return unchanged
    problem = AdjustmentProblem(
        cameras=clip.cameras,
        free=changed[:, None] & np.isin(np.arange(STEP), K1_K2),
        camera_information=np.zeros((count, STEP, STEP)),
        points=points,
        point_information=np.where(np.arange(len(points)) < still, np.inf, 0.0),
        point_of=point_of,
        camera_of=camera_of,
        image=image,
        weight=np.ones(len(image)),
        scale=np.full(len(image), np.inf),
        names=clip.names,
    )
    stopping = SolverSettings(max_iterations=100, min_cost_change=1e-9)
    found = solve(problem, stopping, covariance=False).cameras
    motion = np.where(changed[:, None], camera_motion(clip.cameras, found), 0.0)
    reasons = tuple(
        f"accepted: method=paper has no validation{describe_motion(motion[c])}"
        if changed[c]
        else unchanged.reasons[c]
        for c in range(count)
    )
    return replace(
        unchanged, cameras=found, accepted=changed, reasons=reasons, motion=motion, refused=found
    )
