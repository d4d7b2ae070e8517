"""The person of docs/reference/metrics.md, and tracks of such people."""

import numpy as np

from worldpose.evaluation.matching import EvaluationSettings
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks

SIDES = {1: 0.03, 3: 0.07, 5: 0.20, 7: 0.20, 9: 0.20, 11: 0.11, 13: 0.11, 15: 0.11}
HEIGHTS = (1.70, 1.72, 1.70, 1.45, 1.15, 0.89, 0.90, 0.50, 0.10)


def person(x=0.0, y=0.0):
    """A standing person: lower arms 0.26 m, lower legs 0.4 m, head 0.25 m."""
    joints = np.zeros((17, 3))
    joints[0] = (0.0, 0.0, HEIGHTS[0])
    for (left, side), height in zip(SIDES.items(), HEIGHTS[1:], strict=True):
        joints[left] = (0.0, side, height)
        joints[left + 1] = (0.0, -side, height)
    return joints + np.array([x, y, 0.0])


def tracks(frames_of_people, views=None, first_frame=0):
    joints = np.array(frames_of_people, dtype=np.float64)
    return JointTracks(
        np.arange(first_frame, first_frame + joints.shape[0]),
        np.arange(joints.shape[1]),
        joints,
        views=views,
    )


def score(predicted, true, fps=None, camera=None, **settings):
    return evaluate_joints(predicted, true, EvaluationSettings(**settings), fps=fps, camera=camera)[
        0
    ]


def crowd(frames=4, persons=3, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-20.0, 20.0, (frames, persons, 1, 3)) * [1.0, 1.0, 0.0]
    return tracks(person() + places)


def e4(joints):
    """The 14 joints of the paper, written out."""
    neck = 0.5 * (joints[..., 5, :] + joints[..., 6, :])
    return np.concatenate([joints[..., :1, :], neck[..., None, :], joints[..., 5:, :]], axis=-2)
