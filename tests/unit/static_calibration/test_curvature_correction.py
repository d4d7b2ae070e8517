"""Cameras of clicks and lines that leave distance and focal length nearly open."""

from dataclasses import replace

import clicking_people as people
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import Surface
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.adjustment import build_problem, camera_row
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.curvature_correction import (
    ClicksAndBars,
    fit_with_curvature,
    free_on_pitch,
)
from worldpose.static_calibration.evidence import gather_evidence
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


def test_bars_slide_along_their_line_for_nothing():
    camera = corner_camera()
    bars = evidence(camera).bars
    arc = bars.samples.bend_world.any(axis=1)
    moved = replace(bars, pixels=camera.project(bars.samples.beside(0.4)))
    off = np.abs(moved.whiten_residuals(camera, HERE)[0][: len(arc)]) * bars.noise
    # Forty centimetres are 25 px; lenses bend by a hundredth of a pixel on the way.
    assert off[~arc].max() < 0.02


def test_shared_survey_is_taken_off_once():
    camera = corner_camera()
    bars = evidence(camera).bars
    off, _ = bars.whiten_residuals(camera, HERE)
    assert np.abs(off).max() < 1e-9
    # A surveyed point that is two deviations off costs four, however many samples show it.
    point = bars.unknowns[0, 1]
    shift = 2.0 * np.where(bars.unknowns == point, bars.by_paint, 0.0).sum(axis=1)
    seen = project_lines(camera, bars.samples, 0.12, NOISE)
    other = replace(bars, pixels=bars.pixels + shift[:, None] * seen.normals)
    cost = float((other.whiten_residuals(camera, HERE)[0] ** 2).sum())
    assert 0.0 < cost <= 4.0 + 1e-6


def test_valley_widens_the_covariance_and_is_the_same_each_time():
    camera = corner_camera()
    given = evidence(camera)
    wide = fit_with_curvature(given, camera)
    free = np.flatnonzero(free_on_pitch(given.problem))
    rows = given.residuals(wide.camera, wide.surface)[1]
    added = wide.covariance[np.ix_(free, free)] - np.linalg.inv(rows.T @ rows)
    size = np.sqrt(np.diag(wide.covariance)[free])
    assert np.linalg.eigvalsh(added / np.outer(size, size)).min() > -1e-6
    again = fit_with_curvature(given, camera)
    assert (again.covariance == wide.covariance).all()
    assert (camera_row(again.camera) == camera_row(wide.camera)).all()


def test_stills_without_lines_make_a_camera_weak():
    camera, rng = people.seat(0)
    clicked = people.click(camera, rng).clicked
    picture = np.full((1080, 1920), 90, np.uint8)
    found = calibrate_camera(people.PITCH, clicked, people.SIZE, picture=picture)
    assert found.report.stage == "points"
    assert found.report.weak
    assert any("no painted lines" in reason for reason in found.report.reasons)
    assert not calibrate_camera(people.PITCH, clicked, people.SIZE).report.weak
