import numpy as np
import pytest

torch = pytest.importorskip("torch")

from worldpose.body.differentiable import DifferentiableBody  # noqa: E402
from worldpose.body.keypoints import SKELETONS, fold_keypoints  # noqa: E402

# Double precision at tens of metres.
ROUNDING = 1e-10


def tensors(parameters, dtype=torch.float64):
    names = ("betas", "global_orient", "body_pose", "transl")
    return [torch.tensor(getattr(parameters, name), dtype=dtype) for name in names]


@pytest.mark.parametrize("body", ["open_body", "corrected_body"])
def test_torch_gives_what_numpy_gives(body, people, request):
    model = request.getfixturevalue(body)
    folded = fold_keypoints(model, SKELETONS["body25"])
    same = DifferentiableBody(folded)
    given = tensors(people)
    np.testing.assert_allclose(same.joints(*given), model.joints(people), atol=ROUNDING)
    np.testing.assert_allclose(same.keypoints(*given), folded(people), atol=ROUNDING)
    np.testing.assert_allclose(same.vertices(*given), model.vertices(people), atol=ROUNDING)


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_gradients_of_keypoints_are_those_of_finite_differences(corrected_body, people, scale):
    # Scale 0 is the T-pose, where the angle's own derivative does not exist.
    points = ("nose", "left_wrist", "right_big_toe")
    body = DifferentiableBody(fold_keypoints(corrected_body, points))
    betas, orient, pose, transl = (given[:1] for given in tensors(people))
    given = [betas, scale * orient, scale * pose, transl / 30.0]
    for tensor in given:
        tensor.requires_grad_()
    # gradcheck's own step and tolerances.
    assert torch.autograd.gradcheck(body.keypoints, given)
    assert torch.autograd.gradcheck(body.joints, given)
