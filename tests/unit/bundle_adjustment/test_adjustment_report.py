"""Report of an adjustment: stored arrays, outlier keypoints and clicks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from worldpose.bundle_adjustment.adjustment import adjust_cameras
from worldpose.bundle_adjustment.problems import KeypointNoise
from worldpose.bundle_adjustment.report import (
    adjustment_arrays,
    keypoint_outliers,
    marking_errors,
    review_clicks,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.uncertainty import weak_direction
from worldpose.geometry.cameras import camera_from_arrays
from worldpose.static_calibration.parameters import PARAMETERS
from worldpose.store.groups import checked_arrays, checked_attributes


@pytest.mark.parametrize("evidence", ["markings_and_players", "markings"])
def test_arrays_and_attributes_are_those_of_the_layout(clip, evidence):
    made, *_ = clip(persons=3, frames=8)
    settings = BundleAdjustmentSettings(evidence=evidence, folds=2)
    adjusted = adjust_cameras(made, settings)
    person = np.array([4, 7, 9], dtype=np.int32)
    arrays, attributes = adjustment_arrays(adjusted, settings, person)
    checked = checked_arrays(BUNDLE_ADJUSTMENT, arrays, {})
    given = {"camera": list("abcde"), "surface": None, **attributes}
    stored = checked_attributes(BUNDLE_ADJUSTMENT, checked, given)
    assert set(checked["outlier_person"]) <= {4, 7, 9}
    assert stored["used_frames"] == adjusted.used.tolist()
    back = camera_from_arrays(checked)
    np.testing.assert_array_equal(back.numbers, adjusted.cameras.numbers)


def test_marking_errors_are_root_mean_squares_per_axis(clip):
    made, true, _ = clip(clicked=400)
    # 800 numbers of unit variance tell their root mean square to 2.5 %; three of that.
    np.testing.assert_allclose(marking_errors(made, true), 1.0, atol=0.075)
    none, *_ = clip(clicked=0)
    assert np.isnan(marking_errors(none, true)).all()


def test_focal_length_against_distance_is_named(clip):
    _, true, _ = clip()
    distance = true[0].cam_from_world.apply(np.array([[0.0, 0.0, 1.0]]))[0, 2]
    together = np.zeros(12)
    # Farther away and closer zoomed: 1 % of both.
    together[5], together[6] = 0.01 * distance, 0.01
    covariance = np.outer(together, together) + 1e-12 * np.eye(12)
    weak = weak_direction(true[0], covariance)
    assert {part.split()[0] for part in weak.about.split(", ")} == {"tz", "log_focal"}
    np.testing.assert_allclose(np.abs(weak.step[5:7]), together[5:7], rtol=0.05)


def test_a_given_camera_has_no_weak_direction(clip):
    _, true, _ = clip()
    weak = weak_direction(true[0], np.zeros((12, 12)))
    assert weak.about == "not known"
    assert not weak.step.any()


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


def test_a_person_taken_for_another_is_one_entry(clip):
    made, true, _ = clip(cameras=8, noise=0.9)
    index = made.detections.detection_index.copy()
    index[7, 3, [0, 1]] = [1, 0]
    listed = found(replace(made, detections=replace(made.detections, detection_index=index)), true)
    entries = set(zip(listed.frame, listed.camera, listed.person, listed.joint, strict=True))
    assert {(7, 3, 0, -1), (7, 3, 1, -1)} <= entries
    assert listed.surprise[0] > 10.0


def test_the_list_ends_where_it_is_told_and_still_counts(clip):
    made, true, _ = clip(noise=1.5)
    everything = found(made, true, limit=1.0)
    short = found(made, true, limit=1.0, longest=5)
    assert len(short.frame) == 5
    assert short.found == everything.found > 500
    np.testing.assert_array_equal(short.surprise, everything.surprise[:5])


def test_honest_people_are_hardly_listed(clip):
    made, true, _ = clip(cameras=8, noise=0.8)
    # Chi-square with two degrees of freedom, and the joint's own uncertainty: under 1 in 10,000.
    assert found(made, true).found <= 2


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
