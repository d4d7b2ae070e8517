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
