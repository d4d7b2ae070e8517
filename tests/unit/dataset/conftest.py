"""Sound data sets of every kind, to be spoilt."""

import shutil

import numpy as np
import pytest
from faulty_data_sets import FPS, FRAMES, PERSONS, looking

from data_contracts.conventions import COCO17
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.formats.challenge import challenge_truth, write_challenge, write_submission
from worldpose.formats.joints_file import JointTracks, write_joints, write_poses
from worldpose.formats.motion_capture import coco_dataset, write_json
from worldpose.formats.release_cameras import write_moving_camera, write_static_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

LENS = (0.05, 0.02, 0.004, -0.003, 0.03)


@pytest.fixture(scope="session")
def poses(model):
    """Running people with moving limbs; one is missing for a while."""
    rng = np.random.default_rng(3)
    time = np.arange(FRAMES)[None, :, None] / FPS
    heading = rng.uniform(-np.pi, np.pi, (PERSONS, 1))
    velocity = 5.0 * np.concatenate([np.cos(heading), np.sin(heading)], axis=-1)
    ground = rng.uniform(-12.0, 12.0, (PERSONS, 1, 2)) + velocity[:, None] * time
    body_pose = 0.3 * rng.standard_normal((PERSONS, 1, 69))
    body_pose = body_pose * np.sin(8.0 * time + rng.uniform(0.0, 6.0, (PERSONS, 1, 1)))
    orient = np.empty((PERSONS, FRAMES, 3))
    upright = np.array([np.pi / 2, 0.0, 0.0])
    for person in range(PERSONS):
        turn = Rigid.from_rotvec(np.array([0.0, 0.0, heading[person, 0]]), np.zeros(3))
        whole = turn @ Rigid.from_rotvec(upright, np.zeros(3))
        orient[person] = whole.rotvec
    betas = 0.5 * rng.standard_normal((PERSONS, 1, 10))
    transl = np.concatenate([ground, np.zeros((PERSONS, FRAMES, 1))], axis=-1)
    standing = BodyParameters(betas, orient, body_pose, transl)
    lowest = model.vertices(standing)[..., 2].min(-1)
    transl[..., 2] -= lowest
    transl[1, 10:20], orient[1, 10:20], body_pose[1, 10:20] = np.nan, np.nan, np.nan
    return BodyParameters(betas, orient, body_pose, transl)


@pytest.fixture(scope="session")
def cameras():
    return {
        "north": looking([5.0, 55.0, 14.0], [0.0, 0.0, 0.0], 2000.0, LENS),
        "south": looking([-8.0, -60.0, 11.0], [1.0, 0.0, 0.0], 2300.0, LENS),
        "east": looking([70.0, -10.0, 17.0], [0.0, 1.0, 0.0], 2500.0, LENS),
    }


@pytest.fixture(scope="session")
def main_camera():
    """The broadcast camera, which pans and zooms from one place."""
    rows = [
        looking([0.0, -75.0, 15.0], [x, 0.0, 0.0], 3000.0 + 5.0 * n, (0.3, 0.9, 0.0, 0.0, 0.0))
        for n, x in enumerate(np.linspace(-4.0, 4.0, FRAMES))
    ]
    return Camera.stack(rows)


@pytest.fixture(scope="session")
def written(model, poses, cameras, main_camera, tmp_path_factory):
    """Sound data sets by kind: with 2D of static cameras, without 2D, the challenge's."""
    folder = tmp_path_factory.mktemp("sets")
    joints = fold_keypoints(model, COCO17)(poses).swapaxes(0, 1)
    tracks = JointTracks(np.arange(FRAMES), np.arange(PERSONS), joints)
    for kind in ("static", "plain", "challenge"):
        write_poses(folder / kind / "poses" / "A_1.npz", poses, model.name)
    for name, camera in cameras.items():
        for kind in ("static", "plain"):
            calibration = camera.to_calibration(name)
            write_static_camera(folder / kind / "cameras" / f"{name}.npz", calibration)
        dataset = coco_dataset(name, camera, tracks, np.ones(joints.shape[:3], bool))
        write_json(folder / "static" / f"{name}.json", dataset)
    write_joints(folder / "static" / "joints.npz", tracks)
    for kind in ("plain", "challenge"):
        write_moving_camera(folder / kind / "cameras" / "A_1.npz", main_camera)
    truth = challenge_truth(model, poses, main_camera)
    assert len(truth.persons) == PERSONS, "all must be in sight for rows to be those of the poses"
    write_challenge(folder / "challenge", {"A_1": truth.clip}, 2026)
    write_submission(folder / "challenge" / "submission.zip", {"A_1": truth.submission})
    return folder


@pytest.fixture
def data_set(written, tmp_path):

    def copy(kind):
        return shutil.copytree(written / kind, tmp_path / kind)

    return copy
