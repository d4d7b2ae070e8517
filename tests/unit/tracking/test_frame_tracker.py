import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

detections = KeypointDetections.from_keypoints

SETTINGS = TrackingSettings()
FPS = 50.0


def owners(tracking):
    """The detection that each track holds everywhere it holds one: n is person n."""
    index = tracking.detection_index
    values = [np.unique(index[:, :, n][index[:, :, n] >= 0]) for n in range(index.shape[2])]
    assert all(len(value) == 1 for value in values)
    return [int(value[0]) for value in values]


def test_join_that_may_be_either_way_is_left_to_review(ring, people, seen):
    # Two people face each other, are unseen for 1 s, and stand across: each may be either.
    places = np.zeros((100, 2, 2))
    places[:30] = [[-0.8, 0.0], [0.8, 0.0]]
    places[80:] = [[0.0, -0.8], [0.0, 0.8]]
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[30:80] = np.nan
    result = track_people(ring(5), detections(keypoints, confidence), FPS, SETTINGS)
    assert len(result.tracks) == 4
    assert result.report.undecided == len(result.joins) == 2
    assert {(join.before, join.after) for join in result.joins} in (
        {(0, 2), (1, 3)},
        {(0, 3), (1, 2)},
    )
    for join in result.joins:
        assert not join.decided
        assert join.margin < np.log(SETTINGS.join_odds)
    assert result.joins[0].cost >= result.joins[1].cost


@pytest.mark.parametrize(("agility", "births"), [(2.5, 2), (70.0, 1)])
def test_who_is_unseen_may_be_as_far_beyond_the_gate_as_he_can_have_gone(
    ring, people, seen, agility, births
):
    # Stands, is unseen for 0.16 s, stands 2.5 m further. Agility times sqrt(0.16^3 / 3): 0.09 m
    # beside the gate's 0.5, or 2.59 m.
    places = np.zeros((40, 1, 2))
    places[28:] = [2.5, 0.0]
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[20:28] = np.nan
    settings = SETTINGS.model_copy(update={"velocity_change_std_m_s": agility})
    result = track_people(ring(5), detections(keypoints, confidence), FPS, settings)
    assert result.report.births == births


def test_person_whom_a_camera_loses_is_not_carried_away_by_a_neighbour(ring, people, seen):
    # Two cameras follow a person; then the second sees only a neighbour 0.45 m away, within
    # the gate: its ray misses the other camera's by more than two views of one body do.
    places = np.broadcast_to([[0.0, 0.0], [0.0, 0.45]], (40, 2, 2))
    camera = ring(2)
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, :, 1] = np.nan
    alone = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    assert owners(alone) == [0]
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, 0, 1] = np.nan
    keypoints[:20, 1, 1] = np.nan
    keypoints[20:, 1, 0] = np.nan
    taken = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    together = (taken.detection_index[20:] >= 0).all(axis=1)
    assert not together.any()
