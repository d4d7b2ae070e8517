"""USD's own library poses bodies as the model does, and sees cameras where they are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_gltf_file import FPS, FRAMES, NOTES, cameras, people

from worldpose.body.body_file import load_open_body
from worldpose.formats.usd_file import write_usd


@pytest.fixture(scope="module")
def model():
    return load_open_body()


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
