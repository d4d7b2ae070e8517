"""A bad file of each form of import is one error that names the file."""

import errno
import json
import shutil

import numpy as np
import pytest
from command_line import invoke
from run_records import calibration

from flows.web.draft_problems import take_given
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.store.store import Store
from worldpose.video.files import write_video

TABLE = """
[cam_{0}]
name = "{0}"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = {1}
translation = [0.0, 0.0, 4.0]
"""
CALIBRATION = TABLE.format("a", [0.0, 0.0, 0.0]) + TABLE.format("b", [0.0, 1.0, 0.0])
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


def run(*arguments):
    return invoke("import", *arguments)


def refuse(*arguments):
    result = run(*arguments)
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


@pytest.fixture
def lab(tmp_path):
    """A calibration of two cameras, empty 2D poses, a trial of Pose2Sim, and a match folder."""
    for folder in ("poses", "match/detections", "trial/calibration", "videos"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    (tmp_path / "match/match.yaml").write_text(MATCH)
    np.savez(tmp_path / "match/detections/a.npz", a=1)
    (tmp_path / "trial/Config.toml").write_text("[project]\nframe_rate = 60\n")
    (tmp_path / "trial/calibration/Calib.toml").write_text(CALIBRATION)
    for name in ("a", "b"):
        (tmp_path / f"poses/{name}.json").write_text("[]")
        (tmp_path / f"trial/pose/{name}_json").mkdir(parents=True)
        file = tmp_path / f"trial/pose/{name}_json/{name}_000000.json"
        file.write_text('{"version": 1.3, "people": []}')
    return tmp_path


@pytest.fixture
def filmed(lab):
    """The same with two short videos."""
    for name in ("a.mp4", "b.mp4"):
        write_video(lab / "videos" / name, [np.zeros((48, 64, 3), np.uint8)] * 5, 25.0)
    return lab


POSES = "--detections LAB/poses --fps 25 --out LAB/out"
CALIBRATED = "--calibration LAB/calibration.toml --detections LAB/poses --fps 25 --out LAB/out"
LENS = "--lens LAB/{} --camera a --out LAB/match"
CLICKS = "--clicks LAB/{} --camera a --out LAB/match"
FORMS = {
    **dict.fromkeys(
        [
            *("bad.toml", "bad.qca.txt", "bad.xml", "bad.json", "bad.yml"),
            *("bad.xcp", "bad.mcal", "bad.calib", "bad.pickle", "intri.yml"),
        ],
        f"--calibration LAB/{{}} {POSES}",
    ),
    **dict.fromkeys(("poses/a.json", "poses/a.npz"), CALIBRATED),
    **dict.fromkeys(("videos/a.mp4", "videos/b.mp4"), "--videos LAB/videos --out LAB/out"),
    **dict.fromkeys(
        ["Config.toml", "calibration/Calib.toml", "pose/a_json/a_000000.json"],
        "--pose2sim LAB/trial --out LAB/out",
    ),
    **dict.fromkeys(
        ["lens.toml", "lens.xml", "lens.yml", "lens.json", "lens.npz", "lens.npy"], LENS
    ),
    **dict.fromkeys(("clicks.xml", "clicks.json"), CLICKS),
    "bad.csv": "--pitch LAB/{} --out LAB/match",
}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("content", [b"", NOISE], ids=["empty", "noise"])
def test_a_bad_file_is_named_and_nothing_is_written(filmed, name, content):
    arguments = FORMS[name].format(name).replace("LAB", str(filmed)).split()
    file = filmed / ("trial" if "--pose2sim" in arguments else "") / name
    file.with_suffix(".json").unlink(missing_ok=True)
    file.write_bytes(content)
    if content or "--pose2sim" not in arguments:  # a trial may have empty files
        assert name.rpartition("/")[2] in refuse(*arguments)
    assert not (filmed / "out").exists()
    assert {path.name for path in (filmed / "match").iterdir()} == {"detections", "match.yaml"}


def test_boxes_have_an_ending_in_any_case(filmed):
    (filmed / "boxes").mkdir()
    (filmed / "boxes/a.TXT").write_bytes(b"1,1,5,5,5,5,1\n")
    given = ("--videos", filmed / "videos", "--boxes", filmed / "boxes", "--out", filmed / "out")
    assert run(*given).exit_code == 0
    assert [file.name for file in (filmed / "out/boxes").iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("option", "owner"), [("--left-handed", "--pitch"), ("--join", "--videos")]
)
def test_an_option_of_another_import_is_refused(lab, option, owner):
    result = run(*CALIBRATED.replace("LAB", str(lab)).split(), option)
    assert isinstance(result.exception, UsageError)
    assert f"expected {option} with {owner}" in str(result.exception)
    assert not (lab / "out").exists()


def test_videos_of_two_rates_are_refused_without_a_file_that_is_not_there(filmed):
    write_video(filmed / "videos/b.mp4", [np.zeros((48, 64, 3), np.uint8)] * 10, 50.0)
    told = refuse("--videos", filmed / "videos", "--out", filmed / "out")
    assert "b.mp4: expected 25 frames per second, the rate of the match, found 50. Conv" in told


def test_places_for_a_match(lab):
    cases = {
        lab / "match": "nothing, or an empty folder",
        lab / "calibration.toml": "nothing, or an empty folder",
        lab / "calibration.toml" / "below": "a place where a folder can be made",
    }
    for name in ("a", "b"):
        person = {"image_id": 0, "category_id": 1, "score": 0.9}
        person["keypoints"] = [9.0, 9.0, 1.0] * 17
        (lab / f"poses/{name}.json").write_text(json.dumps([person]))
    given = ("--calibration", lab / "calibration.toml", "--detections", lab / "poses", "--fps", 25)
    for out, told in cases.items():
        assert told in refuse(*given, "--out", out)
    for fps in ("nan", "-5", "0"):
        given = (*given[:-1], fps)
        told = run(*given, "--out", lab / "out").output
        assert f"{fps} is not a number of frames per second" in told
    given = (*given[:-1], 25)
    assert run(*given, "--out", lab / "out").exit_code == 0


def test_a_full_disk_leaves_no_match(filmed, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr("worldpose.ingest.camera_videos.shutil.copyfile", full)
    told = refuse("--videos", filmed / "videos", "--out", filmed / "new" / "out")
    assert "No space left on device" in told
    assert not (filmed / "new").exists() or not list((filmed / "new").iterdir())


def test_a_stated_unit_and_axis_hold_and_absurd_distances_are_refused(filmed):
    far = filmed / "far.toml"
    far.write_text(CALIBRATION.replace("4.0]", "400.0]").replace("[0.0, 1.0, 0.0]", "[0, 3.1, 0]"))
    videos, out = ("--videos", filmed / "videos"), ("--out", filmed / "out")
    assert "--unit mm" in refuse("--calibration", far, *videos, *out)
    answer = run("--calibration", far, *videos, *out, "--unit", "cm", "--up", "-y", "--json")
    said = json.loads(answer.output)["notes"][0]
    assert "centimetres, as stated; up is -y, turned by 90.0" in said
    found = read_calibration(filmed / "out" / "calibration.toml")["a"]
    np.testing.assert_allclose(found.translation, [0.0, 0.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(np.array(found.rotation)[:, 2], [0.0, -1.0, 0.0], atol=1e-12)
    for option, value in (("--unit", "cm"), ("--up", "y")):
        assert isinstance(run(*videos, *out, option, value).exception, UsageError)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("cam00_half1.npz", "cam00_half2.npz"), "one file with 2D poses of cam00"),
        (("cam00.npz", "cam001.npz"), "with a name that begins"),
        (("calibration.toml",), "one calibration"),
    ],
)
def test_a_file_of_another_tool_replaces_none(tiny, tmp_path, names, expected):
    folder, given = tmp_path / "match", tmp_path / "given"
    given.mkdir()
    shutil.copytree(tiny, folder, ignore=lambda *_: {"detections", "calibration.toml"})
    for name in names:
        source = tiny / "detections" / "cam00.npz"
        if name.endswith(".toml"):
            source = folder / name
            write_calibration_toml(source, {"cam00": calibration("cam00")})
        shutil.copy(source, given / name)
    before = {file: file.read_bytes() for file in folder.glob("*.toml")}
    with pytest.raises(InputError, match=expected):
        take_given(Store.open_or_new(tmp_path / "store"), given, folder, {})
    assert {file: file.read_bytes() for file in folder.glob("*.toml")} == before
