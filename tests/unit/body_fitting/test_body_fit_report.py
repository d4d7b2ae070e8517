"""Figures of a fit without the truth."""

from dataclasses import replace

import numpy as np
import pytest
from test_monocular import broadcast
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from data_contracts.keypoints import KeypointDetections
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.report import report_fit
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings


def test_figures_of_every_person_are_those_of_his_joints():
    rng = np.random.default_rng(3)
    truth = walker(30, rng)
    joints, covariance = seen(truth, 0.01, rng)
    joints[10:12] = np.nan
    fit = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), BodyFittingSettings())
    camera = broadcast(1)
    exact = KEYPOINTS(truth)
    keypoints = (camera.project(exact[:, None]) + [3.0, 4.0])[:, :, None]
    keypoints[20:, 0, 0, 5] = np.nan
    index = np.zeros((30, 1, 1), dtype=np.int64)
    index[25:] = -1
    detections = KeypointDetections.from_keypoints(keypoints, keypoints[..., 0], index)
    report = report_fit(fit, joints, 50.0, (camera, detections))
    assert report.bodies == 30 and report.filled == 2 and report.guided == 0
    # Pixels are 5 px off by design; 1 cm at 70 m and 4000 px of focal length is 0.6 px.
    assert report.reprojection_px[0] == pytest.approx(5.0, abs=1.0)
    # 1 cm in each of three axes: a median of 15 mm, less what the body takes up.
    assert report.residual_m[0] == pytest.approx(0.014, abs=0.004)
    # Two joints of 1 cm along a limb.
    assert report.bone_spread_m[0] == pytest.approx(0.0141, abs=0.004)
    # A centimetre of noise, new in every frame, alone: sqrt(20 x 3) x 1 cm x 50^3.
    assert report.jerk_m_s3[0] < 0.1 * np.sqrt(60.0) * 0.01 * 50.0**3


def test_jerk_is_the_root_mean_square_of_third_derivatives():
    joints, covariance = seen(walker(6, np.random.default_rng(3)), 0.01, np.random.default_rng(3))
    fit = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), BodyFittingSettings())
    # 6 times 2 m/s^3 of a cube of time; the nose alone stays.
    moved = np.tile(fit.joints[:1], (6, 1, 1, 1))
    moved[:, :, 1:, 0] += 2.0 * (np.arange(6) / 50.0)[:, None, None] ** 3
    report = report_fit(replace(fit, joints=moved), joints, 50.0)
    assert report.jerk_m_s3[0] == pytest.approx(12.0 * np.sqrt(16.0 / 17.0))
