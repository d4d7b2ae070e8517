"""Formats made from what a run would hold, without running anything."""

import dataclasses
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from run_records import StubRun, match_spec
from stand_ins import empty_store

from data_contracts.release import BaselineSettings
from flows.results import best_results
from flows.results.best_results import Origin
from flows.results.data_set_release import _write_clip
from flows.results.export import EXPORTS, export
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import CHALLENGE15, HALPE26, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.dataset.manifest import ORIGINS
from worldpose.errors import InputError, UsageError
from worldpose.formats.challenge import read_challenge, read_submission
from worldpose.formats.joints_file import read_poses
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.lens_models import LensModel

FRAMES = np.arange(100, 104)


def bodies():
    upright = np.tile([np.pi / 2, 0.0, 0.0], (4, 2, 1))
    transl = np.zeros((4, 2, 3)) + [0.0, 0.0, 1.1]
    transl[:, 1, 0] = 2.0
    transl[2, 1] = np.nan  # lost in one frame
    return xr.Dataset(
        {
            "betas": (("person", "shape"), np.zeros((2, 10))),
            "global_orient": (("frame", "person", "rotation"), upright),
            "body_pose": (("frame", "person", "rotation_23"), np.zeros((4, 2, 69))),
            "transl": (("frame", "person", "coordinate"), transl),
        },
        coords={"frame": FRAMES, "person": [3, 8]},
        attrs={"body_model": "open-neutral/2"},
    )


def broadcast():
    """A camera 70 m in front of the centre spot, known from frame 99 to 102."""
    frames = np.arange(99, 103)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    translation = -rotation @ np.array([0.0, -70.0, 2.0])
    tile = {"focal": [4000.0, 4000.0], "principal_point": [960.0, 540.0], "distortion": [0.0] * 5}
    return xr.Dataset(
        {
            **{n: (("frame", f"{n}_"), np.tile(v, (4, 1))) for n, v in tile.items()},
            "rotation": (("frame", "a", "b"), np.tile(rotation, (4, 1, 1))),
            "translation": (("frame", "a"), np.tile(translation, (4, 1))),
            "image_size": (("axis",), np.array([1920, 1080])),
            "status": (("frame",), np.ones(4, np.uint8)),
        },
        coords={"frame": frames},
        attrs={"clip_id": "A_1", "pitch": None},
    )


@pytest.fixture
def match_folder(tmp_path):
    folder = tmp_path / "m"
    folder.mkdir()
    (folder / "match.yaml").write_text(
        "contract: 1\nmatch_id: m\nfps: 50\n"
        "cameras: [{id: north, width: 1920, height: 1080}, "
        "{id: main, kind: broadcast, width: 1920, height: 1080}]\n"
        "clips: [{id: A_1, first_frame: 100, frame_count: 4, broadcast: main}]\n"
    )
    (folder / "detections").mkdir()
    for name in ("north", "A_1"):
        (folder / "detections" / f"{name}.json").write_text("[]")
    return folder


def origin(folder, **results):
    clips = {"A_1": {"first_frame": 100, "frame_count": 4, "broadcast": "main"}}
    spec = match_spec({"north": {}, "main": {"kind": "broadcast"}}, clips, fps=50.0)
    named = {name.replace("__", "/"): data for name, data in results.items()}
    return Origin(StubRun(named, empty_store()), SimpleNamespace(spec=spec, folder=str(folder)))


def write(form, run, out):
    return list(EXPORTS[form](run, out))


def restated(run, **spec):
    """The run with other entries of match.yaml."""
    about = SimpleNamespace(spec=run.spec.model_copy(update=spec), folder=run.registration.folder)
    return replace(run, registration=about)


@pytest.fixture
def filmed(match_folder):
    """A run with bodies and the broadcast camera alone."""
    return origin(match_folder, body_fitting__A_1=bodies(), broadcast_calibration__A_1=broadcast())


def test_a_camera_of_another_frame_rate_is_left_out_where_others_are_written(
    match_folder, tmp_path, caplog
):
    known = {f"broadcast_calibration__{name}": broadcast() for name in ("A_1", "B_1")}
    known["broadcast_calibration__B_1"].attrs["clip_id"] = "B_1"
    run = origin(match_folder, **known)
    second = run.spec.clips[0].model_copy(update={"id": "B_1", "broadcast": "half"})
    half = run.spec.cameras[1].model_copy(update={"id": "half", "fps": 25.0})
    run = restated(run, clips=(*run.spec.clips, second), cameras=(*run.spec.cameras, half))
    export(run, ["worldpose"], tmp_path / "out")
    assert [path.name for path in (tmp_path / "out/cameras").iterdir()] == ["A_1.npz"]
    assert "left out: view B_1" in caplog.text
    del run.run.results["broadcast_calibration/A_1"]
    with pytest.raises(InputError, match="view B_1: expected the frame rate of the match"):
        export(run, ["worldpose"], tmp_path / "none")


def test_scenes_have_the_lens_of_every_frame_of_a_zoom(match_folder, tmp_path):
    results = tracked()
    results["broadcast_calibration__A_1"]["distortion"][:, 0] = [-0.01, -0.02, -0.08, -0.15]
    run = origin(match_folder, **results)
    (path,) = write("gltf", run, tmp_path)
    content = path.read_bytes()
    nodes = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["nodes"]
    (about,) = (node["extras"] for node in nodes if "camera" in node)
    lenses = about["distortion_k1_k2_p1_p2_k3_by_frame"]
    # The camera is known from frame 99 to 102, the bodies from 100 to 103.
    assert [lens and lens[0] for lens in lenses] == [-0.02, -0.08, -0.15, None]
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd

    (path,) = write("usd", run, tmp_path)
    stage = Usd.Stage.Open(str(path))
    lens = stage.GetAttributeAtPath("/world/broadcast.distortion_k1_k2_p1_p2_k3")
    assert [lens.Get(frame)[0] for frame in lens.GetTimeSamples()] == [-0.02, -0.08, -0.15]


def test_alphapose_results_are_the_projected_bodies(filmed, tmp_path):
    (results,) = write("alphapose", filmed, tmp_path)
    entries = json.loads(results.read_text())
    # The second person is missing in the third frame, and the camera in the last.
    shown = [("0.jpg", 3), ("0.jpg", 8), ("1.jpg", 3), ("1.jpg", 8), ("2.jpg", 3)]
    assert [(each["image_id"], each["idx"]) for each in entries] == shown
    model, poses, *_ = best_results.fitted_bodies(filmed.run, "A_1")
    world = fold_keypoints(model, HALPE26)(poses)[0, 0]
    # From 70 m in front of the centre spot and 2 m up, with 4000 px.
    across = 960.0 + 4000.0 * world[:, 0] / (world[:, 1] + 70.0)
    down = 540.0 - 4000.0 * (world[:, 2] - 2.0) / (world[:, 1] + 70.0)
    points = np.array(entries[0]["keypoints"]).reshape(26, 3)
    np.testing.assert_allclose(points[:, :2], np.stack([across, down], axis=-1), atol=0.0051)
    assert (points[:, 2] == 1.0).all()  # the people stand 2 m apart
    assert points[17, 1] == points[:, 1].min()  # the top of the head


@pytest.mark.parametrize("form", ["challenge", "challenge-2025"])
def test_the_challenge_is_written_from_bodies_and_the_broadcast_camera(filmed, tmp_path, form):
    out = tmp_path / "out"
    written = {path.relative_to(out).as_posix() for path in write(form, filmed, out)}
    kinds = ("boxes", "skel_2d", "skel_3d")
    files = {f"{k}.npz" for k in kinds} if "2025" in form else {f"{k}/A_1.npy" for k in kinds}
    assert written == files | {"cameras/A_1.npz", "pitch_points.txt", "submission.zip"}
    there = np.isfinite(read_challenge(out)["A_1"].boxes).all(-1)
    # The second person is lost in frame 102, the camera in frame 103.
    assert there.tolist() == [[True, True], [True, True], [True, False], [False, False]]
    place = ([np.pi / 2, 0.0, 0.0], np.zeros(69), np.array([2.0, 0.0, 1.1]))
    joints = fold_keypoints(load_open_body(), CHALLENGE15)(BodyParameters(np.zeros(10), *place))
    found = read_submission(out / "submission.zip")["A_1"][1, 0]
    np.testing.assert_allclose(found, joints, atol=1e-6)  # single precision
    points = np.loadtxt(out / "pitch_points.txt")
    assert (np.abs(points).max(0) == [52.5, 34.0, 0.2]).all()


def test_the_broadcast_camera_joins_the_release_layout_where_there_is_one(filmed, tmp_path):
    write("worldpose", filmed, tmp_path / "out")
    poses, model = read_poses(tmp_path / "out" / "poses" / "A_1.npz")
    assert (poses.batch_shape, model) == ((2, 4), "open-neutral/2")
    camera = read_camera(tmp_path / "out" / "cameras" / "A_1.npz")
    np.testing.assert_array_equal(np.isnan(camera.focal[:, 0]), [False, False, False, True])


def test_other_methods_get_our_boxes_as_mot_lines(filmed, match_folder, tmp_path, caplog):
    written = write("tracks", filmed, tmp_path / "out")
    assert [path.name for path in written] == ["baseline_settings.json", "A_1.txt"]
    rows = np.loadtxt(written[1], delimiter=",")
    # The second person is lost in the third image, the camera in the fourth.
    assert rows[:, :2].tolist() == [[1, 4], [1, 9], [2, 4], [2, 9], [3, 4]]
    write("challenge", filmed, tmp_path / "challenge")
    x0, y0, x1, y1 = read_challenge(tmp_path / "challenge")["A_1"].boxes[0, 1]
    # Pixels count from 1, at corners, there; texts hold hundredths.
    assert rows[1, 2:6] == pytest.approx([x0 + 1.5, y0 + 1.5, x1 - x0, y1 - y0], abs=0.006)
    settings = BaselineSettings.model_validate_json(written[0].read_bytes())
    assert (settings.slahmr_max_num_tracks, settings.slahmr_chunk_frames) == (30, 100)
    clip = filmed.spec.clips[0].model_copy(update={"broadcast_offset_frames": 12})
    run = restated(filmed, clips=(clip,))
    later = np.loadtxt(write("tracks", run, tmp_path / "later")[1], delimiter=",")
    assert later[:, 0].tolist() == [13, 13, 14, 14, 15]
    cameras = tuple(each.model_copy(update={"fps": 25.0}) for each in run.spec.cameras)
    run, slower = restated(run, cameras=cameras), "found 25 images per second, and 50 frames"
    for form in ("tracks", "challenge", "slahmr-cameras"):
        with pytest.raises(InputError, match=slower):
            write(form, run, tmp_path / "slower")
    with_joints = replace(run, run=origin(match_folder, **tracked()).run)
    with pytest.raises(InputError, match=slower):
        _write_clip(with_joints, "A_1", "m_A_1", "train", tmp_path / "released", "none", ({}, {}))
    names = [path.name for path in write("worldpose", run, tmp_path / "slower")]
    assert names == ["A_1.npz", "A_1.json"]
    assert not (tmp_path / "slower" / "cameras").exists() and "view A_1" in caplog.text


def tracked():
    """The data that tools' formats need: kinds of people, triangulated joints, fitted joints."""
    joints = np.random.default_rng(0).uniform(-20.0, 20.0, (4, 2, 17, 3))
    joints[2, 1] = np.nan  # lost in one frame
    covariance = np.zeros((4, 2, 17, 3, 3)) + 1e-4 * np.eye(3)
    views = np.full((4, 2, 17), 3)
    views[2, 1] = 0
    coordinates = {"frame": FRAMES, "person": [3, 8]}
    placed = {
        "joints": (("frame", "person", "joint", "coordinate"), joints),
        "covariance": (("frame", "person", "joint", "coordinate", "coordinate_"), covariance),
        "views": (("frame", "person", "joint"), views),
    }
    tracks = [
        {"person": 3, "first_frame": 0, "last_frame": 3, "frames_seen": 4, "views": 3.0},
        {"person": 8, "first_frame": 0, "last_frame": 3, "frames_seen": 3, "views": 3.0}
        | {"kind": "mixed", "plane_frames": 1},
    ]
    fits = bodies()
    for name in ("joints", "covariance"):
        fits[name] = placed[name]
    return {
        "tracking__A_1": xr.Dataset(coords=coordinates, attrs={"tracks": tracks}),
        "triangulation__A_1": xr.Dataset(placed, coords=coordinates, attrs={"changes": []}),
        "body_fitting__A_1": fits,
        "broadcast_calibration__A_1": broadcast(),
    }


def test_files_for_tools_say_what_they_hold(match_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(best_results, "names_of", lambda run, clip: {8: "walker"})
    run = replace(origin(match_folder, **tracked()), licence="For tests alone.")
    files = [path for form in ("c3d", "csv", "mot", "gltf") for path in write(form, run, tmp_path)]
    tables = ("joints", "people", "strides")
    assert {path.relative_to(tmp_path).as_posix() for path in files} == {
        *(f"markers/A_1/person_00{person}.c3d" for person in (3, 8)),
        *(f"tables/A_1.{t}.{end}" for t in tables for end in ("csv", "csv-metadata.json")),
        *(f"opensim/A_1/person_00{n}_frame_000100.mot" for n in (3, 8)),
        *("opensim/A_1/person_008_frame_000103.mot", "scenes/A_1.glb"),
    }
    c3d, about, mot, glb = (
        (tmp_path / name).read_bytes()
        for name in (
            *("markers/A_1/person_008.c3d", "tables/A_1.joints.csv-metadata.json"),
            *("opensim/A_1/person_008_frame_000103.mot", "scenes/A_1.glb"),
        )
    )
    for text in (c3d, about, mot, glb):
        for said in (b"For tests alone.", b"usable", b"open-neutral/2 (CC0 1.0)"):
            assert said in text
    assert b"mixed" in c3d and b"mixed" in mot and b'"kind":"mixed"' in glb
    assert b"COCO-17 keypoints of the fitted body open-neutral/2" in about
    assert b"two contacts of a foot" in about and b"by their feet alone" in about
    assert b"walker" in c3d and b"walker" in mot and b'"name":"walker"' in glb
    assert b"person_8" not in c3d
    rows = (tmp_path / "tables/A_1.joints.csv").read_text().splitlines()
    assert rows[0].startswith("frame,time_s,person,name,kind,")
    assert {row.split(",")[3] for row in rows[1:] if ",8," in row[:20]} == {"walker"}
    write("c3d", replace(run, licence=None), tmp_path / "unstated")
    assert b"not stated" in (tmp_path / "unstated/markers/A_1/person_003.c3d").read_bytes()


def test_heels_and_toes_without_a_body_are_those_of_triangulation(match_folder):
    results = tracked()
    placed, fits = results["triangulation__A_1"], results["body_fitting__A_1"]
    fits["joints"] = fits["joints"].copy()
    fits["joints"][:, 1] = np.nan
    for name in ("global_orient", "body_pose", "transl"):
        fits[name][:, 1] = np.nan
    fits["joint_offsets"] = (("joint", "axis_"), np.zeros((17, 3)))
    fits["extra_offsets"] = (("point", "axis_"), np.zeros((1, 3)))
    places = np.full((4, 2, 1, 3), 2.0)
    for each in (placed, fits):
        own = places if each is placed else np.where([[[[True]], [[False]]]], places, np.nan)
        each["extra_joints"] = (("frame", "person", "point", "coordinate"), own)
        square = ("frame", "person", "point", "coordinate", "coordinate_")
        each["extra_covariance"] = (square, own[..., None] * 1e-4 * np.eye(3))
    placed["extra_views"] = (("frame", "person", "point"), np.full((4, 2, 1), 3))
    for name, each in (("triangulation__A_1", placed), ("body_fitting__A_1", fits)):
        results[name] = each.assign_coords(point=["left_heel"])
    run = origin(match_folder, **results).run
    heels = best_results.joint_tracks(run, "A_1", definition="detector").extra
    np.testing.assert_array_equal(heels.joints, places)
    np.testing.assert_allclose(heels.covariance[:, 1, 0], np.tile(2e-4 * np.eye(3), (4, 1, 1)))
    of_bodies = best_results.joint_tracks(run, "A_1").extra
    np.testing.assert_array_equal(np.isnan(of_bodies.joints[0, :, 0, 0]), [False, True])


def test_a_match_changes_no_frame_rate_of_another_matchs_files(match_folder, tmp_path):
    run, out = origin(match_folder, **tracked()), tmp_path / "out"
    rates = out / "frame_rates.json"
    export(run, ["joints"], out)
    export(restated(run, fps=25.0), ["joints"], out)  # corrected
    assert json.loads(rates.read_text()) == {"A_1": 25.0}
    with pytest.raises(InputError, match=r"A_1: expected 50.0, or no .* found 25.0, of m\."):
        export(restated(run, match_id="other"), ["worldpose"], out)
    assert not (out / "poses").exists() and json.loads(rates.read_text()) == {"A_1": 25.0}
    export(restated(run, match_id="other", fps=25.0), ["worldpose"], out)  # of both
    with pytest.raises(InputError, match=r"found 25.0, of m and other\."):
        export(run, ["joints"], out)
    export(run, ["joints"], out, overwrite=True)
    assert json.loads(rates.read_text()) == {"A_1": 50.0}


def test_matches_in_one_folder_state_the_lens_of_each_camera(match_folder, tmp_path):
    def export_rig(match, camera, model):
        lens = (-0.05, 0.02, 0.0, 0.0, -0.01, 0.0, 0.0, 0.0)
        arrays = {"focal": [1500.0, 1500.0], "principal_point": [960.0, 540.0], "distortion": lens}
        arrays |= {"rotation": np.eye(3), "translation": np.zeros(3), "image_size": [1920, 1080]}
        rig = xr.Dataset(coords={"camera": [camera]})
        for name, value in {**arrays, "lens_model": model}.items():
            dims = [f"{name}{d}" for d in range(np.ndim(value))]
            rig[name] = (("camera", *dims), np.array(value)[None])
        run = origin(match_folder, **tracked(), bundle_adjustment__cameras=rig)
        export(restated(run, match_id=match), ["worldpose"], tmp_path / "out")
        return json.loads((tmp_path / "out" / "lens_errors.json").read_text())

    assert export_rig("m", "north", LensModel.FISHEYE).keys() == {"north"}
    assert export_rig("other", "south", LensModel.FISHEYE).keys() == {"north", "south"}
    with pytest.raises(InputError, match="south"):
        export_rig("m", "south", LensModel.RATIONAL)
    assert export_rig("m", "north", LensModel.BROWN).keys() == {"south"}


def test_filled_joints_are_flagged(match_folder, tmp_path):
    run = origin(match_folder, **tracked())
    assert not [path for path in export(run, ["csv"], tmp_path / "a") if "origins" in path.parts]
    export(replace(run, filled=True), ["csv", "trc"], tmp_path / "b")
    flags = np.load(tmp_path / "b" / "origins" / "A_1.npz")["origin"]
    assert (flags[2, 1] == ORIGINS.index("filled")).all()
    assert (np.delete(flags, 2, axis=0) == ORIGINS.index("automatic")).all()
    table = pd.read_csv(tmp_path / "b" / "tables" / "A_1.joints.csv")
    assert set(table[table.filled].frame) == {102} and set(table[table.filled].person) == {8}
    lines = (tmp_path / "b" / "markers" / "A_1" / "person_008.trc").read_text().split("\n")[6:-1]
    assert len(lines) == 4 and all("" not in line.split("\t") for line in lines)


def test_a_surface_with_terms_of_its_own_is_written_on_request_with_them(
    match_folder, tmp_path, monkeypatch
):
    other = dataclasses.replace(load_open_body(), name="smpl-neutral")
    monkeypatch.setattr(best_results, "find_body", lambda *_: other)
    run = origin(match_folder, **tracked())
    (path,) = write("gltf", run, tmp_path / "joints")
    assert b'"skins"' not in path.read_bytes() and b"person_003_left_hip" in path.read_bytes()
    with pytest.raises(UsageError, match="--licence FILE with the terms of body model smpl-neu"):
        write("gltf", replace(run, surface=True), tmp_path / "refused")
    asked = replace(run, surface=True, licence="Terms of the model.")
    (path,) = write("gltf", asked, tmp_path / "asked")
    assert b'"skins"' in path.read_bytes() and b"Terms of the model." in path.read_bytes()


def test_slahmr_gets_true_cameras_over_a_ground_with_y_down(filmed, tmp_path):
    with pytest.raises(InputError, match="none in 1 of 4, the first 3"):
        write("slahmr-cameras", filmed, tmp_path / "gap")
    filmed.run.results["body_fitting/A_1"] = bodies().isel(frame=slice(0, 3))
    path = write("slahmr-cameras", filmed, tmp_path / "out")[1]
    assert path.relative_to(tmp_path).as_posix() == "out/slahmr/cameras/A_1/shot-0/cameras.npz"
    with np.load(path) as found:
        w2c, (fx, fy, cx, cy) = found["w2c"][0], found["intrins"][0]
        about = int(found["width"]), int(found["height"]), float(found["focal"])
    assert about == (1920, 1080, 4000.0)
    # A head 1.8 m above a spot 3 m to the right and 5 m beyond the centre, y down there.
    x, y, z, _ = w2c @ [3.0, -1.8, 5.0, 1.0]
    # The camera stands at (0, -70, 2), looks along y.
    expected = (960 + 4000 * 3 / 75, 540 + 4000 * 0.2 / 75)
    assert (fx * x / z + cx, fy * y / z + cy) == pytest.approx(expected, abs=1e-9)
