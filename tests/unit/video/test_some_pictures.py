"""Some images of a video: the same as by decoding all of it, without doing so."""

import numpy as np
from test_broken_videos import encode, number_of

from worldpose.video.folder import jumps, open_video, some_pictures


def groups(numbers, keys, count=100):
    key = np.zeros(count, dtype=bool)
    key[keys] = True
    return [group.tolist() for group in jumps(np.array(numbers, dtype=int), key)]


def test_a_jump_is_made_to_the_key_frame_before_a_picture_where_that_saves_many():
    keys = [0, 20, 40, 60]
    assert groups([3, 4, 45], keys) == [[3, 4], [45]]
    assert groups([3, 12, 19], keys) == [[3, 12, 19]]  # no key frame between
    assert groups([18, 22], keys) == [[18, 22]]  # one image is not worth it
    assert groups([0, 61, 99], keys) == [[0], [61, 99]]
    assert groups([], keys) == []
    assert groups([7, 90], [5]) == [[7, 90]]  # the only place to begin is behind


def test_pictures_are_those_of_a_video_read_through(tmp_path):
    path = tmp_path / "video.mp4"
    encode(path, 40 * np.arange(60))  # with a key frame every ten
    wanted = np.array([1, 2, 25, 26, 48, 59])
    with open_video(path) as video:
        through = {n: picture for n, picture in video.frames() if n in wanted}
    with open_video(path) as video:
        found = dict(some_pictures(video, wanted))
    assert list(found) == wanted.tolist() == [number_of(found[n]) for n in found]
    for number in wanted.tolist():
        np.testing.assert_array_equal(found[number], through[number])
