"""Frames of videos by number, and videos that are broken, turned or of another rate."""

import struct
from fractions import Fraction

import av
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.ingest.footage import write_still
from worldpose.video.files import VideoReader, index_frames, write_video
from worldpose.video.folder import index_video, open_video, pictures_at
from worldpose.video.pictures import FrameIndex

SIZE = (48, 64)


def mux(file, stream, pictures):
    for picture in pictures:
        file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    file.mux(stream.encode(None))


def blocks(number, high, wide):
    """An image of eight blocks, each bright where the number has this bit."""
    bits = [220 if number >> bit & 1 else 30 for bit in range(8)]
    picture = np.array(bits, np.uint8).reshape(2, 4).repeat(high // 2, 0).repeat(wide // 4, 1)
    return np.repeat(picture[..., None], 3, axis=2)


def images(count):
    return [blocks(number, *SIZE) for number in range(count)]


def number_in(picture):
    high, wide = picture.shape[0] // 2, picture.shape[1] // 4
    middle = picture.reshape(2, high, 4, wide, -1)[:, 4:-4, :, 4:-4].mean(axis=(1, 3, 4))
    return int((1 << np.flatnonzero(middle.ravel() > 125)).sum())


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    assert write_video(path, images(40), 25.0, quality=5) == 40
    return path


def test_each_number_has_its_frame_also_where_numbers_repeat_and_go_back(clip):
    numbers = np.array([-1, 10, 10, 11, 12, -1, 8, 9, 9, 30])
    with VideoReader(clip) as video:
        shown = list(pictures_at(video, numbers))
    assert [-1 if one is None else number_in(one) for one in shown] == list(numbers)


def test_frames_beyond_the_end_are_refused(clip):
    with VideoReader(clip) as video, pytest.raises(InputError, match="frames from 0 to 40"):
        list(video.frames(38, 41))


def test_what_is_no_video_is_refused(tmp_path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"not a video")
    with pytest.raises(InputError, match="a video file"):
        index_frames(path)


def test_pictures_of_other_sizes_and_no_picture_are_no_video(tmp_path):
    pictures = [*images(1), np.zeros((32, 64, 3), dtype=np.uint8)]
    with pytest.raises(InputError, match="one size"):
        write_video(tmp_path / "clip.mp4", pictures, 25.0)
    with pytest.raises(InputError, match="one picture or more"):
        write_video(tmp_path / "clip.mp4", [], 25.0)


def test_pixels_that_are_not_square_are_refused_with_their_ratio(tmp_path):
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", 25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        mux(container, stream, images(2))
    with pytest.raises(InputError, match="square pixels, found a sample aspect ratio of 4:3"):
        index_frames(tmp_path / "clip.mp4")


CODECS = {
    "h264": ("libx264", "yuv420p", {"x264-params": "bframes=2:b-adapt=0"}),
    "h264_open": ("libx264", "yuv420p", {"x264-params": "bframes=2:b-adapt=0:open-gop=1"}),
    "h264_one_group": ("libx264", "yuv420p", {"g": "99", "x264-params": "bframes=2:b-adapt=0"}),
    "h264_stripes": ("libx264", "yuv420p", {"x264-params": "intra-refresh=1"}),
    "h264_ten_bit": ("libx264", "yuv420p10le", {"x264-params": "bframes=2:b-adapt=0"}),
    "h264_short": ("libx264", "yuv420p", {"x264-params": "keyint=3:bframes=2:b-adapt=0"}),
    "hevc": ("libx265", "yuv420p", {"x265-params": "log-level=none:pools=1:bframes=2"}),
    "hevc_ten_bit": (
        "libx265",
        "yuv420p10le",
        {"x265-params": "log-level=none:pools=1:bframes=3:b-adapt=0:keyint=10:open-gop=1"},
    ),
    "mpeg2": ("mpeg2video", "yuv420p", {"bf": "2", "qmax": "4"}),
    "mpeg4": ("mpeg4", "yuv420p", {"bf": "2", "qmax": "4"}),
    "mjpeg": ("mjpeg", "yuvj420p", {"qmax": "4"}),
    "vp8": ("libvpx", "yuv420p", {"auto-alt-ref": "1", "lag-in-frames": "16"}),
    "vp9": ("libvpx-vp9", "yuv420p", {"cpu-used": "8", "lag-in-frames": "16"}),
    "prores": ("prores_ks", "yuv422p10le", {}),
}
KEPT_IN = {
    "mp4": ("h264_open", "h264_stripes", "hevc_ten_bit"),
    "mov": ("prores",),
    "mkv": ("vp8",),
    "avi": ("h264", "mpeg4", "mjpeg"),
    "ts": ("h264_one_group", "h264_ten_bit", "hevc"),
    "mpg": ("mpeg2",),
    "mxf": ("mpeg2",),
    "gxf": ("mpeg2",),  # the last frame is stored one field early
    "flv": ("h264_short",),
    "webm": ("vp9",),
}


def write_blocks(path, codec):
    """Write 40 images that carry their numbers, with a key frame every ten at most."""
    name, pixels, options = CODECS[codec]
    with av.open(str(path), "w") as file:
        stream = file.add_stream(name, rate=25, options={"g": "10", **options})
        size = (576, 720) if path.suffix == ".gxf" else SIZE  # GXF has those of television alone
        stream.height, stream.width, stream.pix_fmt = *size, pixels
        stream.codec_context.thread_count = 1
        mux(file, stream, [blocks(number, *size) for number in range(40)])


@pytest.mark.parametrize(
    ("container", "codec"), [(end, codec) for end, codecs in KEPT_IN.items() for codec in codecs]
)
def test_access_by_number_equals_a_whole_pass(container, codec, tmp_path):
    path = tmp_path / f"clip.{container}"
    write_blocks(path, codec)
    with VideoReader(path) as video:
        assert video.index.fps == pytest.approx(25.0, rel=1e-3)
        assert [(n, number_in(shown)) for n, shown in video.frames(grey=True)] == [
            (n, n) for n in range(40)
        ]
        mixed = np.random.default_rng(0).permutation(40).tolist()
        for number in [0, 20, 39, *range(39, -1, -3), *mixed[:15]]:
            assert number_in(video.frame(number)) == number


@pytest.mark.parametrize(
    ("codec", "pixels"),
    [("ffv1", "yuv422p12le"), ("ffv1", "bgr0"), ("ffv1", "gray"), ("ffv1", "gray16le")]
    + [("libx264", "yuvj420p"), ("libx265", "yuv422p10le"), ("rawvideo", "nv12")],
)
def test_luma_and_colours_are_those_of_eight_bits_in_every_format(codec, pixels, tmp_path):
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    drawn = np.stack([40 + 2 * column, 30 + 4 * row, 90 + row + column], -1).astype(np.uint8)
    path = tmp_path / f"clip.{'nut' if codec == 'rawvideo' else 'mkv'}"
    options = {"x265-params": "log-level=none:pools=1:crf=1"} if codec == "libx265" else {}
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=25, options={"crf": "1"} | options)
        stream.height, stream.width, stream.pix_fmt = *SIZE, pixels
        frame = av.VideoFrame.from_ndarray(drawn, format="rgb24").reformat(format=pixels)
        file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    luma = drawn @ [0.299, 0.587, 0.114]
    if not pixels.startswith(("gray", "yuvj", "gbr", "bgr")):  # of limited range
        luma = 16.0 + luma * 219.0 / 255.0
    with VideoReader(path) as video:
        grey = next(video.frames(grey=True))[1]
        colours = video.frame(0)
    assert np.abs(grey - luma).max() < 3.0
    shown = np.repeat((drawn @ [0.299, 0.587, 0.114])[..., None], 3, axis=2)
    assert np.abs(colours.astype(float) - (shown if "gray" in pixels else drawn)).mean() < 3.0


def test_a_video_without_two_equal_steps_is_refused_because_its_rate_varies():
    stamps = np.cumsum([0, 20, 61, 33, 95, 47, 70, 28, 110])
    index = FrameIndex(stamps, np.ones(9, bool), Fraction(1, 1000), SIZE[::-1])
    with pytest.raises(InputError, match=r"rate that varies: images are 0\.02 to 0\.11 s apart"):
        index.on_clock(round(index.fps, 3), "phone.mp4")


def encode(path, stamps, *, rotation=None, container_options=None):
    """H.264 with B-frames and a key frame every 10, shown at `stamps` [ms]."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        options = {"crf": "5", "bf": "2", "g": "10", "sc_threshold": "0"}
        stream = container.add_stream("libx264", rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        if rotation is not None:
            stream.set_display_rotation(rotation)
        for picture, stamp in zip(images(len(stamps)), stamps, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = int(stamp), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def numbers_read(path, start=0, stop=None):
    with open_video(path) as video:
        return [
            (number, None if picture is None else number_in(picture))
            for number, picture in video.readable(start, stop)
        ]


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        ((-1, 0, 0, 1), "a display matrix that mirrors them"),
        ((0, 1, 1, 0), "a display matrix that mirrors them"),
        ((0.996, 0.087, -0.087, 0.996), "turns them by 5 degrees"),
        ((0, 0, 0, 0), "an empty display matrix"),
    ],
)
def test_a_display_matrix_that_is_no_quarter_turn_is_refused(tmp_path, matrix, said):
    path = encode(tmp_path / "turned.mp4", 40 * np.arange(4), rotation=90)
    content, one = bytearray(path.read_bytes()), 1 << 16
    place = content.index(b"tkhd") + 44  # of the matrix in this box of version 0
    a, b, c, d = (round(each * one) for each in matrix)
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        index_video(path)


@pytest.mark.parametrize("rotation", [90, 180, 270])
def test_a_turned_camera_s_pictures_stand_upright(tmp_path, rotation):
    path = encode(tmp_path / "turned.mp4", 40 * np.arange(12), rotation=rotation)
    with open_video(path) as video:
        pictures = [picture for _, picture in video.readable()]
    upright = np.rot90(images(8)[7], round(rotation / 90))
    assert pictures[7].shape == upright.shape
    assert video.index.size == upright.shape[1::-1]
    assert np.abs(pictures[7].astype(int) - upright).mean() < 3.0  # the codec's error


def test_a_file_cut_off_ends_early_and_says_where(tmp_path):
    whole = encode(
        tmp_path / "whole.mp4", 40 * np.arange(50), container_options={"movflags": "faststart"}
    )
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: int(0.7 * whole.stat().st_size)])
    read = numbers_read(cut)
    good = [number for number, found in read if found is not None]
    assert 10 <= len(good) < 50
    assert all(found == number for number, found in read if found is not None)
    # Complete data on disk is read: only the rest of the last group before the cut is lost.
    assert good[: len(good) // 10 * 10] == list(range(len(good) // 10 * 10))


@pytest.mark.parametrize(
    ("suffix", "codec", "no_cuts"), [("ts", "mpeg2video", "1000000000"), ("mp4", "libx264", "0")]
)
def test_a_video_that_begins_before_its_first_key_frame_is_read_from_there(
    tmp_path, suffix, codec, no_cuts
):
    options = {"bf": "2", "g": "12", "qmax": "2", "sc_threshold": no_cuts}
    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    with av.open(str(whole), "w") as target:
        stream = target.add_stream(codec, rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        mux(target, stream, images(36))
    with av.open(str(whole)) as source:
        packets = [packet for packet in source.demux(video=0) if packet.size]
        keys = [n for n, packet in enumerate(packets) if packet.is_keyframe]
        # The second group of MPEG-2 is open: its first pictures in order are before its key frame.
        begin = keys[1] if suffix == "ts" else keys[1] - 3
        with av.open(str(cut), "w") as target:
            target.add_stream_from_template(source.streams.video[0])
            for packet in packets[begin:]:
                packet.stream = target.streams[0]
                target.mux(packet)
    read = [number for _, number in numbers_read(cut)]
    assert 24 < len(read) <= 28
    assert read[-24:] == list(range(12, 36))


def test_several_streams_of_video_are_refused(tmp_path):
    with av.open(str(tmp_path / "two.mov"), "w") as target:
        streams = [target.add_stream("mpeg4", rate=25) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        for stream in streams:
            mux(target, stream, images(1))
    with pytest.raises(
        InputError, match="one video stream, found stream 0 of 64 x 48 px, stream 1"
    ):
        index_video(tmp_path / "two.mov")


def test_a_damaged_stretch_is_missing_up_to_the_next_key_frame(tmp_path):
    path = encode(tmp_path / "damaged.mp4", 40 * np.arange(50))
    with av.open(str(path)) as container:
        places = [p.pos for p in container.demux(video=0) if p.size and p.is_keyframe]
    content = bytearray(path.read_bytes())
    content[places[1] + 12 : places[1] + 72] = bytes(60)  # in the group of frames 10 to 19
    path.write_bytes(content)
    read = dict(numbers_read(path))
    assert [read[n] for n in range(10)] == list(range(10))
    assert [read[n] for n in range(10, 20)] == [None] * 10
    assert [read[n] for n in range(20, 50)] == list(range(20, 50))
    for start in (13, 16, 19):  # the same where reading begins after the damage
        assert numbers_read(path, start, 22) == [(n, read[n]) for n in range(start, 22)]


def test_images_count_by_their_numbers_and_a_gap_is_a_missing_frame(tmp_path):
    for number in (7, 8, 10):
        write_still(tmp_path / f"frame_{number:03d}.png", images(11)[number])
    assert index_video(tmp_path).on_clock(25.0, "images").tolist() == [0, 1, -1, 2]
    assert numbers_read(tmp_path) == [(0, 7), (1, 8), (2, 10)]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["first"], "whose names number them, found 1 images with 0 numbers"),
        (["9" * 40], "1 images with 0 numbers"),
        (["take1_10", "take1_11", "take2_5"], "of one clip, .* found 3 images with 0 numbers"),
        # One odd number does not fill the memory.
        (["0", "2000000000"], "2000000000 frames after the first"),
    ],
)
def test_images_whose_names_do_not_number_them_are_refused(tmp_path, names, message):
    for name in names:
        write_still(tmp_path / f"{name}.png", images(1)[0])
    with pytest.raises(InputError, match=message):
        index_video(tmp_path).on_clock(25.0, "images")


def write_lie(path, size, told):
    """Write one PNG image of a size in a MOV file whose header tells another."""
    with av.open(str(path), "w") as target:
        stream = target.add_stream("png", rate=25)
        stream.width, stream.height = size
        stream.pix_fmt = "gray"
        for packet in (*stream.encode(av.VideoFrame(*size, "gray")), *stream.encode(None)):
            target.mux(packet)
    content = path.read_bytes()
    at, ends = content.rindex(b"moov"), [struct.pack(">HH", *each) for each in (size, told)]
    path.write_bytes(content[:at] + content[at:].replace(*ends))


@pytest.mark.parametrize("told", [(12000, 12000), (64, 64)])
def test_too_many_pixels_are_refused_before_they_are_decoded(told, tmp_path):
    write_lie(tmp_path / "huge.mov", (12000, 12000), told)
    with pytest.raises(InputError, match="more than 100,000,000 pixels"):
        index_video(tmp_path / "huge.mov")


def test_a_list_of_other_files_is_no_video(tmp_path):
    write_lie(tmp_path / "other.mov", (64, 64), (64, 64))
    (tmp_path / "video.mp4").write_text("ffconcat version 1.0\nfile other.mov\n")
    with pytest.raises(InputError, match="a list of other files"):
        index_video(tmp_path / "video.mp4")
