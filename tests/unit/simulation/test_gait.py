import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.simulation.bodies import draw_body
from worldpose.simulation.gait import RIGID_BONES, walk
from worldpose.simulation.paths import MARGIN, STEP, GroundPath

J = {name: index for index, name in enumerate(COCO17)}
FPS = 100.0
SPEEDS = (1.0, 1.4, 2.5, 4.0)


def straight(speed, heading=0.0, duration=6.0):
    samples = round((duration + 2 * MARGIN) / STEP) + 1
    time = np.arange(samples) * STEP - MARGIN
    direction = np.array([np.cos(heading), np.sin(heading)])
    steady = np.ones(samples)
    return GroundPath(time, speed * time[:, None] * direction, heading * steady, speed * steady)


def flat(x, y):
    return 0.0 * x


def walked(speed, heading=0.0, ground=flat, seed=0):
    rng = np.random.default_rng(seed)
    body = draw_body((1.8, 1.8), rng)
    times = np.arange(0.0, 6.0, 1.0 / FPS)
    return body, walk(body, straight(speed, heading), times, ground, rng)


@pytest.mark.parametrize("speed", SPEEDS)
def test_bones_keep_their_lengths(speed):
    _, joints = walked(speed, heading=0.7)
    for a, b in RIGID_BONES:
        length = np.linalg.norm(joints[:, a] - joints[:, b], axis=-1)
        # Unit vectors times lengths at 25 m from the origin: rounding only.
        assert np.ptp(length) < 1e-12, (COCO17[a], COCO17[b])


def test_bones_have_the_bodys_lengths_on_both_sides():
    body, joints = walked(2.5)
    for side in ("left", "right"):
        for a, b, length in (
            ("hip", "knee", body.thigh),
            ("knee", "ankle", body.shank),
            ("shoulder", "elbow", body.upper_arm),
            ("elbow", "wrist", body.forearm),
        ):
            bone = joints[:, J[f"{side}_{a}"]] - joints[:, J[f"{side}_{b}"]]
            np.testing.assert_allclose(np.linalg.norm(bone, axis=-1), length, atol=1e-12)


def test_the_pelvis_follows_the_path():
    _, joints = walked(2.5, heading=0.4)
    middle = joints[:, [J["left_hip"], J["right_hip"]]].mean(axis=1)
    way = 2.5 * np.arange(0.0, 6.0, 1.0 / FPS)[:, None] * [np.cos(0.4), np.sin(0.4)]
    np.testing.assert_allclose(middle[:, :2], way, atol=1e-9)


@pytest.mark.parametrize("speed", SPEEDS)
def test_feet_are_never_below_the_ground_and_swing_at_most_knee_high(speed):
    body, joints = walked(speed)
    height = joints[:, [J["left_ankle"], J["right_ankle"]], 2]
    assert height.min() == pytest.approx(body.ankle_height, abs=1e-9)
    assert height.max() < body.ankle_height + body.shank


@pytest.mark.parametrize(("speed", "least"), [(1.0, 0.35), (4.0, 0.2)])
def test_planted_feet_stand_still(speed, least):
    body, joints = walked(speed)
    for side in ("left", "right"):
        ankle = joints[:, J[f"{side}_ankle"]]
        planted = ankle[:, 2] < body.ankle_height + 1e-9
        still = planted[1:] & planted[:-1]
        # Between planted frames nothing moves; at least this share of the time a foot is flat.
        assert np.abs(np.diff(ankle, axis=0)[still]).max() < 1e-9
        assert planted.mean() > least


def test_walkers_have_a_foot_on_the_ground_and_runners_fly():
    for speed, flies in ((1.0, False), (4.0, True)):
        body, joints = walked(speed)
        lowest = joints[:, [J["left_ankle"], J["right_ankle"]], 2].min(axis=1)
        # A heel that rises while the ball of the foot stays lifts the ankle by up to 6 cm.
        assert (lowest.max() > body.ankle_height + 0.06) == flies


def test_the_ground_lifts_everything_on_it():
    _, low = walked(2.5)
    _, high = walked(2.5, ground=lambda x, y: 0.0 * x + 0.3)
    # Equal but for rounding of sums below 100 m.
    np.testing.assert_allclose(high - low, [[[0.0, 0.0, 0.3]]] * np.ones(low.shape), atol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.0])
def test_left_is_left_and_front_is_front(heading):
    _, joints = walked(1.4, heading)
    leftward = np.array([-np.sin(heading), np.cos(heading), 0.0])
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    for part in ("shoulder", "hip", "ear", "eye"):
        across = joints[:, J[f"left_{part}"]] - joints[:, J[f"right_{part}"]]
        assert (across @ leftward > 0.0).all(), part
    nose = joints[:, J["nose"]] - joints[:, [J["left_ear"], J["right_ear"]]].mean(axis=1)
    assert (nose @ forward > 0.0).all()


@pytest.mark.parametrize("speed", SPEEDS)
def test_knees_bend_forward_and_elbows_too(speed):
    _, joints = walked(speed)
    for side in ("left", "right"):
        hip, knee, ankle = (joints[:, J[f"{side}_{part}"]] for part in ("hip", "knee", "ankle"))
        along = ankle - hip
        share = ((knee - hip) * along).sum(-1) / (along**2).sum(-1)
        assert ((knee - hip - share[:, None] * along)[:, 0] > 0.0).all()
        upper = joints[:, J[f"{side}_elbow"]] - joints[:, J[f"{side}_shoulder"]]
        lower = joints[:, J[f"{side}_wrist"]] - joints[:, J[f"{side}_elbow"]]
        assert (np.cross(upper, lower)[:, 1] < 0.0).all()  # turns from down to forward


@pytest.mark.parametrize("speed", SPEEDS)
def test_arms_swing_against_the_legs(speed):
    _, joints = walked(speed)
    for side in ("left", "right"):
        wrist = (joints[:, J[f"{side}_wrist"]] - joints[:, J[f"{side}_shoulder"]])[:, 0]
        ankle = (joints[:, J[f"{side}_ankle"]] - joints[:, J[f"{side}_hip"]])[:, 0]
        assert np.corrcoef(wrist, ankle)[0, 1] < -0.8


@pytest.mark.parametrize(("speed", "strides"), [(1.0, 0.91), (4.0, 1.39)])
def test_strides_come_faster_with_speed(speed, strides):
    _, joints = walked(speed)
    ahead = joints[:, J["left_ankle"], 0] - joints[:, J["left_hip"], 0]
    spectrum = np.abs(np.fft.rfft(ahead - ahead.mean(), 4096))
    # 6 s resolve frequencies to well within a twelfth of a stride.
    assert np.argmax(spectrum) * FPS / 4096 == pytest.approx(strides, abs=0.08)


def test_motion_is_smooth():
    _, joints = walked(4.0)
    # Measured 240 m/s^2, at the knees of a landing leg, as runners show; joints that jumped by a
    # centimetre between two samples would show 100 m/s^2 more for every such centimetre.
    assert np.abs(np.diff(joints, 2, axis=0)).max() * FPS**2 < 300.0


def test_bodies_are_as_tall_as_asked_and_of_human_proportions():
    rng = np.random.default_rng(0)
    bodies = [draw_body((1.70, 1.95), rng) for _ in range(300)]
    heights = np.array([body.height for body in bodies])
    assert heights.min() >= 1.70
    assert heights.max() <= 1.95
    assert np.ptp(heights) > 0.23
    # Floor to top of the ears: ankle + leg + trunk + head, 93 % of the height give or take 2 %.
    eyes = [b.ankle_height + b.leg + b.trunk + 0.105 * b.height for b in bodies]
    np.testing.assert_allclose(np.array(eyes) / heights, 0.93, atol=0.06)
