"""Frames come back by their number, whatever the container does with times."""

from fractions import Fraction

import av
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.video import VideoReader, index_frames, write_video

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
