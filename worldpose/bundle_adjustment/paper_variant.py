"""Bundle adjustment with `method=paper`, in the records of this stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from data_contracts.arrays import Integers
from worldpose.bundle_adjustment.clip import Clip, learn_confidence, select_observations
from worldpose.bundle_adjustment.report import (
    BundleAdjustment,
    camera_motion,
    describe_motion,
    refuse_all,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.geometry.cameras import Camera
from worldpose.reference_method.cameras import K1_K2, TensorCameras
from worldpose.reference_method.reprojection import Views, minimize_reprojection


def adjust_unguarded(
    clip: Clip, settings: BundleAdjustmentSettings, proposed: Integers, used: Integers
) -> BundleAdjustment:
    """Return cameras adjusted to S, or to S and P, without prior, robust loss or validation.

    S are the clicks that calibration uses, and P the joints in the chosen frames. The paper states
    no covariance: that of calibration stays.

    Args:
        clip: calibrated cameras and triangulated people.
        settings: evidence, and minimum views of a joint.
        proposed: frames best suited, indices into the clip.
        used: chosen frames, indices into the clip.
    """
    clip, count = learn_confidence(clip, used), len(clip.clicks)
    marks = [clicks.points_world[clicks.inlier] for clicks in clip.clicks]
    points, image = list(marks), [c.points_image[c.inlier] for c in clip.clicks]
    camera = [np.full(len(each), c) for c, each in enumerate(marks)]
    still = sum(map(len, marks))
    row = [np.arange(still)]
    if settings.evidence == "markings_and_players":
        everyone = np.ones(clip.joints.shape[1], dtype=np.bool_)
        seen = select_observations(clip, used, everyone, clip.cameras, settings.min_views)
        points.append(seen.points)
        image.append(seen.image)
        camera.append(seen.camera_of)
        row.append(still + seen.point_of)
    unchanged = refuse_all(clip, "it has no observation", proposed, used, used)
    changed = np.isin(np.arange(count), np.concatenate(camera))
    if not changed.any():
        return unchanged
    views = Views(*(torch.tensor(np.concatenate(each)) for each in (row, camera, image)))
    places = torch.tensor(np.concatenate(points))
    moving = torch.arange(len(places)) >= still
    solved = minimize_reprojection(TensorCameras.of(clip.cameras), places, views, moving, K1_K2)
    found = solved.cameras.camera()
    cameras = Camera.stack([found[c] if changed[c] else clip.cameras[c] for c in range(count)])
    motion = np.where(changed[:, None], camera_motion(clip.cameras, cameras), 0.0)
    reasons = tuple(
        f"accepted: method=paper has no validation{describe_motion(motion[c])}"
        if changed[c]
        else unchanged.reasons[c]
        for c in range(count)
    )
    return replace(
        unchanged,
        cameras=cameras,
        accepted=changed,
        reasons=reasons,
        motion=motion,
        refused=cameras,
    )
