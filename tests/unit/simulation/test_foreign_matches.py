"""Matches of the second world: projection, detections, folders, independence."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from worldpose.formats.challenge import read_camera
from worldpose.formats.joints_file import read_joints
from worldpose.ingest.match_folder import read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.foreign import rigs as foreign_rigs
from worldpose.simulation.foreign.detectors import (
    PROFILES,
    DetectorProfile,
    defined_joints,
    detect_people,
    draw_detector,
)
from worldpose.simulation.foreign.matches import simulate_foreign_match, simulate_foreign_scene
from worldpose.simulation.foreign.rigs import view_people
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS

SOURCES = Path(foreign_rigs.__file__).parent
LAB, MIXED = FOREIGN_SCENARIOS["foreign-lab"], FOREIGN_SCENARIOS["foreign-mixed"]
EXACT = DetectorProfile(
    name="exact",
    **dict.fromkeys(
        ("definition", "personal", "view_bias", "height_bias", "noise", "floor", "swapped")
        + ("strayed", "joint_missed", "person_missed", "smallest", "merged", "ghosts", "flashes")
        + ("duplicates",),
        0.0,
    ),
    hidden_kept=1.0,
)


def test_no_module_imports_motion_noise_or_cameras_of_the_first_world():
    imported = {
        node.module
        for path in SOURCES.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
    }
    first = {name for name in imported if name.startswith("worldpose.simulation.")}
    shared = {
        f"worldpose.simulation.{name}" for name in ("recorded_files", "reference", "visibility")
    }
    assert first > shared
    assert all(name.startswith("worldpose.simulation.foreign") for name in first - shared)
    assert not any(
        name.startswith(("worldpose.body", "worldpose.body_fitting")) for name in imported
    )


def test_an_exact_detector_reports_exact_pixels_of_the_truth():
    scene = simulate_foreign_scene(LAB, 3, duration=0.3)
    detector = draw_detector(EXACT, np.random.default_rng(0))
    statures = np.array([person.skeleton.stature for person in scene.people])
    joints = scene.truth.joints
    personal = np.zeros((joints.shape[1], 17, 3))
    assert defined_joints(joints, detector, personal) == pytest.approx(joints, abs=1e-12)
    for camera in scene.cameras.values():
        view = view_people(camera, joints, statures, None)
        report = detect_people(
            *(detector, view, camera.project(joints), camera.camera.image_size, scene.fps, 0.0),
            np.random.default_rng(1),
        )
        frame, place = np.nonzero(report.person >= 0)
        found = report.observations.keypoints[frame, place]
        true = camera.project(joints)[frame, report.person[frame, place]]
        there = np.isfinite(found[..., 0])
        assert there.mean() > 0.2
        assert found[there] == pytest.approx(true[there], abs=1e-3)


def test_errors_have_the_size_that_the_profile_states():
    profile = EXACT.model_copy(update={"noise": 0.02, "sudden": 0.5, "tail": 3.5, "limbs": 0.45})
    scene = simulate_foreign_scene(LAB, 11, duration=4.0, people=1)
    detector = draw_detector(profile, np.random.default_rng(0))
    name, camera = next(iter(scene.cameras.items()))
    joints = scene.truth.joints
    statures = np.array([scene.people[0].skeleton.stature])
    view = view_people(camera, joints, statures, None)
    true = camera.project(joints)
    off = []
    for seed in range(20):
        report = detect_people(
            *(detector, view, true, camera.camera.image_size, scene.fps, 0.0),
            np.random.default_rng(seed),
        )
        frame, place = np.nonzero(report.person == 0)
        error = report.observations.keypoints[frame, place] - true[frame, 0]
        size = view.size[frame, 0]
        stated = 0.02 * size * (size / 100.0) ** -0.3
        open_ = ~view.behind_self[frame, 0]
        off.append((error[:, 7] / stated[:, None])[open_[:, 7]])
    spread = np.nanstd(np.concatenate(off))
    assert 0.75 < spread < 1.25, name


def content(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_same_seed_writes_the_same_bytes_and_another_seed_others(tmp_path):
    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        simulate_foreign_match(MIXED, seed, tmp_path / name, duration=0.3, cameras=3, people=2)
    assert content(tmp_path / "a") == content(tmp_path / "b")
    assert (
        content(tmp_path / "a")["reference/joints.npz"]
        != content(tmp_path / "c")["reference/joints.npz"]
    )


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


def test_clicked_cameras_have_clicks_near_the_named_points():
    scenario = FOREIGN_SCENARIOS["foreign-match"].model_copy(update={"given": 0.0})
    off, cameras = [], 0
    for seed in range(3):
        scene = simulate_foreign_scene(scenario, seed, duration=0.2)
        painted = PitchTemplate.from_spec(scene.pitch.painted)
        assert scene.given == {}
        for name, markings in scene.clicked.items():
            cameras += len(markings.points) >= 6
            for point in markings.points:
                if point.name in scene.misnamed[name]:
                    continue
                place = scene.cameras[name].project(painted.positions([point.name]))[0]
                off.append(np.subtract(point.xy, place))
    assert cameras > 0.8 * 24
    off = np.array(off)
    assert 0.3 < np.median(np.abs(off)) / 0.6745 < 1.3
    assert np.abs(off).max() > 4.0 * np.median(np.abs(off))  # heavy tails
