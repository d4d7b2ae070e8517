"""A bad file of each form of import is one error that names the file."""

import errno
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.video.files import write_video

CALIBRATION = """
[cam_0]
name = "a"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 4.0]

[cam_1]
name = "b"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 1.0, 0.0]
translation = [0.0, 0.0, 4.0]
"""
MATCH = """
contract: 1
match_id: lab
fps: 25
cameras:
- {id: a, width: 640, height: 480}
clips:
- {id: clip, frame_count: 10}
"""
NOISE = bytes(range(7, 255)) * 4


def refuse(*arguments):
    result = CliRunner().invoke(app, ["import", *map(str, arguments)])
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


@pytest.fixture
def lab(tmp_path):
    """A calibration of two cameras, 2D poses of none, and a match folder."""
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    (tmp_path / "poses").mkdir()
    (tmp_path / "match" / "detections").mkdir(parents=True)
    (tmp_path / "match" / "match.yaml").write_text(MATCH)
    return tmp_path


CALIBRATIONS = [
    *("bad.toml", "bad.qca.txt", "bad.xml", "bad.json", "bad.yml", "bad.xcp", "bad.mcal"),
    *("bad.calib", "bad.pickle", "intri.yml"),
]


@pytest.mark.parametrize("name", CALIBRATIONS)
@pytest.mark.parametrize("content", [b"", NOISE], ids=["empty", "noise"])
def test_calibrations(lab, name, content):
    file = lab / name
    file.write_bytes(content)
    given = ("--detections", lab / "poses", "--fps", "25", "--out", lab / "out")
    assert name in refuse("--calibration", file, *given)
    assert not (lab / "out").exists()


@pytest.mark.parametrize("name", ["a.json", "a.npz"])
@pytest.mark.parametrize("content", [b"", NOISE, b"[1, 2]"], ids=["empty", "noise", "other"])
def test_2d_poses(lab, name, content):
    (lab / "poses" / name).write_bytes(content)
    (lab / "poses" / "b.json").write_text("[]")
    given = ("--calibration", lab / "calibration.toml", "--fps", "25", "--out", lab / "out")
    assert name in refuse("--detections", lab / "poses", *given)
    assert not (lab / "out").exists()


@pytest.mark.parametrize("with_calibration", [True, False])
def test_videos(lab, with_calibration):
    (lab / "videos").mkdir()
    for name in ("a.mp4", "b.mp4"):
        (lab / "videos" / name).write_bytes(NOISE)
    given = ("--calibration", lab / "calibration.toml") if with_calibration else ()
    assert "a.mp4" in refuse("--videos", lab / "videos", *given, "--out", lab / "out")
    (lab / "videos" / "b.mp4").unlink()
    told = refuse("--videos", lab / "videos", "--out", lab / "out")
    assert "expected a video for each of two cameras or more" in told
    assert not (lab / "out").exists()


@pytest.mark.parametrize(
    "place", ["Config.toml", "calibration/Calib.toml", "pose/a_json/a_000000.json"]
)
@pytest.mark.parametrize("content", [NOISE, b"{"], ids=["noise", "cut"])
def test_trials_of_pose2sim(lab, place, content):
    trial = lab / "trial"
    for folder in ("calibration", "pose/a_json", "pose/b_json"):
        (trial / folder).mkdir(parents=True)
    (trial / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    (trial / "calibration" / "Calib.toml").write_text(CALIBRATION)
    for name in ("a", "b"):
        file = trial / "pose" / f"{name}_json" / f"{name}_000000.json"
        file.write_text('{"version": 1.3, "people": []}')
    (trial / place).write_bytes(content)
    assert place.rpartition("/")[2] in refuse("--pose2sim", trial, "--out", lab / "out")
    assert not (lab / "out").exists()


@pytest.mark.parametrize("name", ["bad.toml", "bad.xml", "bad.yml", "bad.json", "bad.npz", "k.npy"])
@pytest.mark.parametrize("content", [b"", NOISE], ids=["empty", "noise"])
def test_lenses(lab, name, content):
    np.savez(lab / "match" / "detections" / "a.npz", a=1)
    (lab / name).write_bytes(content)
    assert name in refuse("--lens", lab / name, "--camera", "a", "--out", lab / "match")
    assert not (lab / "match" / "lenses.toml").exists()


@pytest.mark.parametrize("name", ["bad.xml", "bad.json"])
@pytest.mark.parametrize("content", [b"", NOISE, b"{}"], ids=["empty", "noise", "other"])
def test_clicks(lab, name, content):
    (lab / name).write_bytes(content)
    assert name in refuse("--clicks", lab / name, "--camera", "a", "--out", lab / "match")


@pytest.mark.parametrize("content", [b"", NOISE, b"a,b\n1,2\n"], ids=["empty", "noise", "other"])
def test_surveys(lab, content):
    (lab / "bad.csv").write_bytes(content)
    assert "bad.csv" in refuse("--pitch", lab / "bad.csv", "--out", lab / "match")
    assert not (lab / "match" / "pitch.json").exists()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "found an empty file"),
        (NOISE, "a.txt"),
        (b"0,1,5,5,5,5,1\n", "line 1: frame"),
        (b"1,1,900,5,5,5,1\n", "line 1: left, top"),
        (b"1,1,5,5,5,5,1\n1,1,9,5,5,5,1\n", "line 2: id"),
    ],
)
def test_boxes(lab, content, told):
    (lab / "videos").mkdir()
    for name in ("a.mp4", "b.mp4"):
        frame = np.zeros((48, 64, 3), np.uint8)
        write_video(lab / "videos" / name, [frame] * 5, 25.0)
    (lab / "boxes").mkdir()
    (lab / "boxes" / "a.txt").write_bytes(content)
    given = ("--videos", lab / "videos", "--boxes", lab / "boxes", "--out", lab / "out")
    assert told in refuse(*given)
    assert not (lab / "out").exists()
    (lab / "boxes" / "a.txt").rename(lab / "boxes" / "c.txt")
    assert "found c.txt" in refuse(*given)
    assert "--boxes with --videos" in refuse("--boxes", lab, "--fps", 25, "--out", lab / "match")


def test_places_for_a_match(lab):
    np.savez(lab / "poses" / "a.npz", a=1)
    cases = {
        lab / "match": "nothing, or an empty folder",
        lab / "calibration.toml": "nothing, or an empty folder",
        lab / "calibration.toml" / "below": "a place where a folder can be made",
        "/proc/nothing/out": "a place where a folder can be made",
    }
    (lab / "poses" / "a.npz").unlink()
    for name in ("a", "b"):
        people = [
            {"image_id": 0, "category_id": 1, "keypoints": [9.0, 9.0, 1.0] * 17, "score": 0.9}
        ]
        (lab / "poses" / f"{name}.json").write_text(json.dumps(people))
    given = ("--calibration", lab / "calibration.toml", "--detections", lab / "poses")
    for out, told in cases.items():
        assert told in refuse(*given, "--fps", "25", "--out", out)
    assert (
        CliRunner()
        .invoke(app, ["import", *map(str, given), "--fps", "25", "--out", str(lab / "out")])
        .exit_code
        == 0
    )


def test_a_full_disk_leaves_no_match(lab, monkeypatch):
    (lab / "videos").mkdir()
    for name in ("a.mp4", "b.mp4"):
        write_video(lab / "videos" / name, [np.zeros((48, 64, 3), np.uint8)] * 5, 25.0)

    def full(source, target):
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr("worldpose.ingest.camera_videos.shutil.copyfile", full)
    given = ["import", "--videos", str(lab / "videos"), "--out", str(lab / "new" / "out")]
    result = CliRunner().invoke(app, given)
    assert isinstance(result.exception, InputError), result.exception
    assert "No space left on device" in str(result.exception)
    assert not (lab / "new").exists() or not list((lab / "new").iterdir())


def test_a_stated_unit_and_axis_hold_and_absurd_distances_are_refused(lab):
    (lab / "videos").mkdir()
    for name in ("a.mp4", "b.mp4"):
        write_video(lab / "videos" / name, [np.zeros((48, 64, 3), np.uint8)] * 5, 25.0)
    far = lab / "far.toml"
    far.write_text(CALIBRATION.replace("4.0]", "400.0]").replace("[0.0, 1.0, 0.0]", "[0, 3.1, 0]"))
    videos, out = ("--videos", lab / "videos"), ("--out", lab / "out")
    assert "--unit mm" in refuse("--calibration", far, *videos, *out)
    given = ("import", "--calibration", far, *videos, *out, "--unit", "cm", "--up", "-y", "--json")
    answer = CliRunner().invoke(app, list(map(str, given)))
    assert (
        "centimetres, as stated; up is -y, turned by 90.0" in json.loads(answer.output)["notes"][0]
    )
    found = read_calibration(lab / "out" / "calibration.toml")["a"]
    np.testing.assert_allclose(found.translation, [0.0, 0.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(np.array(found.rotation)[:, 2], [0.0, -1.0, 0.0], atol=1e-12)
    for option, value in (("--unit", "cm"), ("--up", "y")):
        result = CliRunner().invoke(app, list(map(str, ("import", *videos, *out, option, value))))
        assert isinstance(result.exception, UsageError)
