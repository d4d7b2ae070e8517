"""Clocks that change within a clip, measured on people who are tracked with them taken back."""

import re
from functools import partial

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.camera_changes import describe_change
from worldpose.triangulation.change_search import follow_changes

FPS, FRAMES, BAD = 25.0, 200, 3


@pytest.mark.parametrize(
    ("times", "late", "said"),
    [
        (lambda t: t + 12 * (t >= 90), 12.0, "recorder lost images there"),
        (lambda t: t - 9 * (t >= 120), -9.0, "recorder repeated images there"),
        (lambda t: t + 20 * (t >= 22), 20.0, "near frame 2. .* cease to meet .* then do 20 match"),
        (lambda t: t + np.rint(3.8 * t / (FRAMES - 1)).astype(int), 3.8, r"takes 1\.\d+% fewer"),
        (lambda t: t, None, ""),
    ],
    ids=["lost frames", "repeated frames", "near the beginning", "fast", "healthy"],
)
def test_a_clock_is_measured_on_people_who_are_tracked_with_it_taken_back(
    ring, people, seen, times, late, said
):
    time = np.arange(FRAMES + 20)[:, None] / FPS
    turn = 0.8 * time + np.arange(4)  # at up to 5.6 m/s
    places = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * np.arange(4, 8)[:, None]
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[:FRAMES, BAD] = keypoints[times(np.arange(FRAMES)), BAD]
    detections = KeypointDetections.from_keypoints(
        keypoints[:FRAMES], confidence[:FRAMES], frame=np.arange(FRAMES)
    )
    clip = follow_changes(
        "abcde", ring(5), FPS, lambda _: detections, partial(track_people, ring(5), fps=FPS)
    )
    found = [(each.camera, each.kind) for each in clip.changes]
    assert found == [("abcde"[BAD], "clock")] * (late is not None)
    if found:
        assert clip.changes[0].late_frames == pytest.approx(late, abs=0.2)
        assert re.search(said, describe_change(clip.changes[0]))
