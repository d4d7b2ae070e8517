"""People of the second world: bones, feet, trajectories, recordings."""

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.foreign import FOREIGN_SCENARIOS, read_recordings, simulate_foreign_scene
from worldpose.simulation.foreign.gait import Manner, walk_posture
from worldpose.simulation.foreign.recordings import JOINTS, play_motion
from worldpose.simulation.foreign.skeletons import draw_skeleton, place_joints
from worldpose.simulation.foreign.trajectories import LEAD, follow_tracks, wander

FPS = 100.0
BONES = (
    *((5, 7), (7, 9), (6, 8), (8, 10), (5, 6), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16)),
    *((0, 1), (0, 2), (1, 2), (3, 4), (1, 3)),
)
PLAIN = Manner(lean=0.05, swing=1.0, elbow=0.0, splay=0.15, stride=1.0, sway=1.0, width=0.8)


def flat(x, y):
    return 0.0 * x


def straight(speed, seconds=3.0):
    times = np.arange(-1.0, seconds - 1.0, 1.0 / FPS)
    return times, np.stack([speed * times, 0.0 * times], axis=-1), np.zeros(len(times))


def walked(speed, kind="man", seed=0):
    skeleton = draw_skeleton(kind, np.random.default_rng(seed))
    times, root, heading = straight(speed)
    rng = np.random.default_rng(seed + 1)
    posture = walk_posture(times, root, heading, skeleton.leg, PLAIN, (), rng)
    return skeleton, posture, place_joints(skeleton, posture, root, heading, FPS, flat)


@pytest.mark.parametrize("kind", ["man", "woman", "child"])
@pytest.mark.parametrize("speed", [0.0, 1.3, 3.5, 7.5])
def test_bones_keep_their_lengths_and_are_the_skeletons(kind, speed):
    skeleton, _, joints = walked(speed, kind)
    for one, two in BONES:
        lengths = np.linalg.norm(joints[:, one] - joints[:, two], axis=-1)
        assert np.ptp(lengths) < 1e-9
    thigh = np.linalg.norm(joints[0, 11] - joints[0, 13])
    assert thigh == pytest.approx(skeleton.thigh[0], abs=1e-9)
    forearm = np.linalg.norm(joints[0, 8] - joints[0, 10])
    assert forearm == pytest.approx(skeleton.forearm[1], abs=1e-9)


@pytest.mark.parametrize("speed", [0.0, 0.4, 1.3, 3.5, 5.0, 7.5])
def test_planted_feet_stay_where_they_are_and_on_the_ground(speed):
    skeleton, posture, joints = walked(speed)
    ankles = joints[:, 15:17]
    both = posture.planted[1:] & posture.planted[:-1]
    steps = np.linalg.norm(np.diff(ankles, axis=0), axis=-1)
    assert both.any()
    assert steps[both].max() < 1e-9
    assert ankles[posture.planted][:, 2] == pytest.approx(skeleton.ankle, abs=1e-9)
    assert ankles[..., 2].min() > skeleton.ankle - 1e-9


def test_who_stands_has_both_feet_down_and_who_runs_leaves_the_ground():
    _, standing, _ = walked(0.0)
    assert standing.planted.all()
    skeleton, _, running = walked(5.0)
    highest = running[:, 15:17, 2].min(axis=1).max()
    assert highest > skeleton.ankle + 0.02


def test_hips_follow_the_way_that_is_asked_for():
    _, _, joints = walked(2.5)
    _, root, _ = straight(2.5)
    assert joints[:, 11:13].mean(axis=1)[:, :2] == pytest.approx(root, abs=1e-9)


def test_knees_bend_forward():
    for speed in (1.3, 5.0):
        _, _, joints = walked(speed)
        hip, knee, ankle = joints[:, 11], joints[:, 13], joints[:, 15]
        ahead = (knee - 0.5 * (hip + ankle))[:, 0]
        assert np.quantile(ahead, 0.02) > -0.02


def test_statures_and_proportions_vary_within_what_is_published():
    rng = np.random.default_rng(0)
    men = [draw_skeleton("man", rng) for _ in range(400)]
    women = [draw_skeleton("woman", rng) for _ in range(400)]
    assert np.mean([one.stature for one in men]) == pytest.approx(1.78, abs=0.015)
    assert np.std([one.stature for one in men]) == pytest.approx(0.075, abs=0.012)
    thigh = np.mean([one.thigh[0] / one.stature for one in men])
    assert thigh == pytest.approx(0.2425, abs=0.002)
    hips = [np.mean([one.hips / one.stature for one in kind]) for kind in (men, women)]
    assert hips[1] > hips[0]
    spread = np.std([one.upper_arm[0] / one.stature for one in men]) / 0.1618
    assert 0.025 < spread < 0.045


def test_people_by_social_forces_keep_clear_of_each_other():
    times = np.arange(-LEAD, 6.0, 0.02)
    roles = ["cross"] * 6 + ["duel", "roam"]
    area = np.array([8.0, 8.0])
    nearest = []
    for seed in range(4):
        trajectories = wander(times, roles, np.zeros(2), area, [], np.random.default_rng(seed))
        places = np.stack([trajectory.root for trajectory in trajectories], axis=1)
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        apart[:, np.arange(8), np.arange(8)] = np.inf
        nearest.append(apart.min())
        speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) / 0.02
        assert speed.max() < 9.0
        assert np.ptp(places, axis=0).max() > 2.0
    assert min(nearest) > 0.2
    assert min(nearest) < 0.8  # and still come close


def test_nobody_is_left_to_go_by_social_forces_where_all_replay_recordings():
    times = np.arange(-LEAD, 3.0, 0.02)
    assert wander(times, [], np.zeros(2), np.ones(2), [], np.random.default_rng(0)) == []


def test_a_tracked_player_is_followed_within_the_smoothing():
    clock = np.arange(0.0, 5.0, 0.1)
    xy = np.stack([3.0 * clock, 1.0 + 0.5 * clock], axis=-1)
    times = np.arange(-1.0, 4.5, 0.01)
    trajectory = follow_tracks(times, clock, xy, np.array([1.0, 2.0]), "test")
    inner = (times > 1.0) & (times < 3.5)
    assert trajectory.root[inner, 0] == pytest.approx(3.0 * times[inner], abs=0.02)
    assert trajectory.root[inner, 1] == pytest.approx(2.0 + times[inner], abs=0.02)
    assert trajectory.heading[inner] == pytest.approx(np.arctan2(1.0, 3.0), abs=0.01)


def write_motion(folder, frames=90):
    """Write a recording of a standing person who swings the left arm."""
    names = [options[0] for options in JOINTS.values()]
    places = {
        **{"neck": (0.0, 0.0, 1.45), "chest": (0.0, 0.0, 1.2), "head": (0.0, 0.0, 1.55)},
        **{"l": 1.0, "r": -1.0},
    }
    rows = {}
    for name, options in JOINTS.items():
        side, _, part = name.partition("_")
        if not part:
            rows[options[0]] = np.tile(places[name], (frames, 1))
            continue
        sign = 1.0 if side == "left" else -1.0
        out, height = {
            "shoulder": (0.18, 1.4),
            "elbow": (0.2, 1.12),
            "wrist": (0.2, 0.87),
            "hip": (0.09, 0.9),
            "knee": (0.09, 0.5),
            "ankle": (0.09, 0.09),
        }[part]
        rows[options[0]] = np.tile([0.0, sign * out, height], (frames, 1))
    swing = np.sin(np.linspace(0.0, 6.0, frames))
    rows["lHand"][:, 0] = 0.2 * swing
    joints = np.stack([rows[name] for name in names], axis=1)
    np.savez(folder / "stand.npz", joints=joints, joint_names=np.array(names), fps=30.0)


def test_a_recorded_motion_is_replayed_with_the_persons_bones(tmp_path):
    write_motion(tmp_path)
    motion = read_recordings(tmp_path).motions[0]
    skeleton = draw_skeleton("woman", np.random.default_rng(5))
    times = np.arange(-LEAD, 3.0, 0.01)
    place = np.array([3.0, -2.0])
    trajectory, posture = play_motion(motion, skeleton, times, place, np.random.default_rng(6))
    joints = place_joints(skeleton, posture, trajectory.root, trajectory.heading, 100.0, flat)
    for one, two in BONES:
        assert np.ptp(np.linalg.norm(joints[:, one] - joints[:, two], axis=-1)) < 1e-9
    assert joints[:, 11:13].mean(axis=1)[:, :2] == pytest.approx(np.tile(place, (500, 1)), abs=1e-6)
    assert posture.planted.all()
    wrists = np.ptp(joints[:, 9:11], axis=0).max(axis=-1)
    assert wrists.max() > 0.15  # one arm swings, whichever side it is now
    assert wrists.min() < 0.05
    # The nose is before the ears, on the side to which the knees point.
    front = np.stack(
        [np.cos(trajectory.heading), np.sin(trajectory.heading), 0.0 * trajectory.heading], axis=-1
    )
    assert ((joints[:, 0] - joints[:, 3:5].mean(axis=1)) * front).sum(-1).min() > 0.05


def test_matches_with_recordings_say_who_replays_what(tmp_path):
    write_motion(tmp_path)
    clock = np.arange(0.0, 12.0, 0.1)
    xy = np.stack([np.linspace(-20.0 + p, 20.0, len(clock)) for p in range(10)], axis=1)
    np.savez(tmp_path / "tracks.npz", xy=np.stack([xy, 0.3 * xy], axis=-1), time=clock)
    recordings = read_recordings(tmp_path)
    assert len(recordings.tracks) == 1
    sources = set()
    for seed in range(3):
        scene = simulate_foreign_scene(
            FOREIGN_SCENARIOS["foreign-match"],
            seed,
            duration=0.3,
            cameras=2,
            recordings=recordings,
        )
        sources |= {person.motion.split(",")[0] for person in scene.people}
        assert [one["motion"] for one in scene.record["people"]] == [
            person.motion for person in scene.people
        ]
    assert {"recording stand", "tracking tracks"} <= sources
    assert any(source.startswith("social forces") for source in sources)


@pytest.mark.parametrize("content", ["nothing", "pickle", "names", "shape"])
def test_recordings_that_cannot_be_used_are_refused(tmp_path, content):
    folder = tmp_path / "recordings"
    if content != "nothing":
        folder.mkdir()
    if content == "pickle":
        np.savez(folder / "a.npz", xy=np.array([{}], dtype=object))
    if content == "names":
        joints = np.zeros((20, 2, 3))
        np.savez(folder / "a.npz", joints=joints, joint_names=np.array(["a", "b"]), fps=30.0)
    if content == "shape":
        np.savez(folder / "a.npz", xy=np.zeros((20, 3, 2)), time=np.arange(19.0))
    with pytest.raises(InputError):
        read_recordings(folder)
