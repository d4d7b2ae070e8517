"""Simulated matches: cameras, people, renderings, recordings, and the second world."""

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.joints_file import read_joints
from worldpose.formats.release_cameras import read_camera
from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.foreign.matches import simulate_foreign_match
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.recorded_files import read_bvh
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.scenarios import SCENARIOS

SHORT = 0.4


def quick(names, kept):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in kept)) for name in names]


@pytest.mark.parametrize("name", quick(SCENARIOS, {"hard", "tiny-broadcast"}))
def test_every_scenario_makes_a_match(name, tmp_path):
    scenario = SCENARIOS[name].model_copy(update={"duration": SHORT})
    options = MatchOptions(duration=SHORT, cameras=4, stills=False, video=False)
    spec = simulate_match(scenario, 2, tmp_path / name, options)
    read = read_match(tmp_path / name)
    assert read.spec == spec
    frames = round(SHORT * scenario.fps)
    views, static = read.spec.broadcast_views, [camera.id for camera in spec.static_cameras]
    assert len(views) == len(scenario.broadcast)
    for unit in (*static, *views):
        people, calibration = read_unit(read, unit)
        assert (calibration is not None) == (name == "hard" and unit in static)
        assert len(people.frame) == frames
    for clicks in (read.clicked[unit] for unit in static):
        assert len(clicks.points) + len(clicks.drawn) > 1
    for view in views:
        camera = np.load(tmp_path / name / "reference" / "cameras" / f"{view}.npz")
        assert camera["K"].shape == camera["R"].shape == (frames, 3, 3)


@pytest.mark.parametrize("name", quick(FOREIGN_SCENARIOS, {"foreign-mixed"}))
def test_every_foreign_scenario_makes_a_match_that_the_factory_takes(tmp_path, name):
    scenario, folder = FOREIGN_SCENARIOS[name], tmp_path / "match"
    spec = simulate_foreign_match(scenario, 7, folder, MatchOptions(duration=0.2))
    assert read_match(folder).spec == spec
    truth = read_joints(folder / "reference" / "joints.npz")
    assert np.isfinite(truth.joints).all()
    defined = read_joints(folder / "reference" / "defined_joints.npz")
    apart = np.linalg.norm(defined.joints - truth.joints, axis=-1)
    assert 0.01 < apart.mean() < 0.12
    for camera in spec.cameras:
        file = folder / "reference" / "cameras" / f"{camera.id}.npz"
        true = read_camera(file, (camera.width, camera.height))
        assert np.isfinite(true.project(truth.joints.reshape(-1, 3))).any()


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


ARM = """HIERARCHY
ROOT hip
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT upper
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT lower
    {
      OFFSET 0 0 5
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 2 0 0
      }
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.02
1 2 3 0 0 0  0 0 0  0 0 0
1 2 3 90 0 0  0 0 0  0 0 0
0 0 0 90 90 0  0 0 90  0 90 0
"""


def written(folder, text):
    path = folder / "clip.bvh"
    path.write_text(text)
    return path


def test_positions_are_those_worked_out_by_hand(tmp_path):
    capture = read_bvh(written(tmp_path, ARM))
    assert capture.names == ("hip", "upper", "lower", "lower_end")
    assert capture.fps == 50.0
    expected = [
        # Nothing turned: offsets add up.
        [[1, 2, 3], [1, 12, 3], [1, 12, 8], [3, 12, 8]],
        # A quarter turn about z takes y to -x and x to y.
        [[1, 2, 3], [-9, 2, 3], [-9, 2, 8], [-9, 4, 8]],
        # The root turns by Z then X: Rz Rx takes y to z, z to x and x to y, so (0, 10, 0) goes to
        # z. The upper joint's Ry takes z to x and x to -z, then the root x to y: (0, 0, 5) goes
        # along y. The lower's Rx leaves x, which Ry takes to -z and the root to -x.
        [[0, 0, 0], [0, 0, 10], [0, 5, 10], [-2, 5, 10]],
    ]
    np.testing.assert_allclose(capture.positions, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("HIERARCHY", "SKELETON", "'SKELETON' as word 1"),
        ("Frames: 3", "Frames: 4", "4 frames of 12 channels"),
        ("0.02", "0", "every 0 s"),
        ("OFFSET 0 10 0", "OFFSET 0 ten 0", "'ten'"),
        (
            "3 Zrotation Xrotation Yrotation",
            "3 Zrotation Xrotation Wrotation",
            "Wrotation of upper",
        ),
        ("1 2 3 0 0 0", "1 2 3 nan 0 0", "'nan'"),
        (ARM[ARM.index("lower") :], "", "ends too early"),
    ],
)
def test_what_is_wrong_is_said(old, new, found, tmp_path):
    with pytest.raises(InputError, match=found):
        read_bvh(written(tmp_path, ARM.replace(old, new, 1)))
