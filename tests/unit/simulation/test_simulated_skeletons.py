import numpy as np

from worldpose.body.body_file import OPEN_BODY, load_open_body
from worldpose.body.keypoints import SKELETONS, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.formats.joints_file import read_joints
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS


def test_joints_are_recomputed_from_the_poses(tmp_path):
    simulate_match(
        *(SCENARIOS["tiny"], 5, tmp_path / "m"), MatchOptions(duration=1.0, cameras=1, players=3)
    )
    truth = read_joints(tmp_path / "m" / "reference" / "joints.npz")
    poses = dict(np.load(tmp_path / "m" / "reference" / "poses" / "clip.npz", allow_pickle=False))
    assert poses["body_model"].item() == OPEN_BODY
    arrays = [poses[name].astype(np.float64) for name in ("global_orient", "body_pose", "transl")]
    bodies = BodyParameters(poses["betas"][:, None].astype(np.float64), *arrays)
    again = fold_keypoints(load_open_body(), SKELETONS["coco17"])(bodies)
    # Single precision on a pitch of 105 m: 4 um, and angles of 1e-7 over a limb.
    np.testing.assert_allclose(again.swapaxes(0, 1), truth.joints, atol=2e-5)
