"""Cases P to S of docs/reference/metrics.md, and what must hold for any input."""

import numpy as np
import pytest

from worldpose.evaluation.matching import identity_scores


def scores(distances, gate=1.0):
    """Scores where infinite distances to all others mean that a person is absent."""
    distances = np.array(distances, dtype=np.float64)
    near = np.isfinite(distances)
    return identity_scores(distances, near.any(-1), near.any(-2), gate)


def line(*ids, persons=1, predicted=2, distance=0.0):
    """One person who is found under these ids, -1 for not at all; true in every frame."""
    distances = np.full((len(ids), persons, predicted), np.inf)
    for frame, person_id in enumerate(ids):
        if person_id >= 0:
            distances[frame, 0, person_id] = distance
    exists = np.ones((len(ids), persons), dtype=bool)
    return identity_scores(distances, exists, np.isfinite(distances).any(1), 1.0)


def test_case_p_one_person_under_two_ids():
    split = line(*[0] * 6, *[1] * 4)
    assert (split.switches, split.fragmentations) == (1, 0)
    # Ratios of small whole numbers, rounded once or twice, here and below.
    assert split.idf1 == pytest.approx(0.6, abs=1e-15)
    assert split.detection_accuracy == 1.0
    assert split.association_accuracy == pytest.approx(0.52, abs=1e-15)
    assert split.hota == pytest.approx(np.sqrt(0.52), abs=1e-15)


def test_case_q_one_person_lost_for_two_frames():
    lost = line(*[0] * 4, -1, -1, *[0] * 4)
    assert (lost.switches, lost.fragmentations) == (0, 1)
    assert lost.idf1 == pytest.approx(16 / 18, abs=1e-15)
    assert lost.detection_accuracy == pytest.approx(0.8, abs=1e-15)
    assert lost.association_accuracy == pytest.approx(0.8, abs=1e-15)
    assert lost.hota == pytest.approx(0.8, abs=1e-15)


def test_case_r_hota_counts_the_distances_that_are_reached():
    near = line(*[0] * 10, distance=0.3)
    # 0.7 alike: the levels 0.05, 0.10, ..., 0.70 are reached, 14 of 19.
    assert near.hota == pytest.approx(14 / 19, abs=1e-15)
    assert near.idf1 == 1.0


def test_case_s_two_people_exchange_ids():
    distances = np.full((10, 2, 2), np.inf)
    for frame in range(10):
        first = 0 if frame < 7 else 1
        distances[frame, 0, first] = distances[frame, 1, 1 - first] = 0.0
    exchanged = scores(distances)
    assert exchanged.switches == 2
    assert exchanged.idf1 == pytest.approx(0.7, abs=1e-15)
    # Seven frames share 7 / (10 + 10 - 7), three share 3 / 17.
    assert exchanged.association_accuracy == pytest.approx(0.7 * 7 / 13 + 0.3 * 3 / 17, abs=1e-15)


def test_nobody_anywhere_has_no_scores():
    empty = scores(np.empty((3, 0, 0)))
    assert (empty.idf1, empty.hota, empty.switches) == (None, None, None)
