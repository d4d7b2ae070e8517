from dataclasses import replace

import numpy as np
import pytest
from rigid_bones import RIGID_BONES

from data_contracts.conventions import COCO17
from worldpose.simulation.falls import dive, fall, slide
from worldpose.simulation.gait import walk
from worldpose.simulation.motions import GRAVITY, Action, jump, kick
from worldpose.simulation.paths import (
    MARGIN,
    STEP,
    GroundPath,
    hands_on_hips,
    look_around,
    ready,
    shift_weight,
)
from worldpose.simulation.skeletons import draw_body

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


ANKLES = [J["left_ankle"], J["right_ankle"]]
HIPS = [J["left_hip"], J["right_hip"]]
FPS_ACTIONS = 200.0
BEGIN = 1.0

ACTIONS = {
    "header": (jump(0.4), 1.2),
    "hurdle": (jump(0.3, hurdle=True), 2.4),
    "shot": (kick(1.0), 3.0),
    "pass": (kick(0.4), 1.5),
    "fall": (fall(), 4.0),
    "slide": (slide(), 5.5),
    "dive": (dive(1.8), 0.0),
    "high dive": (dive(2.2), 0.0),
    "shift": (shift_weight(4.0), 0.0),
    "look": (look_around(3.0), 0.0),
    "hands on hips": (hands_on_hips(4.0), 0.0),
    "ready": (ready(4.0), 0.0),
}


def way(motion, speed, left):
    """A path along x that fits the motion: it stops and, for a flight, moves sideways."""
    time = np.arange(round((6.0 + 2 * MARGIN) / STEP) + 1) * STEP - MARGIN
    speeds, aside = np.full(len(time), speed), np.zeros(len(time))
    if motion.stops is not None:
        since = time - BEGIN
        speeds = np.maximum(speed - 5.0 * np.maximum(since - motion.stops, 0.0), 0.0)
        again = 2.0 * np.maximum(since - motion.moves_again, 0.0)
        speeds = np.where(since > motion.moves_again, np.minimum(again, speed), speeds)
        if motion.flight is not None:
            knots = [0.2, 0.5, motion.stops, motion.stops + 0.6]
            aside = np.interp(since, knots, [0.0, 3.3, 3.3, 0.0]) * (1.0 if left else -1.0)
    place = np.stack([speeds, aside], axis=-1).cumsum(axis=0) * STEP
    return GroundPath(time, place, np.zeros(len(time)), np.hypot(speeds, aside))


def acted(name, left=True, seed=0, ground=flat):
    motion, speed = ACTIONS[name]
    path = way(motion, speed, left)
    path = replace(path, actions=(Action(BEGIN, motion, left),))
    rng = np.random.default_rng(seed)
    body = draw_body((1.7, 1.95), rng)
    times = np.arange(0.5, BEGIN + motion.duration + 0.5, 1.0 / FPS_ACTIONS)
    return body, times, walk(body, path, times, ground, rng)


@pytest.fixture(scope="module")
def played():
    return {name: acted(name) for name in ACTIONS}


@pytest.mark.parametrize("name", ACTIONS)
def test_bones_keep_their_lengths_in_every_action(name, played):
    _, _, joints = played[name]
    for a, b in RIGID_BONES:
        length = np.linalg.norm(joints[:, a] - joints[:, b], axis=-1)
        assert np.ptp(length) < 1e-12, (COCO17[a], COCO17[b])  # rounding at 30 m


@pytest.mark.parametrize("name", ACTIONS)
@pytest.mark.parametrize("left", [True, False])
def test_nothing_is_in_the_ground(name, left):
    for seed in (1, 2, 3):
        _, _, joints = acted(name, left, seed)
        # Joint centres lie inside limbs 5 to 10 cm thick, and knees on turf sink a little.
        assert joints[..., 2].min() > 0.0, seed


@pytest.mark.parametrize("name", ACTIONS)
def test_joints_accelerate_as_in_sport_and_never_jump(name, played):
    _, _, joints = played[name]
    acceleration = np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1) * FPS_ACTIONS**2
    # A kicking foot reaches 20 m/s within 0.1 s and a runner's landing knee 250 m/s^2; measured up
    # to 620 m/s^2. A joint that jumped by 2 cm between two samples would show 800 m/s^2 more.
    assert acceleration.max() < 800.0


@pytest.mark.parametrize("name", ["header", "hurdle", "dive", "high dive"])
def test_flight_is_free(name, played):
    _, times, joints = played[name]
    off, land = ACTIONS[name][0].flight
    middle = joints[:, HIPS].mean(axis=1)
    flies = (times > BEGIN + off + 1.0 / FPS_ACTIONS) & (times < BEGIN + land - 1.0 / FPS_ACTIONS)
    fall_of_it = np.diff(middle[flies, 2], 2) * FPS_ACTIONS**2
    # Second differences of a parabola are its acceleration; rounding of 1e-15 m at 200 1/s.
    np.testing.assert_allclose(fall_of_it, -GRAVITY, atol=1e-6)
    # The path is sampled every 0.01 s and linear between, so pace is what is constant.
    pace = np.diff(middle[flies, :2], axis=0) * FPS_ACTIONS
    assert np.ptp(pace, axis=0).max() < 1e-6
    ankles = joints[flies][:, ANKLES, 2]
    assert ankles[len(ankles) // 2].min() > 0.15 if name != "dive" else True


@pytest.mark.parametrize("rise", [0.25, 0.45])
def test_a_jump_rises_as_asked(rise):
    motion = jump(rise)
    off, land = motion.flight
    assert land - off == pytest.approx(2.0 * np.sqrt(2.0 * rise / GRAVITY))
    path = replace(way(motion, 0.0, True), actions=(Action(BEGIN, motion),))
    rng = np.random.default_rng(0)
    body = draw_body((1.8, 1.8), rng)
    times = BEGIN + np.array([off, 0.5 * (off + land), land])
    height = walk(body, path, times, flat, rng)[:, HIPS, 2].mean(axis=1)
    np.testing.assert_allclose(height - height[0], [0.0, rise, 0.0], atol=1e-9)


@pytest.mark.parametrize("name", ACTIONS)
def test_planted_feet_stand_still_during_actions(name, played):
    body, _, joints = played[name]
    still = 0
    for ankle in ANKLES:
        place = joints[:, ankle]
        planted = np.abs(place[:, 2] - body.ankle_height) < 1e-12
        both = planted[1:] & planted[:-1]
        # Exactly on the ground is where a foot stands; nothing moves there but rounding.
        assert np.abs(np.diff(place, axis=0)[both]).max(initial=0.0) < 1e-9
        still += int(both.sum())
    assert still > 0.2 * len(joints)  # and feet do stand


@pytest.mark.parametrize("name", ACTIONS)
def test_before_and_after_an_action_the_gait_is_what_it_was(name):
    motion, speed = ACTIONS[name]
    path = way(motion, speed, True)
    times = np.array([BEGIN - 0.2, BEGIN, BEGIN + motion.duration, BEGIN + motion.duration + 0.2])
    walked, done = (
        walk(
            draw_body((1.8, 1.8), np.random.default_rng(0)),
            each,
            times,
            flat,
            np.random.default_rng(1),
        )
        for each in (path, replace(path, actions=(Action(BEGIN, motion),)))
    )
    np.testing.assert_allclose(done, walked, atol=1e-12)


@pytest.mark.parametrize("name", ["shot", "dive", "slide", "shift"])
def test_the_other_side_is_the_mirror_image(name):
    motion, _ = ACTIONS[name]
    joints = {}
    for left in (True, False):
        path = way(motion, 0.0, left)
        path = replace(path, actions=(Action(BEGIN, motion, left),))
        body = draw_body((1.8, 1.8), np.random.default_rng(0))
        times = BEGIN + np.linspace(0.1, motion.duration - 0.1, 30)
        joints[left] = walk(body, path, times, flat, np.random.default_rng(1))
    swap = [0, 2, 1, *(i + 1 if i % 2 else i - 1 for i in range(3, 17))]
    mirrored = joints[True][:, swap] * [1.0, -1.0, 1.0]
    # Heads look where they looked when an action begins; face and stride differ between people.
    np.testing.assert_allclose(joints[False][:, 5:11], mirrored[:, 5:11], atol=1e-9)


def test_a_kick_is_hip_before_knee_and_as_fast_as_kicks_are(played):
    _, times, joints = played["shot"]
    hit = BEGIN + ACTIONS["shot"][0].blow
    hip, knee, ankle = (joints[:, J[f"left_{part}"]] for part in ("hip", "knee", "ankle"))

    def turning(upper, lower):
        along = (lower - upper) / np.linalg.norm(lower - upper, axis=-1, keepdims=True)
        return np.linalg.norm(np.gradient(along, 1.0 / FPS_ACTIONS, axis=0), axis=-1)

    near = np.abs(times - hit) < 0.12
    thigh, shank = turning(hip, knee)[near], turning(knee, ankle)[near]
    assert times[near][thigh.argmax()] < times[near][shank.argmax()]
    # Skilled kickers: ankles 13 to 19 m/s, toes 16 to 22 m/s; shanks turn at 20 to 35 rad/s.
    speed = np.linalg.norm(np.gradient(ankle, 1.0 / FPS_ACTIONS, axis=0), axis=-1)
    assert 12.0 < speed[near].max() < 19.0
    assert abs(times[speed.argmax()] - hit) < 0.06
    assert 15.0 < shank.max() < 35.0
    arm = joints[:, J["right_wrist"]] - joints[:, J["right_shoulder"]]
    before, after = (np.argmin(np.abs(times - hit - late)) for late in (-0.15, 0.15))
    assert arm[after, 0] > arm[before, 0] + 0.2  # the other arm swings forward


def test_who_falls_lies_and_gets_up():
    body, times, joints = acted("fall")
    high = joints[:, HIPS, 2].mean(axis=1)
    lying = (times > BEGIN + 1.0) & (times < BEGIN + 1.4)
    assert high[lying].max() < 0.25
    assert joints[lying][:, :7, 2].max() < 0.6
    assert high[-1] > 0.85 * body.leg


def test_a_goalkeeper_dives_to_the_ball_with_arms_ahead():
    for left, sign in ((True, 1.0), (False, -1.0)):
        _, times, joints = acted("dive", left)
        reach = np.argmin(np.abs(times - BEGIN - ACTIONS["dive"][0].blow))
        wrist = joints[reach, 9 if left else 10]
        neck, hip = joints[reach, 5:7].mean(axis=0), joints[reach, HIPS].mean(axis=0)
        assert sign * (wrist[1] - neck[1]) > 0.2
        assert sign * (neck[1] - hip[1]) > 0.25  # the trunk is tilted by half a right angle or more


def test_hands_rest_on_the_hips():
    _, times, joints = acted("hands on hips")
    middle = np.argmin(np.abs(times - BEGIN - 2.0))
    for wrist, hip in ((9, 11), (10, 12)):
        # From joint centre to joint centre, past 10 cm of hip and half a hand.
        assert np.linalg.norm(joints[middle, wrist] - joints[middle, hip]) < 0.3


def test_a_goalkeeper_in_waiting_bends_his_knees_by_about_60_degrees():
    _, times, joints = acted("ready")
    middle = np.argmin(np.abs(times - BEGIN - 2.0))
    hip, knee, ankle = (joints[middle, J[f"left_{part}"]] for part in ("hip", "knee", "ankle"))
    thigh, shank = hip - knee, ankle - knee
    cosine = thigh @ shank / np.linalg.norm(thigh) / np.linalg.norm(shank)
    # 62 +- 18 degrees were measured in elite goalkeepers (docs/explanation/simulation.md).
    assert np.degrees(np.pi - np.arccos(cosine)) == pytest.approx(62.0, abs=18.0)


def test_actions_follow_the_ground():
    _, _, low = acted("fall")
    _, _, high = acted("fall", ground=lambda x, y: 0.0 * x + 0.3)
    # Equal but for rounding below 100 m.
    np.testing.assert_allclose(high - low, [[[0.0, 0.0, 0.3]]] * np.ones(low.shape), atol=1e-9)
