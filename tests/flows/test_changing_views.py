"""Files and reports of cameras whose views change within a clip, and of clocks between frames."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from test_release_formats import (
    FRAMES,
    bodies,
    broadcast,
    match_folder,
    origin,
    restated,
    tracked,
    write,
)

from flows.reports import clips
from flows.reports.clip_video import people_at_images
from flows.results import best_results
from flows.results.export import export
from flows.results.tool_exports import image_views
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.geometry.rigid import Rigid

__all__ = ["match_folder"]  # a fixture


def static_rig(*changes, inliers=True):
    """Results with camera north, 70 m in front of the centre spot, and changes of its view."""
    pose = Rigid(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.r_[0.0, 2.0, 70.0]
    )
    camera = Camera([4000.0, 4000.0], [959.5, 539.5], np.zeros(8), pose, [1920, 1080])
    arrays = camera_arrays(Camera.stack([camera])).items()
    cameras = {
        name: ((f"{name}_0", *(f"{name}_{n + 1}" for n in range(each.ndim - 1))), each)
        for name, each in arrays
    }
    known = tracked()
    results = {name: known[name] for name in known if "broadcast" not in name}
    whole = {"camera": "north", "kind": "view", "first_frame": 100, "frame_count": 4, "std": None}
    placed = results["triangulation__A_1"].assign_coords(camera=["north"])
    placed["inliers"] = (("frame", "camera", "person", "joint"), np.full((4, 1, 2, 17), inliers))
    placed.attrs["changes"] = [whole | change for change in changes]
    static = xr.Dataset(cameras, coords={"camera": ["north"]}, attrs={"surface": None})
    return results | {"triangulation__A_1": placed, "bundle_adjustment__cameras": static}


def test_images_that_a_run_leaves_out_are_no_labels_of_an_empty_pitch(
    match_folder, tmp_path, caplog
):
    unknown = {"frame": None, "is_explained": False, "is_left_out": True}
    nobody = static_rig()
    nobody["body_fitting__A_1"]["joints"][:, :, :, 1] -= 200.0  # behind the camera
    (path,) = write("coco", origin(match_folder, **nobody), tmp_path / "nobody")
    labels = json.loads(path.read_text())
    assert [each["id"] for each in labels["images"]] == [100, 101, 102, 103]
    assert not labels["annotations"]
    run = origin(match_folder, **static_rig(unknown | {"first_frame": 101, "frame_count": 2}))
    (path,) = write("coco", run, tmp_path / "part")
    assert [each["id"] for each in json.loads(path.read_text())["images"]] == [100, 103]
    assert not caplog.messages
    run = origin(match_folder, **static_rig(unknown))
    for form in ("coco", "alphapose"):
        assert not write(form, run, tmp_path / "none")
        assert "no labels of camera north, whose views the run leaves out" in caplog.text
        caplog.clear()


def test_changes_of_cameras_are_those_of_the_last_run_and_of_each_match(match_folder, tmp_path):
    change = {"frame": 102, "shift_px": (30.0, 0.0)}
    out, run = tmp_path / "out", origin(match_folder, **static_rig(change))
    told = out / "camera_changes" / "A_1.json"
    export(run, ["worldpose", "gltf"], out)
    scene = (out / "scenes" / "A_1.glb").read_bytes()
    assert b"camera north moves at frame 102, by 30 px" in scene
    before = told.read_bytes()
    assert json.loads(before)[0]["frame"] == 102
    theirs = {name.replace("A_1", "B_1"): data for name, data in static_rig().items()}
    other = origin(match_folder, **theirs)
    clip = run.spec.clips[0].model_copy(update={"id": "B_1"})
    other.registration.spec = run.spec.model_copy(update={"match_id": "other", "clips": (clip,)})
    export(other, ["worldpose"], out)
    assert json.loads((told.parent / "B_1.json").read_text()) == []
    assert told.read_bytes() == before
    export(origin(match_folder, **static_rig()), ["worldpose"], out)
    assert json.loads(told.read_text()) == []


def test_the_report_compares_people_at_the_moments_of_the_images(match_folder, monkeypatch):
    results = static_rig()
    results["body_fitting__A_1"]["joints"] *= 0.1  # into the image
    index = np.tile(np.arange(2), (4, 1, 1))
    results["tracking__A_1"]["detection_index"] = (("frame", "camera", "person"), index)
    run = origin(match_folder, **results)
    north = run.spec.cameras[0].model_copy(update={"offset_frames": 0.4})
    spec = run.spec.model_copy(update={"cameras": (north, *run.spec.cameras[1:])})
    run.registration.spec = spec
    (view,) = image_views(run, "A_1", FRAMES)
    tracks = best_results.joint_tracks(run.run, "A_1")
    seen = view.project(view.at_images(tracks.joints))
    run.run.results["detection/north"] = xr.Dataset(
        {"keypoints": (("frame", "detection", "joint", "axis"), seen)}, coords={"frame": FRAMES}
    )
    for rows in ([0], [1, 3], [0, 1, 2, 3]):
        np.testing.assert_array_equal(view.show(tracks.joints, np.array(rows)), seen[rows])
    monkeypatch.setattr(clips, "seen_in", lambda *_: "detection/north")
    match = SimpleNamespace(registration=run.registration)
    found = clips.worst_views(run.run, match, "A_1", tracks)
    assert [percent for *_, percent in found] == [0, 0]
    monkeypatch.setattr(clips, "frame_picture", lambda *_: None)
    monkeypatch.setattr(clips, "_plot_view", lambda *_, part: part)
    (first, _) = clips.disagreement_pictures(None, run.run, match, "A_1")
    corner, side = first.png
    row, _, person, _ = found[0]
    np.testing.assert_allclose(corner + 0.5 * side, seen[row, person].mean(axis=0))


def test_bodies_are_drawn_at_the_moments_of_the_images(match_folder):
    moving = bodies()
    moving["transl"][:, :, 0] += 0.1 * np.arange(4)[:, None]
    run = origin(match_folder, **(static_rig() | {"body_fitting__A_1": moving}))
    (view,) = image_views(run, "A_1", FRAMES)
    view = replace(view, late=np.full(4, 0.4))
    tracks = best_results.joint_tracks(origin(match_folder, **static_rig()).run, "A_1")
    _, drawn = people_at_images(run.run, "A_1", tracks, view)
    np.testing.assert_allclose(drawn.poses.transl[:, 0, 0], 0.1 * np.arange(4) + 0.04)


@pytest.mark.parametrize("is_explained", [True, False])
def test_the_report_compares_views_as_the_run_corrects_them(
    match_folder, tmp_path, monkeypatch, is_explained
):
    change = {"frame": 102, "shift_px": (30.0, 0.0), "is_explained": is_explained}
    results = static_rig(change | {"is_left_out": not is_explained})
    results["body_fitting__A_1"]["joints"] *= 0.1  # into the image
    index = np.tile(np.arange(2), (4, 1, 1))
    tracking = results["tracking__A_1"]
    tracking["detection_index"] = (("frame", "camera", "person"), index)
    moved = origin(match_folder, **static_rig(change | {"is_explained": True}))
    joints = results["body_fitting__A_1"]["joints"].values
    (view,) = image_views(moved, "A_1", FRAMES)
    seen = xr.Dataset(
        {"keypoints": (("frame", "detection", "joint", "axis"), view.project(joints))},
        coords={"frame": FRAMES},
    )
    shown = view.camera_in(102).project(joints[2].reshape(-1, 3)).reshape(2, 17, 2)
    np.testing.assert_allclose(shown, seen["keypoints"][2], atol=1e-6)
    assert np.isfinite(shown[0]).all()
    monkeypatch.setattr(clips, "seen_in", lambda *_: "detection/north")
    run = origin(match_folder, **results, detection__north=seen)
    match = SimpleNamespace(registration=run.registration)
    found = clips.worst_views(run.run, match, "A_1", best_results.joint_tracks(run.run, "A_1"))
    assert [row for row, *_, percent in found if percent] == ([] if is_explained else [3, 3])


def test_labels_of_a_stage_have_its_own_flags(match_folder, tmp_path, monkeypatch):
    results = static_rig(inliers=False)
    results["body_fitting__A_1"]["joints"] *= 0.1  # into the image
    again = static_rig()["triangulation__A_1"]
    for each in (results["triangulation__A_1"], again):
        each["joints"] *= 0.1
    run = origin(match_folder, **results, retriangulation__A_1=again)
    known = best_results.static_cameras
    monkeypatch.setattr(best_results, "static_cameras", lambda run, spec, _: known(run, spec))
    for stage, flag in (("triangulation", 1), ("retriangulation", 2), ("body_fitting", 2)):
        (path,) = write("coco", replace(run, stage=stage), tmp_path / stage)
        labels = json.loads(path.read_text())["annotations"]
        assert {v for each in labels for v in each["keypoints"][2::3] if v} == {flag}, stage


# Images of the broadcast camera are 0.4 of a frame late; image 100 of the static one is a quarter
# of a frame before match frame 100.
@pytest.mark.parametrize(("camera", "late"), [("main", 0.4), ("north", -0.25)])
def test_labels_are_where_people_are_at_the_moments_of_the_images(
    match_folder, tmp_path, camera, late
):
    moving = bodies()
    moving["transl"][:, :, 0] += 0.1 * np.arange(4)[:, None]
    known = {"broadcast_calibration__A_1": broadcast()} if camera == "main" else static_rig()
    run, places = origin(match_folder, **{**known, "body_fitting__A_1": moving}), []
    for offset in (0.0, late):
        clip = run.spec.clips[0].model_copy(update={"broadcast_offset_frames": 1.0 - offset})
        north = run.spec.cameras[0].model_copy(update={"offset_frames": [[0, -offset]]})
        shifted = restated(run, clips=(clip,), cameras=(north, *run.spec.cameras[1:]))
        (results,) = write("alphapose", shifted, tmp_path / str(offset))
        entries = [each for each in json.loads(results.read_text()) if each["idx"] == 3]
        if camera == "main":
            assert [each["image_id"] for each in entries] == [f"{n}.jpg" for n in (1, 2, 3)]
        places.append(np.array([each["keypoints"][::3] for each in entries]))
    # A step of 0.1 m per frame, at 4000 px and 70 m.
    np.testing.assert_allclose(places[1] - places[0], late * 0.1 * 4000 / 70, rtol=0.02)
