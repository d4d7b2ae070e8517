"""Report of an adjustment: stored arrays, outlier keypoints and clicks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment.report import keypoint_outliers, review_clicks
from worldpose.bundle_adjustment.residuals import KeypointNoise
from worldpose.static_calibration.parameters import PARAMETERS


def found(made, cameras, limit=4.2, longest=10_000):
    return keypoint_outliers(made, cameras, KeypointNoise(), limit, longest)


def test_planted_keypoints_come_first(clip):
    made, true, _ = clip(cameras=8, frames=20, noise=0.9)
    rng = np.random.default_rng(8)
    image = made.detections.keypoints.copy()
    chosen = rng.permutation(20 * 8 * 6 * 17)[:300]
    rows = np.column_stack(np.unravel_index(chosen, (20, 8, 6, 17)))
    planted = {tuple(row) for row in rows.tolist()}
    for row in sorted(planted):
        angle, length = rng.uniform(0.0, 2.0 * np.pi), 0.9 * rng.uniform(4.0, 30.0)
        image[row] += length * np.array([np.cos(angle), np.sin(angle)])
    listed = found(replace(made, detections=replace(made.detections, keypoints=image)), true)
    first = list(zip(listed.frame, listed.camera, listed.person, listed.joint, strict=True))
    assert (np.diff(listed.surprise) <= 0).all()
    hits = planted & set(first[: len(planted)])
    # Errors of 4 to 30 standard deviations, give or take the keypoint's own, among 16,320.
    assert len(hits) >= 0.95 * len(planted)


@pytest.mark.parametrize(
    ("rests", "surprise"),
    # 12 px across and 9 px down at 1 px; across the camera has 0.6 px, less or besides that.
    [(True, np.hypot(12.0 / 0.8, 9.0)), (False, np.hypot(12.0 / np.sqrt(1.36), 9.0))],
)
def test_a_wrong_click_is_more_surprising_than_honest_ones(clip, rests, surprise):
    made, true, _ = clip()
    clicks = made.clicks[2]
    image, inlier = clicks.points_image.copy(), clicks.inlier.copy()
    image[4] = true[2].project(clicks.points_world[4:5])[0] + [12.0, -9.0]
    inlier[4] = rests
    changed = replace(clicks, points_image=image, inlier=inlier)
    all_clicks = (*made.clicks[:2], changed, *made.clicks[3:])
    covariance = np.zeros_like(made.covariance)
    covariance[2, PARAMETERS.index("cx"), PARAMETERS.index("cx")] = 0.36
    review = review_clicks(all_clicks, true, covariance, click_noise=1.0)
    assert (review.camera[0], review.name[0]) == (2, "point_4")
    np.testing.assert_allclose(review.residual[0], [-12.0, 9.0], atol=1e-9)
    assert review.surprise[0] == pytest.approx(surprise, rel=1e-9)
    assert review.surprise[1] < 4.2


IMPOSSIBLE = {
    "behind the camera": [0.0, 0.0, -30.0],
    "outside the lens's field of view": [70.0, 0.0, 10.0],
}


@pytest.mark.parametrize("problem", IMPOSSIBLE)
def test_a_click_on_a_point_that_the_camera_cannot_image_is_first_and_says_why(clip, problem):
    made, true, _ = clip()
    # A lens that folds at twice the focal length.
    true = replace(true, distortion=np.array([[-0.08, 0.0, 0.0, 0.0, 0.0]] * 5))
    made = replace(made, cameras=replace(made.cameras, distortion=true.distortion))
    clicks = made.clicks[2]
    pose = true[2].cam_from_world
    place = pose.inverse().apply(np.array([IMPOSSIBLE[problem]]))
    changed = replace(
        clicks,
        names=(*clicks.names, "impossible"),
        points_world=np.concatenate([clicks.points_world, place]),
        points_image=np.concatenate([clicks.points_image, [[960.0, 540.0]]]),
        inlier=np.append(clicks.inlier, False),
    )
    clip_of = replace(made, clicks=(*made.clicks[:2], changed, *made.clicks[3:]))
    review = review_clicks(clip_of.clicks, true, made.covariance, click_noise=1.0)
    assert (review.camera[0], review.name[0]) == (2, "impossible")
    assert np.isnan(review.residual[0]).all()
    assert review.surprise[0] == np.inf
    assert problem in review.problem[0]
    assert not any(review.problem[1:])
    assert np.isfinite(review.residual[1:]).all()
