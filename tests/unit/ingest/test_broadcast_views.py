"""Views of broadcast cameras, and clicked markings of stills and key frames."""

import json
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from pydantic import ValidationError
from run_records import match_spec

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.match import MatchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.errors import InputError
from worldpose.ingest.clock import ImageClock, rows_at
from worldpose.ingest.footage import (
    footage_size,
    image_clock,
    read_still,
    uncovered_clips,
    unit_frames,
)
from worldpose.ingest.match_folder import read_match, require_calibrated
from worldpose.ingest.writing import MatchAnnotations


def match(broadcast, offsets=0.0, **fast):
    tv = {"kind": "broadcast", **fast}
    clip = {"first_frame": 100, "frame_count": 6}
    clip |= {"broadcast": broadcast, "broadcast_offset_frames": offsets}
    return match_spec({"one": {}, "main": tv, "fast": tv}, {"goal": clip}, fps=50.0)


@pytest.mark.parametrize(
    ("broadcast", "names"),
    [
        (None, []),
        ("main", ["goal"]),
        (["main"], ["goal"]),
        (["main", "fast"], ["goal.main", "goal.fast"]),
    ],
)
def test_a_camera_of_several_has_its_name_after_the_clips(broadcast, names):
    spec = match(broadcast)
    assert list(spec.broadcast_views) == list(spec.views_of("goal")) == names
    assert [spec.filming_camera(name).id for name in names] == [*spec.clips[0].moving_cameras]
    assert MatchSpec.model_validate_json(spec.model_dump_json(), strict=True) == spec


@pytest.mark.parametrize(
    ("broadcast", "offsets", "told"),
    [
        ([], 0.0, "an empty list"),
        (["main", "main"], 0.0, "a camera twice"),
        (["main", "one"], 0.0, "names broadcast camera 'one'"),
        (["main", "fast"], 3.0, r"give each one's, as \{main: 3, fast: 0\}"),
        (["main", "fast"], {"main": 3.0}, r"expected those of its broadcast cameras"),
        (5, 0.0, "the name of a camera, or a list of names"),
        ("main", "late", "a number, or a number for each broadcast camera"),
    ],
)
def test_cameras_and_offsets_that_cannot_be_assigned_are_refused(broadcast, offsets, told):
    with pytest.raises(ValidationError, match=told):
        match(broadcast, offsets)


def test_a_clip_that_no_camera_films_lacks_no_2d_poses():
    clips = {"goal": {"frame_count": 6, "broadcast": "tv"}, "later": {"frame_count": 6}}
    spec = match_spec({"tv": {"kind": "broadcast"}}, clips, fps=50.0)
    assert [*uncovered_clips(SimpleNamespace(spec=spec, detections={}))] == []


def test_each_view_has_its_own_size_rate_and_offset():
    spec = match(["main", "fast"], {"main": 7.0, "fast": 12.4}, fps=60.0, width=3840, height=2160)
    assert footage_size(spec, "goal.fast") == (3840, 2160)
    frames = unit_frames(spec, "goal.fast")
    assert frames.rate == 1.2
    # Images 12.4, 13.6, 14.8, 16.0, 17.2 and 18.4 would be of the match frames.
    assert frames.numbers(frames.frame).tolist() == [12, 14, 15, 16, 17, 18]
    clock = image_clock(spec, "goal.fast")
    late = np.array([-0.4, 0.4, 0.2, 0.0, -0.2, -0.4]) / 1.2
    np.testing.assert_allclose(clock.late, late, atol=1e-9)
    assert clock.images.tolist() == [12, 13, 14, 15, 16, 17, 18]
    np.testing.assert_allclose(clock.frame_row, (clock.images - 12.4) / 1.2)
    assert clock.frame_of(np.array([11, 12, 13, 14, 99])).tolist() == [0, 0, 0, 1, 5]


@pytest.mark.parametrize("rate", [1.0, 1.1988, 0.5, 2.0])
@pytest.mark.parametrize("late", [0.0, 1.7, -0.4])
def test_what_images_show_is_moved_to_the_frames_and_back(rate, late):
    frame = np.arange(100, 130)
    clock = ImageClock.of(frame, 12.3 - 100 * rate, rate, 12.3)
    motion = np.stack([3.0 * np.arange(30.0), 5.0 - np.arange(30.0)], axis=-1)
    seen = clock.to_images(motion, late)
    at = (clock.number - 12.3) / rate + late
    inside = np.isfinite(seen[:, 0])
    np.testing.assert_allclose(seen[inside, 0], 3.0 * at[inside], atol=1e-9)
    back = clock.to_frames(seen, late)
    known = np.isfinite(back[:, 0])
    assert known.sum() >= 26
    np.testing.assert_allclose(back[known], motion[known], atol=1e-9)
    # The nearest image is at most half an image away: 3 units per frame.
    near = clock.to_frames(seen, late, whole=True)
    known = np.isfinite(near[:, 0])
    assert known.sum() >= 26
    assert np.abs(near[known] - motion[known]).max() <= 1.5 / min(rate, 1.0) + 1.6


def test_rows_beyond_the_ends_and_next_to_missing_ones_are_missing():
    values = np.array([1.0, np.nan, 5.0])
    found = rows_at(values, np.array([-0.5, 0.0, 0.5, 2.0, 2.1, np.nan]))
    np.testing.assert_array_equal(found, [np.nan, 1.0, np.nan, 5.0, np.nan, np.nan])


@pytest.fixture
def two(match_folder):
    """A match folder whose clip `goal` has two broadcast cameras, with files of one."""
    file = match_folder / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"].append({**content["cameras"][2], "id": "tight"})
    content["clips"][0].update(broadcast=["main", "tight"])
    file.write_text(yaml.safe_dump(content))
    return match_folder


def test_files_of_several_cameras_are_named_after_clip_and_camera(two):
    with pytest.raises(InputError, match=r"goal\.main, goal\.tight.*found 'goal\.npz'"):
        read_match(two)
    (two / "detections" / "goal.npz").rename(two / "detections" / "goal.main.npz")
    with pytest.raises(InputError, match=r"camera tight for clip goal.*broadcast/goal\.tight\.mp4"):
        read_match(two)
    (two / "broadcast").mkdir()
    (two / "broadcast" / "goal.tight.mp4").write_bytes(b"video")
    read = read_match(two)
    assert [*read.detections][-1] == "goal.main"
    assert [*read.videos] == ["goal.tight"]
    (two / "broadcast" / "goal.mp4").write_bytes(b"video")
    with pytest.raises(InputError, match=r"goal\.mp4.*broadcast/goal\.main\.mp4"):
        read_match(two)


def test_several_broadcast_cameras_need_static_ones(two):
    file = two / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"] = content["cameras"][2:]
    file.write_text(yaml.safe_dump(content))
    for name in ("calibration.toml", "detections/cam1.npz", "detections/cam2.npz"):
        (two / name).unlink()
    (two / "detections" / "goal.npz").rename(two / "detections" / "goal.main.npz")
    with pytest.raises(InputError, match=r"clip goal: broadcast.*one broadcast camera.*tight"):
        read_match(two)


CLICKED = ClickedMarkings(
    points=(
        ClickedPoint(name="corner_left_near", xy=(12.25, 900.5)),
        ClickedPoint(name="center_mark", xy=(-0.5, 1079.5)),
    ),
    drawn=(DrawnMarking(name="center_circle", xy=((3.0, 4.0), (5.5, 6.5))),),
)


@pytest.fixture
def folder(write_tiny):
    annotations = MatchAnnotations(clicked={"cam2": CLICKED})
    return write_tiny(("cam1",), annotations=annotations)


def file_of(folder):
    return folder / "annotations" / "static_calibration" / "cam2.json"


def refusal(folder):
    with pytest.raises(InputError) as caught:
        read_match(folder)
    return caught.value


def test_clicks_are_read_as_written(folder):
    match = read_match(folder)
    assert match.clicked == {"cam2": CLICKED}
    require_calibrated(match)


def test_a_still_of_another_size_or_no_picture_is_refused(tmp_path):
    path = tmp_path / "cam.png"
    cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(InputError, match=r"cam.png.*1920 x 1080 px.*found 30 x 20"):
        read_still(path, (1920, 1080))
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match="40 bytes that are none"):
        read_still(path, (30, 20))
    path.write_bytes(b"")
    with pytest.raises(InputError, match="0 bytes that are none"):
        read_still(path, (30, 20))


def entries(**changes):
    content = {"points": [{"name": "center_mark", "xy": [100.0, 200.0]}], "drawn": []}
    return json.dumps(content | changes)


@pytest.mark.parametrize(
    ("content", "place", "told"),
    [
        (entries(points=[{"name": "corner_left_nea", "xy": [1, 2]}]), "points[0].name", "near"),
        (entries(drawn=[{"name": "halfway", "xy": [[1, 2]]}]), "drawn[0].name", "halfway_line"),
        (entries(drawn=[{"name": "center_mark", "xy": [[1, 2]]}]), "drawn[0].name", "a marking"),
        (entries(points=[{"name": "center_mark", "xy": [1921, 2]}]), "points[0].xy", "1920 x 1080"),
        (
            entries(drawn=[{"name": "center_circle", "xy": [[1, 2], [3, -1.1]]}]),
            "drawn[0].xy[1]",
            "in the image",
        ),
        (entries(points=[{"name": "center_mark", "xy": [np.nan, 2]}]), "points[0].xy[0]", "finite"),
        (entries(points=[{"name": "center_mark", "xy": [1, 2]}] * 2), "points[1].name", "again"),
        (entries(points=[]), "", "points or drawn markings"),
        (entries(drawn=[{"name": "center_circle", "xy": []}]), "drawn[0].xy", "at least 1"),
        ('{"pionts": []}', "pionts", "points"),
        ("{", "", "JSON"),
    ],
)
def test_a_wrong_entry_is_refused_by_file_and_place(folder, content, place, told):
    file_of(folder).write_text(content)
    error = refusal(folder)
    assert error.where == (f"{file_of(folder)}: {place}" if place else str(file_of(folder)))
    assert told in str(error)


def test_a_file_of_no_static_camera_is_refused(folder):
    file_of(folder).rename(file_of(folder).with_name("main.json"))  # the broadcast camera
    error = refusal(folder)
    assert error.where.endswith("main.json")
    assert "a static camera: cam1, cam2" in error.expected


def test_clicks_without_a_pitch_are_refused(folder):
    match_file = folder / "match.yaml"
    match_file.write_text(match_file.read_text() + "pitch: none\n")
    assert "pitch: none" in refusal(folder).expected


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "BMP", "WEBP"])
def test_a_still_of_every_kind_is_read_as_it_is_shown(tmp_path, form):
    picture = np.random.default_rng(1).integers(0, 255, (18, 32, 3), dtype=np.uint8)
    path = tmp_path / f"cam.{form.lower()}"
    more = {"quality": 95} if form == "JPEG" else {"lossless": True} if form == "WEBP" else {}
    Image.fromarray(picture).save(path, form, **more)
    stored = read_still(path, (32, 18))
    if form != "JPEG":
        np.testing.assert_array_equal(stored, picture)
        return
    tag = Image.Exif()
    tag[0x0112] = 6  # shown after a quarter turn clockwise
    Image.fromarray(picture).save(path, form, exif=tag, **more)
    np.testing.assert_array_equal(read_still(path, (18, 32)), np.rot90(stored, -1))
    with pytest.raises(InputError, match="found 18 x 32 as shown, with the turn of its EXIF tag"):
        read_still(path, (32, 18))


def clicks(name="center_mark", xy=(640.0, 360.0)):
    return ClickedMarkings(points=(ClickedPoint(name=name, xy=xy),))


PICKED = KeyFrames(
    key_frames=(
        KeyFrame(frame=0, markings=clicks()),
        KeyFrame(frame=40, markings=clicks("corner_left_near", (3.5, 8.0))),
    )
)


@pytest.fixture
def write(write_tiny):
    def write(key_frames, clip="goal"):
        return write_tiny(annotations=MatchAnnotations(key_frames={clip: key_frames}))

    return write


def test_key_frames_are_read_as_written(write):
    assert read_match(write(PICKED)).key_frames == {"goal": PICKED}


def test_key_frames_of_something_else_are_refused(write):
    with pytest.raises(InputError, match=r"cam1\.json.*a clip with a broadcast camera: goal"):
        write(PICKED, clip="cam1")


@pytest.mark.parametrize("frames", [(4, 4), (9, 4)])
def test_frames_out_of_order_or_twice_are_refused(write, frames):
    picked = KeyFrames(key_frames=tuple(KeyFrame(frame=f, markings=clicks()) for f in frames))
    with pytest.raises(InputError, match=r"goal\.json: key_frames: .*rising order"):
        write(picked)


def test_a_wrong_entry_is_named(write):
    with pytest.raises(InputError, match=r"key_frames\[0\]\.markings: .*Click some"):
        write(KeyFrames(key_frames=(KeyFrame(frame=3, markings=ClickedMarkings()),)))
    with pytest.raises(InputError, match=r"key_frames\[0\]\.markings\.points\[0\]\.name.*center_m"):
        write(KeyFrames(key_frames=(KeyFrame(frame=3, markings=clicks("centre_mark")),)))


def test_a_small_file_that_declares_a_huge_still_is_refused_unread(tmp_path):
    """A PNG of 60,000 x 60,000 pixels takes 254 bytes, and would take 10.8 GB of memory."""
    path = tmp_path / "cam.png"
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(60_000))), (b"IEND", b"")]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks
        )
    )
    assert path.stat().st_size < 300
    with pytest.raises(
        InputError, match=r"cam.png.*at most .* pixels, found .* bytes that are none"
    ):
        read_still(path, (1920, 1080))
