"""Recordings as cameras leave them: pauses, chapters, fields, files cut off, and DPX."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.ingest.camera_videos import describe_gaps, find_videos
from worldpose.ingest.importing import import_videos
from worldpose.ingest.match_folder import read_match
from worldpose.video.files import VideoReader, write_video
from worldpose.video.folder import median_picture, open_video
from worldpose.video.pictures import FrameIndex
from worldpose.video.recordings import describe_video, join_videos

SIZE = (48, 64)


def numbered(first, count):
    return [np.full((*SIZE, 3), 10 + 4 * n, np.uint8) for n in range(first, first + count)]


def number_of(picture):
    return round((float(picture.mean()) - 10) / 4)


def index(stamps):
    stamps = np.array(stamps)
    return FrameIndex(stamps, np.ones(len(stamps), bool), Fraction(1, 1000), SIZE[::-1])


@pytest.mark.parametrize("late", [0, 17])
def test_a_pause_leaves_its_frames_empty_and_is_named(late):
    kept = [n for n in range(500) if not 200 <= n < 275]
    clock = index([40 * n + late * (n > 200) for n in kept]).on_clock(25.0, "cam.mp4")
    assert describe_gaps(clock) == "the video lacks 75 of 500 frames: 200 to 274"
    assert clock[275] == 200
    frame = np.r_[900 + np.arange(250), 2000 + np.arange(250)]  # of two clips
    assert "75 of 500 frames: 1100 to 1149, 2000 to 2024" in describe_gaps(clock, frame)


def test_dropped_frames_shift_none_and_another_rate_is_refused():
    kept = np.flatnonzero(np.random.default_rng(1).random(400) > 0.15)
    clock = index(40 * kept).on_clock(25.0, "cam.mp4")
    np.testing.assert_array_equal(np.flatnonzero(clock >= 0), kept - kept[0])
    for steps in ([80] * 99, [42] * 60 + [33] * 60, [8, 8, 104] * 30):
        with pytest.raises(InputError) as caught:
            index(np.cumsum([0, *steps])).on_clock(30.0, "cam.mp4")
        assert caught.value.expected.split()[0] not in caught.value.found.split()


def film(folder, names, starts=(0, 5)):
    folder.mkdir(parents=True)
    for name, start in zip(names, starts, strict=True):
        write_video(folder / f"{name}.mp4", numbered(start, 5), 25.0, quality=5)
        (folder / f"{name}.mp4").rename(folder / f"{name}.MP4")


@pytest.mark.parametrize("names", [("GX010017", "GX020017"), ("GOPR0017", "GP010017")])
def test_chapters_are_joined_on_request(tmp_path, names):
    film(tmp_path / "videos", names)
    film(tmp_path / "videos" / "cam2", ("a_GH010002", "a_GH020002"))
    with pytest.raises(InputError, match=rf"found chapters of one recording: {names[0]}\.MP4"):
        import_videos(None, tmp_path / "videos", tmp_path / "m")
    spec, _ = import_videos(None, tmp_path / "videos", tmp_path / "m", join=True)
    assert {camera.id for camera in spec.cameras} == {names[0], "cam2"}
    for file in read_match(tmp_path / "m").videos.values():
        with VideoReader(file) as video:
            assert [number_of(shown) for _, shown in video.frames()] == list(range(10))
            assert number_of(video.frame(7)) == 7
            np.testing.assert_allclose(video.index.times, np.arange(10) / 25.0, atol=1e-3)
    last = tmp_path / "videos" / f"{names[1]}.MP4"
    last.rename(last.with_name(f"{names[1][:2]}050017.MP4"))
    with pytest.raises(InputError, match="Add the missing chapter"):
        find_videos(tmp_path / "videos", tmp_path / "x")


def test_folders_of_images_are_videos_of_cameras(tmp_path):
    for camera, ending in (("a", "dpx"), ("b", "tiff")):
        (tmp_path / "videos" / camera).mkdir(parents=True)
        for n, picture in enumerate(numbered(0, 6)):
            file = str(tmp_path / "videos" / camera / f"f_{n + 86400:07d}.{ending}")
            with av.open(file, "w", format="image2", options={"update": "1"}) as container:
                stream = container.add_stream(ending, 25)
                stream.height, stream.width = SIZE
                stream.pix_fmt = "rgb24" if ending == "tiff" else "gbrp10be"
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                container.mux(stream.encode(None))
    with pytest.raises(InputError, match="--fps 25"):
        import_videos(None, tmp_path / "videos", tmp_path / "m")
    import_videos(None, tmp_path / "videos", tmp_path / "m", fps=25.0)
    for file in read_match(tmp_path / "m").videos.values():
        with open_video(file) as video:
            assert [number_of(shown) for _, shown in video.frames()] == list(range(6))
            assert number_of(video.frame(4)) == 4
    cv2.imwrite(str(file / "f_0086403.tiff"), np.zeros((20, 30, 3), np.uint8))
    with open_video(file) as video, pytest.raises(InputError, match="as the first one, found 30"):
        list(video.frames())


def test_the_only_video_of_a_folder_is_its_camera_and_the_rest_is_named(tmp_path):
    videos = tmp_path / "videos"
    film(videos / "cam01", ("video",), (0,))
    film(videos / "cam02", ("video",), (0,))
    film(videos / "cam03", ("video",), (0,))
    film(videos / "cam04", ("a", "b"))
    spec, notes = import_videos(None, videos, tmp_path / "m")
    assert [each.id for each in spec.cameras] == ["cam01", "cam02", "cam03"]
    assert len(set(read_match(tmp_path / "m").videos.values())) == 3
    assert "has one video, or images: cam04/a.MP4, cam04/b.MP4" in str(notes)
    film(tmp_path / "more", ("cam02", "cam05"))
    for file in (tmp_path / "more").iterdir():
        file.rename(videos / file.name)
    spec, notes = import_videos(None, videos, tmp_path / "n")
    assert [each.id for each in spec.cameras] == ["cam02", "cam05"]
    strays = ", ".join(f"cam0{n}/video.MP4" for n in (1, 2, 3))
    assert f"left out, as videos of cameras are beside their folders: {strays}" in notes
    assert read_match(tmp_path / "n").videos["cam02"].suffix == ".MP4"


def test_images_that_begin_at_other_numbers_and_what_is_beside_them_are_said(tmp_path):
    for camera, first in (("a", 0), ("b", 5)):
        folder = tmp_path / "videos" / camera
        (folder / "thumbs").mkdir(parents=True)
        for n in range(first, 9):
            cv2.imwrite(str(folder / f"{n:06d}.png"), numbered(n, 1)[0])
    _, notes = import_videos(None, tmp_path / "videos", tmp_path / "m", fps=25.0)
    assert "set offset_frames as bracketed: a at 0 (0), b at 5 (-5)" in str(notes)
    assert "has one video, or images: a/thumbs, b/thumbs" in str(notes)


def encode(path, count=30, options=None, name="libx264"):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(name, 25, options=options or {})
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        for picture in numbered(0, 50)[: count % 50 or 50] * max(1, count // 50):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def test_parts_of_a_dvd_are_joined_as_one_stream(tmp_path):
    whole = encode(tmp_path / "whole.vob", 100, {"g": "12", "bf": "2"}, "mpeg2video").read_bytes()
    (tmp_path / "videos" / "cam1").mkdir(parents=True)
    cut = len(whole) - 2048
    for number, content in enumerate((b"menu", whole[:cut], whole[cut:])):
        (tmp_path / "videos" / "cam1" / f"VTS_01_{number}.VOB").write_bytes(content)
    with pytest.raises(InputError, match=r"one recording: VTS_01_1\.VOB, VTS_01_2\.VOB"):
        find_videos(tmp_path / "videos")
    found = find_videos(tmp_path / "videos", tmp_path)
    assert found["cam1"].read_bytes() == whole
    files = sorted((tmp_path / "videos" / "cam1").glob("*[12].VOB"))
    parts = [file.rename(file.with_suffix(".mpg")) for file in files]
    with pytest.raises(InputError, match="expected chapters of one recording"):
        join_videos(parts, tmp_path / "joined.mpg")


def test_interlaced_fields_are_said_and_progressive_frames_are_not(tmp_path):
    file = encode(tmp_path / "a.mts", options={"x264-params": "interlaced=1"})
    with VideoReader(file) as video:
        (note,) = describe_video(file, video.index)
        assert "interlaced" in note and "bwdif=mode=send_field" in note and "50 frames" in note
    file = encode(tmp_path / "b.ts")
    with VideoReader(file) as video:
        assert describe_video(file, video.index) == []


@pytest.mark.parametrize(("ending", "words"), [("ts", "within a packet"), ("mkv", "it states 4")])
def test_a_file_that_was_cut_off_is_said(tmp_path, ending, words):
    file = encode(tmp_path / f"a.{ending}", 100, {"g": "10"})
    file.write_bytes(file.read_bytes()[: round(0.6 * file.stat().st_size)])
    with VideoReader(file) as video:
        (note,) = describe_video(file, video.index)
    assert words in note and "copied" in note


def test_recordings_joined_byte_by_byte_are_refused(tmp_path):
    one, two = (encode(tmp_path / f"{n}.ts", 20, {"g": "10"}) for n in range(2))
    (tmp_path / "joined.ts").write_bytes(one.read_bytes() + two.read_bytes())
    with pytest.raises(InputError, match="they go back at frame 20, as where two recordings"):
        VideoReader(tmp_path / "joined.ts")


def test_a_size_that_changes_within_a_video_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.ts"), "w") as container:
        for size, first in ((SIZE, 0), ((96, 128), 10)):
            picture = np.full((*size, 3), 90, np.uint8)
            coder = av.CodecContext.create("libx264", "w")
            coder.height, coder.width, coder.pix_fmt = *size, "yuv420p"
            coder.time_base, coder.options = Fraction(1, 25), {"bf": "0"}
            if not first:
                stream = container.add_stream("libx264", 25)
                stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
            frames = [av.VideoFrame.from_ndarray(picture, format="rgb24") for _ in range(10)]
            for number, frame in enumerate(frames):
                frame.pts, frame.time_base = first + number, Fraction(1, 25)
            for packet in [each for frame in [*frames, None] for each in coder.encode(frame)]:
                packet.stream = stream
                container.mux(packet)
    with VideoReader(tmp_path / "a.ts") as video:
        assert len([*video.frames(0, 5)]) == 5
        with pytest.raises(InputError, match=r"frame 10: expected images of 64 x 48.*128 x 96"):
            list(video.frames())


def test_two_videos_of_one_camera_are_refused(tmp_path):
    film(tmp_path / "videos", ("a", "b"))
    (tmp_path / "videos" / "a.mov").write_bytes(b"")
    with pytest.raises(InputError, match=r"found a\.MP4 and a\.mov"):
        find_videos(tmp_path / "videos")


GRASS = 90


@pytest.mark.parametrize(("count", "shape"), [(21, (20, 300, 3)), (300, (70, 300))])
def test_who_walks_is_gone_however_long_the_clip(count, shape):
    def walking():
        """Frames in one buffer, as readers give them; a bright person crosses."""
        frame = np.empty(shape, dtype=np.uint8)
        for index in range(count):
            left = (shape[1] - 10) * index // (count - 1)
            frame[:] = GRASS
            frame[5:15, left : left + 10] = 200
            yield frame

    assert (median_picture(walking()) == GRASS).all()
