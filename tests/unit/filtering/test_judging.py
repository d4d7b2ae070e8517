"""Joints are judged by their views; missing people are searched for; results are taken in."""

from dataclasses import replace

import numpy as np
import pytest
from bystander import SIZE, expected
from planted_errors import plant

from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.judging import judge_detections, learn_keypoint_spread
from worldpose.filtering.redetection import select_missing_people
from worldpose.filtering.settings import FilteringSettings

SETTINGS = FilteringSettings()


@pytest.fixture(scope="module")
def scene():
    return plant(31)


def judged(scene, dropped=None, exchanged=None, **changes):
    suspects = replace(
        scene.suspects,
        detections=replace(scene.suspects.detections, **changes),
        dropped=scene.suspects.dropped if dropped is None else dropped,
        exchanged=scene.suspects.exchanged if exchanged is None else exchanged,
    )
    spread = learn_keypoint_spread(scene.views, suspects)
    return judge_detections(scene.views, suspects, spread, SETTINGS)


def test_nine_of_ten_planted_keypoints_are_found_and_few_honest_ones_rejected(scene):
    found = judged(scene)
    seen = np.isfinite(scene.suspects.detections.confidence) & (scene.person >= 0)[..., None]
    planted = scene.displaced & seen
    assert planted.sum() > 500
    assert found.rejected[planted].mean() >= 0.9
    assert found.rejected[seen & ~planted].mean() < 0.02


def test_a_box_that_nobody_claims_is_given_to_the_body_that_it_fits(scene):
    frame, camera, person = 3, 1, 2
    index = scene.suspects.detections.detection_index.copy()
    place = index[frame, camera, person]
    assert place >= 0
    index[frame, camera, person] = -1
    found = judged(scene, detection_index=index)
    assert found.fits[frame, camera, place] == person
    assert not found.dropped[frame, camera, place]


def test_a_box_that_fits_nobody_is_dropped_whole(scene):
    keypoints = scene.suspects.detections.keypoints.copy()
    frame, camera, person = 4, 2, 1
    place = scene.suspects.detections.detection_index[frame, camera, person]
    keypoints[frame, camera, place, :, 0] += 400.0
    found = judged(scene, keypoints=keypoints)
    assert found.dropped[frame, camera, place]
    there = np.isfinite(scene.suspects.detections.confidence[frame, camera, place])
    np.testing.assert_array_equal(found.rejected[frame, camera, place], there)
    assert found.fits[frame, camera, place] == -1


def test_sides_that_were_put_right_are_no_contradiction(scene):
    frame, camera, person = 6, 3, 0
    place = scene.suspects.detections.detection_index[frame, camera, person]
    honest = judged(scene).mahalanobis_distance[frame, camera, place]
    left_right = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
    keypoints, confidence = (
        scene.suspects.detections.keypoints.copy(),
        scene.suspects.detections.confidence.copy(),
    )
    for array in (keypoints, confidence):
        array[frame, camera, place] = array[frame, camera, place][left_right]
    exchanged = scene.suspects.exchanged.copy()
    exchanged[frame, camera, person] = True
    found = judged(scene, keypoints=keypoints, confidence=confidence, exchanged=exchanged)
    # Each keypoint keeps its verdict at the place where the detector put it.
    np.testing.assert_allclose(
        found.mahalanobis_distance[frame, camera, place], honest[left_right], rtol=1e-3
    )


SEARCH_SETTINGS = RedetectionSettings()


def sought(bodies, *seen, **kwargs):
    known = np.zeros(bodies.image.shape[:2], dtype=bool)
    known[:, list(seen)] = True
    found = select_missing_people(bodies, known, SIZE, SEARCH_SETTINGS, **kwargs)
    return found.person.tolist(), found.hidden


def test_who_was_not_detected_is_looked_for_where_the_body_is():
    bodies = expected((0.0, 0.0), (3.0, 0.0))
    found = select_missing_people(bodies, np.array([[True, False]]), SIZE, SEARCH_SETTINGS)
    assert (found.frame.tolist(), found.person.tolist(), found.hidden) == ([0], [1], 0)
    np.testing.assert_array_equal(found.boxes, bodies.boxes[0, 1:])


@pytest.mark.parametrize(
    ("where", "deviation"),
    [
        ((0.0, 40.0), 0.02),  # 31 px high
        ((0.0, 0.0), 0.2),  # may be any person there
        ((10.05, 0.0), 0.02),  # at the border: seven joints are in the image
        ((0.0, -30.0), 0.02),  # behind the camera
    ],
)
def test_who_would_not_be_seen_well_is_not_looked_for(where, deviation):
    assert sought(expected(where, deviation=deviation)) == ([], 0)


def test_who_is_hidden_is_not_looked_for_and_counted():
    behind = expected((0.0, 0.0), (0.0, 1.0))
    assert (sought(behind, 0), sought(behind, 1)) == (([], 1), ([0], 0))
