import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.scenarios import SCENARIOS

FRAMES = 120


def captured(scale=1.0):
    """A person [cm, y up, facing z, left is x] who walks along z, swings limbs and leans."""
    time = np.arange(FRAMES) / 60.0
    root = np.stack([0.0 * time, 85.0 - 3.0 * np.sin(3.0 * time) ** 2, 120.0 * time], axis=-1)
    lean = 0.1 * np.cos(time)
    up = np.stack([0.0 * lean, np.cos(lean), np.sin(lean)], axis=-1)
    neck = root + 50.0 * up

    def hang(angle):
        return np.stack([0.0 * angle, -np.cos(angle), np.sin(angle)], axis=-1)

    joints = {"hip": root, "neck": neck, "head": neck + 15.0 * up, "head_end": neck + 16.0 * up}
    for side, sign in (("l", 1.0), ("r", -1.0)):
        thigh, arm = 0.5 * sign * np.sin(5.0 * time), 0.4 * sign * np.cos(5.0 * time)
        joints[f"{side}Thigh"] = root + [9.0 * sign, 0.0, 0.0]
        joints[f"{side}Shin"] = joints[f"{side}Thigh"] + 40.0 * hang(thigh)
        joints[f"{side}Foot"] = joints[f"{side}Shin"] + 41.0 * hang(thigh - 0.6)
        joints[f"{side}Shldr"] = neck + [18.0 * sign, 0.0, 0.0]
        joints[f"{side}ForeArm"] = joints[f"{side}Shldr"] + 28.0 * hang(arm)
        joints[f"{side}Hand"] = joints[f"{side}ForeArm"] + 26.0 * hang(arm + 0.8)
    return {name: scale * place for name, place in joints.items()}


def save(path, joints):
    positions = np.stack(list(joints.values()), axis=1)
    np.savez(path, joints=positions, joint_names=np.array(list(joints)), fps=60.0)
    return path


@pytest.fixture
def file(tmp_path):
    return save(tmp_path / "walk.npz", captured())


def test_a_joint_or_rate_that_is_missing_is_named(tmp_path):
    joints = captured()
    joints["elbow"] = joints.pop("lForeArm")
    with pytest.raises(InputError, match="left elbow"):
        read_clip(save(tmp_path / "clip.npz", joints))
    np.savez(tmp_path / "bad.npz", joints=np.zeros((9, 2, 3)))
    with pytest.raises(InputError, match="fps"):
        read_clip(tmp_path / "bad.npz")


TIME = np.arange(0.0, 6.0, 0.1)


def tracked(path, **changes):
    """A person who runs along x at 4 m/s, and a standing one."""
    runner = np.stack([4.0 * TIME - 10.0, 0.0 * TIME + 5.0], axis=-1)
    keeper = np.tile([-50.0, 1.0], (len(TIME), 1))
    content = {"xy": np.stack([runner, keeper], axis=1), "time": TIME + 100.0, **changes}
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"xy": np.zeros((60, 2))}, "xy of shape"),
        ({"xy": np.full((60, 2, 2), np.nan)}, "0 people"),
        ({"time": None}, "neither time nor fps"),
        ({"xy": np.zeros((2, 2, 2)), "time": np.arange(2.0)}, "2 samples"),
        ({"time": np.zeros(60)}, "1 samples"),
        ({"xy": np.array([None])}, "pickled"),
    ],
)
def test_unusable_files_are_refused(tmp_path, changes, found):
    with pytest.raises(InputError, match=found):
        read_trajectories(tracked(tmp_path / "t.npz", **changes), 60.0)


def test_a_match_is_driven_by_them_and_its_id_names_the_file(tmp_path):
    file = tracked(tmp_path / "t.npz")
    spec = simulate_match(
        SCENARIOS["match"],
        1,
        tmp_path / "m",
        MatchOptions(duration=0.4, cameras=2, stills=False, video=False, trajectories=file),
    )
    assert spec.match_id.startswith("match-1-0.4s-2cameras-tracks")
    assert spec.clips[0].frame_count == 20
    with np.load(tmp_path / "m" / "reference" / "joints.npz") as truth:
        assert truth["joints"].shape == (20, 2, 17, 3)
