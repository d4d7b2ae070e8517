"""Metrics of two runs: better or worse by the stated rule, independent of person ids."""

import numpy as np
import pytest
from camera_builders import plain_camera
from run_records import run_record

from flows.results import comparison
from flows.results.comparison import BodiesOfBoth, compare_runs, pair_people
from worldpose.geometry.rigid import Rigid


def record(figures):
    return run_record(figures=figures)


@pytest.fixture
def compared(monkeypatch):
    """Marks of all subjects by name, with people of B named as given."""

    def compare(before, after, names=None):
        monkeypatch.setattr(comparison, "paired_people", lambda *_: names or {})
        changes = compare_runs(None, record(before), record(after))
        return {f"{change.kind} {change.name}": change for change in changes}

    return compare


@pytest.mark.parametrize(
    ("before", "after", "mark"),
    [
        (0.100, 0.0985, "better"),  # 1.5 %, 1.5 mm
        (0.100, 0.1015, "worse"),
        (0.100, 0.0992, "unchanged"),  # 0.8 %
        (0.010, 0.0095, "unchanged"),  # 5 %, but half a millimetre of at least one
        (0.200, 0.20201, "worse"),  # 1.005 % of what it was, though less of what it is
        (0.010, 0.01101, "worse"),  # 10 %, and a hundredth more than a millimetre
    ],
)
def test_a_figure_must_change_by_a_part_and_by_what_matters(compared, before, after, mark):
    name = "expected_ground_error_median_m"
    found = compared(*({"static_calibration/cam01": {name: x}} for x in (before, after)))
    assert found["camera cam01"].mark == mark
    assert found["camera cam01"].figures[0].mark == mark


def test_better_and_worse_together_are_mixed(compared):
    one = {"residual_m.person1": 0.020, "reprojection_px.person1": 2.0, "jerk_m_s3.person1": 9.0}
    other = {"residual_m.person1": 0.018, "reprojection_px.person1": 2.2, "jerk_m_s3.person1": 1.0}
    found = compared({"body_fitting/clip": one}, {"body_fitting/clip": other})
    (person,) = found.values()
    assert (person.kind, person.name, person.mark) == ("player", "clip: person 1", "mixed")
    # Less jerk may be too much smoothing: it is not judged.
    assert len(person.figures) == 2


def test_people_are_compared_by_who_they_are(compared):
    before = {"body_fitting/clip": {"residual_m.person0": 0.010, "residual_m.person1": 0.030}}
    after = {"body_fitting/clip": {"residual_m.person0": 0.030, "residual_m.person7": 0.010}}
    names = {("clip", "person0"): "person1", ("clip", "person7"): "person0"}
    found = compared(before, after, names)
    assert [change.mark for change in found.values()] == ["unchanged", "unchanged"]
    names = {("clip", "person7"): "person7 of B"}
    found = compared(before, after, names)
    assert {name: change.mark for name, change in found.items()} == {
        "player clip: person 0": "worse",
        "player clip: person 1": "only in A",
        "player clip: person 7 of B": "only in B",
    }


def test_who_stands_where_somebody_stood_is_that_person():
    before = np.zeros((4, 2, 3, 3))
    before[:, 1, :, 0] = 5.0
    after = before[:, ::-1] + 0.1
    assert pair_people(before, after) == {0: 1, 1: 0}
    # Frames in which one is missing say nothing of them.
    after[0, 0] = np.nan
    assert pair_people(before, after) == {0: 1, 1: 0}
    # Beyond 1 m, or with another one nearer, it is another person.
    assert pair_people(before, after + 2.0) == {}
    assert pair_people(before, np.repeat(before[:, :1], 2, axis=1)) == {0: 0}
    assert pair_people(before[:, :0], after) == {}


def test_the_picture_in_which_somebody_moved_most_is_found(monkeypatch):
    # Two metres in front of 1000 px: 2 cm are 10 px. The second person moves most, in frame 11.
    camera = plain_camera(1000.0, (500.0, 500.0), Rigid(np.eye(3), np.zeros(3)), (1000, 1000))
    before = np.zeros((3, 2, 17, 3))
    before[..., 2] = 2.0
    before[:, 1, :, 0] = 0.5
    after = before[:, ::-1].copy()
    after[1, 0, :, 1] += 0.02
    after[2, 1, :, 1] += 0.01
    bodies = BodiesOfBoth("clip", *map(np.array, ([10, 11, 12], [4, 7], [0, 1])), before, after)
    (picture,) = comparison._worst(bodies, "cam01", {"cam01": camera}, {"cam01": camera})
    assert (picture.camera, picture.frame, picture.person) == ("cam01", 11, 7)
    assert picture.moved_px == pytest.approx(10.0)
    # Nobody in the image, nothing to look at.
    away = BodiesOfBoth(
        "clip", *map(np.array, ([10, 11, 12], [4, 7], [0, 1])), before + 9.0, after + 9.0
    )
    assert comparison._worst(away, "cam01", {"cam01": camera}, {"cam01": camera}) == []
