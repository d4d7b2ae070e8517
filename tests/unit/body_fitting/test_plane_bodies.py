"""Bodies of people that one camera alone sees, from monocular poses and places on the pitch."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import plain_camera
from scipy.special import chdtri
from walking_bodies import KEYPOINTS, MODEL, walker

from worldpose.body.model import BodyParameters
from worldpose.body_fitting.evidence import ankle_height
from worldpose.body_fitting.monocular import parse_monocular
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies

FPS, FRAMES = 25.0, 30
CENTER = np.array([0.0, -60.0, 14.0])
PLACE_STD = np.array([0.08, 0.30])
"""Errors of places across and along the line of sight [m]."""


def turn(*vector):
    return Rigid.from_rotvec(np.array(vector), np.zeros(3)).rotation


def panning_camera(frames):
    """A camera 60 m beside the pitch, 14 m up, that pans past the origin."""
    pan = np.linspace(-0.03, 0.08, frames)
    down = np.arctan2(CENTER[2] - 1.0, -CENTER[1])
    x = np.stack([np.cos(pan), np.sin(pan), 0.0 * pan], axis=-1)
    ahead = np.stack([-np.sin(pan), np.cos(pan), 0.0 * pan], axis=-1)
    z = np.cos(down) * ahead - np.sin(down) * np.array([0.0, 0.0, 1.0])
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return plain_camera(
        np.full(frames, 3500.0), (959.5, 539.5), Rigid(rotation, -rotation @ CENTER)
    )


class Clip:
    """Two people who walk on flat ground, their estimates and detections."""

    def __init__(self, seed, *, frames=FRAMES, errors=None, speed=1.0):
        rng = np.random.default_rng(seed)
        walkers = [walker(frames, rng, fps=FPS) for _ in range(2)]
        values = []
        for k, body in enumerate(walkers):
            joints = KEYPOINTS(body)
            lowest = joints[:, 15:17, 2].min(axis=1)
            transl = body.transl + [-3.0 + 6.0 * k, 4.0 * k, 0.0]
            transl[:, 2] += ankle_height(MODEL, body.betas[0]) - lowest
            values.append((body.betas, body.global_orient, body.body_pose, transl))
        self.bodies = BodyParameters(*(np.stack(v, axis=1) for v in zip(*values, strict=True)))
        self.truth = KEYPOINTS(self.bodies)
        self.camera = panning_camera(frames)
        drawn = estimate_bodies(
            MODEL, self.bodies, self.camera, FPS, errors or MonocularErrors(), rng
        )
        self.estimates = parse_monocular(drawn, "estimates")
        flat = self.truth.reshape(frames, -1, 3)
        image = self.camera.project(flat).reshape(frames, 2, 17, 2)
        slow, quick = rng.normal(0.0, 1.2, (1, 2, 17, 2)), rng.normal(0.0, 1.2, image.shape)
        self.keypoints = image + slow + quick
        hips = self.truth[:, :, 11:13, :2].mean(axis=2)
        sight = hips - CENTER[:2]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        across = np.stack([sight[..., 1], -sight[..., 0]], axis=-1)
        axes = np.stack([across, sight], axis=-1)
        off = rng.normal(0.0, PLACE_STD, (1, 2, 2))
        self.place = hips + (axes @ off[..., None])[..., 0]
        self.covariance = axes @ np.diag(PLACE_STD**2) @ np.swapaxes(axes, -1, -2)

    def evidence(self, **changes):
        given = {
            "camera": self.camera,
            "number": np.arange(len(self.truth)),
            "keypoints": self.keypoints,
            "confidence": np.full(self.truth.shape[:3], 0.9),
            "place": self.place,
            "place_covariance": self.covariance,
            "calibration": np.zeros_like(self.covariance),
            "fps": FPS,
        }
        return PlaneEvidence(**{**given, **changes})

    def fit(self, estimates=None, **changes):
        estimates = self.estimates if estimates is None else estimates
        return fit_bodies_on_plane(
            MODEL, self.evidence(**changes), estimates, lambda x, y: 0.0 * (x + y)
        )

    def errors(self, joints):
        return np.linalg.norm(joints - self.truth, axis=-1)

    def rows_of(self, person):
        """Rows of the estimates that show a person."""
        image = self.camera.project(self.truth.reshape(len(self.truth), -1, 3))
        middle = image.reshape(len(self.truth), 2, 17, 2).mean(axis=2)
        center, frame = self.estimates.center, self.estimates.frame
        return np.linalg.norm(middle[frame] - center[:, None], axis=-1).argmin(axis=1) == person


def centred(clip, joints):
    off = joints - clip.truth
    return np.linalg.norm(off - off.mean(axis=2, keepdims=True), axis=-1)


@pytest.fixture(scope="module")
def fits():
    clips = [Clip(seed) for seed in range(4)]
    return [(clip, clip.fit()) for clip in clips]


def test_fitted_bodies_are_nearer_to_the_truth_than_placed_ones(fits):
    placed, fitted, around = [], [], []
    for clip, bodies in fits:
        assert bodies.missing == (None, None)
        assert np.isfinite(bodies.fit.joints).all()
        placed.append(clip.errors(bodies.placed))
        fitted.append(clip.errors(bodies.fit.joints))
        around.append((centred(clip, bodies.placed), centred(clip, bodies.fit.joints)))
    assert np.nanmean(fitted) < 0.75 * np.nanmean(placed)
    before, after = (np.nanmean([pair[k] for pair in around]) for k in (0, 1))
    assert before > 0.12
    assert after < 0.07


def test_regions_hold_the_truth_and_are_long_in_depth(fits):
    inside, ratios = [], []
    for clip, bodies in fits:
        fit = bodies.fit
        off = fit.joints - clip.truth
        square = (off * np.linalg.solve(fit.covariance, off[..., None])[..., 0]).sum(axis=-1)
        inside.append(square < chdtri(3, 0.05))
        sight = clip.truth[:, :, 11] - CENTER
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        hips = fit.covariance[:, :, 11]
        along = np.einsum("fpa,fpab,fpb->fp", sight, hips, sight)
        ratios.append(along / hips[..., 0, 0])
    assert np.mean(inside) > 0.9
    assert np.median(ratios) > 4.0


@pytest.mark.parametrize("case", ["upside down", "turned round"])
def test_estimates_that_contradict_the_keypoints_are_refused_with_the_reason(case):
    clip = Clip(10)
    rotations = clip.estimates.rotations.copy()
    wrong = clip.rows_of(1)
    if case == "upside down":
        rotations[wrong, 0] = turn(0.0, 0.0, np.pi) @ rotations[wrong, 0]
    else:
        rotations[wrong, 0] = rotations[wrong, 0] @ turn(0.0, np.pi, 0.0)
    bodies = clip.fit(replace(clip.estimates, rotations=rotations))
    assert bodies.missing[0] is None
    assert "the keypoints" in bodies.missing[1]
    assert np.isnan(bodies.fit.joints[:, 1]).all()
    assert np.isnan(bodies.fit.betas_covariance[1]).all()
    assert np.isfinite(bodies.fit.joints[:, 0]).all()
