"""Keypoints of a posed body without its surface.

A keypoint that is a weighted mean of skinned vertices, sum_v r_v sum_j w_vj (R_j x_v + o_j), only
needs the sums over v, and those do not depend on the pose:
sum_j R_j (sum_v r_v w_vj x_v) + (sum_v r_v w_vj) o_j. As x_v is linear in the betas and the pose
feature, so are the sums. The result equals that of the surface up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17, FEET
from worldpose.body.model import JOINTS, SMPL_VERTICES, BodyModel, BodyParameters
from worldpose.errors import InputError


def _both(*parts: str) -> tuple[str, ...]:
    """Return the left and the right of each part."""
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


JOINT_NAMES: Final = (
    "pelvis",
    *_both("hip"),
    "spine1",
    *_both("knee"),
    "spine2",
    *_both("ankle"),
    "spine3",
    *_both("foot"),
    "neck",
    *_both("collar"),
    "head",
    *_both("shoulder", "elbow", "wrist", "hand"),
)
"""The model's joints in order."""

JOINT_OF_POINT: Final = MappingProxyType(
    {"mid_hip": 0} | {name: number for number, name in enumerate(JOINT_NAMES)}
)
_LANDMARK_PAIRS: Final = {
    "head": ((20, 21), (58, 57), (1299, 1301), (1376, 1362)),
    "trunk": (
        *((2016, 2015), (2190, 2189), (2337, 2338), (2721, 2722)),
        *((2894, 2895), (2977, 2976), (3603, 3604), (3795, 3794)),
    ),
    "pelvis": ((4757, 4758), (4765, 4766)),
    "upper_arm": ((2653, 2654), (2382, 2381), (2032, 2031)),
    "forearm": ((3421, 3420), (2854, 2853)),
    "thigh": (
        *((4840, 4839), (4971, 4970), (5006, 5007), (5068, 5069)),
        *((5114, 5115), (5157, 5156), (5287, 5286)),
    ),
    "shank": ((5358, 5359), (5439, 5438), (5489, 5488), (5591, 5590)),
    "foot": ((6863, 6862), (6109, 6108)),
}
LANDMARKS: Final = MappingProxyType(
    {
        f"{side}_{part}_{number}": vertex
        for part, pairs in _LANDMARK_PAIRS.items()
        for number, pair in enumerate(pairs, start=1)
        for side, vertex in zip(("left", "right"), pair, strict=True)
    }
)
"""Vertices of landmarks of the surface, in mirrored pairs that cover all segments but hands and
toes evenly (`infra/open_body/make_landmarks.py`), numbered from the top of a segment down."""

VERTEX_OF_POINT: Final = MappingProxyType(
    {
        **LANDMARKS,
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
    *("nose", "neck", "right_shoulder", "right_elbow", "right_wrist"),
    *("left_shoulder", "left_elbow", "left_wrist", "mid_hip"),
    *("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
    *FEET,
)
"""OpenPose's 25 points in its order."""

HALPE26: Final = (*COCO17, *("head_top", "neck", "mid_hip"), *_both("big_toe", "small_toe", "heel"))
"""The 26 points of Halpe Full-Body in its order."""

CHALLENGE15: Final = (
    "nose",
    *(
        f"{side}_{part}"
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe")
        for side in ("right", "left")
    ),
)
"""The joints of the FIFA skeletal tracking challenge in its order."""

SKELETONS: Final = MappingProxyType(
    {
        "coco17": COCO17,
        "body25": BODY25,
        "halpe26": HALPE26,
        # The joints that the paper scores.
        "evaluated14": (
            "nose",
            "neck",
            *_both("shoulder", "elbow", "wrist", "hip", "knee", "ankle"),
        ),
        "challenge15": CHALLENGE15,
        "smpl24": JOINT_NAMES,
    }
)
"""The sets by name."""


@dataclass(frozen=True, eq=False)
class FoldedKeypoints:
    """Keypoints of one body model, precomputed for many poses."""

    model: BodyModel
    joint_shares: NDArray[np.float64]
    """(keypoints, 24), the part of each keypoint that is a mean of joints."""
    keypoint: NDArray[np.int64]
    """(pairs,), ascending: the keypoint of each pair of keypoint and joint that moves it."""
    joint: NDArray[np.int64]
    """(pairs,)."""
    mass: NDArray[np.float64]
    """(pairs,), the share of the pair's joint in its keypoint."""
    basis: NDArray[np.float64]
    """(pairs, 3, 1 + shapes + pose features) [m]: sums over vertices, times their weights, of the
    template, its shape directions and, unless these vertices have none, its pose directions."""

    def __call__(self, parameters: BodyParameters) -> NDArray[np.float64]:
        """Return the keypoints (..., keypoints, 3) [m], world; NaN where a parameter is."""
        posed = self.model.articulate(parameters)
        features = [np.ones((*parameters.batch_shape, 1)), parameters.betas]
        if self.corrected:
            features.append(posed.pose_feature)
        feature = np.concatenate(features, axis=-1)
        unposed = (feature @ self.basis.reshape(-1, feature.shape[-1]).T).reshape(
            *parameters.batch_shape, len(self.joint), 3
        )
        parts = np.einsum("...pab,...pb->...pa", posed.rotations[..., self.joint, :, :], unposed)
        parts += self.mass[:, None] * posed.offsets[..., self.joint, :]
        keypoints: NDArray[np.float64] = self.joint_shares @ posed.joints + self.gather @ parts
        keypoints += parameters.transl[..., None, :]
        return keypoints

    @property
    def corrected(self) -> bool:
        """Whether pose correctives move the keypoints."""
        return bool(self.basis.shape[-1] > 1 + self.model.shapes)

    @cached_property
    def gather(self) -> NDArray[np.float64]:
        """Ones that add each pair to its keypoint (keypoints, pairs)."""
        own: NDArray[np.bool_] = self.keypoint == np.arange(len(self.joint_shares))[:, None]
        return own.astype(np.float64)


def fold_keypoints(model: BodyModel, points: tuple[str, ...]) -> FoldedKeypoints:
    """Return named points of a model, for instance `COCO17` or `HALPE26`.

    Raises:
        InputError: the name of a point is unknown, or the model has another number of vertices than
            SMPL, where no vertex has a meaning.
    """
    joint_shares = np.zeros((len(points), JOINTS))
    vertex_shares = np.zeros((len(points), len(model.template)))
    for row, point in enumerate(points):
        if point in JOINT_OF_POINT:
            joint_shares[row, JOINT_OF_POINT[point]] = 1.0
        elif point == "head_top":
            vertex_shares[row, model.template[:, 1].argmax()] = 1.0
        elif point in VERTEX_OF_POINT and len(model.template) == SMPL_VERTICES:
            vertex_shares[row, VERTEX_OF_POINT[point]] = 1.0
        else:
            raise InputError(
                f"keypoint {point!r}",
                expected="head_top, or a point of JOINT_OF_POINT or VERTEX_OF_POINT, on a model of "
                f"{SMPL_VERTICES} vertices",
                found=f"no such point on {model.name} with {len(model.template)} vertices",
                todo="Take a body of SMPL's vertices; fold_regressor takes any weights.",
            )
    return fold_regressor(model, joint_shares, vertex_shares)


def point_segments(model: BodyModel, points: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the joint that moves each point of the surface most (points,)."""
    vertices = [VERTEX_OF_POINT[point] for point in points]
    return np.asarray(model.weights[vertices].argmax(axis=-1), dtype=np.int64)


def fold_regressor(
    model: BodyModel, joint_shares: NDArray[np.float64], vertex_shares: NDArray[np.float64]
) -> FoldedKeypoints:
    """Return keypoints that are weighted means of joints and vertices.

    Args:
        model: the body.
        joint_shares: (keypoints, 24), weights of the posed joints.
        vertex_shares: (keypoints, vertices), weights of the posed vertices.

    Raises:
        InputError: the shapes differ from these, or a sum differs from 1.
    """
    shapes = (len(joint_shares), JOINTS), (len(joint_shares), len(model.template))
    fitting = (joint_shares.shape, vertex_shares.shape) == shapes
    sums = joint_shares.sum(1) + vertex_shares.sum(1) if fitting else np.zeros(1)
    if not (fitting and np.allclose(sums, 1.0, atol=1e-3)):
        raise InputError(
            "keypoint regressor",
            expected=f"shapes {shapes[0]} and {shapes[1]} and sums of 1 over both",
            found=f"shapes {joint_shares.shape} and {vertex_shares.shape}"
            + (f" and sums {sums}" if fitting else ""),
            todo="Give one row a keypoint, for the joints and the vertices of this model.",
        )
    moved_by = (np.abs(vertex_shares) @ np.abs(model.weights)) > 0.0
    keypoint, joint = np.nonzero(moved_by)
    shares = vertex_shares[keypoint] * model.weights[:, joint].T
    used = np.flatnonzero(shares.any(axis=0))
    parts = [model.template[:, :, None], model.shape_directions, model.pose_directions]
    content = np.concatenate([part[used] for part in parts], axis=-1)
    if not model.pose_directions[used].any():
        content = content[..., : 1 + model.shapes]
    return FoldedKeypoints(
        model=model,
        joint_shares=joint_shares,
        keypoint=keypoint,
        joint=joint,
        mass=shares.sum(1),
        basis=np.einsum("pv,vcf->pcf", shares[:, used], content, optimize=True),
    )
