"""A match folder is read, written and checked as its description says."""

import json
import math

import numpy as np
import pytest
import yaml
from run_records import match_spec

from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.ingest.footage import UnitFrames, read_unit, unit_frames
from worldpose.ingest.match_folder import read_match, require_calibrated, unclicked_clips
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import write_match, write_offsets


@pytest.fixture
def edit(match_folder):

    def change(function):
        path = match_folder / "match.yaml"
        content = yaml.safe_load(path.read_text())
        function(content)
        path.write_text(yaml.safe_dump(content))

    return change


def refusal(folder):
    with pytest.raises(InputError) as caught:
        read_match(folder)
    return caught.value


def test_a_complete_folder_is_read(match_folder, spec, make_camera):
    match = read_match(match_folder)
    assert (match.spec, match.folder) == (spec, match_folder)
    assert list(match.calibrations) == ["cam1", "cam2"]
    assert match.calibrations["cam1"].image_size == (1920, 1080)
    assert {name: path.name for name, path in match.detections.items()} == {
        "cam1": "cam1.npz",
        "cam2": "cam2.npz",
        "goal": "goal.npz",
    }
    assert (match.videos, match.pitch) == ({}, PitchSpec())
    (match_folder / "detections" / "README.txt").write_text("x")
    (match_folder / "detections" / "._cam1.json").write_text("x")
    assert read_match(match_folder).detections == match.detections
    (match_folder / "detections" / "cam1.json").write_text("[]")
    assert refusal(match_folder).found == "cam1.json and cam1.npz"


def test_a_folder_without_match_yaml_is_refused(tmp_path):
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "cam1.mp4").write_bytes(b"video")
    error = refusal(tmp_path)
    assert error.where == str(tmp_path / "match.yaml")
    assert "docs/reference/match_folder.md" in error.todo and "worldpose import" in error.todo
    assert refusal(tmp_path / "absent").where == str(tmp_path / "absent" / "match.yaml")


def test_pitch_none_is_no_pitch_and_refused_beside_a_pitch_file(match_folder, edit):
    edit(lambda content: content.update(pitch="none"))
    assert read_match(match_folder).pitch is None
    (match_folder / "pitch.json").write_text("{}")
    error = refusal(match_folder)
    assert error.where == f"{match_folder / 'match.yaml'}: pitch"
    assert error.expected == "no `pitch: none` where pitch.json lies"


def test_static_camera_without_footage_is_missing(match_folder):
    (match_folder / "detections" / "cam2.npz").unlink()
    error = refusal(match_folder)
    assert "missing camera cam2; there: cam1" in error.found
    assert "videos/cam2.mp4" in error.todo
    (match_folder / "detections" / "cam1.npz").unlink()
    assert "missing camera cam1, cam2; there: " in refusal(match_folder).found


def test_a_folder_of_images_is_footage_unless_empty(match_folder, edit):
    (match_folder / "detections" / "cam2.npz").unlink()
    (match_folder / "images").mkdir()
    edit(lambda content: content["cameras"][1].update(video="images"))
    assert refusal(match_folder).where.endswith("cameras[1].video")
    (match_folder / "images" / "000.png").write_bytes(b"png")
    assert read_match(match_folder).videos == {"cam2": match_folder / "images"}


def test_a_broadcast_clip_needs_footage(match_folder):
    (match_folder / "detections" / "goal.npz").unlink()
    assert "broadcast camera main for clip goal" in refusal(match_folder).expected
    (match_folder / "broadcast").mkdir()
    (match_folder / "broadcast" / "goal.mp4").write_bytes(b"video")
    assert read_match(match_folder).videos["goal"].name == "goal.mp4"


@pytest.mark.parametrize("name", ["cam9.npz", "main.json", "corner.json"])
def test_detections_of_nobody_are_refused(match_folder, name):
    # main is a broadcast camera, seen clip by clip; corner is a clip without one.
    (match_folder / "detections" / name).write_bytes(b"x")
    error = refusal(match_folder)
    assert error.where.endswith(name)
    assert "cam1, cam2, goal" in error.expected


@pytest.mark.parametrize(
    "name",
    ["../out.mp4", "/etc/hostname", "detections/../real.mp4", "C:\\out.mp4", "C:out.mp4", "", "."],
)
@pytest.mark.parametrize("key", ["video", "still"])
def test_a_name_that_is_not_plainly_inside_the_folder_is_refused(match_folder, edit, name, key):
    (match_folder.parent / "out.mp4").write_bytes(b"video")
    (match_folder / "real.mp4").write_bytes(b"video")
    edit(lambda content: content["cameras"][0].update({key: name}))
    error = refusal(match_folder)
    assert error.where.endswith(f"cameras[0].{key}")
    assert error.expected == "a path inside the match folder, without .."


def test_a_link_that_leads_out_of_the_folder_is_refused(match_folder, edit):
    (match_folder.parent / "secret.mp4").write_bytes(b"video")
    (match_folder / "link.mp4").symlink_to(match_folder.parent / "secret.mp4")
    edit(lambda content: content["cameras"][0].update(video="link.mp4"))
    assert "a link that leads out" in refusal(match_folder).found


def test_a_calibration_of_an_unknown_camera_is_refused(match_folder, edit):
    edit(lambda content: content["cameras"][1].update(id="cam3"))
    (match_folder / "detections" / "cam2.npz").rename(match_folder / "detections" / "cam3.npz")
    error = refusal(match_folder)
    assert error.where == str(match_folder / "calibration.toml")
    assert (error.expected, error.found) == (
        "static cameras of match.yaml: cam1, cam3",
        "also cam2",
    )


def test_a_calibration_at_another_size_is_refused(match_folder, edit):
    edit(lambda content: content["cameras"][0].update(width=1280))
    error = refusal(match_folder)
    assert error.where.endswith("calibration.toml: cam1.size")
    assert "[1280, 1080]" in error.expected
    assert error.found == "[1920, 1080]"


def test_missing_calibrations_are_named_when_they_are_required(match_folder):
    require_calibrated(read_match(match_folder))
    path = match_folder / "calibration.toml"
    path.write_text(path.read_text().replace("[cam_0]", "[metadata]").split("[metadata]\nadj")[0])
    match = read_match(match_folder)
    with pytest.raises(InputError, match="missing camera cam1; there: cam2"):
        require_calibrated(match)
    path.unlink()
    with pytest.raises(InputError, match="missing camera cam1, cam2; there: none"):
        require_calibrated(read_match(match_folder))


def test_without_static_cameras_key_frames_of_a_clip_are_required(match_folder, edit):
    def leave_the_broadcast_camera(content):
        content["cameras"] = [each for each in content["cameras"] if each["id"] == "main"]

    edit(leave_the_broadcast_camera)
    (match_folder / "calibration.toml").unlink()
    for name in ("cam1", "cam2"):
        (match_folder / "detections" / f"{name}.npz").unlink()
    match = read_match(match_folder)
    assert unclicked_clips(match) == ()  # there is no video to click in
    with pytest.raises(InputError, match=r"no clip with a video.*broadcast/goal\.mp4"):
        require_calibrated(match)
    (match_folder / "broadcast").mkdir()
    (match_folder / "broadcast" / "goal.mp4").write_bytes(b"video")
    match = read_match(match_folder)
    assert unclicked_clips(match) == ("goal",)
    with pytest.raises(InputError, match="no clicked key frame"):
        require_calibrated(match)
    clicked = match_folder / "annotations" / "broadcast_calibration" / "goal.json"
    clicked.parent.mkdir(parents=True)
    points = [{"name": "center_mark", "xy": [3.0, 4.0]}]
    key = {"frame": 0, "markings": {"points": points, "drawn": []}}
    clicked.write_text(json.dumps({"key_frames": [key]}))
    match = read_match(match_folder)
    assert unclicked_clips(match) == ()
    require_calibrated(match)
    edit(lambda content: content["clips"][0].pop("broadcast"))
    assert refusal(match_folder).expected == "a static camera, or a clip with a broadcast camera"


def test_the_side_of_a_static_camera_lets_key_frames_be_proposed(match_folder, edit):
    (match_folder / "broadcast").mkdir()
    (match_folder / "broadcast" / "goal.mp4").write_bytes(b"video")
    match = read_match(match_folder)
    assert (match.proposed_views, match.calibrated_views) == ((), ())
    edit(lambda content: content["cameras"][0].update(side="near"))
    match = read_match(match_folder)
    assert match.proposed_views == match.calibrated_views == ("goal",)


def test_units_lie_on_the_matchs_clock(match_folder, spec, make_people):
    # Clips span 5 to 8 and 9 to 11; cam2 runs 10 frames ahead; goal's own video starts at 0.
    clips = ((5, 3), (9, 2))
    assert unit_frames(spec, "cam2") == UnitFrames(first=5, count=6, offset=10, ranges=clips)
    assert unit_frames(spec, "goal") == UnitFrames(first=5, count=3, offset=-5, ranges=((5, 3),))
    people, calibration = read_unit(read_match(match_folder), "cam1")
    np.testing.assert_array_equal(people.frame, [5, 6, 7, 9, 10])
    there = [0, 1, 2, 4, 5]  # nothing is kept of frame 8, which no clip has
    np.testing.assert_array_equal(people.keypoints, make_people(5, 6, seed=1).keypoints[there])
    assert calibration.id == "cam1"
    people, calibration = read_unit(read_match(match_folder), "goal")
    np.testing.assert_array_equal(people.frame, [5, 6, 7])
    np.testing.assert_array_equal(people.keypoints, make_people(0, 3, seed=3).keypoints)
    assert calibration is None


@pytest.fixture
def one():
    return match_spec(["cam1"], {"clip": {"frame_count": 3}})


def files(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_written_match_keeps_its_pitch_and_has_usual_rights(write_tiny, tmp_path):
    folder = write_tiny(pitch=PitchSpec(length=104.2))
    assert read_match(folder).pitch == PitchSpec(length=104.2)
    (tmp_path / "usual").mkdir()
    assert folder.stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_what_is_there_is_left_as_it_was(tmp_path, one, make_people, kind):
    target = tmp_path / "m"
    if kind == "folder":
        target.mkdir()
        (target / "mine").write_bytes(b"precious")
    elif kind == "file":
        target.write_bytes(b"precious")
    else:
        (tmp_path / "elsewhere").mkdir()
        target.symlink_to(tmp_path / "elsewhere")
    before = sorted(tmp_path.rglob("*")), files(tmp_path)
    with pytest.raises(InputError, match="left as it was"):
        write_match(target, one, calibrations={}, observations={"cam1": make_people()})
    assert (sorted(tmp_path.rglob("*")), files(tmp_path)) == before


def test_a_failure_on_the_way_leaves_nothing(tmp_path, one, make_people):
    def fail(folder):
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_match(
            tmp_path / "m", one, calibrations={}, observations={"cam1": make_people()}, further=fail
        )
    assert list(tmp_path.iterdir()) == []


def test_clock_offsets_are_written_into_match_yaml_and_all_else_stays(tmp_path):
    file = tmp_path / "match.yaml"
    text = (
        "match_id: m  # the final\n"
        "fps: 25\n"
        "cameras:\n"
        "  - {id: a, width: 64, height: 48, offset_frames: 3}   # late\n"
        "  - {id: b, width: 64, height: 48}\n"
        "  - id: c\n"
        "    width: 64   # small\n"
        "    height: 48\n"
        "  - {id: d, width: 64, height: 48, offset_frames: 1}\n"
        "clips:\n"
        "  - {id: clip, frame_count: 3}\n"
    )
    file.write_text(text)
    write_offsets(tmp_path, {"a": -12, "b": 2, "c": 7})
    more = {"frames: 3": "frames: -12", "b,": "b, offset_frames: 2,"}
    for old, new in {**more, "id: c\n": "id: c\n    offset_frames: 7\n"}.items():
        text = text.replace(old, new)
    assert file.read_text() == text
    with pytest.raises(InputError, match=r"match.yaml: expected the cameras z, found others"):
        write_offsets(tmp_path, {"z": 1})
    assert "offset_frames: 7" in file.read_text()


def match(**changes):
    content = {
        "match_id": "final",
        "fps": 25,
        "cameras": [
            {"id": "cam1", "width": 1920, "height": 1080},
            {"id": "cam2", "width": 1920, "height": 1080},
        ],
        "clips": [{"id": "clip", "frame_count": 10}],
    }
    return {key: value for key, value in {**content, **changes}.items() if value is not ...}


def camera(**changes):
    return {"id": "cam2", "width": 1920, "height": 1080, **changes}


def record_refusal(data, model=MatchSpec):
    with pytest.raises(InputError) as caught:
        validate_record(model, data, "match.yaml")
    return caught.value


FIRST = "match.yaml: cameras[0]"


@pytest.mark.parametrize(
    ("data", "where", "expected", "found", "todo"),
    [
        (match(fps=...), "match.yaml: fps", "a value", "nothing", "Add"),
        (match(fps=-1), "match.yaml: fps", "greater than or equal to 1", "-1", "Correct"),
        (match(fps=math.nan), "match.yaml: fps", "a finite number", "nan", "Correct"),
        (match(match_id=12), "match.yaml: match_id", "a valid string", "12", "quotes: '12'"),
        (match(match_id=False), "match.yaml: match_id", "a valid string", "no, off", "'no'"),
        (match(match_id="../x"), "match.yaml: match_id", "letters", "'../x'", "Rename"),
        (match(contract=2), "match.yaml: contract", "1", "2", "version of worldpose"),
        (match(cameras=[camera(kind="fixed")]), f"{FIRST}.kind", "'broadcast'", "'fixed'", ""),
        (match(cameras=[camera(id=None)]), f"{FIRST}.id", "a valid string", "nothing", "Correct"),
        (match(cameras=[camera(widht=1)]), f"{FIRST}.widht", "width", "'widht'", "'width'?"),
        (match(extra=1), "match.yaml: extra", "match_id", "'extra'", "Remove it"),
        (match(cameras=[camera()] * 2), "match.yaml", "agree", "used twice: ['cam2']", "named"),
        (match(cameras=[]), "match.yaml: cameras", "at least 1", "0", "Correct"),
        ([1], "match.yaml", "a mapping", "[1]", "Correct"),
    ],
)
def test_refusal_names_key_expected_found_and_what_to_do(data, where, expected, found, todo):
    error = record_refusal(data)
    assert error.where == where
    assert expected in error.expected
    assert found in error.found
    assert todo in error.todo
