"""Crown and end fall of a pitch: heights, derivatives, and what a survey tells of them."""

import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import PitchTemplate


def test_surface_falls_to_touch_lines_and_goal_lines():
    pitch = PitchTemplate.from_spec(PitchSpec(crown=0.2, end_fall=0.4))
    assert float(pitch.height(0.0, 0.0)) == 0.0
    assert float(pitch.height(52.5, 0.0)) == pytest.approx(-0.4)
    assert float(pitch.height(0.0, -34.0)) == pytest.approx(-0.2)
    assert pitch.points["corner_left_far"][2] == pytest.approx(-0.6)
    line = pitch.marking_points("touch_line_near", 0.5)
    assert line[:, 2] == pytest.approx(pitch.height(line[:, 0], line[:, 1]))


def test_another_surface_moves_all_but_surveyed_heights():
    points = {
        "corner_left_far": (-52.5, 34.0, -0.3),
        "mast": (-60.0, 0.0),
        "corner_left_near": (-52.5, -34.0),
    }
    spec = PitchSpec(crown=0.2, points=points)
    moved = PitchTemplate.from_spec(spec).with_surface([0.1, 0.3])
    made = PitchTemplate.from_spec(spec.model_copy(update={"crown": 0.1, "end_fall": 0.3}))
    for name, place in made.points.items():
        assert moved.points[name] == pytest.approx(place, abs=1e-12)
    assert moved.points["corner_left_far"][2] == -0.3
    assert moved.by_surface(["corner_left_far", "corner_left_near"]).tolist() == [[0, 0], [-1, -1]]


def test_derivatives_of_samples_are_those_of_their_heights():
    pitch = PitchTemplate.from_spec(PitchSpec(points={"corner_right_near": (52.5, -34.0, -0.1)}))
    change = np.array([-0.05, 0.25])
    other = pitch.with_surface(pitch.surface + change)
    here, there = (each.sample_lines(1.0).points_world[:, 2] for each in (pitch, other))
    assert there - here == pytest.approx(pitch.samples_by_surface(1.0) @ change, abs=1e-12)
