import numpy as np

from worldpose.body.keypoints import (
    JOINT_OF_POINT,
    VERTEX_OF_POINT,
)


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
