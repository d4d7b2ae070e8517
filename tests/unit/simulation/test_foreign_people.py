"""People of the second world: bones, feet, trajectories, recordings."""

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.foreign.matches import simulate_foreign_scene
from worldpose.simulation.foreign.recordings import JOINTS, play_motion, read_recordings
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.foreign.skeletons import draw_skeleton, place_joints
from worldpose.simulation.foreign.trajectories import LEAD

BONES = (
    *((5, 7), (7, 9), (6, 8), (8, 10), (5, 6), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16)),
    *((0, 1), (0, 2), (1, 2), (3, 4), (1, 3)),
)


def flat(x, y):
    return 0.0 * x


def write_motion(folder, frames=90):
    """Write a recording of a standing person who swings the left arm."""
    names = [options[0] for options in JOINTS.values()]
    places = {
        "neck": (0.0, 0.0, 1.45),
        "head": (0.0, 0.0, 1.55),
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
