"""Scores of trajectories and errors of cameras, computed by hand (docs: cases h to o, t to x)."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import plain_camera
from people_samples import crowd, e4, person, score, tracks

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.evaluation.cameras import CameraErrorSettings, camera_samples, evaluate_cameras
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

# Sums of a few thousand rounded distances, after a decomposition of 3 x 3 matrices: 1e-8 mm is
# some thousand roundings of the metres they are made of.
MM = 1e-8
ALIGNED = ("g_mpjpe_mm", "per_person_g_mpjpe_mm", "pa_mpjpe_mm")
RIGID = tuple(name.replace("_mm", "_rigid_mm") for name in ALIGNED)


def moved(truth, rotvec, shift, scale=1.0):
    turned = Rigid.from_rotvec(rotvec, np.zeros(3)).apply(truth.joints.reshape(-1, 17, 3))
    joints = scale * turned.reshape(truth.joints.shape) + np.array(shift)
    return replace(truth, joints=joints)


def scatter(points):
    """Mean distance of points (n, 3) from their middle."""
    return np.linalg.norm(points - points.mean(axis=0), axis=-1).mean()


def walk(positions_x, y=0.0):
    """One person over time, (frames, 17, 3)."""
    return np.array([person(x, y) for x in positions_x])


def test_case_h_a_similarity_costs_its_size_alone_where_size_is_kept():
    truth = crowd(frames=6)
    scores = score(moved(truth, [0.2, -0.4, 1.5], [7.0, -90.0, 3.0], scale=1.25), truth)
    assert [getattr(scores, name) for name in ALIGNED] == pytest.approx([0.0] * 3, abs=MM)
    assert scores.g_scale == pytest.approx(0.8, abs=1e-12)
    assert scores.track_coverage == 1.0
    # Turned and shifted back, every joint is a quarter of its distance from the middle too far.
    joints = e4(truth.joints)
    everybody = 250.0 * scatter(joints.reshape(-1, 3))
    each = np.mean([250.0 * scatter(joints[:, i].reshape(-1, 3)) for i in range(3)])
    pose = 250.0 * scatter(joints[0, 0])
    found = [getattr(scores, name) for name in RIGID]
    assert found == pytest.approx([everybody, each, pose], rel=1e-12)
    assert (scores.coverage, scores.mpjpe_mm) == (0.0, None)


def case_i():
    """Two people walk across, 20 and 10 m; each is predicted 10 cm too far out."""
    steps = np.linspace(-1.0, 1.0, 21)
    truth = tracks(np.stack([[person(5.0, 10.0 * s), person(-5.0, 5.0 * s)] for s in steps]))
    outward = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])[:, None]
    return replace(truth, joints=truth.joints + outward), truth


def test_case_i_wrong_relative_positions_show_in_the_shared_alignment_alone():
    scores, people = evaluate_joints(*case_i())
    assert scores.g_mpjpe_rigid_mm == pytest.approx(100.0, abs=MM)
    assert scores.per_person_g_mpjpe_rigid_mm == pytest.approx(0.0, abs=MM)
    assert scores.pa_mpjpe_rigid_mm == pytest.approx(0.0, abs=MM)
    assert scores.g_mpjpe_mm < 100.0
    assert [each.path_m for each in people] == pytest.approx([20.0, 10.0], abs=1e-12)


def test_case_j_drift_is_the_mean_of_each_person_s_own():
    prediction, truth = case_i()
    # 10 cm / 20 m and 10 cm / 10 m.
    scores = score(prediction, truth)
    assert scores.per_meter_drift_rigid_cm_per_m == pytest.approx(0.75, abs=MM)
    assert scores.per_person_drift_rigid_cm_per_m == pytest.approx(0.0, abs=MM)
    far = score(prediction, truth, min_trajectory_m=15.0)
    assert far.per_meter_drift_rigid_cm_per_m == pytest.approx(0.5, abs=MM)
    assert score(prediction, truth, min_trajectory_m=30.0).per_meter_drift_cm_per_m is None


def test_case_k_one_frame_late_is_one_step_off():
    at = 2.0 / 25.0 * np.arange(20)
    truth = tracks(walk(at)[:, None])
    late = replace(truth, frames=truth.frames + 1)
    scores = score(late, truth, fps=25.0)
    assert scores.mpjpe_mm == pytest.approx(80.0, abs=MM)
    assert scores.challenge_score == pytest.approx(0.08, abs=1e-12)
    found = [getattr(scores, name) for name in (*ALIGNED, *RIGID)]
    assert found == pytest.approx([0.0] * 6, abs=MM)
    assert scores.acceleration_error_m_s2 == pytest.approx(0.0, abs=1e-9)
    assert scores.coverage == 0.95


def test_case_o_challenge_score():
    truth = tracks([[person()]])
    for joint, expected in ((9, 0.01 + 5 * 0.01), (11, 0.01 + 5 * 0.065)):
        joints = truth.joints.copy()
        joints[..., joint, 0] += 0.13
        found = score(replace(truth, joints=joints), truth)
        assert found.challenge_score == pytest.approx(expected, abs=1e-12)
    joints[..., 11, :] = np.nan
    # Without a hip there is no middle to compare with.
    assert score(replace(truth, joints=joints), truth).challenge_score is None


def test_acceleration_of_a_trembling_joint():
    truth = tracks([[person()]] * 10)
    tremble = 0.01 * (-1.0) ** np.arange(10)
    joints = truth.joints + tremble[:, None, None, None] * np.array([1.0, 0.0, 0.0])
    prediction = replace(truth, joints=joints)
    # -0.01, 0.01, -0.01: the second difference is 0.04 m in (1/25 s)^2.
    scores = score(prediction, truth, fps=25.0)
    assert scores.acceleration_error_m_s2 == pytest.approx(25.0, abs=1e-9)
    assert score(prediction, truth).acceleration_error_m_s2 is None
    # Every second frame alone: 0.04 m in (2/25 s)^2; a hole of four frames is not bridged.
    frames = np.array([0, 2, 4, 6, 8, 14, 16, 18, 20, 22])
    sparse = score(replace(prediction, frames=frames), replace(truth, frames=frames), fps=25.0)
    assert sparse.acceleration_error_m_s2 == pytest.approx(6.25, abs=1e-9)
    two = JointTracks(truth.frames[:2], truth.person_ids, truth.joints[:2])
    assert score(two, two, fps=25.0).acceleration_error_m_s2 is None


def test_switches_per_minute_count_match_time():
    truth = tracks([[person()]] * 10)
    joints = np.full((10, 2, 17, 3), np.nan)
    joints[:6, 0], joints[6:, 1] = truth.joints[:6, 0], truth.joints[6:, 0]
    scores = score(tracks(joints), truth, fps=25.0)
    # One in 10 / 25 s.
    assert (scores.switches, scores.switches_per_minute) == (1, pytest.approx(150.0, rel=1e-12))
    # Both parts are the same person: merged, nothing is missing and no error is left.
    assert scores.track_coverage == 1.0
    assert scores.g_mpjpe_mm == pytest.approx(0.0, abs=MM)


SIDE_VIEW = plain_camera(
    1000.0,
    (959.5, 539.5),
    Rigid(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([0.0, 1.5, 50.0])
    ),
)


def test_boxes_match_people_who_are_far_off_along_the_line_of_sight():
    truth = tracks([[person(-4.0), person(4.0)]] * 5)
    # A tenth nearer to the camera and a tenth smaller: the same image.
    center = SIDE_VIEW.center
    prediction = replace(truth, joints=center + 0.9 * (truth.joints - center))
    by_boxes = score(prediction, truth, camera=SIDE_VIEW)
    assert by_boxes.track_coverage == 1.0
    assert by_boxes.g_mpjpe_mm == pytest.approx(0.0, abs=MM)
    # The mean over joints of a tenth of the distance to the camera.
    joints = np.concatenate([truth.joints[..., :1, :], truth.joints[..., 5:, :]], axis=-2)
    expected = 0.1 * np.linalg.norm(joints - center, axis=-1).mean()
    assert by_boxes.challenge_global_m == pytest.approx(expected, rel=1e-12)
    exchanged = score(tracks(prediction.joints[:, ::-1]), truth, camera=SIDE_VIEW)
    assert exchanged.g_mpjpe_mm == pytest.approx(0.0, abs=MM)


def test_a_camera_of_another_clip_is_refused():
    truth = tracks([[person()]] * 5)
    with pytest.raises(InputError, match="one row, or 5"):
        score(truth, truth, camera=Camera.stack([SIDE_VIEW] * 4))


def test_worlds_of_their_own_are_registered_despite_noise_and_split_tracks():
    rng = np.random.default_rng(3)
    steps = np.cumsum(rng.normal(0.0, 0.1, (60, 6, 1, 2)), axis=0)
    places = rng.uniform(-30.0, 30.0, (1, 6, 1, 2)) + steps
    truth = tracks(person() + np.concatenate([places, np.zeros_like(places[..., :1])], axis=-1))
    foreign = moved(truth, [0.3, 0.0, 2.0], [100.0, 50.0, -20.0], scale=0.3).joints
    foreign = foreign + rng.normal(0.0, 0.3 * 0.02, foreign.shape)
    split = np.full((60, 7, 17, 3), np.nan)
    split[:, :6] = foreign
    split[30:, 6], split[30:, 2] = split[30:, 2].copy(), np.nan
    scores = score(tracks(split), truth)
    assert scores.track_coverage == 1.0
    # The mean length of three normal errors of 20 mm is 20 sqrt(8 / pi) = 31.9 mm, of the neck
    # 1 / sqrt(2) of it: 31.2 over the 14; 5000 joints leave less than one per cent of that.
    assert scores.g_mpjpe_mm == pytest.approx(31.2, rel=0.01)


def test_one_frame_in_a_world_of_its_own_is_registered_without_a_joint_of_every_person():
    truth = tracks([[person(), person(3.0, 1.0), person(9.0, -4.0)]])
    foreign = moved(truth, [0.3, 0.0, 2.0], [100.0, 50.0, -20.0], scale=0.3).joints
    foreign[:, :, 9] = np.nan
    scores = score(tracks(foreign), truth)
    assert (scores.track_coverage, scores.g_mpjpe_mm) == (1.0, pytest.approx(0.0, abs=MM))


FLAT = PitchTemplate.from_spec(PitchSpec(crown=0.0))
CROWNED = PitchTemplate.standard()

# x right, y towards the near touch line, looking down.
DOWN = np.diag([1.0, -1.0, -1.0])
# x right, looking along y.
AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def camera(rotation=DOWN, center=(0.0, 0.0, 50.0), focal=1000.0):
    return plain_camera(focal, (959.5, 539.5), Rigid(rotation, -rotation @ np.array(center)))


def errors(estimated, true, pitch=FLAT, **settings):
    found, cameras = evaluate_cameras(
        {"a": estimated}, {"a": true}, pitch, CameraErrorSettings(**settings)
    )
    assert cameras[0].errors == (found.static or found.broadcast)
    return cameras[0].errors


def test_the_true_camera_has_no_error():
    down = Rigid.from_rotvec([0.2, 0.0, 0.0], np.zeros(3)).rotation
    true = camera(down @ AHEAD, (3.0, -70.0, 15.0), 3000.0)
    found = errors(true, true, CROWNED)
    for name, value in found.model_dump().items():
        # Back-projection from 100 m, rounded; 1 is the number of cameras and their coverage.
        assert value == pytest.approx(float(name in ("cameras", "coverage")), abs=1e-9)


def test_case_t_a_camera_shifted_by_30_centimetres():
    found = errors(camera(center=(0.3, 0.0, 50.0)), camera())
    assert found.center_error_m == pytest.approx(0.3, abs=1e-12)
    assert found.ground_error_median_m == pytest.approx(0.3, abs=1e-12)
    assert found.ground_error_p95_m == pytest.approx(0.3, abs=1e-12)
    # 1000 px times 0.3 m over the 49 m from the camera to the points 1 m above the pitch.
    assert found.reprojection_error_median_px == pytest.approx(300 / 49, abs=1e-9)
    assert (found.rotation_error_deg, found.focal_error_percent) == (0.0, 0.0)


def test_case_u_a_focal_length_one_per_cent_too_long():
    samples = camera_samples("a", camera(focal=1010.0), camera(), FLAT, CameraErrorSettings())
    points, _ = grid_in_view(camera())
    expected = np.linalg.norm(points[:, :2], axis=-1) * (1.0 - 1.0 / 1.01)
    np.testing.assert_allclose(np.sort(samples.ground), np.sort(expected), atol=1e-12)
    assert errors(camera(focal=1010.0), camera()).focal_error_percent == pytest.approx(1.0)


def grid_in_view(true):
    """The default grid on the flat pitch, 2.5 m, within the image of a camera looking down."""
    x, y = np.meshgrid(np.linspace(-52.5, 52.5, 43), np.linspace(-34.0, 34.0, 29), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    pixels = true.project(points)
    inside = np.all((pixels >= -0.5) & (pixels <= [1919.5, 1079.5]), axis=-1)
    return points[inside], pixels[inside]


def test_case_v_a_camera_turned_by_two_degrees_about_its_axis():
    turn = Rigid.from_rotvec([0.0, 0.0, np.radians(2.0)], np.zeros(3)).rotation
    found = errors(camera(turn @ DOWN), camera())
    assert found.rotation_error_deg == pytest.approx(2.0, abs=1e-12)
    points, _ = grid_in_view(camera())
    expected = 2.0 * np.sin(np.radians(1.0)) * np.linalg.norm(points, axis=-1)
    assert found.ground_error_median_m == pytest.approx(np.median(expected), abs=1e-12)
    assert found.ground_error_p95_m == pytest.approx(np.percentile(expected, 95), abs=1e-12)
    assert found.center_error_m == pytest.approx(0.0, abs=1e-12)


def test_case_x_a_transposed_rotation():
    true = camera(AHEAD, (0.0, -60.0, 15.0))
    pose = true.cam_from_world
    transposed = replace(true, cam_from_world=Rigid(pose.rotation.T, pose.translation))
    found = errors(transposed, true)
    # AHEAD turns by 90 degrees, its transpose by -90.
    assert found.rotation_error_deg == pytest.approx(180.0, abs=1e-9)
    # t = (0, 15, 60): the centre -R t comes to (0, 60, -15).
    assert found.center_error_m == pytest.approx(2.0 * np.hypot(60.0, 15.0), abs=1e-9)
    # From under the ground no ray meets the pitch: the error of all points is its diagonal.
    assert found.ground_error_median_m == pytest.approx(np.hypot(105.0, 68.0), abs=1e-9)


def test_frames_without_an_estimate_lower_coverage_alone():
    true = Camera.stack([camera()] * 4)
    focal = true.focal.copy()
    focal[2] = np.nan
    found = errors(replace(true, focal=focal), true)
    assert (found.coverage, found.center_error_m) == (0.75, 0.0)
    nothing = errors(replace(true, focal=np.full((4, 2), np.nan)), true)
    assert nothing.model_dump(exclude_none=True) == {"coverage": 0.0, "cameras": 1}


def test_moving_cameras_are_broadcast_and_others_static():
    moving = Camera.stack([camera(center=(0.0, 0.0, 50.0 + 0.1 * i)) for i in range(3)])
    found, cameras = evaluate_cameras(
        {"clip": camera(), "b": camera(), "only": camera()},
        {"clip": moving, "b": camera(), "other": camera()},
        FLAT,
    )
    assert [(each.camera_id, each.kind) for each in cameras] == [
        ("clip", "broadcast"),
        ("b", "static"),
    ]
    # 0, 0.1 and 0.2 m.
    assert found.broadcast.center_error_m == pytest.approx(0.1, abs=1e-12)
    assert found.static.center_error_m == 0.0
    assert evaluate_cameras({"x": camera()}, {"y": camera()}, FLAT) == (None, ())


def test_cameras_of_another_length_are_refused():
    with pytest.raises(InputError, match="camera clip: expected 3 frames"):
        evaluate_cameras(
            {"clip": Camera.stack([camera()] * 2)}, {"clip": Camera.stack([camera()] * 3)}, FLAT
        )
