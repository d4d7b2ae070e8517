import json
import re
import unicodedata

import numpy as np
import pytest
from calibration_writers import write_easymocap

from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.ingest.footage import read_unit
from worldpose.ingest.importing import import_match, import_videos
from worldpose.ingest.match_folder import read_match, require_calibrated
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


@pytest.mark.parametrize("ending", ["MP4", "MOV", "Mkv", "M4V"])
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


def test_openpose_folders_of_some_cameras_and_folders_of_others_are_read(tmp_path, make_camera):
    calibration = calibrate(tmp_path, make_camera, ["one", "two", "three"])
    for name in ("one", "two"):
        (tmp_path / "d" / f"{name}_json").mkdir(parents=True)
        people = json.dumps({"people": [{"pose_keypoints_2d": [300.0, 300.0, 0.9] * 17}]})
        (tmp_path / "d" / f"{name}_json" / "0003.json").write_text(people)
    (tmp_path / "d" / "images").mkdir()
    spec, notes = import_match(calibration, tmp_path / "d", 25.0, tmp_path / "m")
    assert [camera.id for camera in spec.cameras] == ["one", "two"]
    assert notes[-1] == f"camera three is left out: {tmp_path / 'd'} has no file of it"


def test_a_camera_without_a_common_frame_is_said(tmp_path, source):
    (source / "detections" / "left.json").write_text(json.dumps(results(5300, 5302)))
    folder = source / "detections"
    _, notes = import_match(source / "calibration.toml", folder, 25.0, tmp_path / "m")
    assert "left has people in frames 5300 to 5302, where no other camera has any" in str(notes)


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
    names = ["one", "two", "three"]
    cameras = read_calibration(calibrate(tmp_path, make_camera, names))
    folder = tmp_path / "easymocap"
    folder.mkdir()
    write_easymocap(folder, list(cameras.values()))
    lens, pose = folder / "intri.yml", folder / "extri.yml"
    lens.write_text("".join(re.findall(r"^(?![WH]_).*\n", lens.read_text(), re.MULTILINE)))
    pose.write_text(
        re.sub(r"(R|Rot|T)_three: .*?(?=^\S|\Z)", "", pose.read_text(), flags=re.M | re.S)
    )
    with pytest.raises(InputError, match="the image size of camera one"):
        read_calibration(folder)
    for name in names:
        film(tmp_path / "videos" / f"{name}.mp4")
    spec, notes = import_videos(folder, tmp_path / "videos", tmp_path / "m")
    assert [(camera.id, camera.width) for camera in spec.cameras] == [("one", 64), ("two", 64)]
    assert notes == ["camera three is left out: it has no pose"]
