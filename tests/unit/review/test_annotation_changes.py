"""An annotator's changes are found, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.annotations.annotated_images import AnnotatedImage, AnnotatedPerson
from worldpose.review.detections import find_changes, image_name

NAME = image_name("cam_03", 120)


def person(detection, shift=0.0):
    keypoints = np.arange(34.0).reshape(17, 2) + shift
    keypoints[3] = np.nan
    visible = np.full(17, 2, dtype=np.int8)
    visible[3] = 0
    return AnnotatedPerson(np.array([0.0, 0.0, 34.0, 34.0]), keypoints, visible, detection)


def picture(*people, name=f"pictures/{NAME}", size=(100, 50)):
    return AnnotatedImage(name, size, people)


BEFORE = [picture(person(0), person(7))]


@pytest.mark.parametrize(
    "name", [f"pictures/{NAME}", NAME, f"/data/upload/3/f00-{NAME}", f"a\\{NAME}"]
)
def test_what_only_was_rounded_is_no_change(name):
    back = [picture(person(7, 0.004), person(0, -0.004), name=name)]
    changes = find_changes(BEFORE, back, "file")
    assert (changes.edits, changes.pictures, changes.boxes) == ((), 1, 0)
    assert find_changes(BEFORE, [], "file").edits == ()  # a picture that did not come back


def test_moved_hidden_found_added_and_deleted_are_told_apart():
    changed = person(7)
    changed.keypoints[0] = (5.0, 6.0)
    changed.keypoints[1] = np.nan
    changed.keypoints[3] = (9.0, 9.5)
    new = replace(person(None), box=np.array([1.0, 2.0, 30.0, 40.0]))
    changes = find_changes(BEFORE, [picture(changed, new)], "file")
    deleted, nose, eye, ear, added = changes.edits
    assert (deleted.kind, deleted.detection) == ("deleted_detection", 0)
    assert {(each.camera, each.frame) for each in changes.edits} == {("cam_03", 120)}
    assert [(each.joint, each.was, each.xy) for each in (nose, eye, ear)] == [
        ("nose", (0.0, 1.0), (5.0, 6.0)),
        ("left_eye", (2.0, 3.0), None),
        ("left_ear", None, (9.0, 9.5)),
    ]
    assert (added.detection, added.box) == (8, (1.0, 2.0, 30.0, 40.0))
    assert added.keypoints[2:4] == ((4.0, 5.0), None)


@pytest.mark.parametrize(
    ("back", "found"),
    [
        ([picture(name="other_000001.png")], "other_000001"),
        ([picture(size=(50, 100))], "50 x 100"),
        ([picture(), picture(name=NAME)], NAME),
        ([picture(person(3))], "detection 3"),
        ([picture(person(7), person(7))], "detection 7"),
    ],
)
def test_what_is_not_of_this_export_is_refused(back, found):
    with pytest.raises(InputError, match=found):
        find_changes(BEFORE, back, "file")
