"""Real detections of an operating room (MVOR); skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `mvor/camma_mvor_2018.json` and `mvor/openpose_kps.json` of
the repository CAMMA-public/MVOR (CC BY-NC-SA 4.0).
"""

import os
from pathlib import Path

import numpy as np
import pytest
from mvor import NO_BOX, NO_IDENTITY, judge_result, load_moments, measure, name_detections

from worldpose.tracking.settings import TrackingSettings

MVOR = Path(os.environ.get("WORLDPOSE_TEST_DATA", "absent")) / "mvor"
FILES = [MVOR / "camma_mvor_2018.json", MVOR / "openpose_kps.json"]

needs_data = pytest.mark.skipif(
    not all(file.is_file() for file in FILES), reason="WORLDPOSE_TEST_DATA has no mvor"
)


def test_a_detection_is_named_by_the_box_around_it():
    boxes = np.array([[0, 0, 100, 200, 4], [60, 0, 100, 200, NO_IDENTITY], [0, 0, 400, 400, 7.0]])
    joints = np.full((3, 17, 3), np.nan)
    joints[0, :4] = [[10, 10, 1], [90, 10, 1], [90, 190, 1], [10, 190, 1]]
    joints[1, :4] = [[70, 10, 1], [150, 10, 1], [150, 190, 1], [70, 190, 1]]
    joints[2, :2] = [[500, 10, 1], [510, 20, 1]]
    assert name_detections(boxes, joints) == [4, NO_IDENTITY, NO_BOX]
    assert name_detections(np.empty((0, 5)), joints) == [NO_BOX] * 3


@pytest.mark.parametrize(
    ("names", "elsewhere", "taken", "verdict"),
    [
        ([3, 3, 5], [{3}, {3}, {5}], set(), ("real", 3)),
        ([3, 3], [{3}, {3}], {3}, ("false", 3)),
        ([3, 5], [{3}, {5}], set(), ("false", None)),
        ([3, NO_BOX], [{3}, set()], set(), ("false", None)),
        ([3, NO_IDENTITY], [{3}, {NO_IDENTITY}], set(), ("real", 3)),
        ([3, NO_IDENTITY], [{3}, {3, NO_IDENTITY}], set(), ("false", None)),
        ([NO_IDENTITY, NO_IDENTITY], [{NO_IDENTITY}] * 2, set(), ("unknown", None)),
        ([NO_BOX, NO_IDENTITY], [set(), {NO_IDENTITY}], set(), ("false", None)),
    ],
)
def test_boxes_tell_whether_a_result_is_a_person(names, elsewhere, taken, verdict):
    assert judge_result(names, elsewhere, taken) == verdict


@pytest.fixture(scope="module")
def measured():
    """The benchmark's results with default settings: errors [cm] and people, by views."""
    return measure(*load_moments(MVOR), TrackingSettings())


# Published errors of mv3dreg are 9.9 and 18.3 cm; seen here 308 of 308 at 9.2, 356 of 415 at 11.8.
@needs_data
@pytest.mark.parametrize(("views", "share", "limit_cm"), [(3, 0.95, 9.9), (2, 0.85, 13.0)])
def test_people_of_an_operating_room_are_found(measured, views, share, limit_cm):
    errors = np.array(measured["errors"][views])
    assert len(errors) >= share * measured["people"][views] > 0
    # Joints come in pairs of groups: the mean over the groups, as the data set's authors report.
    by_group = np.nanmean(errors.reshape(-1, 4, 2), axis=(0, 2))
    assert by_group.mean() <= limit_cm
    assert measured["false"][views] <= 0.05 * measured["results"][views]
