"""Evidence for a reviewer: metrics over frames, unreviewed detections, views of other cameras."""

import numpy as np
import pytest
from camera_builders import look_at_camera
from hypothesis import example, given, settings
from hypothesis import strategies as st

from worldpose.geometry.cameras import Camera
from worldpose.review.evidence import check_views, epipolar_curves

SIZE = np.array([1920, 1080])


def camera(center, target):
    lens = (-0.25, 0.08, 1e-3, -5e-4, 0.0)
    return look_at_camera(center, target, (1800.0, 1801.8), middle=(955.0, 545.0), lens=lens)


CAMERAS = [
    camera((-40.0, -50.0, 12.0), (0.0, 0.0, 1.0)),
    camera((45.0, -48.0, 15.0), (0.0, 0.0, 1.0)),
    camera((-30.0, 52.0, 10.0), (0.0, 0.0, 1.0)),
    camera((60.0, 10.0, 20.0), (0.0, 0.0, 1.0)),
]


def distance_to_polylines(place, lines):
    """From a place to the nearest point of polylines [px]."""
    best = np.inf
    for line in lines:
        begin, step = line[:-1], np.diff(line, axis=0)
        along = np.einsum("ni,ni->n", place - begin, step) / np.einsum("ni,ni->n", step, step)
        nearest = begin + np.clip(along, 0, 1)[:, None] * step
        best = min(best, np.linalg.norm(nearest - place, axis=1).min())
    return best


@given(
    x=st.floats(-20, 20), y=st.floats(-15, 15), z=st.floats(0, 2.5), pair=st.permutations(range(4))
)
@example(x=11.0, y=11.0, z=2.203125, pair=[0, 3, 2, 1])  # 5 px from the border
@settings(max_examples=30)
def test_what_a_pixel_may_show_lies_on_its_curve_in_the_other_picture(x, y, z, pair):
    source, target = CAMERAS[pair[0]], CAMERAS[pair[1]]
    point = np.array([x, y, z])
    (pixel,), (truth,) = source.project(point[None]), target.project(point[None])
    lines = epipolar_curves(source, target, pixel)
    # Points all along the ray where joints can be, projected one by one, are on the polyline.
    ray = source.unproject(pixel[None])
    heights = np.linspace(-0.25, 3.1, 40)
    along = (heights - ray.origins[0, 2]) / ray.directions[0, 2]
    places = target.project(ray.origins[0] + along[:, None] * ray.directions[0])
    inside = ((places > 0) & (places < SIZE - 1)).all(axis=1)
    assert (truth > 0).all() and (truth < SIZE - 1).all()
    for place in [truth, *places[inside]]:
        # An arc of 12 px bent by this lens is 0.01 px from its chord.
        assert distance_to_polylines(place, lines) < 0.02
    for line in lines:
        assert (line >= -0.5).all() and (line <= SIZE - 0.5).all()
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 12.0


@pytest.fixture
def person():
    return np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 2], (17, 3))


def test_a_wrong_keypoint_is_expected_where_it_belongs_and_put_there_all_views_agree(person):
    rig = Camera.stack(CAMERAS)
    truth = rig.project(np.broadcast_to(person, (4, 17, 3)))
    wrong = truth.copy()
    wrong[1, 9] += (14.0, -6.0)
    check = check_views(rig, wrong)
    np.testing.assert_allclose(check.expected[1, 9], truth[1, 9], atol=1e-3)
    assert check.error[1, 9] > 5.0
    assert np.delete(check.error, 9, axis=1).max() < 1e-3
    wrong[1, 9] = check.expected[1, 9]
    assert check_views(rig, wrong).error.max() < 1e-2


def test_a_joint_that_one_camera_sees_alone_is_expected_nowhere(person):
    rig = Camera.stack(CAMERAS)
    keypoints = rig.project(np.broadcast_to(person, (4, 17, 3)))
    keypoints[1:, 0] = np.nan
    keypoints[2:, 1] = np.nan
    check = check_views(rig, keypoints)
    assert np.isnan(check.joints[0]).all() and np.isnan(check.expected[:, 0]).all()
    assert np.isnan(check.error[:, 0]).all()
    assert np.isfinite(check.joints[1]).all() and np.isnan(check.expected[:2, 1]).all()
    assert np.isfinite(check.expected[2:, 1]).all()  # those two are expected to show it
    assert np.isnan(check.error[2:, 1]).all()
