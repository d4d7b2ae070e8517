"""Counting a data set: the paper's own arithmetic, and a count of another kind on made clips."""

import io
import itertools
import json
import math

import numpy as np
import pytest
from camera_builders import plain_camera
from matplotlib.image import imread
from typer.testing import CliRunner

from data_contracts.release import ReleasedClip, ReleaseManifest
from data_contracts.usability import Usability
from flows.cli.app import app
from flows.results.dataset import count
from worldpose.body.model import BodyParameters
from worldpose.dataset.manifest import (
    ORIGINS,
    changed_files,
    origins_of,
    read_manifest,
    released_files,
    write_frame_rates,
    write_manifest,
    write_origins,
)
from worldpose.dataset.statistics import clip_statistics
from worldpose.errors import InputError
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


def test_a_gap_adds_no_way_and_heights_do_not_count():
    nan = np.nan
    places = np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 9.0], [nan] * 3, [50.0, 0.0, 1.0], [50.0, 1, 1]])
    found = clip_statistics(np.stack([places, np.full((5, 3), nan)], axis=1), 50.0)
    assert found.trajectories_m == (6.0,)
    assert (found.persons, found.poses, found.frames, found.seconds) == (1, 4, 5, 0.1)


@pytest.mark.parametrize("command", ["statistics", "check"])
def test_a_frame_rate_that_nobody_stated_is_said_and_an_export_s_is_taken(tmp_path, command):
    places = made(np.random.default_rng(3), 50, 2).astype(np.float64)
    joints = np.tile(places.swapaxes(0, 1)[:, :, None], (1, 1, 17, 1))
    write_joints(tmp_path / "joints.npz", JointTracks(np.arange(50), np.arange(2), joints))
    told = "no frame rate is stated: 50 per second is assumed (--fps)"
    assert told in CliRunner().invoke(app, [command, str(tmp_path)]).stderr
    assert told not in CliRunner().invoke(app, [command, str(tmp_path), "--fps", "30"]).stderr
    write_frame_rates(tmp_path, {"A_1": 25.0})
    assert told not in CliRunner().invoke(app, [command, str(tmp_path)]).stderr
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
    stored = json.loads(path.read_text())
    assert "x_cam = R x_world + t" in stored["conventions"]["camera"]
    assert stored["files"][0]["path"] == "joints.npz"
    assert stored["files"][0]["size"] == 6
    write_manifest(tmp_path / "again", manifest)
    assert (tmp_path / "again" / "manifest.json").read_bytes() == path.read_bytes()


def test_a_changed_and_a_lost_file_are_noticed(tmp_path):
    manifest = manifest_of(tmp_path)
    assert changed_files(tmp_path, manifest.files) == []
    (tmp_path / "poses" / "A_1.npz").write_bytes(b"p0ses")
    assert changed_files(tmp_path, manifest.files) == ["poses/A_1.npz"]
    (tmp_path / "joints.npz").unlink()
    assert changed_files(tmp_path, manifest.files) == ["joints.npz", "poses/A_1.npz"]


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
