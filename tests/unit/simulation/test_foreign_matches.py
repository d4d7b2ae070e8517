"""Matches of the second world: projection, detections, folders, independence."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from worldpose.formats.joints_file import read_joints
from worldpose.formats.release_cameras import read_camera
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.foreign import rigs as foreign_rigs
from worldpose.simulation.foreign.detectors import PROFILES
from worldpose.simulation.foreign.matches import simulate_foreign_match
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS

SOURCES = Path(foreign_rigs.__file__).parent
LAB, MIXED = FOREIGN_SCENARIOS["foreign-lab"], FOREIGN_SCENARIOS["foreign-mixed"]


def test_no_module_imports_motion_noise_or_cameras_of_the_first_world():
    imported = {
        node.module
        for path in SOURCES.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
    }
    first = {name for name in imported if name.startswith("worldpose.simulation.")}
    shared = {f"worldpose.simulation.{name}" for name in ("recorded_files", "reference")}
    assert first > shared
    assert all(name.startswith("worldpose.simulation.foreign") for name in first - shared)
    bodies = {name for name in imported if name.startswith("worldpose.body")}
    assert bodies == {"worldpose.body.occlusions"}


@pytest.mark.parametrize("name", FOREIGN_SCENARIOS)
def test_every_scenario_makes_a_match_that_the_factory_takes(tmp_path, name):
    scenario = FOREIGN_SCENARIOS[name]
    spec = simulate_foreign_match(scenario, 7, tmp_path / "match", duration=0.2)
    match = read_match(tmp_path / "match")
    assert match.spec == spec
    assert scenario.cameras[0] <= len(spec.cameras) <= scenario.cameras[1]
    truth = read_joints(tmp_path / "match" / "reference" / "joints.npz")
    assert scenario.people[0] <= len(truth.person_ids) <= scenario.people[1]
    assert np.isfinite(truth.joints).all()
    record = json.loads((tmp_path / "match" / "reference" / "world.json").read_text())
    assert len(record["people"]) == len(truth.person_ids)
    assert record["detector"]["name"] in PROFILES
    defined = read_joints(tmp_path / "match" / "reference" / "defined_joints.npz")
    apart = np.linalg.norm(defined.joints - truth.joints, axis=-1)
    assert 0.01 < apart.mean() < 0.12
    for camera in spec.cameras:
        size = (camera.width, camera.height)
        file = tmp_path / "match" / "reference" / "cameras" / f"{camera.id}.npz"
        pixels = read_camera(file, size).project(truth.joints.reshape(-1, 3))
        assert np.isfinite(pixels).any()
