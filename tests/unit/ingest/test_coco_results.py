"""2D poses of people: COCO results, arrays, and feet."""

import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.formats import files
from worldpose.formats.coco_results import read_coco_results
from worldpose.formats.keypoint_files import (
    read_keypoint_arrays,
    read_observations,
    read_people,
    select_ranges,
    write_keypoint_arrays,
)


def person(frame=0, **changes):
    triples = [value for joint in range(17) for value in (100.0 + joint, 200.0 + 2 * joint, 0.5)]
    return {"image_id": frame, "category_id": 1, "keypoints": triples, **changes}


def with_joint(joint, *triple, **changes):
    result = person(**changes)
    result["keypoints"][3 * joint : 3 * joint + 3] = triple
    return result


@pytest.fixture
def read(tmp_path):
    def read_content(content):
        path = tmp_path / "cam1.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return read_coco_results(path).people

    return read_content


@pytest.fixture
def refusal(read):
    def caught(content):
        with pytest.raises(InputError) as error:
            read(content)
        return error.value

    return caught


def test_people_come_by_frame_in_the_order_of_the_file(read):
    results = [person(7, score=0.1), person(3, score=0.2), person(7, score=0.3)]
    people = read(results)
    np.testing.assert_array_equal(people.frame, [3, 7])
    np.testing.assert_array_equal(
        people.score, np.array([[0.2, np.nan], [0.1, 0.3]], dtype=np.float32)
    )
    assert np.all(np.isnan(people.keypoints[0, 1]))
    np.testing.assert_array_equal(people.keypoints[1, 1, 2], [102, 204])


def test_box_and_score_of_found_joints_stand_in(read):
    # Joint 0, the lowest corner, is missing, so the box starts at joint 1.
    people = read([with_joint(0, 0, 0, 0, bbox=None), person(bbox=[0, 0, 1, 1], score=0.25)])
    np.testing.assert_array_equal(people.boxes[0, 0], [101, 202, 116, 232])
    np.testing.assert_array_equal(people.boxes[0, 1], [0, 0, 1, 1])
    np.testing.assert_array_equal(people.score[0], [0.5, 0.25])


def test_an_entry_without_joints_and_box_is_nobody(read):
    boxed = person(keypoints=[0] * 51, bbox=[1, 2, 3, 4], score=0.9)
    people = read([person(keypoints=[0] * 51), boxed, person()])
    assert people.keypoints.shape[1] == 2
    np.testing.assert_array_equal(people.boxes[0, 0], [1, 2, 4, 6])
    np.testing.assert_array_equal(people.score[0], np.array([0.9, 0.5], dtype=np.float32))


def test_data_set_annotations_may_carry_visibility(tmp_path):
    hidden = with_joint(4, 50, 60, 1)
    hidden["keypoints"][2::3] = [2] * 17
    hidden["keypoints"][3 * 4 + 2] = 1
    hidden["keypoints"][3 * 5 + 2] = 0
    hidden["keypoints"][3 * 7 : 3 * 8] = [None] * 3
    (tmp_path / "cam1.json").write_text(json.dumps({"images": [], "annotations": [hidden]}))
    people, _, changes = read_coco_results(tmp_path / "cam1.json")
    assert changes.clamped == 0
    assert (people.confidence[0, 0, 4], people.confidence[0, 0, 6]) == (1, 1)
    assert np.isnan(people.confidence[0, 0, 5])


def test_annotations_are_of_the_category_of_people_with_its_names(tmp_path):
    """A category that names no points has people if it has as many."""
    people = {"id": 1, "name": "person", "keypoints": list(COCO17)}
    others = [
        {"id": 0, "name": "referee", "keypoints": []},
        {"id": 2, "name": "mascot", "keypoints": list(COCO17[::-1])},
        {"id": 5, "name": "post", "keypoints": ["top"]},
    ]
    marks = [person(category_id=1), person(category_id=2), person(category_id=0)]
    marks += [{"image_id": 0, "category_id": n, "keypoints": [1, 1, 2]} for n in (0, 5)]
    file = tmp_path / "cam1.json"
    file.write_text(
        json.dumps({"annotations": marks, "categories": [others[0], people, *others[1:]]})
    )
    found = read_coco_results(file)
    assert found.kind == "COCO-17"
    assert np.isfinite(found.people.confidence).any(axis=-1).sum() == 2
    assert (found.changes.foreign, found.changes.pointless) == (3, 0)
    foreign = {"annotations": [person(category_id=2)], "categories": [people, others[1]]}
    file.write_text(json.dumps(foreign))
    with pytest.raises(InputError, match="1 annotations, all of categories other than person"):
        read_coco_results(file)
    ball = {"id": 2, "name": "Sports ball", "keypoints": []}
    file.write_text(json.dumps(foreign | {"categories": [ball]}))
    with pytest.raises(InputError, match="1 annotations, all of categories other than people"):
        read_coco_results(file)
    for name in ("football player", "player_with_ball", "ball carrier"):
        file.write_text(json.dumps(foreign | {"categories": [{"id": 2, "name": name}]}))
        assert read_coco_results(file).changes.foreign == 0


def test_a_confidence_just_below_zero_is_a_missing_joint(read):
    assert np.isnan(read([with_joint(4, 50, 60, -0.01)]).confidence[0, 0, 4])


@pytest.mark.parametrize(
    ("content", "place", "words"),
    [
        ([with_joint(16, 1, math.inf, 0.5)], "result 0, keypoints joint 16 (right_ankle)", "inf"),
        ([with_joint(0, 1, 1e300, 0.5)], "result 0, keypoints joint 0 (nose)", "pixels up to"),
        ([with_joint(0, 1, 1, -8.5)], "result 0, keypoints joint 0 (nose)", "Scale"),
        ([with_joint(0, 1, 1, 8.5)], "result 0, keypoints joint 0 (nose)", "1 is certain"),
        ([with_joint(2, 1, "x", 1)], "result 0, keypoints[7]", "a number"),
        ([with_joint(2, 1, 10**400, 1)], "result 0, keypoints[7]", "a number"),
        ([person(keypoints=[1.0] * 50)], "result 0, keypoints", "51 numbers"),
        ([person(), person(keypoints=0)], "result 1, keypoints", "51 numbers"),
        ([person(), person(keypoints=[1.0] * 75)], "result 1, keypoints", "found 75"),
        ([person("a.jpg")], "result 0, image_id", "'a.jpg'"),
        ([person(2**40)], "result 0, image_id", "1099511627776"),
        ([person(), 3], "result 1", "a mapping"),
        ([person(bbox=[1, 2, 3])], "result 0, bbox", "4 numbers"),
        ([person(), person(bbox=[1, 2, -3, 4])], "result 1, bbox", "width"),
        ([person(score=-1)], "result 0, score", "from 0"),
        ([person(), person(score="high")], "result 1, score[0]", "'high'"),
        ({"images": []}, "cam1.json", "annotations"),
        (3, "cam1.json", "annotations"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(refusal, content, place, words):
    error = refusal(content)
    assert error.where.endswith(place)
    assert words in str(error)


@pytest.mark.parametrize("entry", ["[0]", '{"image_id":0,"keypoints":[]}'])
def test_a_large_file_of_small_entries_takes_little_memory(tmp_path, entry):
    """26 MB of them took 770 MB: Python's objects are many times their text."""
    path = tmp_path / "cam1.json"
    path.write_text("[" + ",".join([entry] * (1_000_000 // len(entry))) + "]")
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            read_coco_results(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "content",
    [
        *("[1,]", "[1 2]", "[1", "[", '{"annotations"', '{"annotations":[1,]}', "{,}", '{"a":1,}'),
        *('{"a" 1}', "[] 1", "{1: 2}", '{"annotations":[],"annotations":[]}', "", " ", "[nul]"),
        *("[" * 100_000, '{"x":' * 100_000, '["a]', "[1e]", '"\\u12"', "[" + "1" * 5000 + "]"),
    ],
)
def test_what_is_no_json_is_said_so(tmp_path, content):
    path = tmp_path / "cam1.json"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        list(files.JsonItems(path, "annotations", 1 << 20))
    assert (caught.value.where, caught.value.expected) == (str(path), "JSON")


@settings(max_examples=30)
@given(st.data())
def test_entries_are_those_that_python_reads_wherever_the_file_is_cut(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "cut.json"
    values = data.draw(st.lists(JSON, max_size=4))
    content = data.draw(
        st.sampled_from([values, {"a": JSON_OTHERS, "annotations": values, "b": [values, 1]}])
    )
    path.write_text(json.dumps(content, ensure_ascii=data.draw(st.booleans()), indent=1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "CHUNK", data.draw(st.integers(1, 40)))
        items = files.JsonItems(path, "annotations", 1 << 20)
        assert json.dumps(list(items)) == json.dumps(values)
    assert (items.has_list, items.is_mapping) == (True, isinstance(content, dict))


JSON_OTHERS = [{"id": 1, "name": "ö\U0001f3c3"}, 1.5e-3, None]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=10,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cam1.npz"


@pytest.fixture
def array_refusal(path):
    def caught():
        with pytest.raises(InputError) as error:
            read_keypoint_arrays(path)
        assert error.value.where.startswith(str(path))
        return error.value

    return caught


def members(people):
    return {"frame": people.frame, **people.arrays()}


def assert_same(a, b):
    for name, array in members(a).items():
        np.testing.assert_array_equal(array, members(b)[name])
        assert array.dtype == members(b)[name].dtype


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_numpys_own_files_are_read_and_ours_by_numpy(path, make_people, save):
    people = make_people()
    save(path, **members(people))
    assert_same(read_keypoint_arrays(path), people)
    write_keypoint_arrays(path, people)
    assert_same(read_keypoint_arrays(path), people)
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["keypoints"], people.keypoints)


@pytest.mark.parametrize("kept", [0, 10, 0.99])
def test_truncated_file_is_refused(path, make_people, array_refusal, kept):
    write_keypoint_arrays(path, make_people())
    content = path.read_bytes()
    path.write_bytes(content[: kept if isinstance(kept, int) else int(kept * len(content))])
    assert "a whole npz file" in array_refusal().expected


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("frame", lambda a: a[:-1], "shape"),
        ("frame", lambda a: a[::-1], "rise"),
        ("frame", lambda a: a + 2**40, "up to"),
        ("keypoints", lambda a: a.astype(">f4"), "little-endian"),
        ("keypoints", lambda a: a.astype(object), "Python objects"),
        ("keypoints", lambda a: a[:, :, :16], "17, 2)"),
        ("boxes", lambda a: a[..., [2, 3, 0, 1]], "x0 y0 x1 y1"),
        ("boxes", lambda a: a * np.float32(np.nan), "a box for every person"),
        ("score", lambda a: a * np.float32(np.nan), "a score for every person"),
        ("score", lambda a: a - 2, "from 0"),
        ("confidence", lambda a: a + 1, "(0, 1]"),
        ("confidence", lambda a: a * np.float32(np.nan), "finite exactly where"),
        ("keypoints", lambda a: a * np.float32(np.nan), "finite exactly where"),
    ],
)
def test_wrong_array_is_refused_by_name(path, make_people, array_refusal, name, change, words):
    arrays = members(make_people(5))
    np.savez(path, **{**arrays, name: change(arrays[name])})
    error = array_refusal()
    # A confidence without keypoint, or the reverse, is found at the keypoint.
    assert any(f"{path}: {part}" in error.where for part in (name, "keypoints"))
    assert words in str(error)


def test_missing_and_further_members_are_refused(path, make_people, array_refusal):
    arrays = members(make_people())
    np.savez(path, **arrays, extra=np.zeros(3))
    assert "extra" in array_refusal().found
    del arrays["score"]
    np.savez(path, **arrays)
    assert "score" in array_refusal().expected


def test_frames_are_dense_from_first_to_last_or_over_the_wanted_range(path, make_people):
    people = replace(make_people(), frame=np.array([10, 11, 14]))
    write_keypoint_arrays(path, people)
    read = read_observations(path)
    np.testing.assert_array_equal(read.frame, [10, 11, 12, 13, 14])
    np.testing.assert_array_equal(read.keypoints[[0, 1, 4]], people.keypoints)
    assert np.isnan(read.keypoints[2:4]).all() and np.isnan(read.score[2:4]).all()
    read = select_ranges(path, read_people(path).people, [(11, 6)])
    np.testing.assert_array_equal(read.frame, np.arange(11, 17))
    np.testing.assert_array_equal(read.boxes[[0, 3]], people.boxes[1:])
    assert np.isnan(read.boxes[[1, 2, 4, 5]]).all()
    for first in (0, 15, 2**40, -(10**30)):
        with pytest.raises(InputError, match="found frames 10 to 14") as caught:
            select_ranges(path, read_people(path).people, [(first, 5)])
        assert "offset_frames" in caught.value.todo
