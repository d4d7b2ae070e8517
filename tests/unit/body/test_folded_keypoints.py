from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.keypoints import (
    JOINT_OF_POINT,
    SKELETONS,
    VERTEX_OF_POINT,
    fold_keypoints,
    fold_regressor,
)
from worldpose.errors import InputError

# The requirement is 0.02 mm; double precision at tens of metres gives 1e-11.
ROUNDING = 1e-10


def keypoints_of_the_surface(model, parameters, points):
    """The same points picked out of the mesh and the joints."""
    joints, vertices = model.joints(parameters), model.vertices(parameters)
    return np.stack(
        [
            joints[..., JOINT_OF_POINT[point], :]
            if point in JOINT_OF_POINT
            else vertices[..., VERTEX_OF_POINT[point], :]
            for point in points
        ],
        axis=-2,
    )


def test_folded_keypoints_are_those_of_the_surface_with_pose_correctives(corrected_body, people):
    folded = fold_keypoints(corrected_body, SKELETONS["body25"])(people)
    expected = keypoints_of_the_surface(corrected_body, people, SKELETONS["body25"])
    np.testing.assert_allclose(folded, expected, atol=ROUNDING)
    # The correctives take part: they move the face by millimetres.
    plain = replace(corrected_body, pose_directions=np.zeros((6890, 3, 0)))
    moved = np.abs(fold_keypoints(plain, SKELETONS["body25"])(people) - folded)
    assert moved.max() > 1e-3


def test_a_vertex_of_a_model_of_another_size_is_refused(open_body):
    cut = replace(
        open_body,
        template=open_body.template[:6000],
        shape_directions=open_body.shape_directions[:6000],
        pose_directions=open_body.pose_directions[:6000],
        joint_regressor=np.full((24, 6000), 1 / 6000),
        weights=open_body.weights[:6000],
        faces=open_body.faces[:0],
    )
    with pytest.raises(InputError, match="6000 vertices"):
        fold_keypoints(cut, ("nose",))
    assert fold_keypoints(cut, ("neck",)).joint_shares[0, 12] == 1.0


@pytest.mark.parametrize(
    ("joints", "vertices"),
    [
        (np.zeros((2, 24)), np.zeros((2, 6890))),
        (np.full((2, 24), 1 / 24), np.zeros((3, 6890))),
        (np.full((2, 23), 1 / 23), np.zeros((2, 6890))),
    ],
)
def test_a_regressor_that_is_no_mean_is_refused(open_body, joints, vertices):
    with pytest.raises(InputError, match="keypoint regressor"):
        fold_regressor(open_body, joints, vertices)


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
