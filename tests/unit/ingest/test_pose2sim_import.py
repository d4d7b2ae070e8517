"""A trial of Pose2Sim becomes a match folder, or is refused with a message that can be followed."""

import itertools
import json
import shutil

import cv2
import numpy as np
import pytest
from run_records import calibration

from data_contracts.conventions import COCO17
from worldpose.body.keypoints import BODY25
from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.ingest.footage import read_unit
from worldpose.ingest.importing import import_videos
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pose2sim import import_pose2sim
from worldpose.video.files import write_video

CAMERAS = ("cam01", "cam02")


def camera(name, x=0.0):
    lens = {"image_size": (1088, 1920), "principal_point_px": (540.0, 960.0)}
    return calibration(name, translation=(x, 1.0, 5.0), **lens)


def person(size, seed):
    """x, y, confidence of each keypoint, and the same in COCO-17's order."""
    rng = np.random.default_rng(seed)
    values = np.column_stack([rng.uniform(0, 1000, (size, 2)), rng.uniform(0.1, 1.0, size)])
    order = [BODY25.index(name) for name in COCO17] if size == 25 else range(17)
    return values, values[list(order)]


def write_frame(folder, number, people):
    folder.mkdir(parents=True, exist_ok=True)
    found = [{"person_id": [-1], "pose_keypoints_2d": values.ravel().tolist()} for values in people]
    file = folder / f"{folder.name.removesuffix('_json')}_{number:06d}.json"
    file.write_text(json.dumps({"version": 1.3, "people": found}))
    return file


@pytest.fixture
def trial(tmp_path):
    """Two cameras; frame 10 has two people, 11 one, 12 none, 13 one."""
    folder = tmp_path / "trial"
    (folder / "calibration").mkdir(parents=True)
    cameras = {name: camera(name, x) for x, name in enumerate(CAMERAS)}
    write_calibration_toml(folder / "calibration" / "Calib.toml", cameras)
    for c, name in enumerate(CAMERAS):
        for number, count in ((10, 2), (11, 1), (12, 0), (13, 1)):
            people = [person(26, 100 * c + 10 * number + n)[0] for n in range(count)]
            write_frame(folder / "pose" / f"{name}_json", number, people)
    (folder / "Config.toml").write_text("[project]\nframe_rate = 60\nframe_range = 'auto'\n")
    return folder


def test_a_trial_becomes_a_match(trial, tmp_path):
    spec, notes = import_pose2sim(trial, tmp_path / "m")
    clip = spec.clips[0]
    assert (spec.fps, clip.first_frame, clip.frame_count) == (60.0, 10, 4)
    assert any("HALPE-26; kept are the 17 keypoints of COCO and heels and toes" in n for n in notes)
    match = read_match(tmp_path / "m")
    people, given = read_unit(match, "cam02")
    expected = person(26, 100 + 100 + 1)[1]
    np.testing.assert_allclose(people.keypoints[0, 1], expected[:, :2], rtol=1e-6)
    assert np.isfinite(people.keypoints[:, :, 0, 0]).sum(axis=1).tolist() == [2, 1, 0, 1]
    assert given.translation == (1.0, 1.0, 5.0)


def film(trial, size, bars=(0, 0)):
    """Videos of a size (width, height) with black bars at both sides of an axis [px]."""
    (trial / "videos").mkdir()
    width, height = size
    frame = np.full((height, width, 3), 120, np.uint8)
    for axis, bar in enumerate(bars[::-1]):
        if bar:
            np.moveaxis(frame, axis, 0)[:bar] = 0
            np.moveaxis(frame, axis, 0)[-bar:] = 0
    for name in CAMERAS:
        write_video(trial / "videos" / f"{name}.mp4", [frame] * 14, 60.0)


def test_a_calibrated_camera_without_a_video_is_named_with_the_folder_of_videos(trial, tmp_path):
    film(trial, (1088, 1920))
    cameras = {name: camera(name, x) for x, name in enumerate((*CAMERAS, "cam03"))}
    write_calibration_toml(trial / "calibration" / "Calib.toml", cameras)
    for name in CAMERAS:
        (trial / "videos" / name).mkdir()
        (trial / "videos" / f"{name}.mp4").rename(trial / "videos" / name / "take.mp4")
    _, notes = import_pose2sim(trial, tmp_path / "m")
    assert "videos lacks cam03" in notes


XCP = """<Cameras><Camera DEVICEID="{}" ISDV="1" SENSOR_SIZE="1088 1920"><KeyFrames>
<KeyFrame FOCAL_LENGTH="1500" ORIENTATION="0 0 0 1" POSITION="{} 0 0" PRINCIPAL_POINT="540 960"
 VICON_RADIAL="0 0"/></KeyFrames></Camera>{}</Cameras>"""


def test_a_smaller_video_of_vicon_is_the_middle_of_the_sensor(trial, tmp_path):
    (trial / "calibration" / "Calib.toml").unlink()
    one, two = (XCP.format(name, 5000.0 * x, "") for x, name in enumerate(CAMERAS))
    text = one.replace("</Cameras>", two.removeprefix("<Cameras>"))
    (trial / "calibration" / "Calib.xcp").write_text(text)
    film(trial, (1088, 1080))
    _, notes = import_pose2sim(trial, tmp_path / "m")
    found = read_calibration(tmp_path / "m" / "calibration.toml")["cam02"]
    assert (found.image_size, found.focal_px) == ((1088, 1080), (1500.0, 1500.0))
    assert found.principal_point_px == (540.0, 540.0)
    assert found.translation == (-5.0, 0.0, 0.0)
    assert "cam02.mp4: the middle 1088 x 1080 px of the sensor" in notes


def test_a_vicon_video_of_the_sensor_s_shape_is_refused_without_poses(trial, tmp_path):
    (trial / "calibration" / "Calib.toml").unlink()
    one, two = (XCP.format(name, 5000.0 * x, "") for x, name in enumerate(CAMERAS))
    file = trial / "calibration" / "Calib.xcp"
    file.write_text(one.replace("</Cameras>", two.removeprefix("<Cameras>")))
    film(trial, (544, 960))
    _, notes = import_pose2sim(trial, tmp_path / "m")
    assert any("warning: cam01.mp4: the middle 544 x 960 px of the sensor, or" in n for n in notes)
    with pytest.raises(
        InputError, match=r"middle 544 x 960 px .* subtract 272, 480 from PRINCIPAL"
    ):
        import_videos(file, trial / "videos", tmp_path / "n")
    shutil.rmtree(trial / "pose")
    with pytest.raises(InputError, match="or the whole one resized"):
        import_pose2sim(trial, tmp_path / "n")


@pytest.mark.parametrize("folders", [("pose",), ("pose", "pose-sync")])
def test_poses_numbered_from_one_to_the_length_of_the_videos_are_shifted(trial, tmp_path, folders):
    film(trial, (1088, 1920))
    for name, place in itertools.product(CAMERAS, folders):
        for number in range(1, 15):
            write_frame(trial / place / f"{name}_json", number, [person(26, number)[0]])
    for span, (first, count) in (("[1, 15]", (1, 14)), ("[5, 10]", (5, 5)), ("'all'", (1, 14))):
        out = tmp_path / f"m{span[:2]}"
        (trial / "Config.toml").write_text(f"[project]\nframe_rate = 60\nframe_range = {span}\n")
        spec, notes = import_pose2sim(trial, out)
        assert (spec.clips[0].first_frame, spec.clips[0].frame_count) == (first, count)
        assert [each.offset_frames for each in spec.cameras] == [-1, -1]
        assert "2D poses are numbered from 1 to the videos' lengths: 1 is the videos' frame 0" in (
            notes
        )
        people, _ = read_unit(read_match(out), "cam01")
        found = people.keypoints[list(people.frame).index(first), 0]
        np.testing.assert_allclose(found, person(26, first)[1][:, :2], rtol=1e-6)


def test_poses_from_one_that_end_before_the_videos_are_named(trial, tmp_path):
    film(trial, (1088, 1920))
    for name in CAMERAS:
        write_frame(trial / "pose" / f"{name}_json", 1, [person(26, 1)[0]])
    _, notes = import_pose2sim(trial, tmp_path / "m")
    assert any("the 2D poses begin at 1, which is taken as the videos' second" in n for n in notes)


def test_black_bars_shift_the_calibration(trial, tmp_path):
    film(trial, (544, 1000), bars=(0, 20))
    _, notes = import_pose2sim(trial, tmp_path / "m")
    found = read_calibration(tmp_path / "m" / "calibration.toml")["cam01"]
    assert (found.image_size, found.focal_px) == ((544, 1000), (750.0, 750.0))
    assert found.principal_point_px == (540.5 / 2 - 0.5, 960.5 / 2 - 0.5 + 20.0)
    assert "with black bars of 20.0 px" in str(notes)


@pytest.mark.parametrize(("size", "bars"), [((1000, 1920), (0, 0)), ((544, 1000), (0, 40))])
def test_a_cropped_video_is_refused(trial, tmp_path, size, bars):
    film(trial, size, bars)
    told = (
        r"cam01.mp4: expected 1088 x 1920 px, the size in the calibration, found \d+ x \d+. .*crop"
    )
    with pytest.raises(InputError, match=told):
        import_pose2sim(trial, tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_folders_of_other_names_are_in_the_order_of_their_last_numbers(trial, tmp_path):
    cameras = {f"c{n}": camera(f"c{n}", n) for n in range(1, 12)}
    write_calibration_toml(trial / "calibration" / "Calib.toml", cameras)
    shutil.rmtree(trial / "pose")
    for n in range(1, 12):
        write_frame(trial / "pose" / f"p{n}_json", 10, [person(26, n)[0]])
        (trial / "pose" / f"p{n}_img").mkdir()  # pictures of the poses, beside them
    import_pose2sim(trial, tmp_path / "m")
    people, _ = read_unit(read_match(tmp_path / "m"), "c10")
    np.testing.assert_allclose(people.keypoints[0, 0], person(26, 10)[1][:, :2], rtol=1e-6)


@pytest.mark.parametrize("has_raw", [True, False])
def test_synchronised_poses_give_the_clock_of_the_videos(trial, tmp_path, has_raw):
    film(trial, (1088, 1920))
    shutil.copytree(trial / "pose", trial / "pose-sync")
    moved = trial / "pose-sync" / "cam02_json"
    for number in range(10, 14):
        (moved / f"cam02_{number:06d}.json").rename(moved / f"cam02_{number - 7:06d}.json")
    if not has_raw:
        shutil.rmtree(trial / "pose")
    spec, notes = import_pose2sim(trial, tmp_path / "m")
    assert [each.offset_frames for each in spec.cameras] == [0, 7 if has_raw else 0]
    said = "offset_frames, from pose: cam02 7" if has_raw else "not known of cam01, cam02"
    assert said in str(notes)
    people, _ = read_unit(read_match(tmp_path / "m"), "cam02")
    found = people.keypoints[list(people.frame).index(3), 0]
    np.testing.assert_allclose(found, person(26, 200)[1][:, :2], rtol=1e-6)


def test_images_without_a_rate_are_refused_by_the_file_that_lacks_it(trial, tmp_path):
    for name in CAMERAS:
        (trial / "videos" / name).mkdir(parents=True)
        cv2.imwrite(str(trial / "videos" / name / "0.png"), np.zeros((1920, 1088, 3), np.uint8))
    (trial / "Config.toml").unlink()
    with pytest.raises(InputError, match=r"Config.toml: project.frame_rate: expected frames per"):
        import_pose2sim(trial, tmp_path / "m")


def people_of(*values):
    return json.dumps({"people": [{"pose_keypoints_2d": [*values]}]})


POSES, CONFIG, CALIBRATION = "pose/cam01_json", "Config.toml", "calibration/Calib.toml"
FRAME = f"{POSES}/cam01_000010.json"
SPOILT = [
    ("", None, r"trial: expected the folder of a Pose2Sim trial, found nothing"),
    (CALIBRATION, None, r"expected calibration/Calib.toml .*Run Pose2Sim.calibration"),
    (
        CALIBRATION,
        lambda file: shutil.copy(file, file.with_name("Calib_old.toml")),
        r"calibration: expected one calibration \*.toml, found Calib.toml, C",
    ),
    ("pose", None, r"trial: expected pose/<camera>_json .* or videos.*found neither"),
    (POSES, None, r"pose: expected one for each camera in Calib.toml: cam01, cam02, fo"),
    (
        POSES,
        lambda folder: [file.unlink() for file in folder.iterdir()],
        r"cam01_json: expected a .json file for each frame, found none",
    ),
    (
        FRAME,
        '{"persons": []}',
        r"cam01_000010.json: people: expected a list of at most 1000 people",
    ),
    (FRAME, people_of(1, 2, 0.5), r"keypoints_2d: expected x, y.*26 \(HALPE-26\).*fo"),
    (
        POSES,
        lambda folder: write_frame(folder, 11, [person(25, 0)[0]]),
        r"cam01_json: expected the same keypoints in all frames, found 26 in",
    ),
    (
        FRAME,
        lambda file: file.rename(file.with_name("first.json")),
        r"first.json: expected a frame number .* Name it as cam01_000012.json",
    ),
    (CONFIG, "[project]\nframe_rate = 'fast'\n", r"frame_rate: expected .* or 'auto', found"),
    (CONFIG, None, r"Config.toml: project.frame_rate: expected frames per second, as there are n"),
    (
        CONFIG,
        "[project]\nframe_rate = 60\nframe_range = [30, 10]\n",
        r"Config.toml: project.frame_range: expected .* found \[30, 10\]",
    ),
    (CONFIG, "project = [1]\n", r"Config.toml: project: expected a table, found \[1\]"),
    (
        "pose",
        lambda folder: [file.write_text('{"people": []}') for file in folder.rglob("*.json")],
        r"pose: expected people, found none in any frame",
    ),
]


@pytest.mark.parametrize(("place", "change", "message"), SPOILT)
def test_a_bad_trial_is_refused_with_one_error(trial, tmp_path, place, change, message):
    spoilt = trial / place
    if change is None:
        shutil.rmtree(spoilt) if spoilt.is_dir() else spoilt.unlink()
    else:
        change(spoilt) if callable(change) else spoilt.write_text(change)
    with pytest.raises(InputError, match=message) as caught:
        import_pose2sim(trial, tmp_path / "m")
    assert caught.value.todo
    assert not (tmp_path / "m").exists()
