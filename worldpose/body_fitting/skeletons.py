"""Rotations of a body's joints from 3D skeletons of another method."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import PersonEvidence
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.settings import BodyFittingSettings

SKELETON_STD_M = 0.03
"""Standard deviation of a skeleton's joint from the body's, per axis [m]: definitions of joints and
lengths of limbs differ between bodies by this much."""


def pose_skeletons(joints: Floats, fps: float) -> tuple[Floats, Floats]:
    """Return the rotations of the pelvis (frames, 3) and of the other joints (frames, 69) [rad].

    They are those of a mean body in the axes of the joints, without ground. Frames without joints
    are filled by motion. Joints (frames, 17, 3) [m], COCO-17, are about any origin; NaN where
    missing.
    """
    model, settings = load_open_body(), BodyFittingSettings()
    keypoints = ChainedKeypoints.of(fold_keypoints(model, COCO17))
    solver = PoseSolver(keypoints, load_pose_prior(), settings, None)
    covariance = np.broadcast_to(SKELETON_STD_M**2 * np.eye(3), (*joints.shape, 3))
    evidence = PersonEvidence.of(joints, covariance, fps, settings)
    shape = Shape(np.zeros(model.shapes), np.eye(model.shapes))
    pose, _ = solver.solve_poses(evidence, shape, np.zeros((17, 3)), fps)
    body = pose.parameters()
    return body.global_orient, body.body_pose
