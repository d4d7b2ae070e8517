"""Shape and the detector's offsets: neither drifts over a whole clip."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.solver import Solver, fit_shapes, spread_intervals

SETTINGS = BodyFittingSettings()
SOLVER = Solver(ChainedKeypoints.of(KEYPOINTS), load_pose_prior(), SETTINGS, None)


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


@pytest.mark.parametrize("frames", [100, 500, 1500])
def test_neither_people_nor_offsets_grow_with_the_length_of_a_clip(frames):
    truths, joints = people(3, frames, 0.02)
    shapes = fit(joints)
    off = [height(shapes.people[p].betas) - height(t.betas[0]) for p, t in enumerate(truths)]
    # Nobody stands on a ground and the detector has no offsets. Noise leaves 10 mm and 3 mm; with
    # the poses' own weight of the prior and all frames, 1500 of them make it 128 mm and 24 mm.
    assert np.abs(off).max() < 0.02
    assert np.sqrt((shapes.offsets**2).mean()) < 0.005


def test_a_clip_is_looked_at_for_no_longer_than_is_asked():
    _, joints = people(1, 1000, 0.02)
    broken = {p: (j.copy(), c) for p, (j, c) in joints.items()}
    # Nothing is used between the two parts of a second each, at both ends.
    broken[0][0][60:940] += 100.0
    settings = SETTINGS.model_copy(update={"shape_time_s": 2.0})
    solver = Solver(SOLVER.chained, SOLVER.prior, settings, None)
    one = fit(joints, solver=solver)
    two = fit(broken, solver=solver)
    np.testing.assert_array_equal(one.people[0].betas, two.people[0].betas)


def test_what_other_clips_know_of_a_person_counts():
    truths, joints = people(1, 50, 0.04)
    true = truths[0].betas[0]
    sure = Shape(true, 1e-4 * np.eye(MODEL.shapes))
    alone = fit(joints).people[0]
    known = fit(joints, {0: sure}).people[0]
    assert np.linalg.norm(known.betas - true) < 0.1 < np.linalg.norm(alone.betas - true)
    assert np.trace(known.covariance) < 1e-2 * np.trace(alone.covariance)


def test_offsets_are_the_less_sure_the_fewer_frames_tell_them():
    spreads = []
    for frames in (25, 400):
        _, joints = people(2, frames, 0.02)
        shapes = fit(joints)
        spreads.append(np.trace(shapes.offsets_covariance, axis1=-2, axis2=-1))
    assert (spreads[1] <= spreads[0]).all() and (spreads[1] > 0.0).all()


def test_without_people_there_are_no_offsets():
    shapes = fit({})
    assert shapes.people == {}
    np.testing.assert_array_equal(shapes.offsets, 0.0)


def test_what_few_seconds_say_of_offsets_is_held_back_by_how_often_errors_repeat():
    _, joints = people(1, 100, 0.01)
    for _, (places, _) in joints.items():
        places[:, [15, 16], 2] += 0.06
    sizes, spreads = [], []
    for repeat in (1e6, 40.0, 0.02):
        settings = SETTINGS.model_copy(update={"bias_time_s": repeat})
        shapes = fit(joints, solver=Solver(SOLVER.chained, SOLVER.prior, settings, None))
        sizes.append(np.linalg.norm(shapes.offsets[15]))
        spreads.append(np.trace(shapes.offsets_covariance[15]))
    # The prior counts once for the two seconds, and a hundred times where errors repeat as often.
    assert sizes[0] == sizes[1] > 0.01
    assert sizes[2] < 0.1 * sizes[1]
    assert spreads[2] < 0.02 * spreads[1]
