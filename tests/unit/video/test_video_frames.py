"""Frames come back by their number, whatever the container does with times."""

from fractions import Fraction

import av
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.video.files import VideoReader, index_frames, write_video
from worldpose.video.folder import pictures_at
from worldpose.video.pictures import FrameIndex

SIZE = (48, 64)


def numbered(count):
    """Images whose grey level tells their number; 4 levels are more than the codec's error."""
    return [np.full((*SIZE, 3), 10 + 4 * n, dtype=np.uint8) for n in range(count)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    assert write_video(path, numbered(55), 25.0, quality=5) == 55
    return path


def test_each_number_has_its_frame_also_where_numbers_repeat_and_go_back(clip):
    numbers = np.array([-1, 10, 10, 11, 12, -1, 8, 9, 9, 30])
    with VideoReader(clip) as video:
        shown = list(pictures_at(video, numbers))
    assert [-1 if one is None else round((one.mean() - 10) / 4) for one in shown] == list(numbers)


def test_frames_beyond_the_end_are_refused(clip):
    with VideoReader(clip) as video, pytest.raises(InputError, match="frames from 0 to 55"):
        list(video.frames(50, 56))


def test_what_is_no_video_is_refused(tmp_path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"not a video")
    with pytest.raises(InputError, match="a video file"):
        index_frames(path)


def test_pictures_of_other_sizes_and_no_picture_are_no_video(tmp_path):
    pictures = [numbered(1)[0], np.zeros((32, 64, 3), dtype=np.uint8)]
    with pytest.raises(InputError, match="one size"):
        write_video(tmp_path / "clip.mp4", pictures, 25.0)
    with pytest.raises(InputError, match="one picture or more"):
        write_video(tmp_path / "clip.mp4", [], 25.0)


def test_pixels_that_are_not_square_are_refused_with_their_ratio(tmp_path):
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", 25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for picture in numbered(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="square pixels, found a sample aspect ratio of 4:3"):
        index_frames(tmp_path / "clip.mp4")


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
    "mp4": ("h264_open", "h264_stripes", "hevc_ten_bit"),
    "mov": ("prores",),
    "mkv": ("h264_stripes", "vp8"),
    "avi": ("h264", "mpeg4", "mjpeg"),
    "ts": ("h264_one_group", "h264_ten_bit", "hevc"),
    "m2ts": ("h264_one_group",),
    "mpg": ("mpeg2",),
    "mxf": ("mpeg2",),
    "flv": ("h264_short",),
    "webm": ("vp9",),
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


@pytest.mark.parametrize(
    ("codec", "pixels"),
    [("ffv1", "yuv422p12le"), ("ffv1", "bgr0"), ("ffv1", "gray"), ("ffv1", "gray16le")]
    + [("libx264", "yuvj420p"), ("libx265", "yuv422p10le"), ("rawvideo", "nv12")],
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
