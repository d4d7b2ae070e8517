import numpy as np

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import (
    JOINT_NAMES,
    JOINT_OF_POINT,
    LANDMARKS,
    VERTEX_OF_POINT,
    point_segments,
)

ENDS = ("wrist", "hand", "foot")
"""Segments without landmarks."""


def test_joints_keep_the_order_of_smpl():
    # Public documentation of SMPL: elbows are 18 and 19, wrists 20 and 21, knees 4 and 5.
    assert [JOINT_OF_POINT[f"{side}_elbow"] for side in ("left", "right")] == [18, 19]
    assert [JOINT_OF_POINT[f"{side}_wrist"] for side in ("left", "right")] == [20, 21]
    assert [JOINT_OF_POINT[f"{side}_knee"] for side in ("left", "right")] == [4, 5]
    assert JOINT_OF_POINT["mid_hip"] == JOINT_NAMES.index("pelvis") == 0


def test_left_points_are_on_the_left_of_the_open_body(open_body):
    for point, vertex in VERTEX_OF_POINT.items():
        x = open_body.template[vertex, 0]
        side = {"left": 1, "right": -1}.get(point.split("_")[0], 0)
        # The nose is in the middle within a centimetre.
        assert np.sign(x) == side if side else abs(x) < 0.01


def test_face_and_feet_of_the_open_body_are_where_they_belong(open_body):
    at = {point: open_body.template[vertex] for point, vertex in VERTEX_OF_POINT.items()}
    for side in ("left", "right"):
        ankle = open_body.joint_template[JOINT_OF_POINT[f"{side}_ankle"]]
        assert at[f"{side}_heel"][2] < ankle[2] < at[f"{side}_big_toe"][2]
        assert abs(at[f"{side}_big_toe"][0]) < abs(at[f"{side}_small_toe"][0])
        # The sole: within 4 cm of the lowest point of the body.
        for point in ("heel", "big_toe", "small_toe"):
            assert at[f"{side}_{point}"][1] < open_body.template[:, 1].min() + 0.04
        assert at["nose"][2] > at[f"{side}_eye"][2] > at[f"{side}_ear"][2] + 0.05
        assert at[f"{side}_eye"][1] > at["nose"][1]
        # The ears are 13 to 20 cm apart.
        assert 0.065 < abs(at[f"{side}_ear"][0]) < 0.1


def test_landmarks_are_mirrored_pairs_all_over_the_surface():
    model = load_open_body()
    assert len(LANDMARKS) >= 60 and len(set(LANDMARKS.values())) == len(LANDMARKS)
    left = [name for name in LANDMARKS if name.startswith("left_")]
    pairs = [(LANDMARKS[name], LANDMARKS[name.replace("left_", "right_", 1)]) for name in left]
    one, other = (model.template[list(side)] for side in zip(*pairs, strict=True))
    np.testing.assert_allclose(one * [-1.0, 1.0, 1.0], other, atol=2e-3)
    # No place of the surface but of hands and toes is far from a landmark.
    chosen = np.concatenate([one, other])
    owner = model.weights.argmax(axis=1)
    ends = [JOINT_NAMES.index(f"{side}_{end}") for side in ("left", "right") for end in ENDS]
    rest = model.template[~np.isin(owner, ends)]
    away = np.linalg.norm(rest[:, None] - chosen, axis=-1).min(axis=1)
    assert away.max() < 0.2
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=-1) + np.eye(len(chosen))
    assert apart.min() > 0.04


def test_segments_of_points_are_the_joints_that_move_them():
    points = ("left_heel", "right_big_toe", "left_thigh_1", "right_forearm_1", "left_head_1")
    found = [JOINT_NAMES[joint] for joint in point_segments(load_open_body(), points)]
    assert found[:4] == ["left_ankle", "right_foot", "left_hip", "right_elbow"]
    assert found[4] in ("head", "neck")
