"""Bundle adjustment with `method=paper`, in the records of this stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_contracts.arrays import Integers
from worldpose.bundle_adjustment.clip import Clip, learn_confidence, select_observations
from worldpose.bundle_adjustment.report import (
    BundleAdjustment,
    camera_motion,
    describe_motion,
    refuse_all,
)
from worldpose.bundle_adjustment.residuals import AdjustmentProblem, markings_problem
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.geometry.camera_model import STEP
from worldpose.reference_method.cameras import K1_K2, require_radial


def adjust_unguarded(
    clip: Clip, settings: BundleAdjustmentSettings, proposed: Integers, used: Integers
) -> BundleAdjustment:
    """Return arg min of sum I ||Pi(X; Lambda) - x||^2 over cameras, and P if it is used.

    It has no prior, robust loss or validation (section "Bundle Adjustment").

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
