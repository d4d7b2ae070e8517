"""The scripts in examples/ do what they say, with the match and the run that other tests share."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import TINY, succeed

import worldpose
from flows.results.export import EXPORTS
from worldpose.body_fitting.evidence import perceived_joints
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.release_cameras import read_camera

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def script(monkeypatch, capsys):
    """Runs an example in this process and returns its output."""

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture
def bodies(tiny_run):
    return worldpose.open_run(tiny_run, TINY)["body_fitting/clip"]


def test_a_match_in_one_script_gives_the_bodies_of_the_factory(script, tiny, bodies, tmp_path):
    out = tmp_path / "joints.npz"
    assert "5 people" in script("whole_match.py", tiny, out)
    joints = worldpose.read_joints(out)
    np.testing.assert_array_equal(joints.frames, bodies.frame)
    np.testing.assert_allclose(joints.joints, bodies.joints, atol=1e-5)  # stored as float32
    np.testing.assert_allclose(joints.covariance, bodies.covariance, rtol=1e-3, atol=1e-9)


def test_clicks_give_a_camera_and_every_residual(script, tiny):
    out = script(
        "calibrate_camera.py", tiny / "annotations/static_calibration/cam00.json", 1920, 1080
    )
    clicks = json.loads((tiny / "annotations/static_calibration/cam00.json").read_text())
    assert out.count(" px  ") == len(clicks["points"])
    stated = [float(number) for number in out.split("center [")[1].split("]")[0].split()]
    truth = read_camera(tiny / "reference/cameras/cam00.npz")
    assert np.linalg.norm(np.ravel(truth.center)[:3] - stated) < 1.5  # 76 m away, by clicks alone


@pytest.fixture
def coco(tiny, tiny_run, tmp_path):
    """A folder with a calibration, and the bodies' keypoints in the image of every camera."""
    folder = tmp_path / "coco"
    succeed("export", TINY, "--project", tiny_run, "--format", "coco", "--out", folder)
    cameras = {file.stem: read_camera(file) for file in (tiny / "reference/cameras").glob("cam*")}
    write_calibration_toml(
        folder / "calibration.toml",
        {name: camera.to_calibration(name) for name, camera in cameras.items()},
    )
    return folder


def farthest(joints, bodies):
    """Mean distance of the joints [m] of the person who is farthest from the nearest body."""
    distance = np.linalg.norm(joints[:, :, None] - bodies.joints.values[:, None], axis=-1)
    return np.nanmax(np.nanmin(distance.mean(axis=-1), axis=2))


def test_keypoints_in_coco_form_become_joints(script, coco, bodies, tmp_path):
    out = tmp_path / "joints.npz"
    script("triangulate_coco.py", coco / "calibration.toml", coco, 25, out)
    assert farthest(worldpose.read_joints(out).joints, bodies) < 0.02


def test_the_script_in_the_readme_gives_bodies(coco, bodies, monkeypatch):
    noise = np.random.default_rng(7)
    for file in coco.glob("cam*.json"):
        content = json.loads(file.read_text())
        for person in content["annotations"]:
            keypoints = np.reshape(person["keypoints"], (17, 3))
            keypoints[:, :2] += noise.normal(0.0, 2.0, (17, 2))
            person["keypoints"] = keypoints.ravel().tolist()
        file.write_text(json.dumps(content))
    readme = (EXAMPLES.parent / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    monkeypatch.chdir(coco)
    names = {}
    exec(example, names)
    found = names["found"]
    placed, fitted = found.joints.triangulation.joints, found.bodies
    assert farthest(fitted.joints, bodies) < 0.8 * farthest(placed, bodies)
    assert farthest(fitted.joints, bodies) < 0.04
    assert np.isfinite(fitted.covariance[np.isfinite(fitted.joints[..., 0])]).all()


def test_joints_are_evaluated_against_the_truth(script, tiny):
    truth = tiny / "reference/joints.npz"
    metrics, _ = json.JSONDecoder().raw_decode(script("evaluate_result.py", truth, truth, 25))
    assert metrics["g_mpjpe_mm"] < 1e-6
    assert metrics["coverage"] == metrics["idf1"] == 1.0


def test_a_stage_of_ones_own_is_computed_once_and_is_right(script, project_copy, bodies):
    first = script("add_stage.py", project_copy, TINY)
    assert script("add_stage.py", project_copy, TINY) == first
    (result,) = (project_copy / "results" / TINY / "speeds/clip").iterdir()
    assert (result / "manifest.json").exists()
    hips = bodies.joints.values[:, 0, 11:13, :2].mean(axis=1)
    length = float(first.split("clip person 0: ")[1].split()[0])
    assert abs(length - np.linalg.norm(np.diff(hips, axis=0), axis=-1).sum()) < 0.06
    fastest = float(first.split("at most ")[1].split()[0])
    steps = np.linalg.norm(hips[10:] - hips[:-10], axis=-1) * 25 / 10
    assert abs(fastest - steps.max()) < 0.06


def test_the_library_lists_what_it_has():
    for name in worldpose.__all__:
        assert getattr(worldpose, name) is not None
        assert name in dir(worldpose)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        worldpose.nothing  # noqa: B018


def test_the_array_example_of_the_library_guide_runs():
    page = (EXAMPLES.parent / "docs/how-to/library.md").read_text()
    section = page.partition("## Arrays of your own")[2]
    code = section.partition("```python\n")[2].partition("```")[0]
    turns = [np.array([[c, -s, 0], [0, 0, -1], [s, c, 0]]) for c, s in ((1, 0), (0, 1), (0.8, 0.6))]
    joints = np.random.default_rng(1).uniform(-0.5, 0.5, (3, 2, 17, 3))
    given = {
        "K": np.tile([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]], (3, 1, 1)),
        "distortion": np.zeros((3, 5)),
        "R": np.stack(turns),
        "t": np.tile([0.0, 0, 8], (3, 1)),
        "size": np.tile([1920, 1080], (3, 1)),
    }
    cameras = worldpose.Camera.from_matrices(*given.values())
    given["keypoints"] = np.stack([cameras.project(frame) for frame in joints.reshape(3, 34, 3)])
    given["keypoints"] = given["keypoints"].reshape(3, 3, 2, 17, 2)
    given["confidence"] = np.ones((3, 3, 2, 17))
    exec(code, given)
    np.testing.assert_allclose(given["result"].joints, joints, atol=1e-3)


def test_a_cost_term_of_ones_own_moves_the_camera_to_the_surveyed_height(script, tiny):
    truth = np.ravel(read_camera(tiny / "reference/cameras/cam00.npz").center)[:3]
    clicks = tiny / "annotations/static_calibration/cam00.json"
    out = script("add_cost_term.py", clicks, 1920, 1080, truth[2])
    by_clicks, with_mast = (
        np.array(part.split("]")[0].split(), dtype=float) for part in out.split("[")[1:]
    )
    assert abs(with_mast[2] - truth[2]) < 0.03 < abs(by_clicks[2] - truth[2])
    assert np.linalg.norm(with_mast - truth) < np.linalg.norm(by_clicks - truth)


def test_an_export_of_ones_own_holds_the_ways_of_all_people(
    script, tiny_run, bodies, tmp_path, monkeypatch
):
    # The example adds to the table of exports, which other tests of this process compare.
    monkeypatch.setattr("flows.results.export.EXPORTS", dict(EXPORTS))
    assert "clip.geojson" in script("add_export.py", tiny_run, TINY, tmp_path)
    ways = json.loads((tmp_path / "clip.geojson").read_text())["features"]
    detected = perceived_joints(bodies.joints.values, bodies.joint_offsets.values)
    hips = detected[:, :, 11:13, :2].mean(axis=2)
    assert [way["properties"]["person"] for way in ways] == bodies.person.values.tolist()
    for person, way in enumerate(ways):
        np.testing.assert_allclose(way["geometry"]["coordinates"], hips[:, person], atol=6e-4)


def test_a_detector_of_ones_own_gives_poses_that_an_import_takes(script, tmp_path):
    match, poses = tmp_path / "match", tmp_path / "poses"
    scenario = ("--scenario", "tiny", "--seed", 2, "--duration", 0.2, "--cameras", 2)
    succeed("simulate", *scenario, "--render", "--no-stills", "--out", match)
    for camera in ("cam00", "cam01"):
        script("add_detector.py", match / f"videos/{camera}.mp4", poses / f"{camera}.npz")
    truth = np.load(match / "reference/boxes/cam00.npz")["boxes"][0][:, None]
    found = np.load(poses / "cam00.npz")["boxes"][0]
    inside = np.minimum(truth[..., 2:], found[:, 2:]) - np.maximum(truth[..., :2], found[:, :2])
    common = np.clip(inside, 0.0, None).prod(axis=-1)
    areas = [np.prod(each[..., 2:] - each[..., :2], axis=-1) for each in (truth, found)]
    overlap = np.nan_to_num(common / (areas[0] + areas[1] - common))
    assert (overlap.max(axis=1) > 0.5).sum() >= 3  # of five: green and white kits look like pitch
    given = ("--calibration", match / "reference/calibration.toml", "--detections", poses)
    succeed("import", *given, "--fps", 25, "--out", tmp_path / "imported")


FOV_LENS = """
import numpy as np
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid

def camera(w):
    lens = np.array([w, 0, 0, 0, 0, 0, 0, 0.0])
    size, pixel = np.array([1920, 1080]), np.array([960.0, 540.0])
    return Camera(np.array([900.0, 900.0]), pixel, lens, Rigid.identity(), size, LensModel.FOV)

x, w = np.random.default_rng(0).uniform([-2, -1, 1], [2, 1, 3], (50, 3)), 0.9
r = np.linalg.norm(x[:, :2] / x[:, 2:], axis=1, keepdims=True)
bent = np.arctan(2.0 * r * np.tan(0.5 * w)) / (r * w)
seen = camera(w).project_with_jacobians(x)
np.testing.assert_allclose(seen.points_image, 900 * bent * x[:, :2] / x[:, 2:] + [960, 540])
step = 1e-6
by_w = (camera(w + step).project(x) - camera(w - step).project(x)) / (2 * step)
np.testing.assert_allclose(seen.d_distortion[..., 0], by_w, atol=1e-5)
for axis in range(3):
    moved = step * np.eye(3)[axis]
    by_x = (camera(w).project(x + moved) - camera(w).project(x - moved)) / (2 * step)
    np.testing.assert_allclose(seen.d_points[..., axis], by_x, atol=1e-5)
rays = camera(w).unproject(seen.points_image).directions
np.testing.assert_allclose(rays, x / np.linalg.norm(x, axis=1, keepdims=True), atol=1e-12)
"""


def test_a_lens_model_of_ones_own_is_right_everywhere(tmp_path):
    binary = shutil.ignore_patterns("__pycache__", "*.onnx", "*.safetensors")
    for package in ("worldpose", "data_contracts"):
        shutil.copytree(EXAMPLES.parent / package, tmp_path / package, ignore=binary)
    subprocess.run(["git", "apply", EXAMPLES / "add_lens_model.patch"], cwd=tmp_path, check=True)
    pure_python = {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tmp_path)}
    script = [sys.executable, "-c", FOV_LENS]
    subprocess.run(script, cwd=tmp_path, env={**os.environ, **pure_python}, check=True)
