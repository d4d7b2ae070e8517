from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.keypoints import JOINT_NAMES
from worldpose.body.model import BodyParameters


def bent(**turns):
    """The mean body with joints turned [degree]."""
    pose = np.zeros((23, 3))
    for joint, turn in turns.items():
        pose[JOINT_NAMES.index(joint) - 1] = np.radians(turn)
    return replace(BodyParameters.rest(), body_pose=pose.ravel())


def volume(model, parameters):
    a, b, c = model.vertices(parameters)[model.faces].transpose(1, 0, 2)
    return np.einsum("na,na->", a, np.cross(b, c)) / 6.0


POSES = {
    "hanging": bent(left_shoulder=(0, 0, -75), right_shoulder=(0, 0, 75)),
    "raised": bent(left_shoulder=(0, 0, 75), right_shoulder=(0, 0, -75)),
    "forward": bent(left_shoulder=(0, -85, 0), right_shoulder=(0, 85, 0)),
    "bent": bent(left_elbow=(0, -130, 0), right_elbow=(0, 130, 0)),
}


@pytest.mark.parametrize("pose", POSES)
def test_arms_move_without_taking_volume_from_the_body(open_body, pose):
    resting = volume(open_body, BodyParameters.rest())
    # Both arms have 5 litres of 74; a shoulder's skin folds or stretches by a twentieth of it.
    assert volume(open_body, POSES[pose]) == pytest.approx(resting, rel=0.04)


def test_correctives_belong_to_shoulders_and_elbows(open_body):
    used = open_body.pose_directions.reshape(-1, 3, 23, 9).any(axis=(0, 1, 3))
    names = {JOINT_NAMES[joint + 1] for joint in np.flatnonzero(used)}
    assert names == {
        f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "elbow")
    }
