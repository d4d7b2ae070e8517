import numpy as np
import pytest
from rigid_bones import RIGID_BONES

from data_contracts.conventions import COCO17
from worldpose.geometry import Camera, Rigid
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, ObservationNoise
from worldpose.simulation.detector_errors import (
    DIFFICULTY,
    MAX_FALSE_POSITIVES,
    MIRRORED,
    Bodies,
    Detections,
    SystematicErrors,
    detect,
    draw_false_positives,
    draw_systematic_errors,
    facing_axes,
    perceived_bias,
    project_bodies,
    report,
)

FPS = 25.0
FRAMES = 2000


@pytest.fixture
def camera():
    """At the origin, looks along y, x to the right, z up, 100 px per metre at 20 m."""
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


EVEN = SystematicErrors(np.zeros((17, 3)), np.ones((17, 2, 2)))


def bodies(*people, frames=1):
    return Bodies(np.tile(np.stack(people), (frames, 1, 1, 1)), np.full(len(people), 1.8))


def rngs(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def one_setting(**settings):
    return ObservationNoise(**{**ObservationNoise.none().model_dump(), **settings})


def detected(camera, noise, *people, frames=FRAMES):
    projections = project_bodies(camera, bodies(*people, frames=frames))
    found = detect(projections, noise, EVEN, FPS, rngs(len(people)))
    return projections, found.keypoints, found.confidence


def test_pixels_and_size_of_a_person_straight_ahead(camera):
    projections = project_bodies(camera, bodies(standing(0.0, 20.0)))
    # Left ankle: 0.1 m to the right, 0.9 m down, at 100 px per metre.
    assert projections.keypoints[0, 0, 15].tolist() == pytest.approx([969.5, 629.5], abs=1e-9)
    assert projections.size[0, 0] == pytest.approx(180.0, abs=1e-9)
    assert projections.seen.all()


def test_a_person_right_behind_another_is_hidden(camera):
    projections = project_bodies(camera, bodies(standing(0.0, 40.0), standing(0.0, 20.0)))
    # Half as large about the camera's height, all of it fits into the nearer one's box.
    assert projections.hidden[0, 0].all()
    assert not projections.hidden[0, 1].any()


def test_people_side_by_side_hide_nothing(camera):
    assert project_bodies(camera, bodies(standing(-1.0, 20.0), standing(1.0, 25.0))).seen.all()


def test_half_a_body_width_apart_hides_the_covered_joints_only(camera):
    # The nearer person covers 0.2 m + a third of 0.4 m to either side of x = 0: up to 33 px.
    # The farther one stands at 25 px of its own 50 px per metre: its near side lies within.
    projections = project_bodies(camera, bodies(standing(0.5, 40.0), standing(0.0, 20.0)))
    u = projections.keypoints[0, 0, :, 0] - 959.5
    np.testing.assert_array_equal(projections.hidden[0, 0], u <= 100 * (0.2 + 0.4 / 3))
    assert 0 < projections.hidden[0, 0].sum() < 17


def test_what_is_behind_the_camera_or_out_of_the_picture_is_neither_seen_nor_hides(camera):
    projections = project_bodies(
        camera, bodies(standing(0.0, -20.0), standing(30.0, 20.0), standing(0.0, 20.0))
    )
    assert not projections.seen[0, :2].any()
    assert projections.seen[0, 2].all()
    noise = ObservationNoise.none()
    assert np.isnan(detect(projections, noise, EVEN, FPS, rngs(3)).keypoints[0, :2]).all()


def test_without_noise_detections_are_the_projections(camera):
    projections, keypoints, confidence = detected(
        camera, ObservationNoise.none(), standing(0.0, 40.0), standing(0.0, 20.0), frames=3
    )
    np.testing.assert_array_equal(keypoints, projections.keypoints)
    assert (confidence == 1.0).all()


def test_white_noise_is_a_share_of_the_height_by_joint(camera):
    noise = one_setting(white=0.02)
    for distance, height in ((20.0, 180.0), (40.0, 90.0)):
        projections, keypoints, _ = detected(camera, noise, standing(0.0, distance))
        spread = (keypoints - projections.keypoints)[:, 0].std(axis=(0, 2))
        # 4000 draws each: standard error 1.1 %.
        np.testing.assert_allclose(spread, 0.02 * height * DIFFICULTY, rtol=0.06)


def test_the_floor_adds_in_squares(camera):
    projections, keypoints, _ = detected(
        camera, one_setting(white=0.02, floor_px=3.0), standing(0.0, 20.0)
    )
    spread = (keypoints - projections.keypoints)[:, 0].std(axis=(0, 2))
    np.testing.assert_allclose(spread, np.hypot(3.6 * DIFFICULTY, 3.0), rtol=0.06)


def test_slow_noise_stays_over_frames_and_white_noise_does_not(camera):
    for setting, expected in (("slow", np.exp(-1 / (0.3 * FPS))), ("white", 0.0)):
        projections, keypoints, _ = detected(
            camera, one_setting(**{setting: 0.02}), standing(0.0, 20.0)
        )
        error = (keypoints - projections.keypoints)[:, 0].reshape(FRAMES, -1)
        after_one = (error[1:] * error[:-1]).mean() / (error**2).mean()
        # 34 series of 2000 frames: standard error below 0.01.
        assert after_one == pytest.approx(expected, abs=0.03)


def test_hidden_joints_err_more(camera):
    projections, keypoints, _ = detected(
        camera, one_setting(white=0.02, hidden_std=1.0), standing(0.0, 40.0), standing(0.0, 20.0)
    )
    spread = (keypoints - projections.keypoints).std(axis=(0, 3))
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
    projections, keypoints, _ = detected(camera, one_setting(swapped=0.3), standing(0.0, 20.0))
    same = (keypoints == projections.keypoints).all((2, 3))[:, 0]
    swapped = (keypoints == projections.keypoints[:, :, MIRRORED]).all((2, 3))[:, 0]
    assert (same ^ swapped).all()
    assert swapped.mean() == pytest.approx(0.3, abs=0.06)
    assert COCO17[MIRRORED[COCO17.index("left_knee")]] == "right_knee"
    assert MIRRORED[0] == 0


def test_confidence_falls_with_the_error_and_for_hidden_joints(camera):
    noise = one_setting(white=0.03, confidence_drop=8.0, hidden_doubt=0.5)
    projections, keypoints, confidence = detected(
        camera, noise, standing(0.0, 40.0), standing(0.0, 20.0), frames=200
    )
    error = np.linalg.norm(keypoints - projections.keypoints, axis=-1) / projections.size[..., None]
    # Float64 exponentials of equal arguments, up to rounding of pixels of a thousand.
    np.testing.assert_allclose(confidence[:, 1], np.exp(-8 * error[:, 1]), rtol=1e-9)
    np.testing.assert_allclose(confidence[:, 0], 0.5 * np.exp(-8 * error[:, 0]), rtol=1e-9)


def test_confidence_is_above_0_and_at_most_1(camera):
    noise = one_setting(white=0.3, confidence_drop=8.0, confidence_std=0.5, hidden_doubt=0.9)
    _, _, confidence = detected(camera, noise, standing(0.0, 40.0), standing(0.0, 20.0))
    assert confidence.min() > 0.0
    assert confidence.max() <= 1.0


def test_a_few_joints_at_the_border_are_no_person(camera):
    # At 20 m the image ends 9.6 m to the right: the right half of the body stays in.
    person = standing(9.6, 20.0)
    projections = project_bodies(camera, bodies(person))
    inside = int(projections.seen.sum())
    assert 5 < inside < 17
    for fewest, found in ((inside, inside), (inside + 1, 0)):
        some = detect(projections, one_setting(min_joints=fewest), EVEN, FPS, rngs(1))
        assert np.isfinite(some.keypoints[..., 0]).sum() == found


def test_a_further_person_changes_nobodys_errors(camera):
    noise = ObservationNoise()
    alone = detected(camera, noise, standing(-2.0, 20.0), frames=50)[1]
    together = detected(camera, noise, standing(-2.0, 20.0), standing(3.0, 25.0), frames=50)[1]
    np.testing.assert_array_equal(alone[:, 0], together[:, 0])


def test_the_nearest_of_those_before_a_joint_hides_it(camera):
    projections = project_bodies(
        camera, bodies(standing(0.0, 40.0), standing(0.0, 20.0), standing(0.0, 30.0))
    )
    assert (projections.hider[0, 0] == 1).all()
    assert (projections.hider[0, 2] == 1).all()
    assert (projections.hider[0, 1] == -1).all()


def test_azimuth_is_where_the_camera_is_seen_from_the_body(camera):
    # With his left at positive x he faces the camera, which then passes to his right.
    front, left = facing_axes(standing(0.0, 20.0))
    np.testing.assert_allclose(front, [0.0, -1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(left, [1.0, 0.0, 0.0], atol=1e-12)
    projections = project_bodies(camera, bodies(standing(0.0, 20.0), standing(20.0, 20.0)))
    np.testing.assert_allclose(projections.azimuth[0], [0.0, -np.pi / 4], atol=1e-12)


def test_a_camera_for_every_frame_sees_as_each_of_them(camera):
    moving = Camera(
        focal=np.array([[2000.0, 2000.0], [3000.0, 3000.0]]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.array([0.1, 0.0, 0.0, 0.0, 0.0]),
        cam_from_world=Rigid(camera.cam_from_world.rotation, np.array([[0.0] * 3, [1.0, 0, 2]])),
        image_size=np.array([1920, 1080]),
    )
    people = bodies(standing(0.0, 40.0), standing(0.3, 20.0), frames=2)
    together = project_bodies(moving, people)
    for frame in (0, 1):
        alone = project_bodies(moving[frame], bodies(standing(0.0, 40.0), standing(0.3, 20.0)))
        for name in ("keypoints", "hider", "size", "azimuth"):
            np.testing.assert_array_equal(
                getattr(together, name)[frame], getattr(alone, name)[0], err_msg=name
            )


def test_a_detector_errs_alike_left_and_right():
    bias = draw_systematic_errors(np.random.default_rng(0)).joint_bias
    np.testing.assert_array_equal(bias[MIRRORED], bias * [1.0, -1.0, 1.0])
    assert np.abs(bias).max() < 4.0
    assert len(np.unique(bias[:, 0])) == 9  # the nose and eight pairs


def test_the_shared_bias_turns_with_the_body_and_is_in_metres():
    joints = bodies(standing(0.0, 20.0)).joints
    systematic = SystematicErrors(np.tile([1.0, 0.0, 2.0], (17, 1)), np.zeros((17, 2, 2)))
    offset = perceived_bias(
        joints, systematic, one_setting(shared_bias_m=0.03), np.zeros((1, 17, 3))
    )
    # Forward is towards the camera, along negative y.
    np.testing.assert_allclose(offset, np.broadcast_to([0.0, -0.03, 0.06], offset.shape))
    own = perceived_bias(joints, systematic, one_setting(own_bias_m=0.01), np.ones((1, 17, 3)))
    np.testing.assert_allclose(own, np.broadcast_to([0.01, -0.01, 0.01], own.shape))


def test_bias_shifts_what_is_reported_but_not_what_is_seen(camera):
    people = bodies(standing(0.0, 20.0))
    shifted = Bodies(
        people.joints, people.heights, np.zeros((1, 1, 17, 3)) + np.array([0.1, 0.0, 0.0])
    )
    projections, plain = project_bodies(camera, shifted), project_bodies(camera, people)
    np.testing.assert_array_equal(projections.keypoints, plain.keypoints)
    found = detect(projections, ObservationNoise.none(), EVEN, FPS, rngs(1))
    # 0.1 m at 100 px per metre.
    np.testing.assert_allclose(
        found.keypoints - projections.keypoints, [[[[10.0, 0.0]] * 17]], atol=1e-9
    )
    assert (found.confidence == 1.0).all()


def test_the_view_bias_is_the_same_from_opposite_sides_and_changes_sign_from_the_flank(camera):
    person = standing(0.0, 20.0)
    middle = person[[5, 6]].mean(axis=0) * [1.0, 1.0, 0.0]
    seen = []
    for quarter in range(4):
        cos, sin = np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)
        turned = (person - middle) @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + middle
        projections, keypoints, _ = detected(camera, one_setting(view_bias=0.01), turned, frames=1)
        seen.append((keypoints - projections.keypoints)[0, 0, 5, 0] / projections.size[0, 0])
    # cos 2a + sin 2a with coefficients of 1, and an azimuth that is exact at the trunk's middle.
    np.testing.assert_allclose(seen, 0.01 * DIFFICULTY[5] * np.array([1, -1, 1, -1]), rtol=1e-6)


def test_blur_goes_along_the_motion_and_grows_with_it(camera):
    x = np.linspace(-4.0, 4.0, FRAMES)
    people = Bodies(np.array([[standing(at, 20.0)] for at in x]), np.array([1.8]))
    projections = project_bodies(camera, people)
    found = detect(projections, one_setting(blur_s=0.005), EVEN, FPS, rngs(1))
    error = (found.keypoints - projections.keypoints)[:, 0]
    speed = 8.0 / (FRAMES - 1) * FPS * 100.0  # [px/s]
    assert np.abs(error[..., 1]).max() < 1e-9  # the motion is level: rounding
    # 34000 draws: standard error 0.4 %.
    assert error[..., 0].std() == pytest.approx(0.005 * speed, rel=0.03)


def test_stolen_joints_are_the_nearer_persons(camera):
    projections, keypoints, _ = detected(
        camera, one_setting(stolen=0.3), standing(0.0, 40.0), standing(0.0, 20.0)
    )
    moved = (keypoints != projections.keypoints).any(-1)
    assert not moved[:, 1].any()
    # 17 joints in bursts of 4 frames: some 8500 independent draws; the level of the camera's
    # center is the same pixel for both.
    assert moved[:, 0].mean() == pytest.approx(0.3, abs=0.03)
    frame, joint = np.nonzero(moved[:, 0])
    np.testing.assert_array_equal(
        keypoints[frame, 0, joint], projections.keypoints[frame, 1, joint]
    )


def test_displaced_joints_are_flagged_and_far_off_and_no_less_confident(camera):
    projections = project_bodies(camera, bodies(standing(0.0, 20.0), frames=FRAMES))
    noise = one_setting(white=0.01, displaced=0.08, confidence_drop=8.0)
    found = detect(projections, noise, EVEN, FPS, rngs(1))
    error = np.linalg.norm(found.keypoints - projections.keypoints, axis=-1)
    sigmas = error / (0.01 * 180.0 * DIFFICULTY)
    assert found.displaced.mean() == pytest.approx(0.08, abs=0.005)
    # 4 to 10 standard deviations, on top of white noise that itself rarely exceeds 4.
    assert np.percentile(sigmas[found.displaced], [5, 95]) == pytest.approx([4.2, 9.8], abs=0.6)
    assert sigmas[~found.displaced].max() < 5.5
    honest = found.confidence[~found.displaced].mean()
    assert found.confidence[found.displaced].mean() == pytest.approx(honest, abs=0.01)


def test_small_people_are_missed_and_exchanged_twice_as_often(camera):
    for small, share in ((0.0, 0.2), (1000.0, 0.36)):
        _, keypoints, _ = detected(
            camera,
            one_setting(person_missed=0.2, small_px=small),
            standing(0.0, 20.0),
            frames=20000,
        )
        # One source in five, or either of two: 1 - 0.8^2; 800 bursts or more.
        assert np.isnan(keypoints[..., 0]).mean() == pytest.approx(share, abs=0.04)


def test_a_lost_persons_box_goes_to_whoever_stands_before(camera):
    noise = one_setting(hidden_person_missed=1.0, merged=0.5)
    projections = project_bodies(
        camera, bodies(standing(0.0, 40.0), standing(0.0, 20.0), frames=FRAMES)
    )
    merged = detect(projections, noise, EVEN, FPS, rngs(2)).merged_into
    assert set(merged[:, 0]) == {-1, 1}
    assert (merged[:, 0] == 1).mean() == pytest.approx(0.5, abs=0.05)  # 2000 draws
    assert (merged[:, 1] == -1).all()


def reporting(keypoints, confidence, size, *, merged=None, dropped=None, seed=0):
    shape = confidence.shape[:2]
    merged = np.full(shape, -1, dtype=np.int16) if merged is None else merged
    dropped = np.zeros(len(confidence), dtype=bool) if dropped is None else dropped
    detections = Detections(keypoints, confidence, np.zeros(confidence.shape, dtype=bool), merged)
    made = report(detections, size, dropped, np.random.default_rng(seed))
    return made.observations, made.person


def reported(found, seed=0):
    """People that are found or not (frames, bodies), each with its number as coordinate."""
    found = np.array(found, dtype=bool)
    keypoints = np.where(
        found[..., None, None], np.arange(found.shape[1])[:, None, None] * np.ones((17, 2)), np.nan
    )
    confidence = np.where(found[..., None], np.full(17, 0.5), np.nan)
    size = np.full(found.shape, 100.0)
    return reporting(keypoints, confidence, size, seed=seed)


def test_identities_name_the_body_of_every_detection():
    observations, identity = reported(np.random.default_rng(1).random((300, 4)) < 0.7)
    number = observations.keypoints[..., 0, 0]
    np.testing.assert_array_equal(np.where(np.isnan(number), -1, number), identity)
    assert observations.frame.tolist() == list(range(300))


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
    observations, _ = reporting(keypoints, confidence, np.array([[100.0]]))
    assert observations.boxes[0, 0].tolist() == [4.0, 14.0, 36.0, 66.0]
    assert observations.score[0, 0] == 0.75


def test_nobody_found_leaves_no_detections():
    observations, identity = reported(np.zeros((4, 2)))
    assert observations.keypoints.shape == (4, 0, 17, 2)
    assert identity.shape == (4, 0)


def test_dropped_frames_have_no_detections():
    keypoints, confidence = np.ones((3, 2, 17, 2)), np.ones((3, 2, 17))
    dropped = np.array([False, True, False])
    observations, identity = reporting(keypoints, confidence, np.ones((3, 2)), dropped=dropped)
    assert observations.frame.tolist() == [0, 1, 2]
    for array in observations.arrays().values():
        assert np.isnan(array[1]).all()
        assert np.isfinite(array[[0, 2]]).all()
    assert (identity[1] == -1).all()


def test_a_merged_box_is_wider_by_half_a_body():
    keypoints, confidence = np.full((1, 2, 17, 2), 50.0), np.ones((1, 2, 17))
    keypoints[0, 0], confidence[0, 0] = np.nan, np.nan
    merged = np.array([[1, -1]], dtype=np.int16)
    observations, identity = reporting(keypoints, confidence, np.full((1, 2), 100.0), merged=merged)
    # Room of 6 px, and 20 % of the lost one's 100 px on one side.
    assert observations.boxes[0, 0].tolist() == [44.0, 44.0, 76.0, 56.0]
    assert identity.tolist() == [[1]]


TINY = SCENARIOS["tiny"]


def drawn(noise, frames=20_000, seed=0):
    scenario = TINY.model_copy(update={"noise": noise})
    return draw_false_positives(
        scenario, PitchTemplate.standard(), frames, np.random.default_rng(seed)
    ).joints


def test_as_many_as_the_settings_say_and_as_long():
    joints = drawn(ObservationNoise(false_people=0.4, false_people_time_s=0.3))
    there = np.isfinite(joints[..., 0, 0])
    # Some 1000 stretches: standard error 3 %, of the count and of the length.
    assert there.sum(axis=1).mean() == pytest.approx(0.4, rel=0.15)
    appearances = (there[1:] & ~there[:-1]).sum()
    assert there.sum() / appearances / TINY.fps == pytest.approx(0.3, rel=0.15)


def test_they_stand_still_and_come_back_elsewhere():
    joints = drawn(ObservationNoise(false_people=0.4), frames=2000)
    step = np.linalg.norm(np.diff(joints[:, :, 0], axis=0), axis=-1)
    assert np.nanmax(step) == 0.0
    places = {tuple(place) for place in joints[:, 0, 0] if np.isfinite(place[0])}
    assert len(places) > 20


def test_they_have_human_bones_and_stand_on_the_pitch():
    joints = drawn(ObservationNoise(false_people=0.4), frames=2000)
    for a, b in RIGID_BONES:
        length = np.linalg.norm(joints[..., a, :] - joints[..., b, :], axis=-1)
        # Rounding at 100 m from the origin of their walk.
        assert np.nanmax(length) - np.nanmin(length) < 1e-11
    lowest = np.nanmin(joints[..., 2].min(axis=-1))
    assert -0.2 < lowest < 0.15


def test_no_rate_no_phantoms():
    joints = drawn(ObservationNoise.none(), frames=100)
    assert joints.shape == (100, MAX_FALSE_POSITIVES, 17, 3)
    assert np.isnan(joints).all()
