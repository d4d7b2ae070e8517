"""Matches made of given files: units of pitches, sizes, names; and their registration."""

import hashlib
import json
import os
import re
import unicodedata
from dataclasses import replace

import numpy as np
import pytest
from calibration_writers import write_easymocap
from pydantic import ValidationError
from run_records import match_spec

from data_contracts.match import CameraSpec
from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.ingest import registration
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.clock import camera_frames, remaining_offset, simplest_offset
from worldpose.ingest.footage import UnitFrames, read_unit
from worldpose.ingest.importing import import_lenses, import_match, import_videos
from worldpose.ingest.match_folder import read_match, require_calibrated
from worldpose.ingest.pitch_file import read_pitch
from worldpose.ingest.registration import register_match
from worldpose.ingest.writing import copy_boxes
from worldpose.video.files import write_video


def results(*frames):
    return [{"image_id": frame, "keypoints": [float(frame), 2.0, 0.5] * 17} for frame in frames]


@pytest.fixture
def source(tmp_path, make_camera):
    """Two cameras' calibration and poses: frames 300 to 302 in one, 301 to 304 in the other."""
    folder = tmp_path / "source"
    (folder / "detections").mkdir(parents=True)
    write_calibration_toml(
        folder / "calibration.toml",
        {name: make_camera(name, angle) for name, angle in (("right", 0.1), ("left", 0.2))},
    )
    (folder / "detections" / "right.json").write_text(json.dumps(results(300, 302)))
    (folder / "detections" / "left.json").write_text(json.dumps(results(304, 301)))
    return folder


def run(source, out, **options):
    folder = source / "detections"
    return import_match(source / "calibration.toml", folder, 25.0, out, **options)[0]


def test_other_tools_files_become_a_match(tmp_path, source):
    out = tmp_path / "my match"
    spec = run(source, out)
    match = read_match(out)
    require_calibrated(match)
    assert match.spec == spec
    assert (spec.match_id, spec.fps, match.pitch) == ("my-match", 25.0, None)
    assert [camera.id for camera in spec.cameras] == ["right", "left"]
    assert [(camera.width, camera.height) for camera in spec.cameras] == [(1920, 1080)] * 2


def test_frames_keep_their_numbers_in_one_clip_over_all_cameras(tmp_path, source):
    spec = run(source, tmp_path / "m")
    (clip,) = spec.clips
    assert (clip.id, clip.first_frame, clip.frame_count) == ("clip", 300, 5)
    for name, seen in (("right", [300, 302]), ("left", [301, 304])):
        people, _ = read_unit(read_match(tmp_path / "m"), name)
        np.testing.assert_array_equal(people.frame, np.arange(300, 305))
        found = np.isfinite(people.score[:, 0])
        np.testing.assert_array_equal(people.frame[found], seen)
        np.testing.assert_array_equal(people.keypoints[found, 0, 0, 0], seen)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda s: (s / "detections" / "left.json").write_text("[{}]"), "result 0, image_id"),
        (lambda s: (s / "calibration.toml").write_text(""), "calibration.toml"),
        (lambda s: [f.write_text("[]") for f in (s / "detections").iterdir()], "detections"),
        (lambda s: [f.unlink() for f in (s / "detections").iterdir()], "detections"),
    ],
)
def test_a_broken_source_leaves_nothing(tmp_path, source, change, where):
    change(source)
    with pytest.raises(InputError) as caught:
        run(source, tmp_path / "m")
    assert caught.value.where.endswith(where)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]


def film(path, frames=3):
    path.parent.mkdir(exist_ok=True)
    write_video(path.with_suffix(".mp4"), [np.full((48, 64), 9, np.uint8)] * frames, 25.0)
    path.with_suffix(".mp4").rename(path)


def calibrate(folder, make_camera, names):
    cameras = {
        name: make_camera(f"cam{angle}", angle).model_copy(
            update={"image_size": (64, 48), "principal_point_px": (31.5, 23.5)}
        )
        for angle, name in enumerate(names)
    }
    write_calibration_toml(folder / "calibration.toml", cameras)
    return folder / "calibration.toml"


@pytest.mark.parametrize("ending", ["MOV", "Mkv"])
def test_endings_of_videos_and_poses_are_found_in_any_case(tmp_path, source, make_camera, ending):
    names = ["GX010001", "GX010002"]
    calibration = calibrate(tmp_path, make_camera, names)
    for name in names:
        film(tmp_path / "videos" / f"{name}.{ending}")
    (tmp_path / "videos" / f"._{names[0]}.{ending}").write_bytes(b"of macOS")
    for given in (calibration, None):
        out = tmp_path / f"of {given}".replace("/", "")
        import_videos(given, tmp_path / "videos", out)
        match = read_match(out)
        assert sorted(path.name for path in match.videos.values()) == [
            f"{name}.{ending}" for name in names
        ]
    for file in list((source / "detections").iterdir()):
        file.rename(file.with_suffix(".JSON"))
    assert len(run(source, tmp_path / "m").cameras) == 2


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_with_accents_and_spaces_become_ids_in_either_form(tmp_path, make_camera, form):
    names = ["S\u00fcdtrib\u00fcne", "Camera 1"]
    calibration = calibrate(tmp_path, make_camera, names)
    for name in names:
        film(tmp_path / "videos" / (unicodedata.normalize(form, name) + ".mp4"))
    spec, _ = import_videos(calibration, tmp_path / "videos", tmp_path / "m")
    assert [camera.id for camera in spec.cameras] == ["Sudtribune", "Camera-1"]
    assert set(read_match(tmp_path / "m").videos) == {"Sudtribune", "Camera-1"}


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_boxes_lenses_and_clicks_are_of_the_camera_that_has_their_name(tmp_path, form):
    name = unicodedata.normalize(form, "S\u00fcd 1")
    for each in (name, "Camera 2"):
        film(tmp_path / "videos" / f"{each}.mp4")
    (tmp_path / "boxes").mkdir()
    (tmp_path / "boxes" / f"{name}.txt").write_text("1,1,5,5,20,20,1\n")
    match = tmp_path / "m"
    import_videos(None, tmp_path / "videos", match, boxes=tmp_path / "boxes")
    assert [file.name for file in (match / "boxes").iterdir()] == ["Sud-1.txt"]
    with pytest.raises(InputError, match="Rename the files"):  # as beside another Sud-1
        copy_boxes(tmp_path / "boxes", {"Sud_1": None}, match)
    lens = "size = [64, 48]\nmatrix = [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]\n"
    lens += "distortions = [0.0, 0.0, 0.0, 0.0]\n"
    (tmp_path / "named.toml").write_text(f'[a]\nname = "{name}"\n{lens}', "utf-8")
    (tmp_path / "one.toml").write_text(lens)
    assert [*import_lenses([tmp_path / "named.toml"], match)] == ["Sud-1"]
    assert [*import_lenses([tmp_path / "one.toml"], match, "Camera 2")] == ["Camera-2"]
    text = (match / "match.yaml").read_text().replace("pitch: none", "")
    (match / "match.yaml").write_text(text)
    for image, owner in ((f"{name}.png", "Sud-1"), ("u/0a1b2c3d-Camera_2.png", "Camera-2")):
        point = '<points label="halfway_far" points="30.5,20.5"/>'
        shown = f'<image name="{image}" width="64" height="48">{point}</image>'
        (tmp_path / "c.xml").write_text(f"<annotations>{shown}</annotations>", "utf-8")
        report = import_clicks(tmp_path / "c.xml", match)
        assert report.files == [f"annotations/static_calibration/{owner}.json"]
        (match / report.files[0]).unlink()
        (tmp_path / "c.xml").write_text(
            f"<annotations>{shown.replace(image, 'd=x%2FCamera%202.png')}</annotations>"
        )
        assert [*import_clicks(tmp_path / "c.xml", match).clicks] == ["Camera-2"]
        (match / "annotations/static_calibration/Camera-2.json").unlink()


def test_a_calibration_is_scaled_to_videos_of_its_shape_and_no_others(tmp_path, make_camera):
    calibration = calibrate(tmp_path, make_camera, ["one", "two"])
    text = calibration.read_text().replace("[64, 48]", "[128, 96]")
    calibration.write_text(text.replace("31.5", "63.5").replace("23.5", "47.5"))
    for name in ("one", "two"):
        film(tmp_path / "videos" / f"{name}.mp4")
    _, notes = import_videos(calibration, tmp_path / "videos", tmp_path / "m")
    assert notes[0].startswith("one.mp4: 64 x 48 px, calibrated are 128 x 96: the calibration is")
    before = read_calibration(calibration)["one"]
    after = read_calibration(tmp_path / "m" / "calibration.toml")["one"]
    assert after.image_size == (64, 48)
    assert after.principal_point_px == pytest.approx((31.5, 23.5))
    assert after.focal_px == pytest.approx([0.5 * focal for focal in before.focal_px])
    calibration.write_text(text.replace("[128, 96]", "[128, 90]"))
    with pytest.raises(InputError, match="128 x 90 px, the size in the calibration"):
        import_videos(calibration, tmp_path / "videos", tmp_path / "n")


@pytest.mark.parametrize("nothing", ['"null"', "[nan, nan, nan]"])
def test_a_camera_without_a_pose_is_left_out_by_name(tmp_path, source, nothing):
    calibration = source / "calibration.toml"
    content = calibration.read_text()
    lone = re.search(r"\[cam_0\].*?(?=\n\[)", content, re.DOTALL)[0]
    lone = re.sub(r"^(rotation|translation) = .*$", rf"\1 = {nothing}", lone, flags=re.MULTILINE)
    third = lone.replace("cam_0", "cam_9").replace('name = "', 'name = "third_')
    calibration.write_text(third + "\n\n" + content)
    spec, notes = import_match(calibration, source / "detections", 25.0, tmp_path / "m")
    assert len(spec.cameras) == 2
    assert notes[0].startswith(f"camera third_{spec.cameras[0].id} is left out")
    assert notes[1:] == [
        "2D poses are of some frames alone, by their numbers (right: one in 2, left: one in 3)"
    ]
    (source / "detections" / f"third_{spec.cameras[0].id}.json").write_text("[]")
    assert len(run(source, tmp_path / "n").cameras) == 2


def test_cameras_and_videos_without_each_other_are_left_out_by_name(tmp_path, source, make_camera):
    calibration = calibrate(tmp_path, make_camera, ["one", "two", "three"])
    for name in ("one", "two", "four"):
        film(tmp_path / "videos" / f"{name}.mp4")
    spec, notes = import_videos(calibration, tmp_path / "videos", tmp_path / "m")
    assert [camera.id for camera in spec.cameras] == ["one", "two"]
    assert list(read_calibration(tmp_path / "m" / "calibration.toml")) == ["one", "two"]
    assert notes == [
        "four.mp4: calibration.toml has no camera of this name; left out",
        f"camera three is left out: {tmp_path / 'videos'} has no file of it",
    ]
    (source / "detections" / "middle.json").write_text(json.dumps(results(300)))
    assert [camera.id for camera in run(source, tmp_path / "n").cameras] == ["right", "left"]


def test_openpose_folders_are_read_beside_files_and_folders_of_others(tmp_path, make_camera):
    calibration = calibrate(tmp_path, make_camera, ["one", "two", "three"])
    for name in ("one", "two"):
        (tmp_path / "d" / f"{name}_json").mkdir(parents=True)
        people = json.dumps({"people": [{"pose_keypoints_2d": [300.0, 300.0, 0.9] * 17}]})
        (tmp_path / "d" / f"{name}_json" / "0003.json").write_text(people)
    (tmp_path / "d" / "images").mkdir()
    (tmp_path / "d" / "three").mkdir()
    (tmp_path / "d" / "three" / "settings.json").write_text("{}")
    (tmp_path / "d" / "three.json").write_text(json.dumps(results(3)))
    spec, notes = import_match(calibration, tmp_path / "d", 25.0, tmp_path / "m")
    assert [camera.id for camera in spec.cameras] == ["one", "two", "three"]
    assert "three: three.json is of the same camera; left out" in notes


def test_a_camera_without_a_common_frame_is_said(tmp_path, source):
    (source / "detections" / "left.json").write_text(json.dumps(results(5300, 5302)))
    folder = source / "detections"
    _, notes = import_match(source / "calibration.toml", folder, 25.0, tmp_path / "m")
    assert "left has people in frames 5300 to 5302, where no other camera has any" in str(notes)
    (source / "detections" / "left.json").write_text("[]")
    _, notes = import_match(source / "calibration.toml", folder, 25.0, tmp_path / "n")
    assert "warning: the 2D poses of left have nobody in any frame" in notes


def test_a_short_video_does_not_shorten_the_match(tmp_path, make_camera):
    calibration = calibrate(tmp_path, make_camera, ["one", "two", "three"])
    for name, frames in (("one", 9), ("two", 3), ("three", 7)):
        film(tmp_path / "videos" / f"{name}.mp4", frames)
    spec, notes = import_videos(calibration, tmp_path / "videos", tmp_path / "m")
    assert spec.clips[0].frame_count == 7
    assert notes == [
        "the clip has 7 frames; videos end earlier: two after 3",
        "the clip ends after 7 frames, the last that two videos show; one has 9",
    ]


def test_easymocap_takes_the_size_of_the_videos_and_leaves_out_what_has_no_pose(
    tmp_path, make_camera
):
    names = ["one", "two", "three", "four"]
    cameras = read_calibration(calibrate(tmp_path, make_camera, names))
    folder = tmp_path / "easymocap"
    folder.mkdir()
    write_easymocap(folder, list(cameras.values()))
    lens, pose = folder / "intri.yml", folder / "extri.yml"
    lens.write_text(re.sub(r"^[WH]_.*\n| +- .?four.?\n", "", lens.read_text(), flags=re.M))
    pose.write_text(
        re.sub(r"(R|Rot|T)_three: .*?(?=^\S|\Z)", "", pose.read_text(), flags=re.M | re.S)
    )
    for name in names:
        film(tmp_path / "videos" / f"{name}.mp4")
    spec, notes = import_videos(folder, tmp_path / "videos", tmp_path / "m")
    assert [(camera.id, camera.width) for camera in spec.cameras] == [("one", 64), ("two", 64)]
    assert notes == [
        "camera three is left out: it has no pose",
        "camera four is left out: intri.yml has no lens of it",
    ]


SPEC = match_spec(["cam"])


def read(folder, content):
    (folder / "pitch.json").write_text(json.dumps(content))
    return read_pitch(folder, SPEC)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"length": 105000.0, "width": 68000.0}, "length: .*105000, which looks like millimetres"),
        ({"length": 10500, "width": 6800}, "length: .*10500, which looks like centimetres"),
        ({"length": 345.0, "width": 223.0}, "length: .*345, which looks like feet"),
        ({"width": 20.0}, "width: expected 40 to 100 metres, found 20. Give all lengths"),
        ({"crown": 50.0}, "crown"),
        ({"points": {"corner_left_near": [-52500.0, -34000.0, 0.0]}}, "looks like millimetres"),
        ({"points": {"corner_left_near": [-57.4, -37.2, 0.0]}}, "which looks like yards"),
        ({"points": {"corner_left_near": [52.5, -34.0, 0.0]}}, "points.corner_left_near: expected"),
        (
            {"arcs": {"a": {"center": "x", "radius": 1e9, "start_angle": 0, "end_angle": 1}}},
            "radiu",
        ),
    ],
)
def test_a_pitch_that_is_not_in_metres_is_refused(tmp_path, content, message):
    with pytest.raises(InputError, match=message) as refused:
        read(tmp_path, content)
    assert "pitch.json" in refused.value.where


def test_a_pitch_of_another_size_is_taken_where_the_file_says_so(tmp_path):
    assert read(tmp_path, {"length": 61.0, "width": 43.0, "any_size": True}).length == 61.0


OLD = 1_700_000_000


@pytest.fixture
def folder(match_folder):
    """The tiny match with every kind of file, all of them old."""
    for name in ("videos/cam1.mp4", "stills/cam1.png", "annotations/pitch/cam1.json"):
        (match_folder / name).parent.mkdir(parents=True)
        (match_folder / name).write_bytes(name.encode())
    (match_folder / "pitch.json").write_text('{"length": 104.0}')
    (match_folder / "reference").mkdir()
    (match_folder / "reference" / "joints.npz").write_bytes(b"truth")
    (match_folder / "notes.txt").write_bytes(b"mine")
    settle(match_folder)
    return match_folder


def settle(folder):
    for path in folder.rglob("*"):
        os.utime(path, (OLD, OLD))


def register(folder, previous=None):
    return register_match(read_match(folder), previous)


def test_every_file_of_the_match_is_registered_with_its_digest(folder):
    registered = register(folder)
    assert [file.path for file in registered.files] == [
        *("annotations/pitch/cam1.json", "calibration.toml", "detections/cam1.npz"),
        *("detections/cam2.npz", "detections/goal.npz", "match.yaml", "pitch.json"),
        *("stills/cam1.png", "videos/cam1.mp4"),
    ]
    for file in registered.files:
        content = (folder / file.path).read_bytes()
        assert file.sha256 == hashlib.sha256(content).hexdigest()
        assert file.size == len(content)
    assert registered.folder == str(folder)


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("videos/cam1.mp4", False),
        ("detections/goal.npz", False),
        ("pitch.json", False),
        ("annotations/pitch/cam1.json", True),
        ("stills/cam1.png", True),
        ("calibration.toml", True),
        ("reference/joints.npz", True),
        ("notes.txt", True),
    ],
)
def test_identity_is_of_videos_detections_and_pitch(folder, name, same):
    before = register(folder)
    addition = b" " if name.endswith("json") else b"\n"
    (folder / name).write_bytes((folder / name).read_bytes() + addition)
    settle(folder)
    after = register(folder)
    assert (after.identity == before.identity) is same
    registered = {file.path for file in before.files}
    assert (after.files != before.files) is (name in registered)


def test_unchanged_files_are_not_read_again(folder, monkeypatch):
    first = register(folder)

    def refuse(file, digest):
        raise AssertionError(f"read {file.name}")

    monkeypatch.setattr(hashlib, "file_digest", refuse)
    assert register(folder, first) == first


def test_an_empty_file_is_refused(folder):
    (folder / "videos" / "cam1.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="found 0 bytes") as caught:
        register(folder)
    assert caught.value.where.endswith("videos/cam1.mp4")


def test_a_file_that_changes_while_it_is_read_is_refused(folder, monkeypatch):
    digest = registration.sha256_of_file

    def grow(path):
        with (folder / "videos" / "cam1.mp4").open("ab") as video:
            video.write(b"more")
        return digest(path)

    monkeypatch.setattr(registration, "sha256_of_file", grow)
    with pytest.raises(InputError, match="still being written"):
        register(folder)


FRAME = np.arange(8)


@pytest.mark.parametrize(
    ("offset", "rate", "shown"),
    [
        (3, 1.0, [3, 4, 5, 6, 7, 8, 9, 10]),
        (((3, 0), (4, -2)), 1.0, [0, 1, 2, 3, 2, 3, 4, 5]),  # two frames lost after frame 3
        (((0, 0), (4, 2)), 1.0, [0, 2, 3, 5, 6, 7, 8, 9]),  # fast until frame 4
        (0, 0.5, [0, 1, 1, 2, 2, 3, 3, 4]),
    ],
)
def test_a_match_frame_has_its_nearest_camera_frame(offset, rate, shown):
    assert camera_frames(FRAME, offset, rate).tolist() == shown


def test_the_rest_is_how_much_later_the_camera_frame_is():
    # Exact frames are 0, 1.5, 3, 4.5, 6 at a rate of 1.5 frames per match frame.
    assert remaining_offset(FRAME[:5], 0, 1.5) == pytest.approx([0, 1 / 3, 0, 1 / 3, 0])


def test_people_of_a_fast_camera_lie_on_match_frames(make_people, tmp_path):
    people = make_people(0, 12)
    frames = UnitFrames(0, 8, ((0, 0), (4, 2)), ((0, 2), (4, 4)))
    placed = frames.place(tmp_path, replace(people, frame=np.arange(12)))
    np.testing.assert_array_equal(placed.frame, [0, 1, 4, 5, 6, 7])
    np.testing.assert_array_equal(placed.keypoints, people.keypoints[[0, 2, 6, 7, 8, 9]])


@pytest.mark.parametrize(
    ("offset", "kind", "told"),
    [
        (0.5, "static", r"in pairs as \[\[0, 0.5\]\]"),
        (((3, 1), (3, 2)), "static", "rising match frames"),
        ((), "static", "rising match frames"),
        (((0, 1), (9, 2)), "broadcast", "broadcast_offset_frames"),
        (7.0, "broadcast", "broadcast_offset_frames"),
    ],
)
def test_an_offset_that_cannot_be_read_is_refused(offset, kind, told):
    with pytest.raises(ValidationError, match=told):
        CameraSpec(id="a", width=9, height=9, kind=kind, offset_frames=offset)


@pytest.mark.parametrize(
    ("frame", "exact", "written"),
    [
        ([0], [-0.4], 0),
        ([0, 74, 75], [0.1, 0.1, -4.9], ((74, 0.0), (75, -5.0))),
        ([0, 999], [0.0, -5.674], ((0, 0.0), (999, -5.67))),
        ([5, 30, 31, 90], [2.0, 2.0, 0.0, 3.0], ((5, 2.0), (30, 2.0), (31, 0.0), (90, 3.0))),
    ],
)
def test_offsets_are_written_as_simply_as_they_are(frame, exact, written):
    assert simplest_offset(np.array(frame), np.array(exact)) == written
