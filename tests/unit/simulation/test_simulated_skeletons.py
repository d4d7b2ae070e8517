import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.body import OPEN_BODY, SKELETONS, BodyParameters, fold_keypoints, load_open_body
from worldpose.body.keypoints import JOINT_NAMES
from worldpose.formats import read_joints
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, MatchOptions, simulate_match
from worldpose.simulation.crowd import gather
from worldpose.simulation.skeletons import draw_body, draw_figure, solve_body


@pytest.fixture(scope="module")
def figures():
    rng = np.random.default_rng(2)
    return [draw_figure((1.70, 1.95), rng) for _ in range(60)]


def test_figures_are_as_tall_as_they_say(figures):
    for figure in figures[:8]:
        surface = figure.model.vertices(BodyParameters(figure.betas, *map(np.zeros, (3, 69, 3))))
        # Crown and sole are fixed vertices; another may be a little higher or lower.
        assert np.ptp(surface[:, 1]) == pytest.approx(figure.height, abs=0.003)
        assert surface[:, 1].min() == pytest.approx(figure.sole, abs=0.003)
    heights = np.array([figure.height for figure in figures])
    assert heights.min() >= 1.70
    assert heights.max() <= 1.95
    assert np.ptp(heights) > 0.2


def test_figures_of_one_height_differ_in_build():
    rng = np.random.default_rng(0)
    alike = [draw_figure((1.8, 1.8), rng) for _ in range(40)]
    shoulders = np.array([np.linalg.norm(f.joints[16] - f.joints[17]) for f in alike])
    legs = np.array([np.linalg.norm(f.joints[1] - f.joints[7]) for f in alike])
    # MakeHuman's people vary little in their proportions: some percent, and half a percent.
    assert 0.01 < shoulders.std() / shoulders.mean() < 0.05
    assert 0.004 < legs.std() / legs.mean() < 0.02


def test_figures_have_human_proportions(figures):
    for figure in figures:

        def length(a, b, figure=figure):
            return np.linalg.norm(figure.joints[a] - figure.joints[b]) / figure.height

        # Winter, Biomechanics and Motor Control of Human Movement: 0.245 and 0.246 of the height;
        # other hips and other people account for 5 %.
        assert length(1, 4) == pytest.approx(0.245, abs=0.012)
        assert length(4, 7) == pytest.approx(0.246, abs=0.012)
        assert 0.03 < figure.toe < 0.08
        assert 0.03 < figure.heel < 0.08


def test_a_figures_joints_are_its_models(figures):
    figure = figures[0]
    rest = BodyParameters(figure.betas, *map(np.zeros, (3, 69, 3)))
    np.testing.assert_allclose(figure.joints, figure.model.joints(rest), atol=1e-14)


J = {name: index for index, name in enumerate(COCO17)}
FEET = ("left_ankle", "right_ankle", "left_big_toe", "right_big_toe", "left_heel", "right_heel")
FPS = 50.0


def flat(x, y):
    return 0.0 * x


@pytest.fixture(scope="module")
def crowd():
    scenario = SCENARIOS["match"].model_copy(update={"duration": 4.0})
    pitch = PitchTemplate.from_spec(scenario.pitch)
    return gather(scenario, pitch, np.random.SeedSequence(3))


@pytest.fixture(scope="module")
def times():
    return np.arange(200) / FPS


@pytest.fixture(scope="module")
def joints(crowd, times):
    return crowd.joints(times)


@pytest.fixture(scope="module")
def poses(crowd, times):
    return crowd.poses(times)


@pytest.fixture(scope="module")
def body():
    return draw_body((1.8, 1.8), np.random.default_rng(0))


def standing(body):
    """Return a body's 17 joints at rest, facing x, arms along y, soles on the ground."""
    rest = body.figure.joints
    points = np.concatenate([body.figure.head, rest[16:22], rest[[1, 2, 4, 5, 7, 8]]])
    points = points - [0.0, body.figure.sole, 0.0]
    return points[None, :, (2, 0, 1)]


def turned(embodied, joint):
    """How far a joint is turned from its rest, relative to its parent (frames,) [rad]."""
    pose = embodied.parameters().body_pose.reshape(-1, 23, 3)
    return np.linalg.norm(pose[:, JOINT_NAMES.index(joint) - 1], axis=-1)


def test_a_figure_in_its_rest_pose_has_hardly_an_angle(body):
    embodied = solve_body(body.figure, standing(body), flat)
    away = np.linalg.norm(embodied.keypoints() - standing(body), axis=-1)[0]
    # The open body stands with its knees a little outside, but knees bend ahead: 6 mm.
    assert away[[J["left_knee"], J["right_knee"]]].max() < 0.008
    # It is even to within 0.03 mm.
    assert np.delete(away, [J["left_knee"], J["right_knee"]]).max() < 1e-4
    # y up and z ahead become z up and x ahead: a third of a turn about (1, 1, 1).
    about = np.full(3, 2.0 * np.pi / 3.0 / np.sqrt(3.0))
    np.testing.assert_allclose(embodied.parameters().global_orient[0], about, atol=1e-4)
    for joint in JOINT_NAMES[1:]:
        legs = any(part in joint for part in ("hip", "knee", "ankle"))
        arms = any(part in joint for part in ("shoulder", "elbow"))
        assert turned(embodied, joint)[0] < (0.16 if legs else 0.05 if arms else 1e-3), joint


def test_joints_are_the_folded_keypoints_of_the_bodies(crowd, joints, poses):
    fold = fold_keypoints(crowd.bodies[0].figure.model, SKELETONS["coco17"])
    # Rounding of coordinates below 100 m.
    np.testing.assert_allclose(fold(poses).swapaxes(0, 1), joints, atol=1e-12)


def test_hips_and_ankles_stand_where_the_skeletons_do(body):
    skeleton = standing(body)
    skeleton[:, [J["left_ankle"], J["left_knee"]]] += [[0.25, 0.0, 0.2], [0.25, 0.0, 0.1]]
    keypoints = solve_body(body.figure, skeleton, flat).keypoints()
    same = [J["left_hip"], J["right_hip"], J["left_ankle"], J["right_ankle"]]
    np.testing.assert_allclose(keypoints[:, same], skeleton[:, same], atol=1e-12)


def test_an_ankle_out_of_reach_is_reached_for(body):
    skeleton = standing(body)
    skeleton[:, J["left_ankle"], 2] -= 0.2
    keypoints = solve_body(body.figure, skeleton, flat).keypoints()[0]
    leg = keypoints[J["left_ankle"]] - keypoints[J["left_hip"]]
    assert np.linalg.norm(leg) == pytest.approx(body.leg, abs=1e-5)
    wanted = skeleton[0, J["left_ankle"]] - skeleton[0, J["left_hip"]]
    np.testing.assert_allclose(np.cross(leg, wanted), 0.0, atol=1e-8)


def test_a_raised_shank_bends_nothing_but_its_knee(body):
    skeleton = standing(body)
    rest = body.figure.joints
    thigh, shank = rest[4] - rest[1], rest[7] - rest[4]
    # 90 degrees about the model's x brings the shank's -y to -z, which is behind.
    back = np.array([shank[0], -shank[2], shank[1]])
    skeleton[0, J["left_ankle"]] = skeleton[0, J["left_hip"]] + (thigh + back)[[2, 0, 1]]
    embodied = solve_body(body.figure, skeleton, flat)
    assert turned(embodied, "left_knee")[0] == pytest.approx(np.pi / 2, abs=0.05)
    # The leg's own plane leans outward a little, which the rest of the bend shows.
    assert turned(embodied, "left_hip")[0] < 0.1


def test_half_the_turn_of_a_head_is_the_necks(body):
    skeleton = standing(body)
    ears = skeleton[:, 3:5].mean(axis=1, keepdims=True)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    skeleton[:, :5] = ears + (skeleton[:, :5] - ears) @ quarter.T
    embodied = solve_body(body.figure, skeleton, flat)
    for joint in ("neck", "head"):
        assert turned(embodied, joint)[0] == pytest.approx(np.pi / 4, abs=1e-3)


def test_a_trunk_twists_evenly(body):
    skeleton = standing(body)
    chest = slice(0, J["right_wrist"] + 1)
    twist = np.radians(30.0)
    turn = np.array(
        [[np.cos(twist), -np.sin(twist), 0], [np.sin(twist), np.cos(twist), 0], [0, 0, 1]]
    )
    skeleton[:, chest] = skeleton[:, chest] @ turn.T
    embodied = solve_body(body.figure, skeleton, flat)
    for joint in ("spine1", "spine2", "spine3"):
        # Blended directions share an angle of 30 degrees equally to within 3 %.
        assert turned(embodied, joint)[0] == pytest.approx(twist / 3.0, rel=0.03)


@pytest.mark.parametrize("limb", ["arm", "leg"])
def test_limbs_pass_through_straight_without_a_flip(body, limb):
    bends = np.linspace(-0.02, 0.3, 321)
    skeleton = np.repeat(standing(body), len(bends), axis=0)
    if limb == "arm":
        # Hanging arms; the forearm swings forward, through straight.
        down = np.array([0.0, 0.0, -1.0])
        for side in ("left", "right"):
            elbow = skeleton[:, J[f"{side}_shoulder"]] + body.upper_arm * down
            fore = np.stack([np.sin(bends), 0 * bends, -np.cos(bends)], axis=-1)
            skeleton[:, J[f"{side}_elbow"]] = elbow
            skeleton[:, J[f"{side}_wrist"]] = elbow + body.forearm * fore
    else:
        skeleton[:, J["left_ankle"], 2] += 0.2 * np.linspace(-0.05, 0.3, len(bends))
        skeleton[:, J["left_knee"]] = skeleton[:, [J["left_hip"], J["left_ankle"]]].mean(axis=1)
    embodied = solve_body(body.figure, skeleton, flat)
    # Steps of 1 mrad in the elbow and of 0.2 mm at the ankle, whose square root the knee follows.
    assert np.abs(np.diff(embodied.rotations, axis=0)).max() < 0.05


def test_turns_change_no_faster_than_footballers_do(crowd, times):
    for person in range(5):
        step = np.abs(np.diff(crowd._solve_person(person, times).rotations, axis=0)).max()
        # A sprinter's shank turns at 25 rad/s, half a radian a frame; a flip would show 1 to 2.
        assert step < 0.7


def test_planted_feet_stand_still_from_heel_to_toe(crowd, joints, poses):
    model = crowd.bodies[0].figure.model
    feet = fold_keypoints(model, FEET)(poses).reshape(25, 200, 3, 2, 3)
    moved, toes = [], []
    for person, body in enumerate(crowd.bodies):
        ankle = feet[person, :, 0]
        clear = ankle[..., 2] - crowd.pitch.height(ankle[..., 0], ankle[..., 1])
        planted = np.abs(clear - body.ankle_height) < 1e-6
        still = planted[1:] & planted[:-1]
        step = np.linalg.norm(np.diff(feet[person], axis=0), axis=-1)
        moved.append(step[:, 0][still])
        toes.append(step[:, 1:].max(axis=1)[still])
    moved, toes = np.concatenate(moved), np.concatenate(toes)
    assert len(moved) > 2000
    assert moved.max() < 1e-4
    # A person who turns by more than hips allow, pivots.
    assert (toes < 1e-4).mean() > 0.9


def test_soles_are_on_the_ground_and_never_below_it(crowd, poses):
    model = crowd.bodies[0].figure.model
    on_foot = model.weights[:, [7, 8, 10, 11]].sum(axis=1) > 0.9
    for person, body in enumerate(crowd.bodies[:6]):
        picked = poses[person, ::10]
        ankle = model.joints(picked)[:, 7:9]
        clear = ankle[..., 2] - crowd.pitch.height(ankle[..., 0], ankle[..., 1])
        soles = model.vertices(picked)[:, on_foot]
        lowest = (soles[..., 2] - crowd.pitch.height(soles[..., 0], soles[..., 1])).min(axis=1)
        # A foot is a rigid ankle and rigid toes: what rolls over them dips by 2 mm.
        assert lowest.min() > -0.003
        planted = (np.abs(clear - body.ankle_height) < 1e-6).any(axis=1)
        assert lowest[planted].max() < 0.003


def test_somebody_who_lies_has_the_feet_of_his_shanks(body):
    skeleton = standing(body)
    fallen = skeleton[..., (2, 1, 0)] * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.15]  # face to the ground
    embodied = solve_body(body.figure, fallen, flat)
    for joint in ("left_ankle", "right_ankle"):
        assert turned(embodied, joint)[0] == pytest.approx(np.radians(10.0), abs=0.1)
    away = np.linalg.norm(embodied.keypoints() - fallen, axis=-1)
    assert away.max() < 0.008  # the knees, as in the rest pose


def test_no_frames_are_no_bodies(body):
    embodied = solve_body(body.figure, np.empty((0, 17, 3)), flat)
    assert embodied.keypoints().shape == (0, 17, 3)
    assert embodied.parameters().batch_shape == (0,)


TINY = SCENARIOS["tiny"]


@pytest.fixture(scope="module")
def match(tmp_path_factory):
    folder = tmp_path_factory.mktemp("matches") / "tiny"
    simulate_match(TINY, 5, folder, MatchOptions(duration=1.0, cameras=1, players=3))
    return folder


@pytest.fixture(scope="module")
def reference_poses(match):
    with np.load(match / "reference" / "poses" / "clip.npz", allow_pickle=False) as file:
        return dict(file)


def test_poses_have_the_form_of_the_release_and_name_their_body(reference_poses):
    assert {name: array.shape for name, array in reference_poses.items()} == {
        "betas": (3, 10),
        "global_orient": (3, 25, 3),
        "body_pose": (3, 25, 69),
        "transl": (3, 25, 3),
        "body_model": (1,),
    }
    assert reference_poses["body_model"].item() == OPEN_BODY


def test_joints_are_recomputed_from_the_poses(match, reference_poses):
    truth = read_joints(match / "reference" / "joints.npz")
    arrays = [
        reference_poses[name].astype(np.float64)
        for name in ("global_orient", "body_pose", "transl")
    ]
    bodies = BodyParameters(reference_poses["betas"][:, None].astype(np.float64), *arrays)
    again = fold_keypoints(load_open_body(), SKELETONS["coco17"])(bodies)
    # Single precision on a pitch of 105 m: 4 um, and angles of 1e-7 over a limb.
    np.testing.assert_allclose(again.swapaxes(0, 1), truth.joints, atol=2e-5)


def test_people_have_shapes_of_their_own(reference_poses):
    assert np.abs(reference_poses["betas"][0] - reference_poses["betas"][1]).max() > 0.1


def test_an_empty_pitch_has_poses_of_nobody(tmp_path):
    simulate_match(TINY, 0, tmp_path / "m", MatchOptions(duration=0.4, cameras=1, players=0))
    with np.load(tmp_path / "m" / "reference" / "poses" / "clip.npz") as file:
        assert file["betas"].shape == (0, 10)
        assert file["body_pose"].shape == (0, 10, 69)
