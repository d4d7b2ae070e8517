"""The Khronos validator accepts glTF files, and three.js poses bodies as the model does."""

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.formats.gltf_file import AnimatedBody, write_gltf
from worldpose.geometry.cameras import Camera

FPS, FRAMES = 50.0, 60
MODULES = Path(
    os.environ.get("WORLDPOSE_NODE_MODULES")
    or Path(__file__).parents[3] / "infra" / "review_pages" / "node_modules"
)
IN_NODE = pytest.mark.skipif(
    shutil.which("node") is None or not (MODULES / "gltf-validator").is_dir(),
    reason="no gltf-validator and three: npm ci in infra/review_pages",
)
NOTES = {"software": "worldpose", "licence": "For tests alone.", "clip": "a"}


@pytest.fixture(scope="module")
def model():
    return load_open_body()


def motion(seed, frames=FRAMES):
    """A person with a random pose that changes by some degrees from frame to frame."""
    rng = np.random.default_rng(seed)

    def wander(size, step):
        return np.cumsum(rng.normal(0.0, step, (frames, size)), axis=0)

    return BodyParameters(
        rng.standard_normal((1, 10)),
        rng.uniform(-3.0, 3.0, 3) + wander(3, 0.05),
        rng.uniform(-1.0, 1.0, 69) + wander(69, 0.02),
        rng.uniform(-50.0, 50.0, 3) + wander(3, 0.1),
    )


def people():
    """One person in all frames, one who is absent at first and for a while."""
    second = motion(1)
    transl = second.transl.copy()
    transl[:5] = transl[20:30] = np.nan
    gappy = BodyParameters(second.betas, second.global_orient, second.body_pose, transl)
    return [
        AnimatedBody("person_003", motion(0), {"person": 3, "kind": "triangulated"}),
        AnimatedBody("person_007", gappy, {"person": 7, "kind": "mixed"}),
    ]


def cameras(principal=(959.5, 539.5)):
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # looks along +y
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 0.5, FRAMES), [0, 1, 0])).as_matrix()
    size = np.array([1920, 1080])
    focal = np.linspace([3000.0, 3000.0], [4000.0, 4000.0], FRAMES)
    focal[7] = np.nan

    def camera(focal, rotation):
        place = -rotation @ np.array([1.0, -70.0, 12.0])
        return Camera.from_matrices(
            np.stack([intrinsics(f, principal) for f in focal.reshape(-1, 2)]).reshape(
                *focal.shape[:-1], 3, 3
            ),
            np.zeros((*focal.shape[:-1], 5)),
            rotation,
            place,
            size,
        )

    return {"north": camera(np.array([2000.0, 2000.0]), turn), "main": camera(focal, turns @ turn)}


def intrinsics(focal, principal):
    return np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1.0]])


def write(path, model, **changes):
    line = np.array([[-52.5, -34.0, 0.0], [52.5, -34.0, 0.1], [52.5, 34.0, 0.0]])
    given = {"cameras": cameras(), "markings": [line], "notes": NOTES, **changes}
    write_gltf(path, model, given.pop("people", people()), FPS, **given)


def read_glb(path):
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + length])


def pose_in_three(path, frames):
    times = [f"{frame / FPS:.9f}" for frame in frames]
    script = Path(__file__).parent / "gltf_in_three.mjs"
    done = subprocess.run(
        ["node", script, MODULES, path, *times], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@IN_NODE
def test_three_js_poses_every_body_and_camera_as_they_are(model, tmp_path):
    write(tmp_path / "a.glb", model)
    frames = [0, 6, 15, 40, FRAMES - 1]
    found = pose_in_three(tmp_path / "a.glb", frames)
    assert found["issues"]["messages"] == []
    assert found["asset"]["copyright"] == "For tests alone."
    assert found["duration"] == pytest.approx((FRAMES - 1) / FPS)
    checked = 0
    for frame, posed in zip(frames, found["frames"], strict=True):
        for body in people():
            poses = body.poses[frame]
            if np.isnan(poses.transl).any():
                assert posed["nodes"][body.name]["scale"] == 0
                continue
            assert posed["nodes"][body.name]["scale"] == 1
            nodes = [posed["nodes"][f"{body.name}_{joint}"] for joint in SKELETONS["smpl24"]]
            places = np.array([node["place"] for node in nodes])
            assert np.abs(places - model.joints(poses)).max() < 1e-4
            turns = Rotation.from_quat([node["turn"] for node in nodes])
            truth = Rotation.from_matrix(model.articulate(poses).rotations)
            assert np.degrees((turns * truth.inv()).magnitude()).max() < 0.01
            checked += 1
        for name, camera in cameras().items():
            one = camera[frame] if camera.batch_shape else camera
            node = posed["nodes"][name]
            np.testing.assert_allclose(node["place"], one.center, atol=1e-4)
            ahead = Rotation.from_quat(node["turn"]).apply([0.0, 0.0, -1.0])
            np.testing.assert_allclose(ahead, one.cam_from_world.rotation[2], atol=1e-5)
            up = Rotation.from_quat(node["turn"]).apply([0.0, 1.0, 0.0])
            np.testing.assert_allclose(up, -one.cam_from_world.rotation[1], atol=1e-5)
    assert checked == 9
    (north,) = (lens for lens in found["lenses"] if lens["name"] == "north")
    assert north["fov"] == pytest.approx(np.degrees(2 * np.arctan(540 / 2000.0)))


def test_without_a_surface_the_file_has_joints_alone(model, tmp_path):
    write(tmp_path / "a.glb", model, surface=False, markings=[], cameras={})
    content = read_glb(tmp_path / "a.glb")
    assert "meshes" not in content and "skins" not in content
    names = {node["name"] for node in content["nodes"]}
    assert {f"person_007_{joint}" for joint in SKELETONS["smpl24"]} <= names
    assert content["asset"]["extras"] == NOTES
