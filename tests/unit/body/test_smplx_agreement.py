"""The forward pass of the smplx package, on the same arrays, as an independent reference."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
smplx = pytest.importorskip("smplx")

from smplx.utils import Struct  # noqa: E402

from worldpose.body.keypoints import BODY25, fold_keypoints  # noqa: E402

# Measured 2e-8 m in double precision: smplx adds 1e-8 to every angle.
AGREEMENT = 1e-5


@pytest.fixture(scope="module")
def theirs(corrected_body):
    arrays = Struct(
        v_template=corrected_body.template,
        f=corrected_body.faces,
        shapedirs=corrected_body.shape_directions,
        posedirs=corrected_body.pose_directions,
        J_regressor=corrected_body.joint_regressor,
        weights=corrected_body.weights,
        kintree_table=np.stack([corrected_body.parents, np.arange(24)]),
    )
    return smplx.SMPL("", data_struct=arrays, batch_size=5, dtype=torch.float64)


def output_of(layer, parameters):
    names = ("betas", "global_orient", "body_pose", "transl")
    with torch.no_grad():
        return layer(**{name: torch.tensor(getattr(parameters, name)) for name in names})


def test_joints_and_surface_are_those_of_smplx(theirs, corrected_body, people):
    output = output_of(theirs, people)
    joints, vertices = corrected_body.joints(people), corrected_body.vertices(people)
    np.testing.assert_allclose(joints, output.joints[:, :24], atol=AGREEMENT)
    np.testing.assert_allclose(vertices, output.vertices, atol=AGREEMENT)


def test_the_points_of_face_and_feet_are_those_of_smplx(theirs, corrected_body, people):
    # smplx appends nose, right eye, left eye, right ear, left ear, then the left foot's big toe,
    # small toe and heel and the right foot's; OpenPose's order is named in its own mapping.
    of_smplx = [24, 12, 17, 19, 21, 16, 18, 20, 0, 2, 5, 8, 1, 4, 7, 25, 26, 27, 28, *range(29, 35)]
    output = output_of(theirs, people)
    ours = fold_keypoints(corrected_body, BODY25)(people)
    np.testing.assert_allclose(ours, output.joints[:, of_smplx], atol=AGREEMENT)
