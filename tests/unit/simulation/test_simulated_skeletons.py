import numpy as np
import pytest

from worldpose.body.body_file import OPEN_BODY, load_open_body
from worldpose.body.keypoints import SKELETONS, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.formats.joints_file import read_joints
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.crowd import gather
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS

FPS = 50.0


@pytest.fixture(scope="module")
def crowd():
    scenario = SCENARIOS["match"].model_copy(update={"duration": 4.0})
    pitch = PitchTemplate.from_spec(scenario.pitch)
    return gather(scenario, pitch, np.random.SeedSequence(3))


@pytest.fixture(scope="module")
def times():
    return np.arange(200) / FPS


@pytest.fixture(scope="module")
def poses(crowd, times):
    return crowd.poses(times)


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
