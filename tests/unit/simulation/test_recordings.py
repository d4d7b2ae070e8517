import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.scenarios import SCENARIOS

NAMES = ("hip", "neck", "head", "head_end", "elbow", "rForeArm")
SIDES = [f"{side}{name}" for side in "lr" for name in ("Thigh", "Shin", "Foot", "Shldr", "Hand")]


def test_a_joint_or_rate_that_is_missing_is_named(tmp_path):
    names = np.array([*NAMES, *SIDES])
    joints = np.zeros((9, len(names), 3))
    np.savez(tmp_path / "clip.npz", joints=joints, joint_names=names, fps=60.0)
    with pytest.raises(InputError, match="left elbow"):
        read_clip(tmp_path / "clip.npz")
    np.savez(tmp_path / "bad.npz", joints=joints[:, :2])
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
