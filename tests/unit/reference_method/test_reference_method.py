"""The paper's equations: numbers by hand, gradients by finite differences, and known truth."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from camera_builders import look_at_camera  # noqa: E402

import worldpose as wp  # noqa: E402
from data_contracts.conventions import COCO17_RIGID_BONES  # noqa: E402
from worldpose.body.body_file import find_body  # noqa: E402
from worldpose.body.differentiable import DifferentiableBody  # noqa: E402
from worldpose.body.keypoints import SKELETONS, fold_keypoints  # noqa: E402
from worldpose.errors import InputError  # noqa: E402
from worldpose.geometry.cameras import Camera  # noqa: E402
from worldpose.pitch.template import PitchTemplate  # noqa: E402
from worldpose.reference_method import body_fitting, broadcast_calibration  # noqa: E402
from worldpose.reference_method.cameras import TensorCameras  # noqa: E402
from worldpose.reference_method.reprojection import triangulate, triangulate_about_mid_hip  # noqa: E402
from worldpose.reference_method.static_calibration import (  # noqa: E402
    camera_from_plane,
    distance_map,
    look_up,
    refine_on_distance_map,
    refine_on_points,
)

PLACES = ((-60.0, -60.0, 20.0), (0.0, -70.0, 25.0), (60.0, -55.0, 22.0), (20.0, 70.0, 20.0))


@pytest.fixture(scope="module")
def cameras():
    lens = (0.1, -0.2, 0.0, 0.0, 0.0)
    return Camera.stack([look_at_camera(c, (0.0, 0.0, 0.0), 2500.0, lens=lens) for c in PLACES])


@pytest.fixture(scope="module")
def body():
    return DifferentiableBody(fold_keypoints(find_body(), SKELETONS["coco17"]))


def moving_person(body, frames=12):
    """Return beta, theta_r, theta_b, t of a person who runs and bends the arms and knees."""
    time = torch.linspace(0.0, 1.0, frames, dtype=torch.float64)[:, None]
    upright = torch.tensor([[np.pi / 2.0, 0.0, 0.0]], dtype=torch.float64).expand(frames, 3)
    pose = torch.zeros(frames, 69, dtype=torch.float64)
    pose[:, 9:10] = 0.8 * time
    pose[:, 47:48] = -1.0
    pose[:, 50:51] = 1.0
    place = torch.cat([3.0 * time, 1.0 * time, torch.ones_like(time)], dim=1)
    betas = torch.zeros(body.model.shapes, dtype=torch.float64)
    betas[0] = 1.0
    return body_fitting.Omega(betas, upright, pose, place)


def test_projection_is_that_of_the_library_and_returns_to_the_same_cameras(cameras):
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (20, 3))
    tensors = TensorCameras.of(cameras)
    found = tensors.project(torch.tensor(points)[:, None]).numpy()
    np.testing.assert_allclose(
        found, np.stack([c.project(points) for c in map(cameras.__getitem__, range(4))], 1)
    )
    np.testing.assert_allclose(tensors.camera().project(points), cameras.project(points))
    values = tensors.values.clone().requires_grad_()
    place = torch.tensor(points[:3, None]).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v, p: tensors.with_values(v).project(p), (values, place), atol=1e-2, eps=1e-7
    )


def test_a_point_behind_the_camera_has_no_image_and_other_lenses_are_refused(cameras):
    behind = torch.tensor(cameras.center[0] * 2.0)
    assert torch.isnan(TensorCameras.of(cameras[:1]).project(behind)).all()
    lens = (0.1, 0.0, 0.01, 0.0, 0.0)
    tangential = Camera.stack([look_at_camera(PLACES[0], (0, 0, 0), 2500.0, lens=lens)])
    with pytest.raises(InputError, match="tangential"):
        TensorCameras.of(tangential)


def test_stages_1_and_2_find_the_camera_of_exact_clicks():
    pitch, true = (
        PitchTemplate.standard(),
        look_at_camera((-20.0, -70.0, 25.0), (-38, 0, 0), 1900.0),
    )
    names = [name for name in pitch.points if "left" in name and "top" not in name]
    points = pitch.positions(names)
    image = true.project(points)
    first = camera_from_plane(points, image, (1920, 1080))
    # The crown of 0.2 m is all that the homography does not know.
    assert abs(first.focal[0] - 1900.0) < 80.0
    found = refine_on_points(first, points, image)
    np.testing.assert_allclose(found.focal, 1900.0, rtol=1e-5)
    np.testing.assert_allclose(found.center, true.center, atol=1e-3)


@pytest.mark.parametrize(
    "points", [[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[i, 0.0, 0] for i in range(6)]]
)
def test_too_few_points_or_points_on_one_line_are_refused(points):
    places = np.array(points)
    image = look_at_camera((0.0, -60.0, 20.0), (0, 0, 0), 2000.0).project(places)
    with pytest.raises(InputError, match="four clicked points"):
        camera_from_plane(places, image, (1920, 1080))


def test_the_distance_map_is_looked_up_at_rounded_pixels_with_its_slope():
    away = torch.arange(12.0, dtype=torch.float64).reshape(3, 4)  # D = 4 v + u
    pixels = torch.tensor([[1.4, 0.6], [-9.0, 9.0]], dtype=torch.float64, requires_grad=True)
    found = look_up(away, pixels)
    assert found.tolist() == [5.0, 8.0]
    found.sum().backward()
    assert pixels.grad.tolist() == [[1.0, 4.0], [1.0, 4.0]]


def test_stage_3_moves_projected_markings_onto_drawn_ones():
    from worldpose.simulation.renderer import render_pitch

    pitch, true = PitchTemplate.standard(), look_at_camera((0.0, -70.0, 25.0), (-30, 0, 0), 1800.0)
    picture = render_pitch(true, pitch, None, 0)
    lines = pitch.sample_lines(0.3).points_world
    start = look_at_camera((0.0, -70.0, 25.0), (-30.2, 0.05, 0), 1810.0)

    def error(camera):
        off = np.linalg.norm(camera.project(lines) - true.project(lines), axis=1)
        return np.nanmedian(off)

    found = refine_on_distance_map(start, distance_map(picture, start, lines), lines)
    # Canny finds both edges of the paint, and the paper picks none of them: some pixels remain.
    assert error(start) > 5.0
    assert error(found) < 0.6 * error(start)


def test_triangulation_weighs_all_views_alike_and_ignores_missing_ones(cameras):
    true = np.array([[1.0, 2.0, 1.0], [-3.0, 0.5, 0.2]])
    image = np.stack([cameras[c].project(true) for c in range(4)], axis=1)
    image[1, 2:] = np.nan
    tensors = TensorCameras.of(cameras)
    found = triangulate(tensors, torch.tensor(image), torch.tensor(true + 0.3))
    np.testing.assert_allclose(found, true, atol=1e-8)
    # A minimum: the gradient of the sum of squares is zero, also with noise.
    noisy = torch.tensor(image[:1] + np.random.default_rng(0).normal(size=(1, 4, 2)))
    place = triangulate(tensors, noisy, torch.tensor(true[:1])).requires_grad_()
    (tensors.project(place[:, None]) - noisy).square().sum().backward()
    assert place.grad.abs().max() < 1e-3


def test_joints_about_the_mid_hip_do_not_feel_a_camera_that_shifts_the_person(cameras):
    joints = np.array([[[0.0, 0.1, 0.9], [0.0, -0.1, 0.9], [0.0, 0.0, 1.6]]])
    image = np.stack([cameras[c].project(joints) for c in range(4)], axis=2)
    image[:, :, 0] += [12.0, -7.0]
    tensors, pixels = TensorCameras.of(cameras), torch.tensor(image)
    middle = torch.tensor(joints[:, :2].mean(1))
    start = torch.tensor(joints + 0.05)
    found = triangulate_about_mid_hip(tensors, pixels, start, pixels[:, :2].mean(1), middle)
    np.testing.assert_allclose(found, joints, atol=2e-3)
    plain = triangulate(tensors, pixels.flatten(0, 1), start.flatten(0, 1)).reshape(1, 3, 3)
    assert np.abs(plain.numpy() - joints).max() > 0.02


@pytest.mark.parametrize("method", ["paper", "paper_midhip"])
def test_the_papers_method_is_computed_or_refused_but_never_ours_in_its_name(body, cameras, method):
    joints = body.keypoints(*moving_person(body)).numpy()[:, None]
    image = cameras.project(joints.reshape(-1, 1, 17, 3)).reshape(-1, 4, 1, 17, 2)
    image = image + np.random.default_rng(0).normal(size=image.shape)
    index = np.zeros(image.shape[:3], dtype=np.int16)
    seen = wp.KeypointDetections.from_keypoints(image, np.ones(image.shape[:-1]), index)
    papers, ours = wp.TriangulationSettings(method=method), wp.triangulate_joints(cameras, seen)
    found = wp.reconstruct_joints(cameras, seen, 25.0, papers).triangulation.joints
    assert 1e-6 < np.abs(found - ours.joints).max() < 0.1
    with pytest.raises(InputError, match="Call reconstruct_joints"):
        wp.triangulate_joints(cameras, seen, papers)
    evidence = wp.ClipEvidence(joints, np.full((*joints.shape, 3), 1e-4) * np.eye(3), 25.0)
    with pytest.raises(InputError, match=r"body_fitting.paper_variant.fit_in_windows"):
        wp.fit_bodies(find_body(), evidence, wp.BodyFittingSettings(method="paper"))


def test_shape_by_bone_lengths_is_that_of_an_exact_body_whatever_a_few_frames_say(body):
    joints = body.keypoints(*moving_person(body)).numpy()
    joints[3, 7] += 0.5  # L1: a gross error in one frame changes nothing
    betas = torch.tensor(body_fitting.fit_shape(body, joints))
    still = torch.zeros(75, dtype=torch.float64).split((3, 69, 3))
    found, true = (body.keypoints(b, *still) for b in (betas, moving_person(body).betas))
    for first, second in COCO17_RIGID_BONES:
        lengths = [torch.linalg.vector_norm(k[first] - k[second]) for k in (found, true)]
        np.testing.assert_allclose(*lengths, atol=0.002)


def test_root_alignment_places_a_still_body_exactly_and_fills_frames_without_it(body):
    true = moving_person(body, 6)
    true = true._replace(pose=0.0 * true.pose)
    joints = body.keypoints(*true).numpy()
    joints[2] = np.nan
    start = body_fitting.Omega(true.betas, *(0.0 * each for each in true[1:]))
    found = body_fitting.align_root(body, start, joints)
    np.testing.assert_allclose(found.transl[3], true.transl[3], atol=1e-9)
    np.testing.assert_allclose(found.orient, true.orient, atol=1e-9)
    assert torch.isfinite(found.transl).all()


def test_energies_have_the_values_of_their_equations(body, cameras):
    joints = torch.zeros(3, 17, 3, dtype=torch.float64)
    joints[1, 0, 0] = 2.0  # second difference of one joint: 0 - 2 * 2 + 0
    assert body_fitting.smoothness_energy(joints) == 16.0
    assert body_fitting.shape_energy(torch.tensor([1.0, -2.0])) == 5.0
    omega, tensors = moving_person(body, 3), TensorCameras.of(cameras)
    places = body.keypoints(*omega)
    image = tensors.project(places[:, :, None]).transpose(1, 2) + torch.tensor([30.0, 4.0])
    aligned = body_fitting.align_keypoints(tensors, image, places)
    # The mean of two projected hips is not the projected mid-hip: some hundredths of a pixel.
    assert body_fitting.data_energy(places, tensors, aligned) < 0.1
    assert broadcast_calibration.robust(torch.tensor([[60.0, 80.0]])) == 5000.0
    parts = [part.clone().requires_grad_() for part in omega]
    assert torch.autograd.gradcheck(
        lambda *o: body_fitting.refine_energy(body, body_fitting.Omega(*o), tensors, aligned + 1.0),
        parts,
        eps=1e-7,
        rtol=1e-3,
        atol=1.0,
        fast_mode=True,
    )


@pytest.mark.slow
def test_refinement_finds_a_moving_person(body, cameras):
    true = moving_person(body)
    joints, tensors = body.keypoints(*true), TensorCameras.of(cameras)
    image = tensors.project(joints[:, :, None]).transpose(1, 2)
    found = body_fitting.fit_person(body, joints.numpy(), tensors, image, iterations=1000)
    away = torch.linalg.vector_norm(body.keypoints(*found) - joints, dim=-1)
    assert away.mean() < 0.012


def test_adam_moves_the_camera_onto_people_and_keeps_it_at_the_markings():
    true = look_at_camera((0.0, -70.0, 20.0), (0, 0, 0), 3000.0)
    rng = np.random.default_rng(2)
    world = rng.uniform((-8, -8, 0), (8, 8, 2), (90, 3))
    frame = np.repeat(np.arange(3), 30)
    start = Camera.stack([look_at_camera((0.0, -70.0, 20.0), (0.2, 0, 0), 3000.0)] * 3)
    none = np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    people = world, true.project(world), frame
    found = broadcast_calibration.refine(start, none, people, 300)

    def error(camera):
        return np.abs(camera[0].project(world) - true.project(world)).mean()

    assert error(start) > 4.0
    assert error(found) < 0.3
    held = broadcast_calibration.refine(start, (world, start[0].project(world), frame), people, 300)
    # lambda_4 = 1 against lambda_5 = 0.5 about quadratic losses: a third of the way.
    assert 0.55 < error(held) / error(start) < 0.8
