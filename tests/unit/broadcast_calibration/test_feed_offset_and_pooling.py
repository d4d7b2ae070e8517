"""The feed's clock seen in moving people, and one place for several clips."""

import numpy as np
import pytest
import turning_clip as clip

from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.players import People, estimate_feed_offset
from worldpose.broadcast_calibration.uncertainty import (
    Uncertainty,
    drawn_to,
    pool_centers,
    static_covariance,
)
from worldpose.static_calibration.parameters import project_with_jacobian

FRAMES, FPS = 120, 50.0


def people(late, speed, rng, noise=1.0):
    """Eight people who run to and fro along x; the feed shows them `late` frames on."""
    camera = clip.moving(FRAMES)
    start = np.stack([np.linspace(-6.0, 8.0, 8), np.tile([-6.0, -2.0, 4.0, 8.0], 2)], axis=-1)
    phase = rng.uniform(0.0, 6.0, 8)

    def joints(frames):
        time = frames[:, None] / FPS
        x = start[:, 0] + speed / 2.0 * np.sin(2.0 * time + phase)
        places = np.stack([x, np.broadcast_to(start[:, 1], x.shape), 0.0 * x], axis=-1)
        return places[:, :, None] + clip.SHAPE

    frames = np.arange(FRAMES, dtype=float)
    seen = camera.camera.project(joints(frames + late).reshape(FRAMES, -1, 3))
    seen = seen.reshape(FRAMES, 8, 17, 2) + noise * rng.standard_normal((FRAMES, 8, 17, 2))
    given = joints(frames) + 0.01 * rng.standard_normal((FRAMES, 8, 17, 3))
    return camera, People(given, seen, FPS)


@pytest.mark.parametrize("late", [-4.0, 2.4])
def test_the_offset_is_found_within_half_a_frame(late):
    camera, moving = people(late, 5.0, np.random.default_rng(1))
    found = estimate_feed_offset(camera, moving, reach=10.0)
    assert found.determined
    # A runner goes 0.1 m per frame, 2 px; 8 people of 17 joints at 1 px.
    assert found.frames == pytest.approx(late, abs=0.2)


def test_who_stands_tells_no_clock():
    camera, still = people(3.0, 0.0, np.random.default_rng(2))
    found = estimate_feed_offset(camera, still, reach=6.0)
    assert not found.determined
    assert np.isnan(found.frames)


def test_an_offset_beyond_what_is_tried_is_not_claimed():
    camera, moving = people(9.0, 5.0, np.random.default_rng(3))
    assert not estimate_feed_offset(camera, moving, reach=4.0).determined


def test_people_are_taken_later_and_earlier_by_parts_of_a_frame():
    joints = np.broadcast_to(np.arange(5.0)[:, None, None, None], (5, 1, 17, 3))
    moving = People(joints, np.zeros((5, 1, 17, 2)), FPS)

    def places(late):
        return moving.later(late).joints[:, 0, 0, 0]

    nan = np.nan
    np.testing.assert_array_equal(places(0.0), [0.0, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(places(2.0), [2.0, 3.0, 4.0, nan, nan])
    np.testing.assert_array_equal(places(-1.0), [nan, 0.0, 1.0, 2.0, 3.0])
    # Halves are exact in binary; between two frames both are needed.
    np.testing.assert_array_equal(places(0.5), [0.5, 1.5, 2.5, 3.5, nan])
    np.testing.assert_array_equal(places(-1.5), [nan, nan, 0.5, 1.5, 2.5])
    np.testing.assert_array_equal(places(9.0), [nan] * 5)


def test_clips_that_agree_give_their_weighted_mean():
    wide, narrow = 4.0 * np.eye(3), np.eye(3)
    pooled = pool_centers(
        [np.array([0.0, -70.0, 15.0]), np.array([1.0, -70.0, 15.0])], [wide, narrow]
    )
    assert pooled.agree
    # Weights of 1/4 and 1.
    np.testing.assert_allclose(pooled.center, [0.8, -70.0, 15.0])
    np.testing.assert_allclose(pooled.covariance, 0.8 * np.eye(3))


def test_clips_of_two_places_are_not_pooled():
    pooled = pool_centers([np.zeros(3), np.array([10.0, 0.0, 0.0])], [np.eye(3), np.eye(3)])
    assert not pooled.agree
    assert np.isnan(pooled.center).all()
    # Half of ten to either side.
    np.testing.assert_allclose(pooled.distance, [5.0, 5.0])


def test_a_camera_goes_to_the_common_place_and_its_frames_go_along():
    camera = clip.moving(3)
    # A displacement of six centimetres with a rotation about y: a milliradian per metre.
    known = np.tile(1e-12 * np.eye(12), (3, 1, 1))
    known[:, 7:10, 7:10] = 0.04 * np.eye(3)
    known[:, 1, 7] = known[:, 7, 1] = 1e-3 * 0.04
    known[:, 1, 1] = 1e-6 * 0.04 + 1e-12
    other = camera.center + np.array([0.06, 0.0, 0.0])
    pooled = pool_centers([camera.center, other], [0.04 * np.eye(3), 0.02 * np.eye(3)])
    moved, left = drawn_to(camera, Uncertainty(known), pooled)
    # Weights of one and two thirds.
    np.testing.assert_allclose(moved.center - camera.center, [0.04, 0.0, 0.0], atol=1e-12)
    turned = moved.rotation @ np.swapaxes(camera.rotation, -1, -2)
    np.testing.assert_allclose(turned[:, 0, 2], 4e-5, rtol=1e-6)
    np.testing.assert_allclose(left.clip[:3, :3], 0.04 / 3.0 * np.eye(3), atol=1e-15)
    # The turn keeps its own spread and a third of what the place gave it.
    np.testing.assert_allclose(left.frame[:, 1, 1], 1e-6 * 0.04 / 3.0 + 1e-12, rtol=1e-9)


def test_a_moving_cameras_covariance_is_that_of_static_cameras_with_the_same_pixels():
    camera = clip.moving(frames=2)
    rng = np.random.default_rng(3)
    spread = rng.standard_normal((12, 12)) * 1e-3
    known = Uncertainty(np.broadcast_to(spread @ spread.T, (2, 12, 12)))
    places = np.array([[3.0, -10.0, 0.1], [-8.0, 5.0, 0.0]])
    rows, pixel = np.empty((2, 12)), np.empty(2)
    for frame, covariance in enumerate(static_covariance(camera, known)):
        _, jacobian = project_with_jacobian(camera.camera[frame], places)
        for place, row in zip(places, jacobian, strict=True):
            lens = camera.lens(frame)
            point_row(camera.rotation[frame], camera.center, lens, place, pixel, rows)
            np.testing.assert_allclose(
                row @ covariance @ row.T, rows @ known.frame[frame] @ rows.T, rtol=1e-6
            )
