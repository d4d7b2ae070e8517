import json

import numpy as np
import pytest
import yaml

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.ingest.footage import UnitFrames, read_unit, unit_frames
from worldpose.ingest.match_folder import read_match, require_calibrated, unclicked_clips


@pytest.fixture
def edit(match_folder):
    """Change match.yaml: `edit(lambda content: ...)`."""

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
    assert match.spec == spec
    assert match.folder == match_folder
    assert list(match.calibrations) == ["cam1", "cam2"]
    assert match.calibrations["cam1"].image_size == (1920, 1080)
    assert {name: path.name for name, path in match.detections.items()} == {
        "cam1": "cam1.npz",
        "cam2": "cam2.npz",
        "goal": "goal.npz",
    }
    assert match.videos == {}
    assert match.pitch == PitchSpec()
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


def test_units_lie_on_the_matchs_clock(spec):
    # Clips span 5 to 8 and 9 to 11; cam2 runs 10 frames ahead; goal's own video starts at 0.
    clips = ((5, 3), (9, 2))
    assert unit_frames(spec, "cam1") == UnitFrames(first=5, count=6, offset=0, ranges=clips)
    assert unit_frames(spec, "cam2") == UnitFrames(first=5, count=6, offset=10, ranges=clips)
    assert unit_frames(spec, "goal") == UnitFrames(first=5, count=3, offset=-5, ranges=((5, 3),))


def test_a_static_camera_covers_all_clips_in_match_frames(match_folder, make_people):
    people, calibration = read_unit(read_match(match_folder), "cam1")
    np.testing.assert_array_equal(people.frame, [5, 6, 7, 9, 10])
    there = [0, 1, 2, 4, 5]  # nothing is kept of frame 8, which no clip has
    np.testing.assert_array_equal(people.keypoints, make_people(5, 6, seed=1).keypoints[there])
    assert calibration is not None
    assert calibration.id == "cam1"


def test_a_broadcast_camera_covers_its_clip(match_folder, make_people):
    # Clip goal starts at match frame 5; its video starts at frame 0.
    people, calibration = read_unit(read_match(match_folder), "goal")
    np.testing.assert_array_equal(people.frame, [5, 6, 7])
    np.testing.assert_array_equal(people.keypoints, make_people(0, 3, seed=3).keypoints)
    assert calibration is None


@pytest.mark.parametrize("unit_id", ["cam9", "main", "corner"])
def test_a_unit_without_detections_is_refused(match_folder, unit_id):
    with pytest.raises(InputError, match="those of cam1, cam2, goal"):
        read_unit(read_match(match_folder), unit_id)
