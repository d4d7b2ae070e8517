"""Joint angles of a body as a motion file (.mot) of OpenSim, named as in Rajagopal's model."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body import SKELETONS, BodyModel, BodyParameters
from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.formats.motion_capture import Y_UP, zxy_angles
from worldpose.geometry import Rigid

BODY_AXES: Final = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation from the axes of the body model in T-pose (x left, y up, z forward) to those of
OpenSim's bodies (x forward, y up, z right)."""
LOWERED: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of the right arm from hanging, OpenSim's zero, to the T-pose: -90 degrees about x."""
MIRROR: Final = np.diag([1.0, 1.0, -1.0])
"""Reflection in the body's sagittal plane: a left limb's angles are those of its mirror image."""
MID_HIP_M: Final = np.array([-0.056276, -0.07849, 0.0])
"""Middle of the hips from the pelvis's origin in the unscaled model [m], pelvis axes."""
DECIMALS: Final = 5
"""Of degrees, metres and seconds."""
COORDINATES: Final = (
    *("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz"),
    *("hip_flexion_r", "hip_adduction_r", "hip_rotation_r", "knee_angle_r", "ankle_angle_r"),
    *("hip_flexion_l", "hip_adduction_l", "hip_rotation_l", "knee_angle_l", "ankle_angle_l"),
    *("lumbar_extension", "lumbar_bending", "lumbar_rotation"),
    *("arm_flex_r", "arm_add_r", "arm_rot_r", "elbow_flex_r"),
    *("arm_flex_l", "arm_add_l", "arm_rot_l", "elbow_flex_l"),
)
"""Columns after `time`."""
CONVENTION: Final = (
    "OpenSim, coordinates of Rajagopal et al. (2016): body axes x forward, y up, z right; order of "
    "rotations z, x, y; ground y up; zero: body model's T-pose, arms and bones of legs hang down"
)
_JOINT: Final = {name: index for index, name in enumerate(SKELETONS["smpl24"])}


def opensim_coordinates(model: BodyModel, poses: BodyParameters) -> Floats:
    """Return the values of `COORDINATES` (frames, 27) [deg, m] for one person's poses (frames,).

    An angle is the one that the rotation of the child relative to its parent has in Rajagopal's
    order, z then x then y. The trunk is the pelvis's rotation to `spine3`, the arm the rotation
    from there to the upper arm, collar included. The axes of thighs and shanks are turned so that
    their bones, which lean by some degrees in the T-pose, hang along -y at zero. Knees, ankles and
    elbows have one coordinate: their rotation about z, of the same order; the rest of it is left
    out. The pelvis's place is such that the middle of the hips of the unscaled model is that of the
    body.
    """
    rest = (model.joint_template + model.joint_directions @ poses.betas[0]) @ BODY_AXES.T
    turns = model.articulate(poses).local_rotations
    relative = BODY_AXES @ turns @ BODY_AXES.T
    pelvis = Y_UP @ Rigid.from_rotvec(poses.global_orient, np.zeros(3)).rotation @ BODY_AXES.T

    def turn(*names: str) -> Floats:
        """Return the rotation of a chain of joints, from the first's parent to the last."""
        whole = np.broadcast_to(np.eye(3), pelvis.shape)
        for name in names:
            whole = whole @ relative[:, _JOINT[name]]
        return whole

    hips = model.joints(poses)[:, [_JOINT["left_hip"], _JOINT["right_hip"]]].mean(axis=1)
    place = hips @ Y_UP.T - pelvis @ MID_HIP_M
    columns = {}
    for side, mirror in (("right", np.eye(3)), ("left", MIRROR)):
        arm = mirror @ turn(f"{side}_collar", f"{side}_shoulder") @ mirror @ LOWERED
        elbow = LOWERED.T @ mirror @ turn(f"{side}_elbow") @ mirror @ LOWERED
        hip, knee, ankle = (
            mirror @ turn(f"{side}_{name}") @ mirror for name in ("hip", "knee", "ankle")
        )
        places = [rest[_JOINT[f"{side}_{name}"]] @ mirror for name in ("hip", "knee", "ankle")]
        thigh, shank = (_hanging_axes(b - a) for a, b in pairwise(places))
        hip, knee, ankle = hip @ thigh, thigh.T @ knee @ shank, shank.T @ ankle
        # Knees bend backwards: about -z, as the model counts flexion.
        leg = [_angles(hip), -_angles(knee)[:, :1], _angles(ankle)[:, :1]]
        columns[side] = (leg, [_angles(arm), _angles(elbow)[:, :1]])
    trunk = _angles(turn("spine1", "spine2", "spine3"))
    parts = [_angles(pelvis), place, *columns["right"][0], *columns["left"][0], trunk]
    return np.concatenate([*parts, *columns["right"][1], *columns["left"][1]], axis=-1)


def _hanging_axes(bone: Floats) -> Floats:
    """Return the smallest rotation (3, 3) of -y to the direction of a bone."""
    down, along = np.array([0.0, -1.0, 0.0]), bone / np.linalg.norm(bone)
    axis = np.cross(down, along)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, down @ along)
    turned = Rigid.from_rotvec(axis * (angle / max(sine, 1e-12)), np.zeros(3))
    matrix: Floats = turned.rotation
    return matrix


def write_opensim_motion(
    path: Path, coordinates: Floats, times: Floats, notes: Mapping[str, str]
) -> None:
    """Write coordinates over time as a .mot file, whole or not at all.

    Args:
        path: the file.
        coordinates: (frames, 27) [deg, m], as `opensim_coordinates` returns them.
        times: (frames,) [s].
        notes: texts of the header, one line each.

    Raises:
        InputError: there are no frames, or a value is missing.
    """
    if not len(coordinates) or not np.isfinite(coordinates).all():
        raise InputError(
            str(path),
            expected="frames that all have a body",
            found=f"{len(coordinates)} frames, some without" if len(coordinates) else "no frames",
            todo="Write a file for each uninterrupted interval.",
        )
    rows = np.column_stack([times, coordinates])
    lines = [
        "Coordinates",
        "version=1",
        f"nRows={len(rows)}",
        f"nColumns={rows.shape[1]}",
        "inDegrees=yes",
        *(f"{name}={' '.join(text.split())}" for name, text in notes.items()),
        "endheader",
        "\t".join(["time", *COORDINATES]),
    ]
    lines += ["\t".join(row) for row in np.char.mod(f"%.{DECIMALS}f", rows).tolist()]
    with whole_file(path) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _angles(rotation: Floats) -> Floats:
    """Return angles (frames, 3) [deg] about z, x and y, without jumps from frame to frame."""
    angles: Floats = np.unwrap(np.degrees(zxy_angles(rotation)), axis=0, period=360.0)
    return angles
