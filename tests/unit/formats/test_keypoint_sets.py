"""Points in files of 2D poses: their order by name, by model, by lengths; and forms of JSON."""

import json
import re

import numpy as np
import pytest

from data_contracts.conventions import COCO17, FEET
from worldpose.body.keypoints import BODY25
from worldpose.errors import InputError
from worldpose.formats.coco_results import read_coco_results
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.formats.keypoint_files import read_people
from worldpose.formats.keypoint_sets import order_by_names
from worldpose.ingest.importing import describe_changes, pose_folders
from worldpose.video.names import frame_numbers

# A standing person in pixels, 400 px tall, of which each set has some points.
SIDE = {
    "eye": (8, -8),
    "ear": (18, -4),
    "shoulder": (40, 60),
    "elbow": (50, 130),
    "wrist": (55, 195),
    "hip": (25, 190),
    "knee": (28, 290),
    "ankle": (30, 390),
    "big_toe": (40, 410),
    "small_toe": (48, 405),
    "heel": (26, 400),
}
BODY = {
    "nose": (0, 0),
    "neck": (0, 55),
    "mid_hip": (0, 190),
    "head_top": (0, -30),
    "spine": (0, 130),
    "thorax": (0, 60),
    **{f"left_{name}": place for name, place in SIDE.items()},
    **{f"right_{name}": (-x, y) for name, (x, y) in SIDE.items()},
}
BODY_25B = (*COCO17, "neck", "head_top", *FEET)
COCO18 = (*BODY25[:8], *BODY25[9:19])
HUMAN36M = (
    *("mid_hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"),
    *("spine", "thorax", "nose", "head_top", "left_shoulder", "left_elbow", "left_wrist"),
    *("right_shoulder", "right_elbow", "right_wrist"),
)


def points(names, confidence=0.9):
    """x, y, confidence of each point of a person, in a file's order."""
    return [v for name in names for v in (500 + BODY[name][0], 300 + BODY[name][1], confidence)]


def results(path, names, **more):
    people = [{"image_id": n, "keypoints": points(names), **more} for n in (0, 1)]
    path.write_text(json.dumps(people))
    return path


def frames(folder, names, count=2, key="pose_keypoints_2d"):
    folder.mkdir()
    for n in range(count):
        text = json.dumps({"people": [{key: points(names)}]})
        (folder / f"cam_{n:012d}_keypoints.json").write_text(text)
    return folder


def assert_body(people):
    wanted = np.array([BODY[name] for name in COCO17]) + (500, 300)
    np.testing.assert_allclose(people.keypoints[0, 0], wanted)
    if people.points:
        wanted = np.array([BODY[name] for name in FEET]) + (500, 300)
        np.testing.assert_allclose(people.extra_keypoints[0, 0], wanted)


@pytest.mark.parametrize(
    ("names", "kind", "feet"),
    [
        (COCO17, "COCO-17", False),
        (COCO18, "COCO-18", False),
        (BODY25, "BODY_25", True),
        (BODY_25B, "BODY_25B", True),
    ],
)
def test_a_silent_file_is_told_by_its_lengths_on_each_route(tmp_path, names, kind, feet):
    for found in (
        read_coco_results(results(tmp_path / "a.json", names)),
        read_openpose_folder(frames(tmp_path / "a_json", names)),
        read_people(frames(tmp_path / "old_json", names, key="pose_keypoints")),
    ):
        assert (found.kind, bool(found.people.points)) == (kind, feet)
        assert_body(found.people)


@pytest.mark.parametrize("change", ["faceless", "foreshortened"])
def test_an_order_is_told_without_faces_and_of_people_seen_from_the_side(tmp_path, change):
    folder = frames(tmp_path / "a_json", BODY_25B)
    for file in folder.iterdir():
        content = json.loads(file.read_text())
        triples = np.reshape(content["people"][0]["pose_keypoints_2d"], (25, 3))
        if change == "faceless":
            triples[:3] = 0.0
        else:
            triples[9:11] = 0.5 * (triples[7:9] + triples[9:11])  # forearms towards the camera
            triples[1:3] = 3.0 * triples[1:3] - 2.0 * triples[0]
            triples[:, 2] = 0.9
        content["people"][0]["pose_keypoints_2d"] = triples.ravel().tolist()
        file.write_text(json.dumps(content))
    found = read_openpose_folder(folder)
    assert found.kind == "BODY_25B"
    np.testing.assert_allclose(found.people.keypoints[0, 0, 15], (530, 690))


@pytest.mark.parametrize(
    "hidden",
    ["knee|ankle", "elbow|wrist", "nose|eye|knee|ankle", "nose|eye|ear|shoulder"],
    ids=["legs", "arms", "both", "chest"],
)
@pytest.mark.parametrize(
    ("names", "kind", "length"),
    [
        *[(COCO17, "COCO-17", 1.0), (BODY25, "BODY_25", 1.0), (BODY25, "BODY_25", 0.4)],
        *[(BODY_25B, "BODY_25B", 1.0), (HUMAN36M, "Human3.6M", 1.0)],
    ],
)
def test_an_order_is_told_where_limbs_are_hidden_in_all_frames(
    tmp_path, names, kind, length, hidden
):
    person = np.reshape(points(names), (-1, 3))
    knee, ankle = (names.index(f"left_{joint}") for joint in ("knee", "ankle"))
    person[ankle, :2] += (1.0 - length) * (person[knee, :2] - person[ankle, :2])  # to the camera
    person[[re.search(hidden, name) is not None for name in names]] = 0.0
    file = tmp_path / "a.json"
    file.write_text(json.dumps([{"image_id": 0, "keypoints": person.ravel().tolist()}]))
    if kind == "Human3.6M":
        with pytest.raises(InputError, match=kind):
            read_coco_results(file)
        return
    assert read_coco_results(file).kind == kind


def test_hidden_points_at_the_origin_with_a_confidence_tell_no_lengths(tmp_path):
    person = np.reshape(points(COCO17), (-1, 3))
    person[13:] = 0.0, 0.0, 0.3  # as Ultralytics writes points below its threshold
    people = [{"image_id": n, "keypoints": person.ravel().tolist()} for n in range(25)]
    (tmp_path / "a.json").write_text(json.dumps(people))
    found = read_coco_results(tmp_path / "a.json").people
    assert np.isnan(found.confidence[:, 0]).all(axis=0).tolist() == [False] * 13 + [True] * 4


def test_neck_and_top_of_the_head_in_place_of_eyes_are_no_eyes(tmp_path):
    names = ("nose", "neck", "head_top", *COCO17[3:])
    values = np.reshape(points(names), (17, 3))
    values[3:5] = 0.0
    people = [{"image_id": n, "keypoints": values.ravel().tolist()} for n in (0, 1)]
    (tmp_path / "a.json").write_text(json.dumps(people))
    found = read_coco_results(tmp_path / "a.json")
    assert found.kind == "PoseTrack18"
    assert np.isfinite(found.people.confidence[0, 0]).tolist() == [False] * 5 + [True] * 12


def test_a_stated_model_counts_if_it_is_known_and_its_size_fits(tmp_path):
    folder = frames(tmp_path / "a_json", BODY_25B)
    assert read_openpose_folder(folder, "BODY_25").kind == "BODY_25"
    assert read_openpose_folder(folder, "Body_with_feet").kind == "BODY_25B"
    with pytest.raises(InputError, match="of model 'MY_NET' have another order"):
        read_openpose_folder(frames(tmp_path / "b", COCO17[::-1]), "MY_NET")


@pytest.mark.parametrize(
    "spell",
    [
        str,
        lambda name: name.replace("_", " ").title(),
        lambda name: "".join(part.title() for part in name.split("_")),
        lambda name: name.replace("left_", "l_").replace("right_", "r_"),
        lambda name: "_".join(reversed(name.split("_"))) if name[:4] in ("left", "righ") else name,
        lambda name: name.replace("left_", "L").replace("right_", "R"),
        lambda name: f"{len(name)}: {name}",
    ],
)
def test_names_decide_the_order_in_any_spelling(tmp_path, spell):
    names = list(reversed(BODY_25B))
    if spell("left_eye") == "Leye":
        names = names[6:]  # toes are spelled in words
    order = order_by_names("file", [spell(name) for name in names])
    assert [names[place] for place in order.joints] == list(COCO17)
    assert [names[place] for place in order.feet] == (list(FEET) if len(names) == 25 else [])


def data_set(path, images, names=COCO17):
    """Write a COCO data set with a person in each image, and the names of its points."""
    people = [{"image_id": each["id"], "keypoints": points(names, 2)} for each in images]
    category = {"id": 1, "name": "person", "keypoints": list(names)}
    content = {"annotations": people, "images": images, "categories": [category]}
    path.write_text(json.dumps(content))
    return path


def test_a_data_set_gives_names_of_points_and_numbers_of_images(tmp_path):
    images = [{"id": 7001 + n, "file_name": f"cam/a_{5 * n}.jpg"} for n in range(3)]
    found = read_coco_results(data_set(tmp_path / "a.json", images, list(reversed(BODY_25B))))
    assert_body(found.people)
    np.testing.assert_array_equal(found.people.frame, [0, 5, 10])


@pytest.mark.parametrize(
    ("images", "names", "place", "words"),
    [
        ([{"id": 1, "file_name": "a.jpg"}], COCO17, "images[0]", "in file_name or frame_id"),
        ([{"id": 1}], COCO17, "images[0]", "found nothing"),
        ([{"id": 1, "file_name": "3fa9c1.jpg"}], COCO17, "images[0]", "found '3fa9c1.jpg'"),
        (
            [{"id": n, "file_name": f"cam{n}/000000.jpg"} for n in (1, 2)],
            COCO17,
            "images",
            "2 images with 1 numbers",
        ),
        ([{"id": 1, "file_name": "a1.jpg"}], HUMAN36M[2:], "categories", "missing are right_hip"),
    ],
)
def test_a_data_set_that_does_not_say_is_refused(tmp_path, images, names, place, words):
    with pytest.raises(InputError) as caught:
        read_coco_results(data_set(tmp_path / "a.json", images, names))
    assert caught.value.where.endswith(place)
    assert words in str(caught.value)


MPI = (
    *("head_top", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder"),
    *("left_elbow", "left_wrist", "right_hip", "right_knee", "right_ankle", "left_hip"),
    *("left_knee", "left_ankle", "spine"),
)


def test_a_set_may_lack_the_face(tmp_path):
    images = [{"id": 3, "file_name": "a_5.jpg"}]
    named = [name.replace("ankle", "foot").replace("nose", "neck_base") for name in HUMAN36M]
    category = {"id": 1, "name": "person", "keypoints": named}
    path = data_set(tmp_path / "a.json", images, HUMAN36M)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"categories": [category]}))
    for found in (read_coco_results(path), read_openpose_folder(frames(tmp_path / "b", MPI))):
        wanted = np.array([BODY[name] for name in COCO17[5:]]) + (500, 300)
        np.testing.assert_allclose(found.people.keypoints[0, 0, 5:], wanted)
        assert np.isnan(found.people.keypoints[0, 0, :5]).all()
    with pytest.raises(InputError, match="in the order of MPI-15"):
        read_openpose_folder(frames(tmp_path / "c", MPI[::-1]))


def test_landmarks_of_two_faces_are_no_bodies(tmp_path):
    jaw = np.linspace(np.pi, 0, 17)
    around = np.linspace(0, 2 * np.pi, 51)
    face = np.r_[
        np.c_[70 * np.cos(jaw), 90 * np.sin(jaw)], np.c_[30 * np.cos(around), 30 * np.sin(around)]
    ]
    row = np.c_[face + 300, np.full(68, 0.9)].ravel().tolist()
    file = tmp_path / "faces.json"
    file.write_text(json.dumps([{"image_id": n, "keypoints": row} for n in (0, 1)]))
    with pytest.raises(InputError, match="limbs of usual lengths in the order of HALPE-68"):
        read_coco_results(file)
    row[3 * 11 : 3 * 17] = [0.0] * 18  # no hips and legs in the image
    file.write_text(json.dumps([{"image_id": 0, "keypoints": row}]))
    assert read_coco_results(file).kind == "HALPE-68"


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["3_cam1.png", "12_cam1.png"], [3, 12]),  # the camera's number does not differ
        (["f3_1700000000480.png", "f12_1700000000840.png"], [3, 12]),  # times are no frames
        (["2_0.5_3.JSON", "2_0.5_12.JSON"], [3, 12]),
        (["a%2012.jpg", "a%2013.jpg"], [12, 13]),  # an escaped space is no digit
        (["a_1.jpg", "b_1.jpg", "c.jpg"], [1, 1]),
        # One frame of several clips, or cameras: the callers refuse equal numbers.
        (["clip1_5.png", "clip2_5.png"], [5, 5]),
        (["clip1_5.png", "clip2_9.png"], [5, 9]),
        (["cam1_000012_480.png", "cam1_000013_520.png"], [12, 13]),  # a time [ms]
        (["12_480_7.png", "13_520_7.png"], [12, 13]),
        # Times of day, and two clips in one folder, number no frames.
        (["T_04_17.73.png", "T_04_17.98.png", "T_04_18.21.png"], [None] * 3),
        (["take1_10.png", "take1_11.png", "take2_5.png"], [None] * 3),
        ([f"T12_04_{s}.png" for s in ("17.738369", "17.771702", "18.005036")], [None] * 3),
        (["take1_3.png", "take1_5.png", "take2_4.png", "take2_2.png"], [None] * 4),
        # One clip whose day, chunk or part falls where its frames count on.
        (["cam_31_12_23_000001", "cam_31_12_23_000002", "cam_01_01_00_000003"], [1, 2, 3]),
        (["3_000001", "3_000002", "2_000003"], [1, 2, 3]),
        (["part_2_frame_0", "part_2_frame_1", "part_1_frame_2"], [0, 1, 2]),
    ],
)
def test_the_frame_is_the_number_that_differs_from_name_to_name(names, wanted):
    assert list(map(frame_numbers(names).get, names))[: len(wanted)] == wanted


def test_files_of_several_clips_are_refused(tmp_path):
    names = ["take1_10", "take1_11", "take2_5"]
    (tmp_path / "a_json").mkdir()
    for name in names:
        (tmp_path / "a_json" / f"{name}.json").write_text('{"people": []}')
    people = [{"image_id": f"{name}.jpg", "keypoints": points(COCO17)} for name in names]
    (tmp_path / "b.json").write_text(json.dumps(people))
    for read, file in ((read_openpose_folder, "a_json"), (read_coco_results, "b.json")):
        with pytest.raises(InputError, match=r"rises by image .*several clips or times"):
            read(tmp_path / file)


def test_pictures_of_one_number_are_refused_and_frame_id_helps_out(tmp_path):
    images = [{"id": n, "file_name": f"{n}ab.jpg", "frame_id": n + 4} for n in (3, 5)]
    found = read_coco_results(data_set(tmp_path / "a.json", images))
    np.testing.assert_array_equal(found.people.frame, [7, 9])
    people = [{"image_id": f"{name}_1.jpg", "keypoints": points(COCO17)} for name in "ab"]
    (tmp_path / "b.json").write_text(json.dumps(people))
    with pytest.raises(InputError, match=r"image_id: .* whose numbers differ, found 2"):
        read_coco_results(tmp_path / "b.json")


def test_annotations_without_points_and_people_of_nan_are_nobody(tmp_path):
    path = data_set(tmp_path / "a.json", [{"id": 3, "file_name": "a_5.jpg"}])
    content = json.loads(path.read_text())
    nan = {"image_id": 3, "keypoints": [float("nan")] * 51, "score": float("nan")}
    ball = {"image_id": 3, "bbox": [1, 2, 3, 4]}
    content["annotations"] += [ball, nan]
    path.write_text(json.dumps(content))
    found = read_coco_results(path)
    assert (found.people.score.shape, found.changes) == ((1, 1), (0, 1, 0, 1, 0))
    said = str(describe_changes({"a": found}))
    assert "annotations without keypoints, such as of the ball" in said
    path.write_text(json.dumps(content | {"annotations": [ball, {**ball, "keypoints": []}]}))
    with pytest.raises(InputError, match="expected keypoints of people, found 2 annotations"):
        read_coco_results(path)


def test_people_with_a_box_alone_are_told(tmp_path):
    result = {"image_id": 3, "category_id": 1, "keypoints": [0] * 51, "bbox": [1, 2, 30, 40]}
    (tmp_path / "a.json").write_text(json.dumps([result, result]))
    found = {"a": read_people(tmp_path / "a.json")}
    assert "warning: people have a box but no keypoint: 2 of a" in describe_changes(found)


def test_alphapose_numbers_its_images_by_their_names(tmp_path):
    more = {"score": 2.9, "box": [450, 250, 100, 500], "idx": [0.0]}
    path = results(tmp_path / "a.json", COCO17, **more)
    people = json.loads(path.read_text())
    for person, name in zip(people, ("a_10.jpg", "x/a_2.jpg"), strict=True):
        person["image_id"] = name
    path.write_text(json.dumps(people))
    found = read_coco_results(path).people
    np.testing.assert_array_equal(found.frame, [2, 10])
    np.testing.assert_array_equal(found.boxes[0, 0], [450, 250, 550, 750])


def test_one_rule_for_confidences_missing_people_and_empty_frames(tmp_path):
    folder = frames(tmp_path / "a_json", COCO17, 4)
    sure = {"pose_keypoints_2d": points(COCO17, 1.26)}
    nobody = {"pose_keypoints_2d": [float("nan")] * 51}
    lame = {"pose_keypoints_2d": [float("nan")] * 3 + points(COCO17)[3:]}
    (folder / "cam_000000000001_keypoints.json").write_text(json.dumps({"people": [sure, nobody]}))
    (folder / "cam_000000000002_keypoints.json").write_text("")
    (folder / "cam_000000000003_keypoints.json").write_text(json.dumps({"people": [lame]}))
    found = read_openpose_folder(folder)
    assert found.changes == (17, 1, 1, 0, 0)
    assert found.people.confidence[1, 0].max() == 1.0
    people = np.isfinite(found.people.score).sum(axis=1)
    np.testing.assert_array_equal(people, [1, 1, 0, 1])
    assert np.isnan(found.people.confidence[3, 0, 0])
    same = [{"image_id": 1, **{"keypoints": one["pose_keypoints_2d"]}} for one in (sure, nobody)]
    assert_null_is_nan(folder, tmp_path / "b.json", [sure, nobody, lame])
    (tmp_path / "a.json").write_text(json.dumps(same))
    listed = read_coco_results(tmp_path / "a.json")
    assert listed.changes == (17, 1, 0, 0, 0)
    np.testing.assert_array_equal(listed.people.keypoints[0], found.people.keypoints[1])


def assert_null_is_nan(folder, file, people):
    """Assert that null is NaN in both forms, and that entries without a list of points are none."""
    empty = [{"pose_keypoints_2d": given} for given in (None, [])]
    text = json.dumps({"people": [*empty, *people]}).replace("NaN", "null")
    (folder / "cam_000000000001_keypoints.json").write_text(text)
    found = read_openpose_folder(folder)
    assert found.changes.nobody == 3
    assert np.isnan(found.people.confidence[1, :, 0]).tolist() == [False, True]
    rows = [{"image_id": 1, "keypoints": one["pose_keypoints_2d"]} for one in (*empty, *people)]
    file.write_text(json.dumps(rows).replace("NaN", "null"))
    listed = read_coco_results(file)
    assert (listed.changes.nobody, listed.changes.pointless) == (1, 2)
    np.testing.assert_array_equal(listed.people.keypoints[0], found.people.keypoints[1])
    for wrong in ('"500"', f"1{'0' * 400}", "true"):
        text = json.dumps({"people": people}).replace("500", wrong, 1)
        (folder / "cam_000000000001_keypoints.json").write_text(text)
        with pytest.raises(InputError, match=r"pose_keypoints_2d\[0\]: expected a number"):
            read_openpose_folder(folder)


PLACES = np.array([BODY[name] for name in COCO17]) + (500.25, 300.5)
SURE = np.linspace(0.3, 1.2, 17).round(2)


def mmpose():
    return {
        "keypoints": PLACES.tolist(),
        "keypoint_scores": SURE.tolist(),
        "bbox": [[90, 80, 950, 940]],
        "bbox_score": 0.8,
    }


def ultralytics(scale=1.0):
    x, y = (scale * PLACES).T.tolist()
    return {
        "name": "person",
        "class": 0,
        "confidence": 0.8,
        "box": {"x1": 90, "y1": 80, "x2": 950, "y2": 940},
        "keypoints": {"x": x, "y": y, "visible": SURE.tolist()},
    }


def demo(first=1):
    frames = [{"frame_id": first + n, "instances": [mmpose()] * (n != 1)} for n in range(3)]
    names = {str(n): name for n, name in enumerate(COCO17)}
    return {"meta_info": {"keypoint_id2name": names}, "instance_info": frames}


@pytest.mark.parametrize(
    "content",
    [
        demo(),
        demo(0),
        demo(0)["instance_info"],
        [[ultralytics()], [], [ultralytics()]],
        [json.dumps([ultralytics()]), "[]", json.dumps([ultralytics()])],
    ],
)
def test_a_file_of_all_frames(tmp_path, content):
    (tmp_path / "cam.json").write_text(json.dumps(content))
    found = read_people(tmp_path / "cam.json")
    assert found.people.frame.tolist() == [0, 2]
    np.testing.assert_allclose(found.people.keypoints[1, 0], PLACES, rtol=1e-6)
    np.testing.assert_allclose(found.people.confidence[1, 0], np.minimum(SURE, 1.0), rtol=1e-6)
    np.testing.assert_allclose(found.people.boxes[1, 0], [90, 80, 950, 940])
    assert found.changes.clamped == 2 * (SURE > 1.0).sum()


def test_keypoints_without_scores_are_sure(tmp_path):
    person = ultralytics()
    person["keypoints"]["visible"] = None
    (tmp_path / "cam.json").write_text(json.dumps([[person]]))
    assert (read_people(tmp_path / "cam.json").people.confidence == 1.0).all()


@pytest.mark.parametrize("person", [mmpose(), ultralytics()])
def test_a_file_of_each_frame(tmp_path, person):
    info = {"meta_info": {}, "instance_info": [person]}
    for number, people in ((7, info), (8, []), (9, [person, person])):
        (tmp_path / f"cam_{number:06d}.json").write_text(json.dumps(people))
    people = read_people(tmp_path).people
    assert people.frame.tolist() == [7, 8, 9]
    np.testing.assert_allclose(people.keypoints[2, 1], PLACES, rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([ultralytics()], "people of one image"),
        ([[ultralytics(1e-3)]], "shares of the image"),
        ([[{"name": "person", "box": {}}]], "of poses, not of boxes"),
        (demo(5), "begin with 0 or 1"),
        ([[{**ultralytics(), "keypoints": {"x": [1], "y": [1, 2]}}]], "lists of 1 and 2"),
        ([[{**mmpose(), "keypoint_scores": [1.0]}]], "lists of 17 and 17 and 1"),
        ([[{**mmpose(), "keypoints": [[1, 2, 3]] * 17}]], "result 0, keypoints"),
    ],
)
def test_what_does_not_say_its_frame_or_pixels_is_refused(tmp_path, content, words):
    (tmp_path / "cam.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        read_people(tmp_path / "cam.json")
    assert words in str(caught.value)


def test_hidden_files_beside_those_of_frames_are_none(tmp_path):
    folder = frames(tmp_path / "a_json", COCO17)
    (folder / "._cam_000000000000_keypoints.json").write_bytes(b"\0\5\26\7")
    assert read_openpose_folder(folder).people.frame.tolist() == [0, 1]
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "._cam_000000000000_keypoints.json").write_bytes(b"\0\5\26\7")
    assert pose_folders(tmp_path) == [folder]
