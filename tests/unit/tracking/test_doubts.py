"""Where nothing tells who is who: takeovers, undecided joins, and what a run says of them."""

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from data_contracts.tracking import Join
from worldpose.tracking.joins import Takeover, describe_doubts
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

detections = KeypointDetections.from_keypoints

FRAMES = np.arange(300, 400)
FPS = 50.0
LOST, BACK, END = 20, 24, 60


def join(before, after, last_frame, first_frame, decided=False):
    return Join(
        before=before,
        after=after,
        last_frame=last_frame,
        first_frame=first_frame,
        cost=0.0,
        margin=0.5,
        decided=decided,
    )


@pytest.fixture
def hidden(ring, people, seen):
    """Two people on nearly one ray of camera 0; from `LOST` on, cameras 0 and 1 alone see them.

    Camera 0 misses the first of them from `LOST` to `BACK`.
    """
    cameras = ring(5)
    toward = cameras.center[0, :2] / np.linalg.norm(cameras.center[0, :2])
    aside = np.array([-toward[1], toward[0]])
    places = np.array([0.0 * toward, 1.2 * toward + 0.15 * aside])
    keypoints, confidence = seen(cameras, people(np.broadcast_to(places, (END, 2, 2))), noise=0.3)
    keypoints[LOST:, 2:] = np.nan
    keypoints[LOST:BACK, 0, 0] = np.nan
    return cameras, keypoints, confidence


def test_person_who_takes_the_detection_that_another_loses_is_a_takeover(hidden):
    cameras, keypoints, confidence = hidden
    keypoints[BACK:, 0, 1] = np.nan  # one detection is left to the two of them
    result = track_people(cameras, detections(keypoints, confidence), FPS, TrackingSettings())
    hidden_one, other = np.argsort(result.detection_index[0, 0])
    assert result.takeovers == (Takeover(BACK, hidden_one, other),)
    assert result.report.takeovers == 1


def test_takeovers_are_named_by_person_and_frame_of_the_clip():
    text = describe_doubts(FRAMES, 4, [Takeover(25, 0, 2), Takeover(99, 3, -1)], [])
    assert text == (
        "2 tracks may have passed from one person to another where one of them is hidden from a "
        "camera (person 0 and person 2 in frame 325; person 3 in frame 399). Look at these frames "
        "on the review pages, and split or join the tracks there"
    )


def test_undecided_joins_are_named_where_they_are_many_for_the_people():
    joins = [join(0, 3, 10, 40), join(1, 1, 5, 20, decided=True)]
    assert describe_doubts(FRAMES, 5, [], joins) is None  # one of five people
    assert describe_doubts(FRAMES, 4, [], joins) == (
        "1 pair of tracks may each be one person (person 0 until frame 310 and person 3 from frame "
        "340). Look at these frames on the review pages, and split or join the tracks there"
    )
