"""A match of two fisheye cameras and a rational one, without truth, from import to exports."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera
from command_line import succeed
from imported_people import import_people, seen_by

from worldpose.formats.joints_file import read_joints
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.lens_models import LensModel

NOISE_PX = 1.0
LENSES = {
    "cam00": (LensModel.FISHEYE, (-0.05, 0.02, 0.0, 0.0, -0.01, 0.002, 0.0, 0.0)),
    "cam01": (LensModel.FISHEYE, (-0.09, 0.0, 0.0, 0.0, 0.004, -0.002, 0.0, 0.0)),
    "cam02": (LensModel.RATIONAL, (0.4, -0.05, 1e-3, -2e-3, 0.01, 0.7, 0.02, 0.003)),
}


@pytest.fixture(scope="module")
def exported(server, tiny, tmp_path_factory):
    """The true cameras and joints, and the folder of exports."""
    folder = tmp_path_factory.mktemp("lenses")
    joints = read_joints(tiny / "reference" / "joints.npz").joints[:, :2]
    middle, cameras = joints.mean(axis=(0, 1, 2)), {}
    for turn, (name, (model, lens)) in enumerate(LENSES.items()):
        away = np.array([np.cos(2.1 * turn), np.sin(2.1 * turn)])
        place = [*(middle[:2] + 14.0 * away), 5.0]
        # The people are far from the image's middle, where Brown's model is hundreds of px off.
        aim = [*(middle[:2] + 8.0 * away[::-1] * [1.0, -1.0]), 1.0]
        camera = look_at_camera(place, aim, 800.0)
        cameras[name] = replace(camera, distortion=np.array(lens), lens_model=model)
    rng = np.random.default_rng(0)
    pixels = {name: seen_by(each, joints, rng, NOISE_PX) for name, each in cameras.items()}
    match, out = import_people(folder, cameras, pixels, 50), folder / "out"
    succeed("run", match, "--project", folder / "project")
    formats = ("joints", "worldpose", "coco", "gltf", "viewer")
    asked = [word for form in formats for word in ("--format", form)]
    said = succeed("export", "match", *asked, "--out", out, "--project", folder / "project").out
    assert "differ from those used by up to" in said
    succeed("report", "match", "--out", folder / "report", "--project", folder / "project")
    return cameras, joints, out


def test_joints_of_fisheye_cameras_are_within_the_noise_of_the_truth(exported):
    cameras, joints, out = exported
    found = read_joints(out / "joints.npz")
    assert found.joints.shape[:2] == joints.shape[:2]
    off = np.linalg.norm(found.joints[:, :, None] - joints[:, None], axis=-1)
    error = np.nanmedian(off, axis=(0, 3)).min(axis=1)
    depth = np.mean([np.linalg.norm(c.center - joints.mean((0, 1, 2))) for c in cameras.values()])
    noise_m = NOISE_PX * depth / np.mean([c.focal.mean() for c in cameras.values()])
    assert (error < 1.5 * noise_m).all(), (error, noise_m)


def test_exports_say_the_lens_and_independent_readers_find_the_pixels(exported):
    cameras, _, out = exported
    errors = json.loads((out / "lens_errors.json").read_text())
    (scene,) = (out / "scenes").glob("*.glb")
    blob = scene.read_bytes()
    document = json.loads(blob[20 : 20 + int.from_bytes(blob[12:16], "little")])
    extras = {each["name"]: each.get("extras", {}) for each in document["nodes"]}
    for name, camera in cameras.items():
        model = LENSES[name][0].label
        assert errors[name]["lens_model"] == extras[name]["lens_model"] == model
        points = camera.unproject(np.array([[500.0, 400.0], [1300.0, 800.0]]))
        world = points.origins + 15.0 * points.directions
        released = read_camera(out / "cameras" / f"{name}.npz")
        off = np.linalg.norm(released.project(world) - camera.project(world), axis=1).max()
        assert off < errors[name]["max_error_px"] + 1.5  # and the adjusted camera's own change
        lens = next(v for k, v in extras[name].items() if k.startswith("distortion"))
        function = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
        matrix = np.diag([*camera.focal, 1.0])
        matrix[:2, 2] = camera.principal_point
        pose = camera.cam_from_world.rotvec, np.array(camera.cam_from_world.translation)
        pixels = function(world[:, None], *pose, matrix, np.array(lens))[0].reshape(-1, 2)
        assert np.abs(pixels - camera.project(world)).max() < 1.5
