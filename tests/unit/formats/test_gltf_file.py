"""Scenes in glTF, USD and the viewer's own form pose bodies as the model does."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from viewer_clips import CENTER, bodies_clip, mixed_clip

from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats import viewer_file
from worldpose.formats.gltf_file import AnimatedBody, write_gltf
from worldpose.formats.usd_file import write_usd
from worldpose.formats.viewer_file import (
    decode_bodies,
    decode_part,
    encode_frames,
    encode_scene,
    read_viewer,
    write_viewer,
)
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


LINE = np.array([[-52.5, -34.0, 0.0], [52.5, -34.0, 0.1], [52.5, 34.0, 0.0]])


def test_bodies_cameras_and_units_are_read_back(model, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    path = tmp_path / "a.usdc"
    seen_by = {f"1 {name}": each for name, each in cameras((940.0, 560.0)).items()}
    write_usd(path, model, people(), FPS, cameras=seen_by, markings=[LINE], notes=NOTES)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (FPS, FRAMES - 1)
    assert stage.GetRootLayer().customLayerData["licence"] == "For tests alone."
    cache, checked = UsdSkel.Cache(), 0
    for body in people():
        root = UsdSkel.Root(stage.GetPrimAtPath(f"/world/{body.name}"))
        assert root.GetPrim().GetCustomDataByKey("person") == body.about["person"]
        cache.Populate(root, Usd.TraverseInstanceProxies())
        skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath(f"/world/{body.name}/skeleton"))
        query = cache.GetSkelQuery(skeleton)
        skinning = cache.GetSkinningQuery(stage.GetPrimAtPath(f"/world/{body.name}/surface"))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/world/{body.name}/surface"))
        for frame in range(FRAMES):
            poses = body.poses[frame]
            seen = UsdGeom.Imageable(root.GetPrim()).ComputeVisibility(frame)
            if np.isnan(poses.transl).any():
                assert seen == "invisible"
                continue
            assert seen == "inherited"
            found = np.array(query.ComputeJointSkelTransforms(frame))
            assert np.abs(found[:, 3, :3] - model.joints(poses)).max() < 1e-4
            truth = model.articulate(poses).rotations
            turned = Rotation.from_matrix(found[:, :3, :3].swapaxes(1, 2))
            off = (turned * Rotation.from_matrix(truth).inv()).magnitude()
            assert np.degrees(off).max() < 0.01
            checked += 1
        points = mesh.GetPointsAttr().Get()
        assert skinning.ComputeSkinnedPoints(
            query.ComputeSkinningTransforms(FRAMES - 1), points, FRAMES - 1
        )
        # The surface stands where the joints do, without the correctives of the pose.
        away = np.asarray(points) - model.vertices(body.poses[FRAMES - 1])
        assert np.linalg.norm(away, axis=1).max() < 0.2
    assert checked == 2 * FRAMES - 15
    for name, camera in seen_by.items():
        prim = UsdGeom.Camera(stage.GetPrimAtPath(f"/world/{name.replace('1 ', 'camera_1_')}"))
        for frame in (0, FRAMES - 1):
            one = camera[frame] if camera.batch_shape else camera
            lens = prim.GetCamera(frame)
            place = np.array([3.0, 5.0, 1.0])
            window = lens.frustum.ComputeViewMatrix() * lens.frustum.ComputeProjectionMatrix()
            x, y, _ = window.Transform(Gf.Vec3d(*place))
            shown = [960.0 * (1.0 + x) - 0.5, 540.0 * (1.0 - y) - 0.5]
            np.testing.assert_allclose(shown, one.project(place[None])[0], atol=0.02)
    curve = UsdGeom.BasisCurves(stage.GetPrimAtPath("/world/pitch/marking_00"))
    np.testing.assert_allclose(np.array(curve.GetPointsAttr().Get()), LINE, atol=1e-5)


def test_cameras_of_one_plain_name_are_apart_and_keep_their_own(model, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd

    camera = next(iter(cameras((940.0, 560.0)).values()))
    names = ("cam-1", "cam.1", "cam_1", "pitch", people()[0].name)
    given = dict.fromkeys(names, camera)
    path = tmp_path / "a.usdc"
    write_usd(path, model, people(), FPS, cameras=given, markings=[LINE], notes=NOTES)
    stage = Usd.Stage.Open(str(path))
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == "Camera"]
    assert [prim.GetCustomDataByKey("camera") for prim in prims] == list(names)


ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).with_name("viewer_in_node.mjs")
MODULE = ROOT / "infra" / "review_pages" / "src" / "viewer" / "payload.js"
PAGE = "<title>worldpose viewer</title><body><!--worldpose-data--><script>1</script></body>"
VIEWER_IN_NODE = pytest.mark.skipif(shutil.which("node") is None, reason="no node")
MAX_JOINT_M, MAX_ROTATION_DEG = 1e-4, 0.01


def pose_in_node(clip, folder):
    parts = [folder / "scene"]
    parts[0].write_bytes(encode_scene(clip))
    for first in range(0, len(clip.frames), clip.range_frames):
        parts.append(folder / f"range-{first}")
        parts[-1].write_bytes(encode_frames(clip, first, clip.range_frames))
    command = ["node", SCRIPT, MODULE, *parts]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def rotation_errors_deg(found, truth):
    found, truth = (np.reshape(each, (-1, 3, 3)) for each in (found, truth))
    return np.degrees((Rotation.from_matrix(found) * Rotation.from_matrix(truth).inv()).magnitude())


def test_joints_and_rotations_come_back_from_the_parts():
    clip = bodies_clip(frames=600, people=3)
    scene = encode_scene(clip)
    truth = clip.model.articulate(clip.bodies).rotations
    joints = clip.model.joints(clip.bodies)
    assert clip.range_frames == 500
    for first in (0, 500):
        turned, placed = decode_bodies(scene, encode_frames(clip, first, 500))
        here = slice(first, first + 500)
        there = np.isfinite(joints[here])
        assert np.array_equal(np.isfinite(placed), there)
        far = np.linalg.norm(placed - joints[here], axis=-1)
        assert np.nanmax(far) < MAX_JOINT_M
        known = there.all(axis=(-1, -2))
        assert known.sum() >= 300
        assert rotation_errors_deg(turned[known], truth[here][known]).max() < MAX_ROTATION_DEG


@VIEWER_IN_NODE
def test_the_page_poses_bodies_as_the_model_does(tmp_path):
    clip = bodies_clip(frames=40)
    seen = pose_in_node(clip, tmp_path)["frames"]
    joints, surfaces = clip.model.joints(clip.bodies), clip.model.vertices(clip.bodies)
    rotations = clip.model.articulate(clip.bodies).rotations
    for frame, people in enumerate(seen):
        for column, posed in enumerate(people):
            if posed is None:
                assert np.isnan(joints[frame, column]).any()
                continue
            assert posed["kind"] == "body"
            far = np.linalg.norm(posed["joints"] - joints[frame, column], axis=-1)
            assert far.max() < MAX_JOINT_M
            wrong = rotation_errors_deg(posed["rotations"], rotations[frame, column])
            assert wrong.max() < MAX_ROTATION_DEG
            # Four joints move a vertex of the view, and its shape does not follow the pose.
            away = np.linalg.norm(posed["placed"] - surfaces[frame, column, ::500], axis=-1)
            assert away.max() < 0.08
    assert [frame for frame, people in enumerate(seen) if people[0] is None] == [5, 6, 7, 8]


@VIEWER_IN_NODE
def test_the_page_shows_joints_feet_and_evidence_of_people_without_a_body(tmp_path):
    clip = mixed_clip(frames=10)
    shown = pose_in_node(clip, tmp_path)
    people = shown["frames"][9]
    assert [person["kind"] for person in people] == ["body", "joints", "feet"]
    assert [person["kind"] for person in shown["people"]] == ["triangulated"] * 2 + ["plane"]
    assert people[1]["joints"][3] is None
    known = [0, 1, 2, *range(4, 17)]
    found = np.array([people[1]["joints"][joint] for joint in known])
    assert np.linalg.norm(found - clip.joints[9, 1, known], axis=-1).max() < MAX_JOINT_M
    np.testing.assert_allclose(people[2]["feet"], [1.0, -6.0])
    assert people[2]["feetSpread"] == 0.25
    assert shown["frames"][2][2] is None
    # A step of the logarithmic scale of uncertainty is 2.8 %.
    np.testing.assert_allclose(people[0]["spread"], clip.spread[9, 0], rtol=0.014)
    assert people[0]["views"] == clip.views[9, 0].tolist()


def test_cameras_and_the_pitch_are_those_of_the_clip():
    clip = bodies_clip(frames=3)
    header, _ = decode_part(encode_scene(clip))
    row = np.array(header["cameras"][0]["row"])
    rotation = row[:9].reshape(3, 3)
    np.testing.assert_allclose(-rotation.T @ row[9:12], CENTER, atol=1e-5)
    np.testing.assert_allclose(row[12:], [2000.0, 2000.0, 959.5, 539.5, 1920, 1080])
    # The point in the middle of a straight line says nothing.
    assert header["markings"] == [[[-52.5, -34.0, 0.0], [52.5, -34.0, 0.0], [52.5, 34.0, 0.0]]]
    _, arrays = decode_part(encode_frames(clip, 0, 3))
    np.testing.assert_allclose(arrays["moving"][:, 0], np.tile(row, (3, 1)), atol=1e-4)


def test_the_surface_of_a_licensed_body_stays_on_the_machine():
    clip = bodies_clip(frames=2)
    licensed = replace(clip, model=replace(clip.model, name="smpl-neutral/1"))
    assert {"surface", "faces"} <= set(decode_part(encode_scene(clip))[1])
    assert set(decode_part(encode_scene(licensed))[1]) == {"rest_joints", "parents"}


def test_a_file_holds_several_clips_and_videos_and_its_notes(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"\0film")
    clips = [bodies_clip(frames=3), replace(mixed_clip(frames=3), clip="other")]
    write_viewer(tmp_path / "v.html", PAGE, clips, {"other": tmp_path / "film.mp4"})
    first, second = read_viewer(tmp_path / "v.html")
    assert "video" not in first
    assert second["video"] == b"\0film"
    assert decode_part(second["scene"])[0]["notes"]["licence"] == "For tests alone."
    text = (tmp_path / "v.html").read_text()
    assert "<title>m &amp; n: half, other</title>" in text
    assert text.index("data-clip") < text.index("<script>1")


def test_a_file_that_browsers_refuse_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_file, "MAX_FILE_BYTES", 100_000)
    with pytest.raises(InputError, match=r"expected at most 0\.1 MB"):
        write_viewer(tmp_path / "v.html", PAGE, [bodies_clip(frames=300)], {})
    assert list(tmp_path.iterdir()) == []
