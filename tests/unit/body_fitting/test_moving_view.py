"""The moving camera as one more view."""

import numpy as np
import pytest
from test_monocular_poses import broadcast, crowd
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body_fitting import BodyFittingSettings, fit_bodies
from worldpose.body_fitting.evidence import Evidence
from worldpose.body_fitting.moving_view import between_frames, recognise_people, sight_people


def shuffled(camera, joints, rng):
    """Keypoints (frames, detections, 17, 2) in no order of persons, and which is whose."""
    frames, persons = joints.shape[:2]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)
    order = rng.permuted(np.tile(np.arange(persons), (frames, 1)), axis=1)
    return np.take_along_axis(image, order[..., None, None], axis=1), image


def test_people_are_recognised_in_every_picture():
    camera, joints = broadcast(12), KEYPOINTS(crowd(12))
    keypoints, own = shuffled(camera, joints, np.random.default_rng(1))
    # 0.2 m off is a ninth of a person's height, within the gate; people are 4 m apart.
    found = recognise_people(camera, keypoints, joints + [0.2, 0.0, 0.0])
    np.testing.assert_array_equal(found, own)


def test_strangers_and_people_out_of_sight_are_not_recognised():
    camera, joints = broadcast(4), KEYPOINTS(crowd(4))
    keypoints, _ = shuffled(camera, joints, np.random.default_rng(1))
    away = joints.copy()
    away[:, 0] += [0.0, 0.0, 3.0]
    away[:, 1] = np.nan
    found = recognise_people(camera, keypoints, away)
    assert np.isnan(found[:, :2]).all() and np.isfinite(found[:, 2]).all()
    assert np.isnan(recognise_people(camera, np.full_like(keypoints, np.nan), joints)).all()


def test_lines_of_a_moving_camera_pass_through_what_it_sees():
    camera, joints = broadcast(6), KEYPOINTS(crowd(6))
    keypoints = camera.project(joints.reshape(6, -1, 3)).reshape(6, 3, 17, 2)
    keypoints[2, 1] = np.nan
    lines = sight_people(camera, keypoints, joints)
    assert not lines.seen[2, 1] and lines.seen.sum() == 17
    # The point nearest to the joint itself is the joint.
    np.testing.assert_allclose(lines.points[lines.seen], joints[lines.seen], atol=1e-8)


def test_two_lines_make_a_joint_and_one_more_makes_it_surer():
    settings = BodyFittingSettings()
    nothing = Evidence(np.full((1, 17, 3), np.nan), np.zeros((1, 17, 3, 3)))
    across_x, across_y = np.diag([0.0, 1.0, 1.0]), np.diag([1.0, 0.0, 1.0])

    def line(point, across):
        shape = (1, 17, 3)
        return np.broadcast_to(point, shape), np.broadcast_to(across, (*shape, 3)), 50.0, settings

    one = nothing.with_lines(*line([4.0, 2.0, 1.0], across_x))
    two = one.with_lines(*line([3.0, 7.0, 1.0], across_y))
    # One knows y and z, the other x and z. 1e-6 1/m^2 beside 28 to 280 is 0.2 um of metres.
    np.testing.assert_allclose(two.joints[0], np.tile([3.0, 2.0, 1.0], (17, 1)), atol=1e-6)
    np.testing.assert_allclose(two.information, two.information.swapaxes(-1, -2))
    assert (np.linalg.eigvalsh(two.information) > 0.9 * one.information[..., :1, :1] + 1.0).all()
    np.testing.assert_allclose(one.joints[0], np.tile([4.0, 2.0, 1.0], (17, 1)))


def test_one_more_view_helps_whom_nobody_triangulates():
    rng = np.random.default_rng(6)
    truth = walker(70, rng)
    exact, camera = KEYPOINTS(truth)[:, None], broadcast(70)
    joints, covariance = seen(truth, 0.01, rng)
    joints[20:50] = np.nan
    keypoints = camera.project(exact.reshape(70, -1, 3)).reshape(70, 1, 17, 2)
    settings = BodyFittingSettings()
    alone = fit_bodies(MODEL, joints, covariance, 50.0, settings)
    view = sight_people(camera, recognise_people(camera, keypoints, alone.joints), alone.joints)
    viewed = fit_bodies(MODEL, joints, covariance, 50.0, settings, sightings=[view])
    before, after = (
        np.linalg.norm(x.joints - exact, axis=-1)[20:50].mean() for x in (alone, viewed)
    )
    assert after < 0.75 * before


@pytest.mark.parametrize(
    ("late", "expected"),
    [(0.0, [1, 2, 4]), (0.5, [1.5, 3, np.nan]), (-0.25, [np.nan, 1.75, 3.5])],
)
def test_values_between_frames_lie_on_lines(late, expected):
    values = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(between_frames(values, late), expected)
