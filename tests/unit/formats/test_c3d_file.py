"""C3D, TRC, BVH and MOT files hold the joints and angles as other programs' readers find them."""

import dataclasses
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from data_contracts.conventions import COCO17, FEET
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.c3d_file import write_c3d
from worldpose.formats.joints_file import ExtraTracks, JointTracks, read_joints, write_joints
from worldpose.formats.motion_capture import (
    OPENSIM_COORDINATES,
    opensim_coordinates,
    write_markers,
    write_motion,
    write_opensim_motion,
)
from worldpose.simulation.recorded_files import read_bvh

NOTES = {"licence": "For tests alone.\n" + "A long line. " * 40, "kind": "mixed"}
FRAMES = np.array([100, 101, 102, 103, 105])


@pytest.fixture
def tracks():
    """Two people over five frames and a frame that both lack; the second has gaps."""
    joints = np.random.default_rng(0).uniform(-60.0, 60.0, (5, 2, 17, 3))
    joints[0, 1] = np.nan
    joints[2, 1, 5] = np.nan
    covariance = np.zeros((5, 2, 17, 3, 3)) + np.diag([1e-4, 4e-4, 4e-4])  # 17.3 mm in the mean
    views = np.full((5, 2, 17), 3)
    views[3, 1, 7] = 0  # filled
    return JointTracks(FRAMES, np.array([4, 9]), joints, covariance, views)


def expected(tracks, person):
    joints = np.full((6, 17, 3), np.nan)
    joints[FRAMES - 100] = tracks.joints[:, person]
    return joints


def test_ezc3d_finds_the_joints_within_a_tenth_of_a_millimetre(tracks, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(tmp_path / "p.c3d", tracks, 1, 50.0, NOTES)
    file = ezc3d.c3d(str(tmp_path / "p.c3d"))
    point, event = file["parameters"]["POINT"], file["parameters"]["EVENT"]
    assert point["LABELS"]["value"] == list(COCO17)
    assert point["UNITS"]["value"] == ["mm"]
    assert (point["RATE"]["value"], file["header"]["points"]["frame_rate"]) == ([50.0], 50.0)
    points = file["data"]["points"][:3].transpose(2, 1, 0) / 1000.0
    np.testing.assert_allclose(points, expected(tracks, 1), atol=1e-4)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    assert residuals[0].tolist() == residuals[4].tolist() == [-1.0] * 17
    assert (residuals[2, 5], residuals[3, 7]) == (-1.0, 0.0)
    assert event["LABELS"]["value"] == ["Clip begin", "Clip end"]
    np.testing.assert_allclose(event["TIMES"]["value"], [[0.0, 0.0], [0.0, 0.1]], atol=1e-6)
    about = file["parameters"]["WORLDPOSE"]
    assert about["KIND"]["value"] == ["mixed"]
    assert " ".join(about["LICENCE"]["value"]).split() == NOTES["licence"].split()


def test_what_the_format_cannot_hold_is_refused(tracks, tmp_path):
    path = tmp_path / "p.c3d"
    with pytest.raises(InputError, match=r"WORLDPOSE:LICENCE: expected a text of at most 255"):
        write_c3d(path, tracks, 0, 50.0, {"licence": "word " * 5000})
    long = JointTracks(np.array([0, 1 << 24]), np.array([4]), np.zeros((2, 1, 17, 3)))
    with pytest.raises(InputError, match=r"expected 1 to 16777216 frames.*found 16777217"):
        write_c3d(path, long, 0, 50.0, {})
    none = JointTracks(np.zeros(0, np.int64), np.array([4]), np.zeros((0, 1, 17, 3)))
    with pytest.raises(InputError, match="found 0"):
        write_c3d(path, none, 0, 50.0, {})
    assert not path.exists()


def test_a_long_clip_counts_its_frames_beyond_16_bits(tmp_path):
    c3d = pytest.importorskip("c3d")
    count = 65_537
    joints = np.zeros((count, 1, 17, 3))
    joints[-1] = 1.5
    long = JointTracks(np.arange(count), np.array([4]), joints)
    write_c3d(tmp_path / "p.c3d", long, 0, 50.0, {})
    with (tmp_path / "p.c3d").open("rb") as file:
        reader = c3d.Reader(file)
        assert (reader.first_frame, reader.last_frame) == (1, count)
        start = 512 * (reader.header.data_block - 1)
    values = np.fromfile(tmp_path / "p.c3d", "<f4", offset=start)[: count * 17 * 4]
    np.testing.assert_allclose(
        values.reshape(count, 17, 4)[[0, -1], :, 0], [[0.0] * 17, [1500.0] * 17]
    )


FPS = 50.0


@pytest.fixture
def tracks_with_feet():
    """Two people over four frames; a toe of the second is missing in one of them."""
    rng = np.random.default_rng(0)
    shape = (4, 2, 6)
    feet = rng.uniform(-50.0, 50.0, (*shape, 3))
    feet[1, 1, 3] = np.nan
    views = np.full(shape, 3)
    views[2, 1, 5] = 0
    extra = ExtraTracks(FEET, feet, np.zeros((*shape, 3, 3)) + 4e-4 * np.eye(3), views)
    return JointTracks(
        np.arange(100, 104),
        np.array([4, 9]),
        rng.uniform(-50.0, 50.0, (4, 2, 17, 3)),
        np.zeros((4, 2, 17, 3, 3)) + 1e-4 * np.eye(3),
        np.full((4, 2, 17), 5),
        extra,
    )


def test_a_joints_file_keeps_them(tracks_with_feet, tmp_path):
    write_joints(tmp_path / "a.npz", tracks_with_feet)
    back = read_joints(tmp_path / "a.npz").extra
    assert back.points == FEET
    for name in ("joints", "covariance", "views"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tracks_with_feet.extra, name))
    bare = replace(
        tracks_with_feet, extra=replace(tracks_with_feet.extra, covariance=None, views=None)
    )
    write_joints(tmp_path / "b.npz", bare)
    back = read_joints(tmp_path / "b.npz").extra
    assert back.covariance is None and back.views is None


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"points": ("nose", *FEET[1:])}, "none of COCO-17"),
        ({"points": (FEET[1], *FEET[1:])}, "each name once"),
        ({"joints": np.zeros((4, 2, 5, 3))}, "extra_joints"),
        ({"views": np.zeros((4, 2, 6, 1), int)}, "extra_views"),
        ({"joints": np.full((4, 2, 6, 3), [np.nan, 0.0, 0.0])}, "extra_joints.*all of x, y, z or"),
    ],
)
def test_wrong_points_are_refused(tracks_with_feet, change, word):
    with pytest.raises(InputError, match=word):
        replace(tracks_with_feet, extra=replace(tracks_with_feet.extra, **change))


def test_names_without_points_are_refused(tracks_with_feet, tmp_path):
    write_joints(tmp_path / "a.npz", tracks_with_feet)
    with np.load(tmp_path / "a.npz") as file:
        arrays = {name: file[name] for name in file if name != "extra_joints"}
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(InputError, match="one without the other"):
        read_joints(tmp_path / "b.npz")


def test_c3d_has_them_as_points(tracks_with_feet, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(tmp_path / "p.c3d", tracks_with_feet, 1, FPS, {})
    file = ezc3d.c3d(str(tmp_path / "p.c3d"))
    assert file["parameters"]["POINT"]["LABELS"]["value"] == [*COCO17, *FEET]
    points = file["data"]["points"][:3, 17:].transpose(2, 1, 0) / 1000.0
    np.testing.assert_allclose(points, tracks_with_feet.extra.joints[:, 1], atol=1e-4)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    assert (residuals[1, 20], residuals[2, 22]) == (-1.0, 0.0)


def read_trc(path):
    """Frames, times, marker names and coordinates of a TRC file, NaN for empty cells."""
    lines = path.read_text().split("\n")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    names = lines[3].split("\t")[2::3]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:-1]]
    cells = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    assert cells.shape == (int(header["NumFrames"]), 2 + 3 * int(header["NumMarkers"]))
    return header, names, cells[:, 0], cells[:, 1], cells[:, 2:].reshape(len(cells), -1, 3)


@pytest.fixture
def tracks_with_gaps():
    joints = np.random.default_rng(0).uniform(-50.0, 50.0, (6, 2, 17, 3))
    joints[0, 1] = np.nan  # not there yet
    joints[3, 1, 5] = np.nan  # one joint lost
    joints[4, 1] = np.nan  # lost
    frames = np.array([100, 101, 102, 103, 104, 106])
    return JointTracks(frames, np.array([4, 9]), joints)


def test_joints_come_back_in_millimetres_with_y_up(tracks_with_gaps, tmp_path):
    write_markers(tmp_path / "p.trc", tracks_with_gaps, 1, 50.0)
    header, names, frames, times, markers = read_trc(tmp_path / "p.trc")
    assert (header["Units"], header["DataRate"], header["OrigDataStartFrame"]) == ("mm", "50", "1")
    assert tuple(names) == COCO17
    assert frames.tolist() == [102, 103, 104, 105, 106, 107]
    # The format's own rule: the time of frame f is (f - OrigDataStartFrame) / DataRate.
    np.testing.assert_allclose(times, (frames - 1) / 50.0, atol=1e-9)
    expected = np.full((6, 17, 3), np.nan)
    expected[[0, 1, 2, 3, 5]] = tracks_with_gaps.joints[1:, 1]
    back = np.stack([markers[..., 0], -markers[..., 2], markers[..., 1]], axis=-1) / 1000.0
    # Written to a micrometre.
    np.testing.assert_allclose(back, expected, atol=5.1e-7)


MOTION_FRAMES = 40


def motion(seed=0):
    rng = np.random.default_rng(seed)
    return BodyParameters(
        rng.standard_normal((1, 10)),
        rng.uniform(-3.0, 3.0, (MOTION_FRAMES, 3)),
        rng.uniform(-1.5, 1.5, (MOTION_FRAMES, 69)),
        rng.uniform(-50.0, 50.0, (MOTION_FRAMES, 3)),
    )


def joints_of(path):
    """The capture's 24 joints in SMPL's order, world metres."""
    capture = read_bvh(path)
    places = [capture.names.index(name) for name in SKELETONS["smpl24"]]
    x, y, z = np.moveaxis(capture.positions[:, places], -1, 0)
    return np.stack([x, -z, y], axis=-1) / 100.0, capture


def test_the_24_joints_come_back_within_a_tenth_of_a_millimetre(model, tmp_path):
    poses = motion()
    write_motion(tmp_path / "p.bvh", model, poses, 50.0)
    joints, capture = joints_of(tmp_path / "p.bvh")
    assert capture.fps == pytest.approx(50.0)
    # Angles and places are written to 1e-6 degrees and centimetres: below a micrometre.
    np.testing.assert_allclose(joints, model.joints(poses), atol=1e-6)


def test_a_turning_persons_angles_do_not_jump(model, tmp_path):
    turning = np.linspace(0.0, 4.0 * np.pi, MOTION_FRAMES)
    poses = BodyParameters(
        np.zeros((1, 10)),
        np.outer(turning, [0.0, 1.0, 0.0]),
        np.zeros((MOTION_FRAMES, 69)),
        np.zeros((MOTION_FRAMES, 3)),
    )
    write_motion(tmp_path / "p.bvh", model, poses, 25.0)
    rows = (tmp_path / "p.bvh").read_text().split("\n")[-MOTION_FRAMES - 1 : -1]
    channels = np.array([row.split() for row in rows], dtype=float)
    # Two turns in 39 steps are 18.5 degrees each.
    assert np.abs(np.diff(channels[:, 3:], axis=0)).max() < 19.0


TOLERANCE_DEG = 1e-4
FORWARD, LEFT, UP = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
"""Axes of the body model in T-pose, in its own coordinates."""


@pytest.fixture(scope="module")
def straight_model():
    """The open body with legs that hang vertically in the T-pose: all its angles are known."""
    straight = dataclasses.replace(load_open_body())
    joints = straight.joint_template.copy()
    for hip, knee, ankle in ((1, 4, 7), (2, 5, 8)):
        joints[knee] = joints[hip] - [0.0, 0.4, 0.0]
        joints[ankle] = joints[hip] - [0.0, 0.8, 0.0]
    straight.__dict__["joint_template"] = joints
    return straight


def body(orient=(np.pi / 2, 0.0, 0.0), place=(0.0, 0.0, 0.0), **rotations):
    """One frame with rotations about axes of the T-pose: joint=(axis, degrees) or a list."""
    pose = np.zeros((24, 3))
    for joint, turns in rotations.items():
        whole = Rotation.identity()
        for axis, degrees in [turns] if isinstance(turns, tuple) else turns:
            whole = whole * Rotation.from_rotvec(np.radians(degrees) * axis)
        pose[SKELETONS["smpl24"].index(joint)] = whole.as_rotvec()
    return BodyParameters(
        np.zeros((1, 10)), np.array([orient]), pose[None, 1:].reshape(1, 69), np.array([place])
    )


def angles(model, poses, frame=0):
    return dict(zip(OPENSIM_COORDINATES, opensim_coordinates(model, poses)[frame], strict=True))


def check(model, poses, **expected):
    found = angles(model, poses)
    for name, value in found.items():
        if not name.startswith("pelvis_t") or name == "pelvis_tilt":
            assert value == pytest.approx(expected.get(name, 0.0), abs=TOLERANCE_DEG), name


# A standing person along the touch line's direction, +x of the world: facing +x, left is +y.
FACING_X = tuple(Rotation.from_euler("XYZ", [90.0, 90.0, 0.0], degrees=True).as_rotvec())


def lowered(**more):
    return {"left_shoulder": (FORWARD, -90.0), "right_shoulder": (FORWARD, 90.0), **more}


@pytest.mark.parametrize(
    ("joint", "turn", "name", "expected"),
    [
        # A thigh forward: about the axis to the left, by the left-handed sense.
        ("left_hip", (LEFT, -30.0), "hip_flexion_l", 30.0),
        # A left thigh to the right.
        ("left_hip", (FORWARD, -20.0), "hip_adduction_l", 20.0),
        # Toes inwards.
        ("left_hip", (UP, -10.0), "hip_rotation_l", 10.0),
        # A heel to the buttocks.
        ("right_knee", (LEFT, 70.0), "knee_angle_r", 70.0),
        ("left_knee", (LEFT, 70.0), "knee_angle_l", 70.0),
        # Toes up.
        ("right_ankle", (LEFT, -15.0), "ankle_angle_r", 15.0),
        ("left_ankle", (LEFT, -15.0), "ankle_angle_l", 15.0),
        # Backwards, to the right, to the left about the vertical.
        ("spine2", (LEFT, -25.0), "lumbar_extension", 25.0),
        ("spine1", (FORWARD, 12.0), "lumbar_bending", 12.0),
        ("spine3", (UP, 18.0), "lumbar_rotation", 18.0),
    ],
)
def test_a_joint_that_bends_about_one_axis_has_that_angle(
    straight_model, joint, turn, name, expected
):
    check(straight_model, body(FACING_X, **lowered(**{joint: turn})), **{name: expected})


def test_three_angles_of_a_hip_compose_in_the_models_order(straight_model):
    # R = Rz(50) Rx(-20) Ry(15) in axes x forward, y up, z right.
    joint = [(-LEFT, 50.0), (FORWARD, -20.0), (UP, 15.0)]
    check(
        straight_model,
        body(FACING_X, **lowered(right_hip=joint)),
        hip_flexion_r=50.0,
        hip_adduction_r=-20.0,
        hip_rotation_r=15.0,
    )


@pytest.mark.parametrize("heading", [0.0, 35.0, -170.0])
def test_the_pelvis_has_tilt_list_rotation_and_place(straight_model, heading):
    # Ground axes of OpenSim: x as the world's, y up, z = -y of the world.
    order = Rotation.from_euler("ZXY", [8.0, -5.0, heading], degrees=True).as_matrix()
    y_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    axes = np.array([FORWARD, UP, -LEFT])  # rows: OpenSim's axes in the body's coordinates
    orient = Rotation.from_matrix(y_up.T @ order @ axes).as_rotvec()
    poses = body(orient, (10.0, 20.0, 1.0), **lowered())
    check(straight_model, poses, pelvis_tilt=8.0, pelvis_list=-5.0, pelvis_rotation=heading)
    found = angles(straight_model, poses)
    origin = np.array([found[f"pelvis_t{axis}"] for axis in "xyz"])
    middle = origin + order @ [-0.056276, -0.07849, 0.0]
    hips = straight_model.joints(poses)[0, [1, 2]].mean(axis=0)
    np.testing.assert_allclose(middle, y_up @ hips, atol=1e-9)


def test_the_file_comes_back_from_pandas(straight_model, tmp_path):
    turning = np.radians(np.linspace(0.0, 700.0, 60))
    upright = Rotation.from_rotvec(FACING_X)
    orient = (Rotation.from_rotvec(np.outer(turning, [0, 0, 1])) * upright).as_rotvec()
    poses = BodyParameters(
        np.zeros((1, 10)), orient, np.zeros((60, 69)), np.zeros((60, 3)) + [30.0, -20.0, 1.0]
    )
    coordinates = opensim_coordinates(straight_model, poses)
    times = np.arange(60) / 50.0 + 3.0
    write_opensim_motion(tmp_path / "p.mot", coordinates, times, {"licence": "For\n tests."})
    lines = (tmp_path / "p.mot").read_text().split("\n")
    assert lines[:5] == ["Coordinates", "version=1", "nRows=60", "nColumns=28", "inDegrees=yes"]
    assert lines[5:7] == ["licence=For tests.", "endheader"]
    table = pd.read_csv(tmp_path / "p.mot", sep="\t", skiprows=7)
    assert list(table.columns) == ["time", *OPENSIM_COORDINATES]
    np.testing.assert_allclose(table.to_numpy()[:, 1:], coordinates, atol=5.1e-6)
    # Two turns in 59 steps, without a jump of 360 degrees.
    np.testing.assert_allclose(np.diff(table.pelvis_rotation), 700.0 / 59, atol=1e-4)


@pytest.mark.parametrize(("frames", "told"), [(2, "that all have a body"), (0, "found no frames")])
def test_frames_without_a_body_are_refused(tmp_path, frames, told):
    with pytest.raises(InputError, match=told):
        write_opensim_motion(
            tmp_path / "p.mot", np.full((frames, 27), np.nan), np.zeros(frames), {}
        )
    assert not (tmp_path / "p.mot").exists()
