"""Data sets are counted as plain loops count them; tables of methods over many clips."""

import csv
import io
import itertools
import json
import math
import shutil

import numpy as np
import pytest
from camera_builders import plain_camera
from command_line import invoke
from faulty_data_sets import FRAMES, PERSONS, edit, transpose_rotation
from matplotlib.image import imread

from data_contracts.conventions import COCO17
from data_contracts.release import ReleasedClip, ReleaseManifest
from data_contracts.usability import Usability
from flows.results.dataset import count
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.dataset.benchmark import require_one_rate, score_folders
from worldpose.dataset.manifest import (
    ORIGINS,
    origins_of,
    read_manifest,
    released_files,
    stated_rate,
    write_frame_rates,
    write_manifest,
    write_origins,
)
from worldpose.dataset.statistics import camera_kind, kind_of
from worldpose.errors import InputError, UsageError
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.archives import write_archive
from worldpose.formats.challenge import write_submission
from worldpose.formats.joints_file import JointTracks, write_joints, write_poses
from worldpose.formats.release_cameras import write_moving_camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.data_set import plot_statistics


def made(rng, frames, persons):
    """Ways of people who come and go, in single precision as files have them."""
    steps = rng.normal(0.0, 0.05, (persons, frames, 3))
    places = (rng.uniform(-20.0, 20.0, (persons, 1, 3)) + steps.cumsum(1)).astype(np.float32)
    for person in range(persons):
        first = int(rng.integers(0, frames // 2))
        places[person, first : first + int(rng.integers(1, frames // 3))] = np.nan
    return places


def panning(frames, focal, angle):
    turn = Rigid.from_rotvec(np.linspace(0, angle, frames)[:, None] * [0, 0, 1], np.zeros(3))
    return plain_camera(np.linspace(3000.0, focal, frames), (960.0, 540.0), turn)


def test_a_clip_that_two_cameras_film_is_one_clip_with_the_people_of_both(tmp_path):
    people = np.random.default_rng(0).normal(size=(4, 20, 15, 3)).astype(np.float32)
    seen = {"goal.fast": people[:3], "goal.main": people[1:], "half.a": people[:1] + 1.0}
    write_submission(tmp_path / "submission.zip", seen)
    for view, angle in (("goal.fast", 0.1), ("goal.main", 0.0), ("half.a", 0.0)):
        write_moving_camera(tmp_path / "cameras" / f"{view}.npz", panning(20, 3000.0, angle))
    found = count([tmp_path], fps=25.0)
    assert {name: clip.persons for name, clip in found.clips.items()} == {"goal": 4, "half.a": 1}
    assert (found.frames, found.poses, found.clips["goal"].camera) == (40, 100, "M")


def test_clips_whose_names_differ_behind_a_dot_are_two(tmp_path):
    people = np.random.default_rng(0).normal(size=(4, 20, 15, 3)).astype(np.float32)
    people[3] = np.nan
    write_submission(tmp_path / "submission.zip", {"game.1": people, "game.2": people + 1.0})
    found = count([tmp_path], fps=25.0)
    assert {name: clip.poses for name, clip in found.clips.items()} == {"game.1": 60, "game.2": 60}


def test_ten_made_clips_are_counted_as_plain_loops_count_them(tmp_path):
    rng = np.random.default_rng(4)
    frames = poses = 0
    metres, seconds, ways = 0.0, 0.0, []
    for number in range(10):
        length, persons = int(rng.integers(40, 90)), int(rng.integers(3, 8))
        places = made(rng, length, persons)
        write_poses(
            tmp_path / "poses" / f"C_{number}.npz",
            BodyParameters(np.zeros(10), np.zeros(3), np.zeros(69), places.astype(np.float64)),
            "open-neutral/2",
        )
        kind = panning(length, (3000.0, 3000.0, 4000.0)[number % 3], (0.0, 0.1, 0.1)[number % 3])
        write_moving_camera(tmp_path / "cameras" / f"C_{number}.npz", kind)
        frames += length
        seconds += length / 25.0
        for person in places.astype(np.float64):
            way = 0.0
            for here, there in itertools.pairwise(person):
                if not math.isnan(here[0]) and not math.isnan(there[0]):
                    way += math.hypot(there[0] - here[0], there[1] - here[1])
            poses += sum(not math.isnan(place[0]) for place in person)
            ways.append(way)
            metres += way
    found = count([tmp_path], fps=25.0)
    assert (len(found.clips), found.frames, found.poses) == (10, frames, poses)
    assert found.minutes == pytest.approx(seconds / 60)
    assert found.distance_km == pytest.approx(metres / 1000)
    assert found.subjects_per_frame == pytest.approx(poses / frames)
    assert found.speed_m_s == pytest.approx(metres / (poses / 25.0))
    assert found.longest_trajectory_m == pytest.approx(max(ways))
    assert found.camera == "M+Z"
    assert [found.clips[f"C_{n}"].camera for n in range(3)] == ["S", "M", "M+Z"]
    picture = imread(io.BytesIO(plot_statistics(found)))
    assert picture.shape[:2] == (462, 1540)


@pytest.mark.parametrize("command", ["statistics", "check"])
def test_a_frame_rate_that_nobody_stated_is_said_and_an_export_s_is_taken(tmp_path, command):
    places = made(np.random.default_rng(3), 50, 2).astype(np.float64)
    joints = np.tile(places.swapaxes(0, 1)[:, :, None], (1, 1, 17, 1))
    write_joints(tmp_path / "joints.npz", JointTracks(np.arange(50), np.arange(2), joints))
    told = "no frame rate is stated: 50 per second is assumed (--fps)"
    assert told in invoke(command, tmp_path).stderr
    assert told not in invoke(command, tmp_path, "--fps", 30).stderr
    write_frame_rates(tmp_path, {"A_1": 25.0})
    assert told not in invoke(command, tmp_path).stderr
    assert count([tmp_path]).clips["clip"].seconds == pytest.approx(2.0)
    assert count([tmp_path], fps=50.0).clips["clip"].seconds == pytest.approx(1.0)


def manifest_of(folder, **changes):
    (folder / "poses").mkdir(exist_ok=True)
    (folder / "poses" / "A_1.npz").write_bytes(b"poses")
    (folder / "joints.npz").write_bytes(b"joints")
    fields = {
        "release": "first",
        "match_id": "final",
        "run_id": "0003",
        "formats": ("worldpose", "joints"),
        "fps": 50.0,
        "clips": {
            "A_1": ReleasedClip(first_frame=100, frame_count=2, person_ids=(0, 4), origins={})
        },
        "pictures": {"north": (1920, 1080)},
        "pitch": True,
        "body_model": "open-neutral/2",
        "licence": "For tests.",
        "usability": Usability(verdict="usable"),
        "worldpose": "0.1.0",
        "versions": {"numpy": "2.4"},
        "settings": {"tracking": {"a": 1}},
        "results": {"tracking/A_1": "0" * 32},
        "files": released_files(folder, [folder / "poses" / "A_1.npz", folder / "joints.npz"]),
    }
    return ReleaseManifest(**{**fields, **changes})


def test_a_manifest_comes_back_and_holds_the_conventions(tmp_path):
    manifest = manifest_of(tmp_path)
    path = write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
    assert stated_rate(tmp_path, "A_1") == 50.0
    stored = json.loads(path.read_text())
    assert "x_cam = R x_world + t" in stored["conventions"]["camera"]
    assert stored["files"][0]["path"] == "joints.npz"
    assert stored["files"][0]["size"] == 6
    write_manifest(tmp_path / "again", manifest)
    assert (tmp_path / "again" / "manifest.json").read_bytes() == path.read_bytes()


def test_a_folder_without_a_manifest_has_none_and_another_contract_is_refused(tmp_path):
    assert read_manifest(tmp_path) is None
    path = write_manifest(tmp_path, manifest_of(tmp_path))
    path.write_text(path.read_text().replace('"contract": 1,', '"contract": 2,', 1))
    with pytest.raises(InputError, match="contract 1"):
        read_manifest(tmp_path)
    fields = json.loads(write_manifest(tmp_path, manifest_of(tmp_path)).read_text())
    path.write_text(json.dumps({name: fields[name] for name in fields if name != "usability"}))
    with pytest.raises(InputError, match=r"usability: Field required: another version.*again with"):
        read_manifest(tmp_path)


def test_one_pose_does_not_tell_a_static_camera_but_a_file_of_one_row_does(tmp_path):
    camera = panning(2, 3000.0, 0.0)
    one, two = (
        kind_of(each.focal[:, 0], each.cam_from_world.rotation) for each in (camera[:1], camera)
    )
    assert (one, two) == (None, "S")
    write_moving_camera(tmp_path / "a.npz", camera[:1])
    assert camera_kind(tmp_path / "a.npz") == "S"


def test_origins_tell_absent_automatic_filled_and_corrected_joints(tmp_path):
    joints = np.ones((2, 1, 17, 3))
    joints[1, 0, 3] = np.nan
    views = np.full((2, 1, 17), 4)
    views[0, 0, 5] = 0
    views[1, 0, 3] = 0
    corrected = np.zeros((2, 1, 17), bool)
    corrected[0, 0, 7] = True
    tracks = JointTracks(np.arange(2), np.array([4]), joints, views=views)
    origin = origins_of(tracks, corrected)
    names = np.array(ORIGINS)[origin]
    assert (names[0, 0, 5], names[0, 0, 7]) == ("filled", "corrected")
    assert (names[1, 0, 3], (names == "automatic").sum()) == ("absent", 2 * 17 - 3)
    write_origins(tmp_path / "A_1.npz", tracks, origin)
    np.testing.assert_array_equal(np.load(tmp_path / "A_1.npz")["origin"], origin)


CLIPS = ("A_1", "B_2", "C_3")
OWN = 0.4 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
"""Takes the world to that of a method: turned, and smaller."""


@pytest.fixture(scope="module")
def clips(model, poses):
    """True bodies by clip, and their joints (frames, persons, 17, 3)."""
    keypoints = fold_keypoints(model, COCO17)
    found = {}
    for number, clip in enumerate(CLIPS):
        moved = poses.transl + [3.0 * number, 0.0, 0.0]
        some = slice(0, FRAMES - 5 * number)
        body = BodyParameters(poses.betas, poses.global_orient, poses.body_pose, moved)[:, some]
        found[clip] = body, keypoints(body).swapaxes(0, 1)
    return found


@pytest.fixture(scope="module")
def reference(model, clips, main_camera, tmp_path_factory):
    """The layout of the published data set: poses and cameras in single files."""
    folder = tmp_path_factory.mktemp("reference")
    for clip, (body, joints) in clips.items():
        write_poses(folder / "poses" / f"{clip}.npz", body, model.name)
        write_moving_camera(folder / "cameras" / f"{clip}.npz", main_camera[: len(joints)])
    return folder


NAMES = (
    *("g_mpjpe_mm", "per_person_g_mpjpe_mm", "pa_mpjpe_mm", "track_coverage"),
    *("per_meter_drift_cm_per_m", "per_person_drift_cm_per_m"),
)


def made_method(kind, folder, clips, reference):
    """Write a method's folder: truth with noise of 50 or 20 mm; return its joints by clip."""
    rng = np.random.default_rng(5)
    found = {}
    for clip, (_, joints) in clips.items():
        found[clip] = joints + 0.05 * rng.standard_normal(joints.shape)
        if kind == "split":  # its own world and camera; the first person has two ids
            half = len(joints) // 2
            mine = np.concatenate([joints, joints[:, :1]], axis=1)
            mine = mine + 0.02 * rng.standard_normal(mine.shape)
            mine[half:, 0], mine[:half, PERSONS] = np.nan, np.nan
            mine[3:9, 2] = np.nan  # lost for a while
            found[clip] = mine @ OWN.T + [1.0, -2.0, 0.5]
            with np.load(reference / "cameras" / f"{clip}.npz") as file:
                own = dict(file)
            own["R"] = own["R"] @ (OWN / 0.4).T
            own["t"] = 0.4 * own["t"] - own["R"] @ [1.0, -2.0, 0.5]
            write_archive(folder / "cameras" / f"{clip}.npz", own)
        tracks = JointTracks(np.arange(len(joints)), np.arange(found[clip].shape[1]), found[clip])
        write_joints(folder / f"{clip}.joints.npz", tracks)
    return found


def test_scores_are_those_of_each_clip_and_of_all_their_joints(
    clips, reference, main_camera, tmp_path
):
    found = {
        kind: made_method(kind, tmp_path / kind, clips, reference) for kind in ("jitter", "split")
    }
    scores, _ = score_folders(reference, {kind: tmp_path / kind for kind in found})
    jitter, split = (score.evaluation for score in scores)
    means, counts = [], []
    for clip, (_, true) in clips.items():
        frames, count = np.arange(len(true)), np.arange(PERSONS)
        mine = JointTracks(frames, count, found["jitter"][clip])
        camera = main_camera[: len(true)]
        expected, _ = evaluate_joints(mine, JointTracks(frames, count, true), camera=camera)
        ours = scores[0].clips[clip].model_dump(include=set(NAMES))
        # Poses of the reference are in single precision.
        assert ours == pytest.approx(expected.model_dump(include=set(NAMES)), rel=1e-4)
        means.append(expected.g_mpjpe_mm)
        counts.append(np.isfinite(true[..., 0]).all(-1).sum())
    assert jitter.g_mpjpe_mm == pytest.approx(np.average(means, weights=counts), rel=1e-4)
    # The mean length of three normal errors of 20 mm is 31.9 mm, of the neck 1 / sqrt(2) of it.
    assert split.g_mpjpe_mm == pytest.approx(31.2, rel=0.03)
    assert split.track_coverage == pytest.approx(1.0 - 6 * len(clips) / sum(counts))


def run(*arguments):
    return invoke("evaluate", *arguments)


def test_the_command_writes_tables_and_a_picture(clips, reference, tmp_path):
    for kind in ("jitter", "split"):
        made_method(kind, tmp_path / kind, clips, reference)
    named = [f"--prediction={kind}={tmp_path / kind}" for kind in ("jitter", "split")]
    asked = ("--reference", reference, *named)
    table = run(*asked, "--table", "csv", "--picture", tmp_path / "methods.png")
    rows = list(csv.DictReader(io.StringIO(table.stdout)))
    assert [row["clip"] for row in rows[::4]] == [*CLIPS, "all clips"]
    assert (tmp_path / "methods.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(run(*asked, "--json").stdout)
    assert set(told["methods"][0]["clips"]) == set(CLIPS)
    assert f"{told['methods'][1]['evaluation']['g_mpjpe_mm']:.1f}" == rows[-3]["g_mpjpe_mm"]
    assert "all clips & jitter (per-person) & " in run(*asked, "--table", "latex").stdout
    assert "each name once" in str(run("--reference", reference, named[0], named[0]).exception)


def without_model(arrays):
    del arrays["body_model"]


def plural(arrays):
    for name in ("global_orient", "body_pose"):
        arrays[f"{name}s"] = arrays.pop(name)


def shorter(arrays):
    for name in ("global_orient", "body_pose", "transl"):
        arrays[name] = arrays[name][:, 1:]


def late(arrays):
    for name in ("global_orient", "body_pose", "transl"):
        arrays[name] = np.roll(arrays[name], 2, axis=1)


@pytest.mark.parametrize(
    ("side", "file", "change", "told"),
    [
        ("mine", "poses", shorter, "poses/A_1.npz: transl: expected frames 0 to 39 of the clip"),
        ("mine", "cameras", transpose_rotation, "cameras/A_1.npz: R: expected x_cam = R x_world"),
        ("mine", "poses", without_model, "poses/A_1.npz: body_model: expected the name of the"),
        ("true", "cameras", transpose_rotation, "cameras/A_1.npz: R: expected x_cam = R x_world"),
        ("true", "cameras", lambda a: a.update({n: a[n][1:] for n in "KkRt"}), "npz: K: expected"),
    ],
)
def test_wrong_files_are_told_with_file_and_key(reference, tmp_path, side, file, change, told):
    for name in ("mine", "true"):
        shutil.copytree(reference, tmp_path / name)
    edit(tmp_path / side / file / "A_1.npz", change)
    with pytest.raises(InputError, match=told):
        score_folders(tmp_path / "true", {"mine": tmp_path / "mine"})


def test_plural_keys_and_shifted_frames_are_told(reference, model, tmp_path):
    shutil.copytree(reference, tmp_path / "mine")
    edit(tmp_path / "mine" / "poses" / "A_1.npz", plural)
    edit(tmp_path / "mine" / "poses" / "B_2.npz", late)
    edit(tmp_path / "mine" / "poses" / "C_3.npz", without_model)
    (score,), _ = score_folders(reference, {"mine": tmp_path / "mine"}, body=model.name)
    for clip in ("A_1", "C_3"):
        assert score.clips[clip].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
    places = tmp_path / "mine" / "poses"
    read, shift = score.notes[f"{places}/A_1.npz"], score.notes[f"{places}/B_2.npz: transl"]
    assert "read global_orients as global_orient, body_poses as body_pose" in read
    assert "people are 2 frames late" in shift


def test_a_clip_that_a_method_lacks_is_refused(reference, tmp_path):
    shutil.copytree(reference, tmp_path / "mine")
    (tmp_path / "mine" / "poses" / "B_2.npz").unlink()
    with pytest.raises(InputError, match=r"mine: clip B_2: expected poses/B_2\.npz"):
        score_folders(reference, {"mine": tmp_path / "mine"})


def test_a_clip_in_two_folders_of_a_method_is_refused(reference, tmp_path):
    shutil.copytree(reference, tmp_path / "mine")
    shutil.copytree(reference, tmp_path / "mine" / "old")
    for mine in (tmp_path / "mine", shutil.copytree(tmp_path / "mine" / "old", tmp_path / "2/a")):
        with pytest.raises(InputError, match=r"clip A_1: expected one, found .* and "):
            score_folders(reference, {"mine": mine if mine.name == "mine" else mine.parent})
        shutil.copytree(reference, tmp_path / "2" / "b", dirs_exist_ok=True)


def test_sides_of_other_rates_are_refused(reference, tmp_path):
    for name, rate in (("mine", 50.0), ("true", 25.0)):
        shutil.copytree(reference, tmp_path / name)
        (tmp_path / name / "frame_rates.json").write_text(json.dumps(dict.fromkeys(CLIPS, rate)))
    with pytest.raises(InputError, match=r"found 25 in .*true and 50 in .*mine"):
        score_folders(tmp_path / "true", {"mine": tmp_path / "mine"})
    require_one_rate({"mine": 29.97, "true": 30.0})


def test_boxes_are_compared_in_the_same_view(reference, tmp_path):
    """Each side has the cameras main and side; then the method has one of them alone."""
    for name in ("mine", "true"):
        cameras = shutil.copytree(reference, tmp_path / name) / "cameras"
        shutil.copy(cameras / "A_1.npz", cameras / "A_1.side.npz")
        (cameras / "A_1.npz").rename(cameras / "A_1.main.npz")
        edit(cameras / "A_1.side.npz", lambda a: a.update(K=a["K"] * [[[0.7], [0.7], [1.0]]]))
    asked = tmp_path / "true", {"mine": tmp_path / "mine"}
    (score,), _ = score_folders(*asked)
    assert score.clips["A_1"].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
    (tmp_path / "mine" / "cameras" / "A_1.main.npz").unlink()
    with pytest.raises(InputError, match=r"mine/cameras/A_1\.main\.npz: expected the camera"):
        score_folders(*asked)
    (tmp_path / "true" / "cameras" / "A_1.side.npz").unlink()
    (tmp_path / "mine" / "cameras" / "A_1.side.npz").unlink()
    shutil.copy(tmp_path / "true/cameras/A_1.main.npz", tmp_path / "mine/cameras/A_1.npz")
    (score,), _ = score_folders(*asked)
    assert score.clips["A_1"].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "option"),
    [
        *(("joints.npz", option) for option in ("--first-frame=3", "--body=x", "--table=csv")),
        ("a.zip", "--match-in=main"),
        *(("folder", option) for option in ("--run=3", "--stage=body_fitting", "--markers=x")),
        ("folder", "--method=a=x"),
    ],
)
def test_an_option_without_effect_is_refused(reference, tmp_path, kind, option):
    side, named = tmp_path / kind, ""
    if kind == "a.zip":
        write_submission(side, {"A_1": np.zeros((1, 2, 15, 3))})
    elif kind == "folder":
        side, named = reference, "a="
    else:
        write_joints(side, JointTracks(np.arange(2), np.arange(1), np.zeros((2, 1, 17, 3))))
    answer = run("--reference", side, "--prediction", f"{named}{side}", option)
    assert isinstance(answer.exception, UsageError)
    assert option.split("=")[0] in str(answer.exception)
