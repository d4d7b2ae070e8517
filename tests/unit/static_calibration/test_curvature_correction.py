"""Cameras of clicks and lines that leave distance and focal length nearly open."""

import clicking_people as people
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import Surface
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.curvature_correction import (
    ClicksAndBars,
    free_on_pitch,
)
from worldpose.static_calibration.evidence import gather_evidence
from worldpose.static_calibration.fit import build_problem
from worldpose.static_calibration.line_samples import PaintNoise, project_lines, sample_markings
from worldpose.static_calibration.line_search import Bars
from worldpose.static_calibration.parameters import step_camera
from worldpose.static_calibration.settings import StaticCalibrationSettings

SETTINGS = StaticCalibrationSettings()
NOISE = PaintNoise(0.006, 0.001, 0.05, 1.0)
HERE = np.array([people.PITCH.crown, people.PITCH.end_fall])


def corner_camera():
    """A camera that sees one corner of a penalty area, and the touch line beyond it."""
    rng = np.random.default_rng(3)
    return place_camera(SCENARIOS["sparse-corner"].rig, 3, np.zeros(3), PitchSpec(), rng)


def evidence(camera, noise=0.02):
    """The corner clicked, and exact bars on all that is seen."""
    clicked = people.points(people.visible(camera, ["penalty_area_left_near_front"]))
    problem = build_problem(
        gather_evidence(people.PITCH, clicked, people.SIZE, 0.5, "test"), people.SIZE, SETTINGS
    )
    samples = sample_markings(people.PITCH, 0.5)
    seen = project_lines(camera, samples, 0.12, NOISE)
    here = seen.visible
    bars = Bars(
        samples[here],
        seen.places[here],
        np.full(int(here.sum()), noise),
        HERE,
        seen.by_paint[here],
        seen.unknowns[here],
        NOISE,
    )
    return ClicksAndBars(problem, 1.0, bars, Surface.of(people.PITCH))


def test_derivatives_are_those_of_the_residuals():
    camera = corner_camera()
    given = evidence(camera)
    _, rows = given.residuals(camera, HERE)
    for column, parameter in enumerate(np.flatnonzero(free_on_pitch(given.problem))):
        step = np.zeros(14)
        step[parameter] = 1e-5 if parameter in (0, 1, 2, 6) else 1e-3
        ahead, behind = (
            given.residuals(step_camera(camera, sign * step[:12]), HERE + sign * step[12:])[0]
            for sign in (1.0, -1.0)
        )
        slope = (ahead - behind) / (2.0 * step[parameter])
        # Exact bars: residuals are zero, and so is what the turning normals would add.
        scale = np.abs(rows[:, column]).max()
        assert rows[:, column] == pytest.approx(slope, rel=1e-3, abs=1e-4 * scale)
