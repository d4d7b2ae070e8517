"""Evidence for a reviewer: metrics over frames, unreviewed detections, views of other cameras."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from data_contracts.review import Acceptance, DeletedDetection
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.review.evidence import check_views, clip_curves, epipolar_curves, open_detections


def test_each_frame_is_counted_on_its_own():
    bodies = np.zeros((3, 2, 17, 3))
    bodies[1, 1] = bodies[2] = np.nan  # two people, one, none
    placed = bodies + np.array([0.02, 0.0, 0.0])
    placed[0, 1] = np.nan
    variance = np.where(np.isfinite(bodies), 1.0, np.nan)[..., None] * np.diag([1e-4, 4e-4, 4e-4])
    filled = np.array([[False, True], [False, False], [True, False]])
    people, share, deviation, apart = (
        curve.values for curve in clip_curves(bodies, variance, filled, placed)
    )
    assert people.tolist() == [2.0, 1.0, 0.0]
    np.testing.assert_allclose(share, [0.5, 0.0, np.nan])
    np.testing.assert_allclose(deviation, [3e-4**0.5, 3e-4**0.5, np.nan])
    # 2 cm along one of three axes.
    np.testing.assert_allclose(apart, [0.02 / 3**0.5] * 2 + [np.nan])


FRAME = np.arange(10, 13)
SCORE = np.array([[0.9, 0.2, np.nan], [0.5, np.nan, np.nan], [0.7, 0.2, 0.6]], dtype=np.float32)


def left(*acceptances, edits=()):
    found = open_detections(FRAME, SCORE, acceptances, edits)
    assert found.people == 6
    return list(zip(found.frame.tolist(), found.detection.tolist(), strict=True))


def accepted(**what):
    return Acceptance(
        id="a", match_id="m", results={}, who="Ada", accepted_at=datetime.now(UTC), **what
    )


def test_all_are_left_in_the_order_of_their_scores():
    assert left() == [(10, 1), (12, 1), (11, 0), (12, 2), (12, 0), (10, 0)]
    found = open_detections(np.arange(0), np.empty((0, 4), dtype=np.float32), [accepted()], ())
    assert (len(found.frame), found.people) == (0, 0)


def test_everybody_at_least_as_certain_is_accepted_at_once():
    # A threshold as the page shows it is the score itself, though that is stored coarser.
    assert left(accepted(at_least=0.6)) == [(10, 1), (12, 1), (11, 0)]
    assert left(accepted(at_least=0.0)) == []
    assert left(accepted()) == left()


def test_who_was_named_or_corrected_was_looked_at():
    taken_out = DeletedDetection(camera="a", frame=12, detection=2)
    beyond = DeletedDetection(camera="a", frame=99, detection=2)
    named = accepted(people=((10, 1), (11, 0), (11, 7), (9, 0)))
    assert left(named, edits=[taken_out, beyond]) == [(12, 1), (12, 0), (10, 0)]


SIZE = np.array([1920, 1080])


def camera(center, target, distortion=(-0.25, 0.08, 1e-3, -5e-4, 0.0), focal=1800.0):
    """A camera that looks at a place, its image's bottom towards the ground."""
    center, target = np.array(center, dtype=float), np.array(target, dtype=float)
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        focal=np.array([focal, focal * 1.001]),
        principal_point=np.array([955.0, 545.0]),
        distortion=np.array(distortion),
        cam_from_world=Rigid(rotation=rotation, translation=-rotation @ center),
        image_size=SIZE,
    )


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


def test_a_ray_that_no_joint_can_be_on_has_no_curve():
    sky = camera((0.0, -50.0, 10.0), (0.0, 0.0, 40.0))
    assert epipolar_curves(sky, CAMERAS[1], (960.0, 100.0)) == []
    away = camera((45.0, -48.0, 15.0), (200.0, -200.0, 1.0))
    assert epipolar_curves(CAMERAS[0], away, (960.0, 540.0)) == []


def test_a_level_ray_at_the_height_of_joints_is_followed_as_far_as_a_stadium_goes():
    level = camera((-60.0, 0.0, 1.5), (0.0, 0.0, 1.5), distortion=(0.0,) * 5)
    lines = epipolar_curves(level, CAMERAS[1], level.principal_point)
    truth = CAMERAS[1].project(np.array([[-10.0, 0.0, 1.5], [5.0, 0.0, 1.5]]))
    assert all(distance_to_polylines(place, lines) < 0.02 for place in truth)
    high = camera((-60.0, 0.0, 9.0), (0.0, 0.0, 9.0), distortion=(0.0,) * 5)
    assert epipolar_curves(high, CAMERAS[1], high.principal_point) == []


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
