"""Boxes become tracks: half hidden people are kept, gaps filled, flickers dropped."""

import numpy as np
import pytest

from worldpose.detection.box_tracking import BoxCleaner, BoxTracker, detect_strided
from worldpose.detection.interfaces import People
from worldpose.detection.settings import DetectionSettings

PICTURE = np.zeros((4, 4, 3), dtype=np.uint8)


def walker(frame, start=100.0, speed=4.0, height=60.0):
    x = start + speed * frame
    return [x, 200.0, x + 0.4 * height, 200.0 + height]


def people(*rows):
    rows = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return People(rows[:, :4], rows[:, 4])


def followed(found, **settings):
    """Frames in, frames out: people per frame, None in skipped frames."""
    cleaner = BoxCleaner(DetectionSettings(**settings))
    frames = [(number, PICTURE, one) for number, one in enumerate(found)]
    return [(number, out) for number, _, out in cleaner.clean(frames)], cleaner


def test_two_people_who_cross_keep_their_tracks():
    tracker = BoxTracker(high_score_threshold=0.4, track_buffer_frames=25)
    ids = []
    for frame in range(40):
        boxes = np.array([walker(frame, 100, 4, 60), walker(frame, 260, -4, 80)])
        ids.append(tracker.update(boxes, np.array([0.9, 0.9])))
    assert np.unique(np.array(ids), axis=0).tolist() == [[0, 1]]


def test_a_gap_is_filled_evenly_and_a_longer_one_is_not():
    for gap, filled in ((4, 4), (6, 0)):
        seen = [people() if 10 <= n < 10 + gap else people([*walker(n), 0.9]) for n in range(30)]
        frames, cleaner = followed(seen, max_gap_frames=5)
        assert [number for number, _ in frames] == list(range(30))
        counts = [len(one.scores) for _, one in frames]
        assert counts.count(1) == 30 - gap + filled
        assert cleaner.bridged == filled
        if filled:
            np.testing.assert_allclose(frames[12][1].boxes, [walker(12)])


def test_looks_at_every_third_frame_give_boxes_in_all_of_them():
    batch = 3
    looked = []

    def look(pictures):
        numbers = [int(picture[0, 0, 0]) for picture in pictures]
        looked.extend(numbers)
        return [people([*walker(number), 0.9]) for number in numbers]

    frames = [(n, None if n == 5 else np.full((4, 4, 3), n, dtype=np.uint8)) for n in range(21)]
    cleaner = BoxCleaner(DetectionSettings(stride=3, max_gap_frames=0))
    found = list(cleaner.clean(detect_strided(iter(frames), look, 3, batch)))
    assert looked == [0, 3, 6, 9, 12, 15, 18, 20]  # and the last, so that boxes reach the end
    assert [number for number, _, _ in found] == list(range(21))
    for number, picture, one in found:
        assert len(one.scores) == (0 if picture is None else 1), number
        if picture is not None:
            # Constant speed: boxes between two looks are where the person is.
            np.testing.assert_allclose(one.boxes, [walker(number)], atol=1e-9)


@pytest.mark.parametrize(
    ("lost", "begin", "settings"),
    [
        ({50}, 0, {"stride": 10}),
        ({50, 51, 52}, 0, {"stride": 10}),
        (set(), 30, {"stride": 10, "min_hits": 3}),
        (set(), 30, {"min_hits": 12}),
    ],
)
def test_no_frame_of_a_true_track_is_lost(lost, begin, settings):
    def look(pictures):
        numbers = [int(picture[0, 0, 0]) for picture in pictures]
        return [people(*[[*walker(n, speed=0.1), 0.9]] * (n >= begin)) for n in numbers]

    asked = DetectionSettings(**settings)
    frames = ((n, None if n in lost else np.full((4, 4, 3), n, np.uint8)) for n in range(100))
    found = BoxCleaner(asked).clean(detect_strided(frames, look, asked.stride, asked.batch))
    shown = {number for number, _, one in found if len(one.scores)}
    assert shown == set(range(begin, 100)) - lost


def test_frames_in_memory_do_not_grow_with_batch_times_stride():
    taken = []
    frames = (taken.append(n) or (n, PICTURE) for n in range(500))
    most = 0
    for n, _, _ in detect_strided(frames, lambda each: [people()] * len(each), 25, 8):
        most = max(most, len(taken) - n)
    assert most <= 51
