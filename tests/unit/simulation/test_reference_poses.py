import numpy as np
import pytest

from worldpose.body import OPEN_BODY, SKELETONS, BodyParameters, fold_keypoints, load_open_body
from worldpose.formats import read_joints
from worldpose.simulation import SCENARIOS, simulate_match

TINY = SCENARIOS["tiny"]


@pytest.fixture(scope="module")
def match(tmp_path_factory):
    folder = tmp_path_factory.mktemp("matches") / "tiny"
    simulate_match(TINY, 5, folder, duration=1.0, cameras=1, players=3)
    return folder


@pytest.fixture(scope="module")
def poses(match):
    with np.load(match / "reference" / "poses" / "clip.npz", allow_pickle=False) as file:
        return dict(file)


def test_poses_have_the_form_of_the_release_and_name_their_body(poses):
    assert {name: array.shape for name, array in poses.items()} == {
        "betas": (3, 10),
        "global_orient": (3, 25, 3),
        "body_pose": (3, 25, 69),
        "transl": (3, 25, 3),
        "body_model": (1,),
    }
    assert poses["body_model"].item() == OPEN_BODY


def test_joints_are_recomputed_from_the_poses(match, poses):
    truth = read_joints(match / "reference" / "joints.npz")
    arrays = [poses[name].astype(np.float64) for name in ("global_orient", "body_pose", "transl")]
    bodies = BodyParameters(poses["betas"][:, None].astype(np.float64), *arrays)
    again = fold_keypoints(load_open_body(), SKELETONS["coco17"])(bodies)
    # Single precision on a pitch of 105 m: 4 um, and angles of 1e-7 over a limb.
    np.testing.assert_allclose(again.swapaxes(0, 1), truth.joints, atol=2e-5)


def test_people_have_shapes_of_their_own(poses):
    assert np.abs(poses["betas"][0] - poses["betas"][1]).max() > 0.1


def test_an_empty_pitch_has_poses_of_nobody(tmp_path):
    simulate_match(TINY, 0, tmp_path / "m", duration=0.4, cameras=1, players=0)
    with np.load(tmp_path / "m" / "reference" / "poses" / "clip.npz") as file:
        assert file["betas"].shape == (0, 10)
        assert file["body_pose"].shape == (0, 10, 69)
