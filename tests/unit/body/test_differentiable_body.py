import numpy as np
import pytest

torch = pytest.importorskip("torch")

from worldpose.body.differentiable import DifferentiableBody  # noqa: E402
from worldpose.body.keypoints import SKELETONS, fold_keypoints  # noqa: E402
from worldpose.body.model import BodyParameters  # noqa: E402

# Double precision at tens of metres.
ROUNDING = 1e-10
# Single precision at a hundred metres is 8e-6 m.
SINGLE = 5e-5


def tensors(parameters: BodyParameters, dtype=torch.float64) -> list[torch.Tensor]:
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


def test_single_precision_is_within_a_twentieth_of_a_millimetre(corrected_body, people):
    folded = fold_keypoints(corrected_body, SKELETONS["coco17"])
    rough = DifferentiableBody(folded, dtype=torch.float32)
    given = tensors(people, torch.float32)
    assert rough.keypoints(*given).dtype == torch.float32
    np.testing.assert_allclose(rough.keypoints(*given), folded(people), atol=SINGLE)


def test_one_shape_serves_many_frames(open_body):
    folded = fold_keypoints(open_body, SKELETONS["coco17"])
    body = DifferentiableBody(folded)
    rng = np.random.default_rng(3)
    frames = BodyParameters(
        rng.normal(size=10),
        rng.normal(size=(2, 6, 3)),
        rng.normal(size=(6, 69)),
        rng.normal(size=(2, 1, 3)),
    )
    betas, *_ = tensors(frames)
    given = (betas[0, 0], *tensors(frames)[1:])
    assert body.keypoints(*given).shape == (2, 6, 17, 3)
    np.testing.assert_allclose(body.keypoints(*given), folded(frames), atol=ROUNDING)
    np.testing.assert_allclose(body.joints(*given), open_body.joints(frames), atol=ROUNDING)
    np.testing.assert_allclose(body.vertices(*given), open_body.vertices(frames), atol=ROUNDING)


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


def test_gradients_of_the_surface_are_those_of_finite_differences(corrected_body, people):
    body = DifferentiableBody(fold_keypoints(corrected_body, ("nose",)))
    given = [tensor[:1].requires_grad_() for tensor in tensors(people)]
    direction = torch.tensor(np.random.default_rng(4).normal(size=(1, 6890, 3)) / 6890)

    def mean_motion(*parameters):
        return (body.vertices(*parameters) * direction).sum()

    assert torch.autograd.gradcheck(mean_motion, given, fast_mode=True)


def test_a_missing_person_spoils_no_gradient_of_the_others(open_body, people):
    body = DifferentiableBody(fold_keypoints(open_body, SKELETONS["coco17"]))
    given = tensors(people)
    given[2][1] = torch.nan
    given[2].requires_grad_()
    body.keypoints(*given)[[0, 2, 3, 4]].square().sum().backward()
    assert torch.isfinite(given[2].grad[[0, 2, 3, 4]]).all()
