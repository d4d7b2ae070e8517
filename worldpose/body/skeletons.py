"""Named points of the body, and common keypoint sets.

Joints of the limbs are the model's own joints. Points of the face and feet are vertices, at the
vertex numbers that SMPL's users know (those of smplx); the open body has the same points at the
same numbers. So a hip is the centre of the joint, a little below and inside of annotated hips in
images.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from worldpose.errors import InputError

JOINT_NAMES: Final = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)
"""The model's joints in order."""

JOINT_OF_POINT: Final = MappingProxyType(
    {"mid_hip": 0} | {name: number for number, name in enumerate(JOINT_NAMES)}
)
VERTEX_OF_POINT: Final = MappingProxyType(
    {
        "nose": 332,
        "left_eye": 2800,
        "right_eye": 6260,
        "left_ear": 583,
        "right_ear": 4071,
        "left_big_toe": 3216,
        "left_small_toe": 3226,
        "left_heel": 3387,
        "right_big_toe": 6617,
        "right_small_toe": 6624,
        "right_heel": 6787,
    }
)

BODY25: Final = (
    "nose",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "mid_hip",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_eye",
    "left_eye",
    "right_ear",
    "left_ear",
    "left_big_toe",
    "left_small_toe",
    "left_heel",
    "right_big_toe",
    "right_small_toe",
    "right_heel",
)
"""OpenPose's 25 points in its order."""

EVALUATED14: Final = (
    "nose",
    "neck",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)
"""The joints that the paper scores (E4)."""

CHALLENGE15: Final = (
    "nose",
    "right_shoulder",
    "left_shoulder",
    "right_elbow",
    "left_elbow",
    "right_wrist",
    "left_wrist",
    "right_hip",
    "left_hip",
    "right_knee",
    "left_knee",
    "right_ankle",
    "left_ankle",
    "right_big_toe",
    "left_big_toe",
)
"""The joints of the FIFA skeletal tracking challenge in its order."""

SKELETONS: Final = MappingProxyType(
    {
        "coco17": COCO17,
        "body25": BODY25,
        "evaluated14": EVALUATED14,
        "challenge15": CHALLENGE15,
        "smpl24": JOINT_NAMES,
    }
)
"""The sets by name."""


def places_of(points: tuple[str, ...], skeleton: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the index of each of `points` in `skeleton` (points,).

    Raises:
        InputError: the skeleton lacks a point.
    """
    lacking = [point for point in points if point not in skeleton]
    if lacking:
        raise InputError(
            "skeleton",
            expected=f"the points {', '.join(points)}",
            found=f"none named {', '.join(lacking)}",
            todo="Take the points from a skeleton that has them, such as body25.",
        )
    return np.array([skeleton.index(point) for point in points], dtype=np.int64)
