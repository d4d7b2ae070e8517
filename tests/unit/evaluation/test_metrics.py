"""Errors, coverage and identities of hand-made predictions (docs: cases a to g, p to s)."""

from dataclasses import replace

import numpy as np
import pytest
from people_samples import crowd, person, score, tracks

from worldpose.errors import InputError
from worldpose.evaluation.matching import identity_scores
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks

# Sums of a few hundred rounded distances of some metres: 1e-9 mm is a thousand times their error.
MM = 1e-9


def test_truth_re_encoded_scores_perfectly():
    truth = crowd()
    # Other ids, another order of people, further frames: the same people for all that.
    again = JointTracks(
        np.arange(-2, 8),
        np.array([40, 7, 12]),
        np.pad(truth.joints, ((2, 4), (0, 0), (0, 0), (0, 0)))[:, [2, 0, 1]],
    )
    scores = score(again, truth, fps=25.0).model_dump(exclude_none=True)
    perfect = {
        **dict.fromkeys(("coverage", "joint_coverage", "track_coverage", "idf1", "hota"), 1.0),
        **dict.fromkeys(("detection_accuracy", "association_accuracy", "g_scale"), 1.0),
        **{"pcp3d": 100.0, "persons": 3, "frames": 4},
    }
    errors = {name for name in scores if name not in perfect}
    assert {name: scores[name] for name in perfect} == pytest.approx(perfect, abs=1e-12)
    assert {name: scores[name] for name in errors} == pytest.approx(
        dict.fromkeys(errors, 0.0), abs=MM
    )
    assert len(errors) == 19


def test_case_a_matching_takes_the_least_sum_not_the_nearest_pair_first():
    truth = tracks([[person(0.0), person(0.5)]])
    predicted = tracks([[person(0.9), person(0.3)]])
    assert score(predicted, truth).mpjpe_mm == pytest.approx(350.0, abs=MM)


def test_case_b_a_prediction_beyond_the_gate_is_missed_and_false():
    scores = score(tracks([[person(1.2)]]), tracks([[person(0.0)]]))
    assert scores.mpjpe_mm is None
    assert (scores.coverage, scores.joint_coverage, scores.pcp3d) == (0.0, 0.0, 0.0)
    assert (scores.false_persons_per_frame, scores.persons, scores.frames) == (1.0, 1, 1)
    assert score(tracks([[person(1.2)]]), tracks([[person(0.0)]]), match_gate_m=1.3).coverage == 1.0


def test_case_c_a_missing_joint_lowers_joint_coverage_not_the_error():
    predicted = person(0.03, 0.04)
    predicted[9] = np.nan
    scores = score(tracks([[predicted]]), tracks([[person()]]))
    assert scores.mpjpe_mm == pytest.approx(50.0, abs=MM)
    assert scores.joint_coverage == pytest.approx(16 / 17, abs=1e-15)
    assert (scores.coverage, scores.pcp3d) == (1.0, 90.0)


def test_case_d_left_and_right_exchanged():
    mirrored = person() * [1.0, -1.0, 1.0]
    scores = score(tracks([[mirrored]]), tracks([[person()]]))
    assert scores.mpjpe_mm == pytest.approx(1000 * 4 * (0.03 + 0.07 + 0.60 + 0.33) / 17, abs=MM)
    assert scores.pcp3d == 20.0


def test_case_e_a_dropped_person_lowers_coverage():
    truth = tracks([[person(0.0), person(5.0)]] * 10)
    joints = truth.joints.copy()
    joints[3:7, 1] = np.nan
    scores, people = evaluate_joints(replace(truth, joints=joints), truth)
    assert (scores.coverage, scores.joint_coverage, scores.pcp3d) == (0.8, 0.8, 80.0)
    assert [each.coverage for each in people] == [1.0, 0.6]
    assert [each.frames for each in people] == [10, 10]
    assert scores.mpjpe_mm == 0.0


def test_case_f_people_whom_one_camera_saw_neither_count_nor_are_false():
    views = np.full((1, 2, 17), 3)
    views[0, 1] = 1
    truth = tracks([[person(0.0), person(5.0)]], views=views)
    scores, people = evaluate_joints(tracks(truth.joints), truth)
    assert (scores.persons, scores.coverage, scores.false_persons_per_frame) == (1, 1.0, 0.0)
    assert people[1].frames == 0
    assert people[1].coverage is None
    nobody = tracks(np.full((1, 1, 17, 3), np.nan))
    assert score(nobody, truth).coverage == 0.0


def test_case_g_a_limb_is_right_within_half_its_length():
    for shift, expected in ((0.24, 100.0), (0.28, 90.0)):
        predicted = person()
        predicted[9, 0] += shift
        assert score(tracks([[predicted]]), tracks([[person()]])).pcp3d == expected


def test_frames_are_paired_by_number():
    truth = tracks([[person(float(i))] for i in range(10)], first_frame=100)
    later = JointTracks(truth.frames[6:], truth.person_ids, truth.joints[6:])
    scores = score(later, truth)
    assert (scores.frames, scores.coverage, scores.mpjpe_mm) == (10, 0.4, 0.0)
    beyond = score(truth, later)
    assert (beyond.frames, beyond.coverage, beyond.false_persons_per_frame) == (4, 1.0, 0.0)


def test_frames_of_another_clip_or_between_sparse_labels_are_refused():
    truth = crowd()
    sparse = JointTracks(30 * truth.frames, truth.person_ids, truth.joints)
    between = JointTracks(31 + truth.frames, truth.person_ids, truth.joints)
    with pytest.raises(InputError, match="some of 0 to 90, found 31 to 34, none in common"):
        score(between, sparse)
    one = JointTracks(30 + truth.frames, truth.person_ids, np.roll(truth.joints, -1, axis=0))
    assert score(one, sparse).coverage == 0.25
    later = JointTracks(truth.frames + 1000, truth.person_ids, truth.joints)
    with pytest.raises(InputError, match="which has some of 0 to 3, found 1000 to 1003, none in"):
        score(later, truth)


def test_an_empty_prediction_and_an_empty_truth_have_no_error():
    truth = crowd()
    nobody = JointTracks(truth.frames, np.arange(0), np.empty((4, 0, 17, 3)))
    assert score(nobody, truth).mpjpe_mm is None
    assert score(nobody, truth).coverage == 0.0
    assert score(truth, nobody).coverage is None
    assert score(truth, nobody).false_persons_per_frame == 3.0
    no_frames = JointTracks(np.arange(0), np.arange(0), np.empty((0, 0, 17, 3)))
    assert score(no_frames, truth).coverage == 0.0
    assert score(truth, no_frames).model_dump(exclude_none=True) == {"persons": 0, "frames": 0}


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
    assert (near.hota, near.idf1) == (pytest.approx(14 / 19, abs=1e-15), 1.0)


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
