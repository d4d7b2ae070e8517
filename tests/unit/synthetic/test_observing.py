import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.cameras import Camera, Rigid
from worldpose.synthetic import ObservationNoise
from worldpose.synthetic.observing import DIFFICULTY, MIRRORED, Bodies, detect, report, see

FPS = 25.0
FRAMES = 2000


@pytest.fixture
def camera():
    """At the origin, looks along y, x to the right, z up, 100 px a metre at 20 m."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return Camera(
        focal=np.array([2000.0, 2000.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, np.zeros(3)),
        image_size=np.array([1920, 1080]),
    )


def standing(x, y):
    """A person 1.8 m tall at a place, feet 1 m below the camera's height; arms hang."""
    across = np.array([0, 0.03, -0.03, 0.07, -0.07, *[0.2, -0.2] * 3, *[0.1, -0.1] * 3])
    height = np.array([1.6, 1.65, 1.65, 1.6, 1.6, *np.repeat([1.45, 1.15, 0.9, 0.95, 0.5, 0.1], 2)])
    return np.stack([x + across, np.full(17, y), height - 1.0], axis=-1)


def bodies(*people, frames=1):
    return Bodies(np.tile(np.stack(people), (frames, 1, 1, 1)), np.full(len(people), 1.8))


def rngs(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def one_setting(**settings):
    return ObservationNoise(**{**ObservationNoise.none().model_dump(), **settings})


def detected(camera, noise, *people, frames=FRAMES):
    sight = see(camera, bodies(*people, frames=frames))
    return sight, *detect(sight, noise, FPS, rngs(len(people)))


def test_pixels_and_size_of_a_person_straight_ahead(camera):
    sight = see(camera, bodies(standing(0.0, 20.0)))
    # Left ankle: 0.1 m to the right, 0.9 m down, at 100 px a metre.
    assert sight.keypoints[0, 0, 15].tolist() == pytest.approx([969.5, 629.5], abs=1e-9)
    assert sight.size[0, 0] == pytest.approx(180.0, abs=1e-9)
    assert sight.seen.all()


def test_a_person_right_behind_another_is_hidden(camera):
    sight = see(camera, bodies(standing(0.0, 40.0), standing(0.0, 20.0)))
    # Half as large about the camera's height, all of it fits into the nearer one's box.
    assert sight.hidden[0, 0].all()
    assert not sight.hidden[0, 1].any()


def test_people_side_by_side_hide_nothing(camera):
    assert see(camera, bodies(standing(-1.0, 20.0), standing(1.0, 25.0))).seen.all()


def test_half_a_body_width_apart_hides_the_covered_joints_only(camera):
    # The nearer person covers 0.2 m + a third of 0.4 m to either side of x = 0: up to 33 px.
    # The farther one stands at 25 px of its own 50 px a metre: its near side lies within.
    sight = see(camera, bodies(standing(0.5, 40.0), standing(0.0, 20.0)))
    u = sight.keypoints[0, 0, :, 0] - 959.5
    np.testing.assert_array_equal(sight.hidden[0, 0], u <= 100 * (0.2 + 0.4 / 3))
    assert 0 < sight.hidden[0, 0].sum() < 17


def test_what_is_behind_the_camera_or_out_of_the_picture_is_neither_seen_nor_hides(camera):
    sight = see(camera, bodies(standing(0.0, -20.0), standing(30.0, 20.0), standing(0.0, 20.0)))
    assert not sight.seen[0, :2].any()
    assert sight.seen[0, 2].all()
    noise = ObservationNoise.none()
    assert np.isnan(detect(sight, noise, FPS, rngs(3))[0][0, :2]).all()


def test_without_noise_detections_are_the_projections(camera):
    sight, keypoints, confidence = detected(
        camera, ObservationNoise.none(), standing(0.0, 40.0), standing(0.0, 20.0), frames=3
    )
    np.testing.assert_array_equal(keypoints, sight.keypoints)
    assert (confidence == 1.0).all()


def test_white_noise_is_a_share_of_the_height_by_joint(camera):
    noise = one_setting(white=0.02)
    for distance, height in ((20.0, 180.0), (40.0, 90.0)):
        sight, keypoints, _ = detected(camera, noise, standing(0.0, distance))
        spread = (keypoints - sight.keypoints)[:, 0].std(axis=(0, 2))
        # 4000 draws each: standard error 1.1 %.
        np.testing.assert_allclose(spread, 0.02 * height * DIFFICULTY, rtol=0.06)


def test_the_floor_adds_in_squares(camera):
    sight, keypoints, _ = detected(camera, one_setting(white=0.02, floor=3.0), standing(0.0, 20.0))
    spread = (keypoints - sight.keypoints)[:, 0].std(axis=(0, 2))
    np.testing.assert_allclose(spread, np.hypot(3.6 * DIFFICULTY, 3.0), rtol=0.06)


def test_slow_noise_stays_over_frames_and_white_noise_does_not(camera):
    for setting, expected in (("slow", np.exp(-1 / (0.3 * FPS))), ("white", 0.0)):
        sight, keypoints, _ = detected(camera, one_setting(**{setting: 0.02}), standing(0.0, 20.0))
        error = (keypoints - sight.keypoints)[:, 0].reshape(FRAMES, -1)
        after_one = (error[1:] * error[:-1]).mean() / (error**2).mean()
        # 34 series of 2000 frames: standard error below 0.01.
        assert after_one == pytest.approx(expected, abs=0.03)


def test_hidden_joints_err_more(camera):
    sight, keypoints, _ = detected(
        camera, one_setting(white=0.02, hidden_spread=1.0), standing(0.0, 40.0), standing(0.0, 20.0)
    )
    spread = (keypoints - sight.keypoints).std(axis=(0, 3))
    np.testing.assert_allclose(spread[0], 2 * 0.02 * 90.0 * DIFFICULTY, rtol=0.06)
    np.testing.assert_allclose(spread[1], 0.02 * 180.0 * DIFFICULTY, rtol=0.06)


@pytest.mark.parametrize(
    ("setting", "share", "whose"),
    [
        ("joint_missed", 0.1, (0.0, 0.1)),
        ("person_missed", 0.2, (0.2, 0.2)),
        ("hidden_joint_missed", 0.4, (0.4, 0.0)),
        ("hidden_person_missed", 0.9, (0.9, 0.0)),
    ],
)
def test_misses_have_their_rates(camera, setting, share, whose):
    _, keypoints, confidence = detected(
        camera, one_setting(**{setting: share}), standing(0.0, 40.0), standing(0.0, 20.0)
    )
    missing = np.isnan(keypoints[..., 0])
    np.testing.assert_array_equal(missing, np.isnan(confidence))
    # Bursts of 5 frames leave some 400 independent draws: standard error 0.02.
    np.testing.assert_allclose(missing.mean(axis=(0, 2)), whose, atol=0.06)
    whole = missing.all(-1) | ~missing.any(-1)
    assert whole.all() == setting.startswith(("person", "hidden_person"))


def test_swaps_exchange_left_and_right_of_the_whole_person(camera):
    sight, keypoints, _ = detected(camera, one_setting(swapped=0.3), standing(0.0, 20.0))
    same = (keypoints == sight.keypoints).all((2, 3))[:, 0]
    swapped = (keypoints == sight.keypoints[:, :, MIRRORED]).all((2, 3))[:, 0]
    assert (same ^ swapped).all()
    assert swapped.mean() == pytest.approx(0.3, abs=0.06)
    assert COCO17[MIRRORED[COCO17.index("left_knee")]] == "right_knee"
    assert MIRRORED[0] == 0


def test_confidence_falls_with_the_error_and_for_hidden_joints(camera):
    noise = one_setting(white=0.03, confidence_drop=8.0, hidden_doubt=0.5)
    sight, keypoints, confidence = detected(
        camera, noise, standing(0.0, 40.0), standing(0.0, 20.0), frames=200
    )
    error = np.linalg.norm(keypoints - sight.keypoints, axis=-1) / sight.size[..., None]
    # Float64 exponentials of equal arguments, up to rounding of pixels of a thousand.
    np.testing.assert_allclose(confidence[:, 1], np.exp(-8 * error[:, 1]), rtol=1e-9)
    np.testing.assert_allclose(confidence[:, 0], 0.5 * np.exp(-8 * error[:, 0]), rtol=1e-9)


def test_confidence_is_above_0_and_at_most_1(camera):
    noise = one_setting(white=0.3, confidence_drop=8.0, confidence_spread=0.5, hidden_doubt=0.9)
    _, _, confidence = detected(camera, noise, standing(0.0, 40.0), standing(0.0, 20.0))
    assert confidence.min() > 0.0
    assert confidence.max() <= 1.0


def test_a_few_joints_at_the_border_are_no_person(camera):
    # At 20 m the picture ends 9.6 m to the right: the right half of the body stays in.
    person = standing(9.6, 20.0)
    sight = see(camera, bodies(person))
    inside = int(sight.seen.sum())
    assert 5 < inside < 17
    for fewest, found in ((inside, inside), (inside + 1, 0)):
        keypoints, _ = detect(sight, one_setting(fewest_joints=fewest), FPS, rngs(1))
        assert np.isfinite(keypoints[..., 0]).sum() == found


def test_a_further_person_changes_nobodys_errors(camera):
    noise = ObservationNoise()
    alone = detected(camera, noise, standing(-2.0, 20.0), frames=50)[1]
    together = detected(camera, noise, standing(-2.0, 20.0), standing(3.0, 25.0), frames=50)[1]
    np.testing.assert_array_equal(alone[:, 0], together[:, 0])


def reported(found, seed=0):
    """People that are found or not (frames, bodies), each with its number as coordinate."""
    found = np.array(found, dtype=bool)
    keypoints = np.where(
        found[..., None, None], np.arange(found.shape[1])[:, None, None] * np.ones((17, 2)), np.nan
    )
    confidence = np.where(found[..., None], np.full(17, 0.5), np.nan)
    size = np.full(found.shape, 100.0)
    return report(40, keypoints, confidence, size, np.random.default_rng(seed))


def test_identities_name_the_body_of_every_detection():
    observations, identity = reported(np.random.default_rng(1).random((300, 4)) < 0.7)
    number = observations.keypoints[..., 0, 0]
    np.testing.assert_array_equal(np.where(np.isnan(number), -1, number), identity)
    assert observations.frame.tolist() == list(range(40, 340))


def test_padding_comes_last_and_is_all_missing():
    observations, identity = reported([[1, 0, 1], [0, 0, 0], [0, 1, 0]])
    assert observations.keypoints.shape == (3, 2, 17, 2)
    assert (identity >= 0).tolist() == [[True, True], [False, False], [True, False]]
    for array in observations.arrays().values():
        assert np.isnan(array[1]).all()
        assert np.isnan(array[2, 1]).all()


def test_order_tells_nothing_about_identity():
    _, identity = reported(np.ones((6000, 3)))
    for place in range(3):
        counts = np.bincount(identity[:, place], minlength=3)
        # 6000 draws: standard deviation of a count of 2000 is 37.
        np.testing.assert_allclose(counts, 2000, atol=150)
    # Whoever is first says nothing about the next frame: a third of the time the same.
    assert (identity[1:, 0] == identity[:-1, 0]).mean() == pytest.approx(1 / 3, abs=0.03)


def test_boxes_hold_the_keypoints_with_room_of_six_percent_of_the_height():
    keypoints = np.full((1, 1, 17, 2), np.nan)
    keypoints[0, 0, 0], keypoints[0, 0, 1] = (10.0, 20.0), (30.0, 60.0)
    confidence = np.where(np.isnan(keypoints[..., 0]), np.nan, 0.5)
    confidence[0, 0, 1] = 1.0
    observations, _ = report(
        0, keypoints, confidence, np.array([[100.0]]), np.random.default_rng(0)
    )
    assert observations.boxes[0, 0].tolist() == [4.0, 14.0, 36.0, 66.0]
    assert observations.score[0, 0] == 0.75


def test_nobody_found_leaves_no_detections():
    observations, identity = reported(np.zeros((4, 2)))
    assert observations.keypoints.shape == (4, 0, 17, 2)
    assert identity.shape == (4, 0)
