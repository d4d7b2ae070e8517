"""Joint angles of known poses come back from a .mot file, by pandas and by OpenSim."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.motion_capture import (
    OPENSIM_COORDINATES,
    opensim_coordinates,
    write_opensim_motion,
)

TOLERANCE_DEG = 1e-4
FORWARD, LEFT, UP = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
"""Axes of the body model in T-pose, in its own coordinates."""


@pytest.fixture(scope="module")
def model():
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
    """All angles as expected, those not named zero."""
    found = angles(model, poses)
    for name, value in found.items():
        if not name.startswith("pelvis_t") or name == "pelvis_tilt":
            assert value == pytest.approx(expected.get(name, 0.0), abs=TOLERANCE_DEG), name


# A standing person along the touch line's direction, +x of the world: facing +x, left is +y.
FACING_X = tuple(Rotation.from_euler("XYZ", [90.0, 90.0, 0.0], degrees=True).as_rotvec())


def lowered(**more):
    """The arms hang, as in the model's zero."""
    return {"left_shoulder": (FORWARD, -90.0), "right_shoulder": (FORWARD, 90.0), **more}


@pytest.mark.parametrize(
    ("joint", "turn", "name", "expected"),
    [
        # A thigh forward: about the axis to the left, by the left-handed sense.
        ("right_hip", (LEFT, -30.0), "hip_flexion_r", 30.0),
        ("left_hip", (LEFT, -30.0), "hip_flexion_l", 30.0),
        # A right thigh to the left, a left one to the right.
        ("right_hip", (FORWARD, 20.0), "hip_adduction_r", 20.0),
        ("left_hip", (FORWARD, -20.0), "hip_adduction_l", 20.0),
        # Toes inwards.
        ("right_hip", (UP, 10.0), "hip_rotation_r", 10.0),
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
def test_a_joint_that_bends_about_one_axis_has_that_angle(model, joint, turn, name, expected):
    check(model, body(FACING_X, **lowered(**{joint: turn})), **{name: expected})


def test_three_angles_of_a_hip_compose_in_the_models_order(model):
    # R = Rz(50) Rx(-20) Ry(15) in axes x forward, y up, z right.
    joint = [(-LEFT, 50.0), (FORWARD, -20.0), (UP, 15.0)]
    check(
        model,
        body(FACING_X, **lowered(right_hip=joint)),
        hip_flexion_r=50.0,
        hip_adduction_r=-20.0,
        hip_rotation_r=15.0,
    )


@pytest.mark.parametrize("heading", [0.0, 35.0, -170.0])
def test_the_pelvis_has_tilt_list_rotation_and_place(model, heading):
    # Ground axes of OpenSim: x as the world's, y up, z = -y of the world.
    order = Rotation.from_euler("ZXY", [8.0, -5.0, heading], degrees=True).as_matrix()
    y_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    axes = np.array([FORWARD, UP, -LEFT])  # rows: OpenSim's axes in the body's coordinates
    orient = Rotation.from_matrix(y_up.T @ order @ axes).as_rotvec()
    poses = body(orient, (10.0, 20.0, 1.0), **lowered())
    check(model, poses, pelvis_tilt=8.0, pelvis_list=-5.0, pelvis_rotation=heading)
    found = angles(model, poses)
    origin = np.array([found[f"pelvis_t{axis}"] for axis in "xyz"])
    middle = origin + order @ [-0.056276, -0.07849, 0.0]
    hips = model.joints(poses)[0, [1, 2]].mean(axis=0)
    np.testing.assert_allclose(middle, y_up @ hips, atol=1e-9)


def test_the_file_comes_back_from_pandas(model, tmp_path):
    turning = np.radians(np.linspace(0.0, 700.0, 60))
    upright = Rotation.from_rotvec(FACING_X)
    orient = (Rotation.from_rotvec(np.outer(turning, [0, 0, 1])) * upright).as_rotvec()
    poses = BodyParameters(
        np.zeros((1, 10)), orient, np.zeros((60, 69)), np.zeros((60, 3)) + [30.0, -20.0, 1.0]
    )
    coordinates = opensim_coordinates(model, poses)
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


def test_frames_without_a_body_are_refused(tmp_path):
    with pytest.raises(InputError, match="frames that all have a body"):
        write_opensim_motion(tmp_path / "p.mot", np.full((2, 27), np.nan), np.zeros(2), {})
    with pytest.raises(InputError, match="found no frames"):
        write_opensim_motion(tmp_path / "p.mot", np.zeros((0, 27)), np.zeros(0), {})
    assert not (tmp_path / "p.mot").exists()
