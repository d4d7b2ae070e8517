"""Unreviewed detections remain, the least certain first."""

from datetime import UTC, datetime

import numpy as np

from data_contracts.review import Acceptance, DeletedDetection
from worldpose.review.evidence import open_detections

FRAME = np.arange(10, 13)
SCORE = np.array([[0.9, 0.2, np.nan], [0.5, np.nan, np.nan], [0.7, 0.2, 0.6]], dtype=np.float32)


def left(*acceptances, edits=()):
    found = open_detections(FRAME, SCORE, acceptances, edits)
    assert found.people == 6
    return list(zip(found.frame.tolist(), found.detection.tolist(), strict=True))


def accepted(**what):
    return Acceptance(
        id="a", match_id="m", results={}, who="Ada", accepted_at=datetime.now(UTC), **what
    )


def test_all_are_left_in_the_order_of_their_scores():
    assert left() == [(10, 1), (12, 1), (11, 0), (12, 2), (12, 0), (10, 0)]
    found = open_detections(FRAME, SCORE, (), ())
    assert found.score.tolist() == sorted(found.score)


def test_everybody_at_least_as_certain_is_accepted_at_once():
    # A threshold as the page shows it is the score itself, though that is stored coarser.
    assert left(accepted(at_least=0.6)) == [(10, 1), (12, 1), (11, 0)]
    assert left(accepted(at_least=0.0)) == []
    assert left(accepted()) == left()


def test_who_was_named_or_corrected_was_looked_at():
    taken_out = DeletedDetection(camera="a", frame=12, detection=2)
    beyond = DeletedDetection(camera="a", frame=99, detection=2)
    named = accepted(people=((10, 1), (11, 0), (11, 7), (9, 0)))
    assert left(named, edits=[taken_out, beyond]) == [(12, 1), (12, 0), (10, 0)]


def test_of_nobody_nobody_is_left():
    found = open_detections(np.arange(0), np.empty((0, 4), dtype=np.float32), [accepted()], ())
    assert (len(found.frame), found.people) == (0, 0)
