"""A camera whose markings lie in one corner: people tell what it does elsewhere (C6)."""

from dataclasses import replace

import numpy as np

from worldpose.bundle_adjustment.adjustment import adjust_cameras
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.static_calibration.parameters import project_with_jacobian, step_camera
from worldpose.triangulation.passes import triangulate_joints

AMBIGUOUS = 0
QUICK = BundleAdjustmentSettings(max_frames=8, folds=2)


def ground_error(camera, true, places):
    """Root mean square distance [m] on the ground of where two cameras see the same pixels."""
    off = camera.project(places) - true.project(places)
    by_place = camera.project_with_jacobians(places).d_points[:, :, :2]
    off = np.linalg.solve(by_place, off[..., None])[..., 0]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def test_players_tell_an_ambiguous_camera_about_the_half_without_markings(clip):
    before, after = [], []
    for seed in range(4):
        made, true, _ = clip(cameras=8, persons=8, seed=seed)
        rng = np.random.default_rng(seed)
        covariance = 0.01 * made.covariance
        # Six clicks of a pixel in a corner of 8 m, and a lens that is known to ten times what a
        # usual calibration leaves.
        corner = rng.uniform([10.0, 10.0, 0.0], [18.0, 18.0, 0.0], (6, 3))
        _, by_step = project_with_jacobian(true[AMBIGUOUS], corner)
        spread = np.sqrt(np.diag(made.covariance[AMBIGUOUS]))
        free = spread > 0.0
        scaled = (by_step * 10.0 * spread)[:, :, free].reshape(-1, int(free.sum()))
        known = np.linalg.inv(scaled.T @ scaled + np.eye(int(free.sum())))
        size = 10.0 * spread[free]
        covariance[AMBIGUOUS][np.ix_(free, free)] = known * np.outer(size, size)
        step = np.zeros((8, 12))
        for c in range(8):
            block = covariance[c][np.ix_(free, free)]
            scale = np.sqrt(np.diag(block))
            root = np.linalg.cholesky(block / np.outer(scale, scale))
            step[c, free] = scale * (root @ rng.standard_normal(int(free.sum())))
        cameras = step_camera(true, step)
        detections = made.detections
        placed = triangulate_joints(cameras, detections, made.triangulation)
        ambiguous = replace(
            made,
            cameras=cameras,
            covariance=covariance,
            joints=placed.joints,
            views=placed.views.astype(np.int64),
        )
        adjusted = adjust_cameras(ambiguous, QUICK)
        assert adjusted.accepted[AMBIGUOUS]
        places = rng.uniform([-14.0, -14.0, 0.0], [0.0, 0.0, 0.0], (50, 3))
        before.append(ground_error(cameras[AMBIGUOUS], true[AMBIGUOUS], places))
        after.append(ground_error(adjusted.cameras[AMBIGUOUS], true[AMBIGUOUS], places))
    # 29 cm become 2.4 cm.
    assert np.mean(before) > 5.0 * np.mean(after)
