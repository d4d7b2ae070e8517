"""Corrections of clicks and detections, and changes by annotators."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_records import correction, match_spec

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.review import (
    AddedDetection,
    ChosenFrames,
    DeletedDetection,
    MovedKeypoint,
    MovedPoint,
    RedrawnMarking,
)
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.errors import InputError
from worldpose.formats.annotations.annotated_images import AnnotatedImage, AnnotatedPerson
from worldpose.ingest.match_folder import MatchFolder
from worldpose.review.clicks import replay_corrections
from worldpose.review.detections import find_changes, find_objection, image_name, replay_detections

CORNER, MARK, LINE = "corner_left_near", "penalty_mark_left", "touch_line_near"


def clicks(*points, drawn=()):
    return ClickedMarkings(
        points=tuple(ClickedPoint(name=name, xy=xy) for name, xy in points),
        drawn=tuple(DrawnMarking(name=name, xy=xy) for name, xy in drawn),
    )


@pytest.fixture(scope="module")
def folder():
    cameras = {"a": {}, "b": {}, "tv": {"kind": "broadcast", "width": 200, "height": 100}}
    return MatchFolder(
        folder=Path("m"),
        spec=match_spec(cameras, {"clip": {"frame_count": 9, "broadcast": "tv"}}, size=(100, 50)),
        calibrations={},
        detections={},
        pitch=PitchSpec(),
        videos={},
        clicked={
            "a": clicks((CORNER, (1.0, 2.0)), (MARK, (3.0, 4.0)), drawn=[(LINE, ((5.0, 6.0),))]),
            "b": clicks((CORNER, (7.0, 8.0))),
        },
        stills={},
        key_frames={
            "clip": KeyFrames(
                key_frames=(KeyFrame(frame=3, markings=clicks((CORNER, (150.0, 60.0)))),)
            )
        },
    )


def made(*edits):
    return [correction(edit, f"c{number}") for number, edit in enumerate(edits)]


def moved(xy, was, camera="a", marking=CORNER, frame=None):
    return MovedPoint(camera=camera, marking=marking, frame=frame, was=was, xy=xy)


def hidden(joint, xy=None):
    return MovedKeypoint(camera="a", frame=0, detection=0, joint=joint, was=(1.0, 1.0), xy=xy)


def points(clicked):
    return {point.name: point.xy for point in clicked.points}


def test_a_moved_point_moves_in_its_camera_alone(folder):
    corrections = made(moved((9.0, 9.0), (1.0, 2.0)))
    replay = replay_corrections(folder, corrections)
    assert points(replay.folder.clicked["a"]) == {CORNER: (9.0, 9.0), MARK: (3.0, 4.0)}
    assert replay.folder.clicked["b"] == folder.clicked["b"]
    assert replay.folder.clicked["a"].drawn == folder.clicked["a"].drawn
    assert list(replay.folder.clicked) == ["a", "b"]
    assert replay.folder.key_frames == folder.key_frames
    assert replay.applied == tuple(corrections)
    assert points(folder.clicked["a"])[CORNER] == (1.0, 2.0), "the folder itself was changed"


def test_a_marking_is_drawn_anew_removed_and_added(folder):
    new = ((1.0, 1.0), (2.0, 2.0))
    again = RedrawnMarking(camera="a", marking=LINE, was=((5.0, 6.0),), xy=new)
    added = RedrawnMarking(camera="b", marking=LINE, was=(), xy=new)
    removed = RedrawnMarking(camera="a", marking=LINE, was=new, xy=())
    drawn = replay_corrections(folder, made(again, added)).folder.clicked
    assert [marking.xy for marking in drawn["a"].drawn] == [new]
    assert [marking.xy for marking in drawn["b"].drawn] == [new]
    assert replay_corrections(folder, made(again, removed)).folder.clicked["a"].drawn == ()


def added(box, nose=None):
    keypoints = (nose,) + (None,) * 16
    return AddedDetection(camera="a", frame=0, detection=0, box=box, keypoints=keypoints)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (moved((9.0, 9.0), (1.0, 2.0), camera="z"), "no image z"),
        (moved((9.0, 9.0), (1.0, 2.0), frame=3), "no image a frame 3"),
        (moved((9.0, 9.0), None, camera="clip"), "no image clip"),
        (moved((9.0, 9.0), None, marking=LINE), f"no point {LINE}"),
        (RedrawnMarking(camera="a", marking=CORNER, xy=((1.0, 1.0),)), f"no marking {CORNER}"),
        (moved((99.6, 9.0), (1.0, 2.0)), "outside of the image"),
        (moved((9.0, 9.0), (1.0, 2.0), marking="corner_left_far"), "is not there now"),
        (moved((9.0, 9.0), None), "was not there when"),
        (ChosenFrames(stage="bundle_adjustment", clip="clip", frames=(1,)), "no stage applies"),
        (added((0, 0, 9, 9)), None),
        (added((9, 9, 0, 0)), "not a box inside the image of a"),
        (added((0, 0, 9, 9), nose=(100.0, 9.0)), "outside of the image"),
        (DeletedDetection(camera="tv", frame=0, detection=0), "no camera tv"),
        (hidden("nose"), None),
        (hidden("tail"), "no joint tail"),
    ],
)
def test_what_does_not_apply_says_why_and_changes_nothing(folder, edit, reason):
    replay = replay_corrections(folder, made(edit))
    if reason is None:
        assert replay.stale == ()
        return
    ((stale, said),) = replay.stale
    assert stale.edit == edit
    assert reason in said
    assert replay.folder is folder


def test_key_frames_of_a_clip_are_corrected_picked_and_dropped(folder):
    at_3 = moved((190.0, 90.0), (150.0, 60.0), camera="clip", frame=3)
    at_1 = moved((10.0, 9.0), None, camera="clip", frame=1)
    picked = replay_corrections(folder, made(at_3, at_1)).folder.key_frames["clip"].key_frames
    assert [each.frame for each in picked] == [1, 3]
    assert points(picked[1].markings) == {CORNER: (190.0, 90.0)}
    gone = moved(None, (150.0, 60.0), camera="clip", frame=3)
    assert replay_corrections(folder, made(gone)).folder.key_frames == {}


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


@pytest.mark.parametrize("name", [NAME, f"/data/upload/3/f00-{NAME}", f"a\\{NAME}"])
def test_what_only_was_rounded_is_no_change(name):
    back = [picture(person(7, 0.004), person(0, -0.004), name=name)]
    changes = find_changes(BEFORE, back, "file")
    assert (changes.edits, changes.pictures, changes.boxes) == ((), 1, 0)
    assert find_changes(BEFORE, [], "file").edits == ()  # a picture that did not come back


@pytest.mark.parametrize("prefix", ["", "pictures/", "f00-"])
def test_a_picture_is_of_the_camera_whose_whole_name_it_has(prefix):
    names = [image_name(camera, 120) for camera in ("1", "north-1", "west")]
    before = [picture(person(0), name=name) for name in names]
    for camera, name in zip(("1", "north-1", "west"), names, strict=True):
        (edit,) = find_changes(before, [picture(name=prefix + name)], "file").edits
        assert edit.camera == camera
    back = [picture(person(0), name=prefix + name) for name in reversed(names)]
    assert find_changes(before, back, "file").edits == ()


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


FIRST = 50
"""Match frame of the first row."""


def observations():
    """Two frames, two people; the second is not there in the second frame."""
    keypoints = np.arange(2 * 2 * 17 * 2, dtype=np.float32).reshape(2, 2, 17, 2)
    confidence = np.full((2, 2, 17), 0.5, dtype=np.float32)
    boxes = np.ones((2, 2, 4), dtype=np.float32)
    score = np.full((2, 2), 0.9, dtype=np.float32)
    for array in (keypoints, confidence, boxes, score):
        array[1, 1] = np.nan
    return KeypointDetections(keypoints, confidence, boxes, score, np.arange(FIRST, FIRST + 2))


def keypoint(xy, was=(0.0, 1.0), **where):
    place = {"camera": "a", "frame": FIRST, "detection": 0, "joint": "nose"} | where
    return MovedKeypoint(**place, was=was, xy=xy)


def deleted(frame=FIRST, detection=0, was=None):
    return DeletedDetection(camera="a", frame=frame, detection=detection, was=was)


def added_person(detection, frame=FIRST + 1, nose=(3.0, 4.0)):
    keypoints = (nose,) + (None,) * 16
    box = (1.0, 2.0, 5.0, 9.0)
    return AddedDetection(
        camera="a", frame=frame, detection=detection, box=box, keypoints=keypoints
    )


def changed(edit):
    """Return the changes of an edit, as (name, index) of every value."""
    found, before = observations(), observations()
    replay = replay_detections(found, [edit])
    assert replay.objections == (None,)
    assert all(map(same, found.arrays().values(), before.arrays().values()))  # the input stays
    after = replay.observations.arrays()
    return {
        name: np.argwhere(~((array == after[name]) | (np.isnan(array) & np.isnan(after[name]))))
        for name, array in before.arrays().items()
    }


def same(one, other):
    return np.array_equal(one, other, equal_nan=True)


def test_a_keypoint_taken_out_is_not_seen_any_more():
    places = changed(keypoint(None))
    assert places["keypoints"].tolist() == [[0, 0, 0, 0], [0, 0, 0, 1]]
    assert places["confidence"].tolist() == [[0, 0, 0]]
    assert len(places["boxes"]) == len(places["score"]) == 0


def test_a_keypoint_put_elsewhere_is_certain():
    replay = replay_detections(observations(), [keypoint((7.5, 8.5))])
    assert replay.observations.keypoints[0, 0, 0].tolist() == [7.5, 8.5]
    assert replay.observations.confidence[0, 0, 0] == 1.0
    again = keypoint((0.0, 1.0), was=(7.5, 8.5))
    there_and_back = replay_detections(observations(), [keypoint((7.5, 8.5)), again])
    assert there_and_back.objections == (None, None)
    assert same(there_and_back.observations.keypoints, observations().keypoints)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (keypoint(None, frame=FIRST - 1), f"no frame {FIRST - 1}"),
        (keypoint(None, frame=FIRST + 1, detection=1), "no detection 1"),
        (keypoint(None, was=(0.0, 1.5)), "was (0.0, 1.5) when it was corrected, and is [0.0, 1.0]"),
        (keypoint((1.0, 1.0), was=None), "was not seen when"),
        (deleted(frame=FIRST + 1, detection=1), "no detection 1"),
        (deleted(was=(1.0, 1.0, 1.0, 2.0)), "was [1.0, 1.0, 1.0, 2.0] when it was deleted"),
        (added_person(0), "there is a detection 0"),
        (added_person(102), "2 is the next"),
    ],
)
def test_what_does_not_fit_what_was_seen_says_why_and_changes_nothing(edit, reason):
    replay = replay_detections(observations(), [edit])
    (objection,) = replay.objections
    assert reason in objection
    for name, array in replay.observations.arrays().items():
        assert same(array, observations().arrays()[name])


def test_an_added_person_takes_a_free_place_and_is_certain():
    places = changed(added_person(1))
    assert places["keypoints"].tolist() == [[1, 1, 0, 0], [1, 1, 0, 1]]
    assert places["confidence"].tolist() == [[1, 1, 0]]
    assert places["boxes"].tolist() == [[1, 1, k] for k in range(4)]
    after = replay_detections(observations(), [added_person(1)]).observations
    assert (after.score[1, 1], after.confidence[1, 1, 0]) == (1.0, 1.0)
    assert after.boxes[1, 1].tolist() == [1.0, 2.0, 5.0, 9.0]


def test_an_added_person_stays_when_one_that_was_added_before_is_withdrawn():
    first, second = added_person(2), added_person(3, nose=(7.0, 8.0))
    moved = keypoint((1.0, 1.0), was=(7.0, 8.0), frame=FIRST + 1, detection=3)
    assert "2 is the next" in str(find_objection(observations(), second))  # if it is made now
    assert find_objection(observations(), first) is None
    both = replay_detections(observations(), [first, second, moved])
    one = replay_detections(observations(), [second, moved])
    assert (both.objections, one.objections) == ((None,) * 3, (None,) * 2)
    for each in (both, one):
        assert each.observations.keypoints[1, 3, 0].tolist() == [1.0, 1.0]
    assert np.isnan(one.observations.score[:, 2]).all()
    assert np.isfinite(both.observations.score[1, 2])
