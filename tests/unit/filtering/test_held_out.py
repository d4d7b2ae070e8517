"""How well left-out cameras are foreseen: only better people make it better."""

import numpy as np
import pytest
from planted_errors import plant

from data_contracts.keypoints import KeypointDetections
from worldpose.filtering.held_out import FARTHEST, measure_held_out
from worldpose.triangulation.settings import TriangulationSettings

as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings()


@pytest.fixture(scope="module")
def scene():
    return plant(41, duration=0.4)


def measured(scene, index=None, used=None):
    suspects = scene.suspects
    keypoints, confidence = (
        (suspects.detections.keypoints, suspects.detections.confidence) if used is None else used
    )
    index = suspects.detections.detection_index if index is None else index
    detections = as_detections(keypoints, confidence, index.astype(np.int16))
    return measure_held_out(scene.cameras, detections, suspects.detections.keypoints, SETTINGS)


def test_people_who_are_not_followed_make_it_worse_though_nothing_contradicts_them(scene):
    index = scene.suspects.detections.detection_index.copy()
    index[:, :, 0] = -1
    whole, fewer = measured(scene), measured(scene, index)
    assert fewer.keypoints == whole.keypoints
    assert fewer.error > 1.1 * whole.error


def test_what_nobody_foresees_counts_as_the_farthest(scene):
    nobody = np.full_like(scene.suspects.detections.detection_index, -1)
    assert measured(scene, nobody).error == pytest.approx(FARTHEST)


def test_without_keypoints_there_is_nothing_to_foresee(scene):
    nothing = np.full_like(scene.suspects.detections.keypoints, np.nan)
    index = scene.suspects.detections.detection_index.astype(np.int16)
    used = as_detections(nothing, nothing[..., 0], index)
    assert measure_held_out(scene.cameras, used, nothing, SETTINGS) is None


@pytest.mark.parametrize(("count", "least", "judges"), [(2, 2, False), (3, 2, True), (3, 3, False)])
def test_left_out_cameras_judge_only_where_enough_others_are_left(scene, count, least, judges):
    suspects, some = scene.suspects, slice(count)
    found = measure_held_out(
        scene.cameras[some],
        as_detections(
            suspects.detections.keypoints[:, some],
            suspects.detections.confidence[:, some],
            suspects.detections.detection_index[:, some].astype(np.int16),
        ),
        suspects.detections.keypoints[:, some],
        TriangulationSettings(min_views=least),
    )
    assert (found is not None) == judges
