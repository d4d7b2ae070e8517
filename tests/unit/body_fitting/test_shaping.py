"""Shape and the detector's offsets: neither drifts over a whole clip."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shapes import fit_shapes, spread_intervals

SETTINGS = BodyFittingSettings()
SOLVER = PoseSolver(ChainedKeypoints.of(KEYPOINTS), load_pose_prior(), SETTINGS, None)


def height(betas):
    return np.ptp(MODEL.template[:, 1] + MODEL.shape_directions[:, 1] @ betas)


def people(count, frames, noise, seed=5):
    """Walkers, and their joints and covariance by person."""
    rng = np.random.default_rng(seed)
    truths = [walker(frames, rng) for _ in range(count)]
    parts = [seen(truth, noise, rng) for truth in truths]
    return truths, {p: (part[0][:, 0], part[1][:, 0]) for p, part in enumerate(parts)}


def fit(joints, known=None, solver=SOLVER):
    """Shapes of people, from the intervals of their tracks that the settings choose."""
    sampled = {
        person: [
            (places[part], covariance[part])
            for part in spread_intervals(len(places), 50.0, solver.settings)
        ]
        for person, (places, covariance) in joints.items()
    }
    return fit_shapes(solver, sampled, known or {}, 50.0)


@pytest.mark.parametrize("frames", [100, 1500])
def test_neither_people_nor_offsets_grow_with_the_length_of_a_clip(frames):
    truths, joints = people(3, frames, 0.02)
    shapes = fit(joints)
    off = [height(shapes.people[p].betas) - height(t.betas[0]) for p, t in enumerate(truths)]
    # Nobody stands on a ground and the detector has no offsets. Noise leaves 10 mm and 3 mm; with
    # the poses' own weight of the prior and all frames, 1500 of them make it 128 mm and 24 mm.
    assert np.abs(off).max() < 0.02
    assert np.sqrt((shapes.offsets**2).mean()) < 0.005


def test_what_other_clips_know_of_a_person_counts():
    truths, joints = people(1, 50, 0.04)
    true = truths[0].betas[0]
    sure = Shape(true, 1e-4 * np.eye(MODEL.shapes))
    alone = fit(joints).people[0]
    known = fit(joints, {0: sure}).people[0]
    assert np.linalg.norm(known.betas - true) < 0.1 < np.linalg.norm(alone.betas - true)
    assert np.trace(known.covariance) < 1e-2 * np.trace(alone.covariance)
