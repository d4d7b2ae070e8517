"""Frames come back by their number, whatever the container does with times."""

from fractions import Fraction

import av
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.video.files import FrameIndex, VideoReader, cut_video, index_frames, write_video

SIZE = (48, 64)


def numbered(count):
    """Images whose grey level tells their number; 4 levels are more than the codec's error."""
    return [np.full((*SIZE, 3), 10 + 4 * n, dtype=np.uint8) for n in range(count)]


def number_of(picture):
    return round((float(picture.mean()) - 10.0) / 4.0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    assert write_video(path, numbered(55), 25.0, quality=5) == 55
    return path


def test_every_frame_is_the_one_that_was_written(clip):
    with VideoReader(clip) as video:
        assert len(video) == 55
        assert [number_of(picture) for _, picture in video.frames()] == list(range(55))


@pytest.mark.parametrize("wanted", [0, 1, 24, 25, 26, 40, 54])
def test_a_single_frame_is_the_same_as_in_a_whole_pass(clip, wanted):
    with VideoReader(clip) as video:
        assert number_of(video.frame(wanted)) == wanted


def test_frames_can_be_read_backwards(clip):
    with VideoReader(clip) as video:
        assert [number_of(video.frame(n)) for n in (30, 12, 3)] == [30, 12, 3]


def test_luma_has_the_shape_and_the_order_of_the_pictures(clip):
    with VideoReader(clip) as video:
        pictures = [picture for _, picture in video.frames(10, 14, grey=True)]
    assert [picture.shape for picture in pictures] == [SIZE] * 4
    assert np.all(np.diff([picture.mean() for picture in pictures]) > 2.0)


def test_times_and_rate_follow_from_the_stamps(clip):
    index = index_frames(clip)
    assert index.fps == pytest.approx(25.0)
    # Stamps are whole units of the time base.
    np.testing.assert_allclose(index.times, np.arange(55) / 25.0, atol=1e-3)
    assert index.size == (SIZE[1], SIZE[0])
    assert index.key[0] and 2 <= index.key.sum() <= 4


def test_a_clip_with_uneven_times_keeps_its_numbers(tmp_path):
    path = tmp_path / "uneven.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "5"})
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, picture in enumerate(numbered(12)):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            late = 17 if number > 5 else 0
            frame.pts, frame.time_base = 500 + 40 * number + late, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with VideoReader(path) as video:
        assert [number_of(picture) for _, picture in video.frames(3, 9)] == [3, 4, 5, 6, 7, 8]
        assert video.index.times[6] - video.index.times[5] == pytest.approx(0.057, abs=1e-3)


def test_the_same_pictures_give_the_same_bytes(tmp_path):
    paths = [tmp_path / "one.mp4", tmp_path / "two.mp4"]
    for path in paths:
        write_video(path, numbered(5), 50.0)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_frames_beyond_the_end_are_refused(clip):
    with VideoReader(clip) as video, pytest.raises(InputError, match="frames from 0 to 55"):
        list(video.frames(50, 56))


def test_what_is_no_video_is_refused(tmp_path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"not a video")
    with pytest.raises(InputError, match="a video file"):
        index_frames(path)


def test_pictures_of_other_sizes_are_refused(tmp_path):
    pictures = [numbered(1)[0], np.zeros((32, 64, 3), dtype=np.uint8)]
    with pytest.raises(InputError, match="one size"):
        write_video(tmp_path / "clip.mp4", pictures, 25.0)


def test_no_picture_is_no_video(tmp_path):
    with pytest.raises(InputError, match="one picture or more"):
        write_video(tmp_path / "clip.mp4", [], 25.0)


CODECS = {
    "h264": ("libx264", "yuv420p", {"x264-params": "bframes=2:b-adapt=0"}),
    "h264_open": ("libx264", "yuv420p", {"x264-params": "bframes=2:b-adapt=0:open-gop=1"}),
    "h264_one_group": ("libx264", "yuv420p", {"g": "99", "x264-params": "bframes=2:b-adapt=0"}),
    "h264_short": ("libx264", "yuv420p", {"x264-params": "keyint=3:bframes=2:b-adapt=0"}),
    "h264_stripes": ("libx264", "yuv420p", {"x264-params": "intra-refresh=1"}),
    "h264_ten_bit": ("libx264", "yuv420p10le", {"x264-params": "bframes=2:b-adapt=0"}),
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
    "mp4": ("h264", "h264_open", "h264_short", "h264_stripes", "h264_ten_bit")
    + ("hevc", "hevc_ten_bit", "mpeg2", "mpeg4", "mjpeg", "vp9"),
    "mov": ("h264", "hevc_ten_bit", "prores"),
    "mkv": ("h264_open", "h264_stripes", "hevc", "mpeg2", "vp8", "prores"),
    "avi": ("h264", "h264_ten_bit", "h264_short", "mpeg2", "mpeg4", "mjpeg"),
    "ts": ("h264", "h264_open", "h264_one_group", "h264_short", "h264_stripes", "h264_ten_bit")
    + ("hevc", "hevc_ten_bit", "mpeg2", "mpeg4"),
    "m2ts": ("h264", "h264_one_group", "hevc_ten_bit", "mpeg2"),
    "mpg": ("mpeg2",),
    "mxf": ("h264", "mpeg2"),
    "flv": ("h264_short",),
    "webm": ("vp8", "vp9"),
}


def blocks(number):
    """An image of eight blocks, each bright where the number has this bit."""
    bits = [220 if number >> bit & 1 else 30 for bit in range(8)]
    picture = np.array(bits, np.uint8).reshape(2, 4).repeat(24, 0).repeat(16, 1)
    return np.repeat(picture[..., None], 3, axis=2)


def number_in(picture):
    middle = picture.reshape(2, 24, 4, 16, -1)[:, 4:20, :, 4:12].mean(axis=(1, 3, 4))
    return int((1 << np.flatnonzero(middle.ravel() > 125)).sum())


def write_blocks(path, codec):
    """Write 40 images that carry their numbers, with a key frame every ten at most."""
    name, pixels, options = CODECS[codec]
    with av.open(str(path), "w") as file:
        stream = file.add_stream(name, rate=25, options={"g": "10", **options})
        stream.height, stream.width, stream.pix_fmt = *SIZE, pixels
        stream.codec_context.thread_count = 1
        for number in range(40):
            frame = av.VideoFrame.from_ndarray(blocks(number), format="rgb24")
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


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


def test_a_stretch_cut_out_of_a_transport_stream_is_whole(tmp_path):
    path, out = tmp_path / "clip.ts", tmp_path / "cut.ts"
    write_blocks(path, "h264")
    place = cut_video(path, 23, 28, out)
    with VideoReader(out) as video:
        assert [number_in(video.frame(place + n)) for n in range(5)] == [23, 24, 25, 26, 27]


@pytest.mark.parametrize(
    ("codec", "pixels"),
    [("ffv1", "yuv422p"), ("ffv1", "yuv444p10le"), ("ffv1", "yuv422p12le"), ("ffv1", "bgr0")]
    + [("ffv1", "gray"), ("ffv1", "gray10le"), ("ffv1", "gray16le"), ("ffv1", "gbrp10le")]
    + [("libx264", "yuv420p10le"), ("libx264", "yuvj420p"), ("libx265", "yuv422p10le")]
    + [("prores_ks", "yuv422p10le"), ("rawvideo", "nv12"), ("rawvideo", "yuv420p10be")],
)
def test_luma_and_colours_are_those_of_eight_bits_in_every_format(codec, pixels, tmp_path):
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    drawn = np.stack([40 + 2 * column, 30 + 4 * row, 90 + row + column], -1).astype(np.uint8)
    path = (
        tmp_path / f"clip.{'nut' if codec == 'rawvideo' else 'mov' if 'prores' in codec else 'mkv'}"
    )
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
