import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation import SCENARIOS, read_trajectories, simulate_match
from worldpose.simulation.paths import MARGIN

TIME = np.arange(0.0, 6.0, 0.1)


def tracked(path, **changes):
    """Somebody who runs along x at 4 m/s, and somebody who stands."""
    runner = np.stack([4.0 * TIME - 10.0, 0.0 * TIME + 5.0], axis=-1)
    keeper = np.tile([-50.0, 1.0], (len(TIME), 1))
    content = {"xy": np.stack([runner, keeper], axis=1), "time": TIME + 100.0, **changes}
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def test_paths_follow_the_data(tmp_path):
    (runner, keeper), length = read_trajectories(tracked(tmp_path / "t.npz"), 60.0)
    assert length == pytest.approx(5.9, abs=1e-9)
    assert runner.time[0] == pytest.approx(-MARGIN)
    assert runner.time[-1] == pytest.approx(length + MARGIN, abs=0.01)
    inner = (runner.time >= 0.5) & (runner.time <= 5.4)
    # Smoothing leaves a straight run as it is; its ends are coasted half a second further in.
    np.testing.assert_allclose(
        runner.position[inner],
        np.stack([4 * runner.time - 10, 0 * runner.time + 5], -1)[inner],
        atol=1e-3,
    )
    np.testing.assert_allclose(runner.speed[inner], 4.0, atol=0.01)
    np.testing.assert_allclose(runner.heading, 0.0, atol=1e-9)
    np.testing.assert_allclose(keeper.position, np.tile([-50.0, 1.0], (len(keeper.time), 1)))
    assert keeper.speed.max() < 1e-9


def test_people_come_to_a_stop_before_and_after_the_data(tmp_path):
    (runner, _), _ = read_trajectories(tracked(tmp_path / "t.npz"), 60.0)
    assert runner.speed[0] < 0.6
    assert runner.speed[-1] < 0.6
    assert np.abs(np.diff(runner.speed)).max() / 0.01 < 8.0  # [m/s^2]


def test_the_clip_is_no_longer_than_asked_and_people_no_more(tmp_path):
    paths, length = read_trajectories(tracked(tmp_path / "t.npz"), 2.0, most=1)
    assert length == pytest.approx(2.0, abs=1e-6)
    assert len(paths) == 1


def test_fps_stands_for_time(tmp_path):
    paths, length = read_trajectories(
        tracked(tmp_path / "t.npz", time=None, fps=np.array(10.0)), 60.0
    )
    assert (len(paths), round(length, 6)) == (2, 5.9)


def test_the_longest_stretch_is_used_and_who_is_in_all_of_it(tmp_path):
    xy = np.load(tracked(tmp_path / "t.npz"))["xy"]
    xy[40, 1] = np.nan
    segment = np.where(TIME < 1.95, 1, 2)
    paths, length = read_trajectories(tracked(tmp_path / "gap.npz", xy=xy, segment=segment), 60.0)
    assert len(paths) == 1
    assert length == pytest.approx(3.9, abs=1e-6)
    start = np.interp(0.0, paths[0].time, paths[0].position[:, 0])
    assert start == pytest.approx(-2.0, abs=0.3)  # where the runner is after 2 s


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"xy": np.zeros((60, 2))}, "xy of shape"),
        ({"xy": np.full((60, 2, 2), np.nan)}, "0 people"),
        ({"time": None}, "neither time nor fps"),
        ({"time": np.zeros(3)}, r"time \(3,\)"),
        ({"xy": np.zeros((2, 2, 2)), "time": np.arange(2.0)}, "2 samples"),
        ({"time": np.zeros(60)}, "1 samples"),
        ({"xy": np.array([None])}, "allow_pickle"),
    ],
)
def test_unusable_files_are_refused(tmp_path, changes, found):
    with pytest.raises(InputError, match=found):
        read_trajectories(tracked(tmp_path / "t.npz", **changes), 60.0)


def test_no_file_and_no_npz_are_refused(tmp_path):
    (tmp_path / "t.npz").write_text("hello")
    for name in ("t.npz", "absent.npz"):
        with pytest.raises(InputError):
            read_trajectories(tmp_path / name, 60.0)


def test_a_match_is_driven_by_them_and_its_id_names_the_file(tmp_path):
    file = tracked(tmp_path / "t.npz")
    spec = simulate_match(
        SCENARIOS["match"], 1, tmp_path / "m", duration=0.4, cameras=2, trajectories=file
    )
    assert spec.match_id.startswith("match-1-0.4s-2cameras-tracks")
    assert spec.clips[0].frame_count == 20
    with np.load(tmp_path / "m" / "reference" / "joints.npz") as truth:
        assert truth["joints"].shape == (20, 2, 17, 3)
