"""Frames, axes, units and joint names: the one record that ships with every result.

tests/unit/geometry proves the image half of it against OpenCV.
"""

from __future__ import annotations

from data_contracts.records import CONTRACT_VERSION, Record

UNITS = {
    "mm": (0.001, "millimetres"),
    "cm": (0.01, "centimetres"),
    "m": (1.0, "metres"),
    "in": (0.0254, "inches"),
    "ft": (0.3048, "feet"),
    "yd": (0.9144, "yards"),
    "km": (1000.0, "kilometres"),
}
"""Units of length by their sign: metres, and the name."""
OTHER_UNITS = {name: metres for metres, name in UNITS.values() if metres != 1.0}
"""Metres of the units by name in which a file may be that should be in metres."""

_PAIRED = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
COCO17 = ("nose", *(f"{side}_{joint}" for joint in _PAIRED for side in ("left", "right")))
"""Joint order of every `keypoints` and `joints` array."""

COCO17_BONES = (
    *((5, 7), (7, 9), (6, 8), (8, 10), (5, 6), (11, 12), (5, 11), (6, 12)),
    *((11, 13), (13, 15), (12, 14), (14, 16)),
    *((0, 1), (0, 2), (1, 3), (2, 4), (0, 5), (0, 6)),
)
"""Pairs of indices into `COCO17` that are drawn as bones."""

COCO17_BODY_BONES = (
    *((5, 6), (5, 7), (6, 8), (7, 9), (8, 10)),
    *((5, 11), (6, 12), (11, 13), (12, 14), (13, 15), (14, 16)),
)
"""Bones below the neck whose lengths measure a person's size."""

COCO17_LIMBS = ((5, 7), (6, 8), (7, 9), (8, 10), (11, 13), (12, 14), (13, 15), (14, 16))
"""Upper and lower ends of upper arms, forearms, thighs and shanks, left before right."""

COCO17_RIGID_BONES = (*COCO17_LIMBS, (5, 6), (11, 12))
"""Bones whose length no pose changes: the limbs, and the lines between shoulders and hips."""

COCO17_TORSO = (5, 6, 11, 12)
"""Left and right shoulder, left and right hip."""

COCO17_HIPS = COCO17_TORSO[2:]
"""Left and right hip."""

COCO17_FLIP = (0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15)
"""The joint that each joint becomes in the mirror image."""

JOINT_GROUPS = {"head": ("nose", "eye", "ear"), **{name: (name,) for name in _PAIRED[2:]}}
"""Parts of the names in `COCO17`, by group of joints."""

FEET = (
    *("left_big_toe", "left_small_toe", "left_heel"),
    *("right_big_toe", "right_small_toe", "right_heel"),
)
"""Points of the feet, in the order of COCO-WholeBody: tips of the big toes, outer ends of the small
toes, backs of the heels."""

_PAIRED_SIGMAS = (0.025, 0.035, 0.079, 0.072, 0.062, 0.107, 0.087, 0.089)
COCO17_SIGMAS = (0.026, *(sigma for sigma in _PAIRED_SIGMAS for _ in ("left", "right")))
"""COCO's per-joint spread of human labels, as a fraction of person size."""
COCO17_SPREAD = tuple(sigma / 0.08 for sigma in COCO17_SIGMAS)
"""Spread of each joint relative to an average one: COCO's sigmas over their mean of 0.08."""

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of distortion coefficients, OpenCV's; a coefficient that a lens model lacks is 0."""


class Conventions(Record):
    """Coordinate frames, units and orders of all results."""

    contract: int = CONTRACT_VERSION
    world: str = (
        "metres; origin at the centre spot on the ground; x along the touch line, y across, z up; "
        "right-handed; the main camera stands at negative y. A match without a pitch keeps the "
        "world frame of its calibration."
    )
    camera: str = "x right, y down, z forward; x_cam = R x_world + t (cam_from_world)"
    pixel_origin: str = "(0, 0) is the centre of the top-left pixel; u right, v down"
    distortion: tuple[str, ...] = DISTORTION
    rotations: str = "3x3 matrices or axis-angle vectors in radians"
    frames: str = "0-based match frames; camera frame = match frame + offset_frames"
    dimensions: str = "frame, camera, person, joint, coordinate"
    missing: str = "NaN in floats, -1 in indices, 0 in counts; never a zero coordinate"
    joints: tuple[str, ...] = COCO17
    smpl_pivot: str = "global_orient rotates about the pelvis joint; transl is added after it"


CONVENTIONS = Conventions()
