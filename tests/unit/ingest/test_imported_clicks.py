"""Clicks of annotation tools: the same markings from every form, and places by their metres."""

import json
import os
import shutil
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from flows.review.repeated_clicks import explain_repeated
from worldpose.errors import InputError, UsageError
from worldpose.formats.annotations.marked_images import read_marked_images
from worldpose.ingest.annotations import read_clicked_markings
from worldpose.ingest.camera_data import import_camera_data, read_given_camera
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.match_folder import read_match, read_spec
from worldpose.ingest.pitch_file import read_pitch

SIZE = (1920, 1080)
SIDES = {"original_width": SIZE[0], "original_height": SIZE[1]}
CLICKS = {"corner_left_near": (400.25, 900.5), "halfway_far": (960.0, 300.0)}
LINE = [(100.0, 200.0), (300.0, 250.5)]


def match(folder, *, pitch=None):
    folder.mkdir()
    lines = ["contract: 1", "match_id: m", "fps: 25", "cameras:"]
    lines += [f"  - {{id: {name}, width: 1920, height: 1080}}" for name in ("east", "west")]
    lines += ["  - {id: main, width: 1920, height: 1080, kind: broadcast}", "clips:"]
    lines += ["  - {id: goal, first_frame: 0, frame_count: 50, broadcast: main}"]
    (folder / "match.yaml").write_text("\n".join(lines) + "\n")
    if pitch:
        (folder / "pitch.json").write_text(json.dumps(pitch))
    return folder


def cvat(file, clicks, lines=(), *, areas=(), name="east.png", size=SIZE):
    shapes = [
        f'<points label={quoteattr(label)} points="{x + 0.5},{y + 0.5}"/>'
        for label, (x, y) in clicks
    ]
    for tag, (label, pixels) in [("polyline", a) for a in lines] + [("polygon", a) for a in areas]:
        text = ";".join(f"{x + 0.5},{y + 0.5}" for x, y in pixels)
        shapes.append(f'<{tag} label={quoteattr(label)} points="{text}"/>')
    file.write_text(
        f'<annotations><image id="0" name="{name}" width="{size[0]}" '
        f'height="{size[1]}">{"".join(shapes)}</image></annotations>'
    )
    return file


def label_studio(file, clicks, lines=()):
    percent = 100.0 / np.array(SIZE)
    result = [{"type": "choices", "value": {"choices": ["good"]}}]
    for label, pixel in clicks:
        x, y = (np.array(pixel) + 0.5) * percent
        value = {"x": x, "y": y, "width": 0.4, "keypointlabels": [label]}
        result.append({"type": "keypointlabels", "value": value, **SIDES})
    for label, pixels in lines:
        value = {"points": ((np.array(pixels) + 0.5) * percent).tolist(), "polygonlabels": [label]}
        result.append({"type": "polygonlabels", "value": value, **SIDES})
    task = {"data": {"image": "/data/upload/east.png"}, "annotations": [{"result": result}]}
    file.write_text(json.dumps([task]))
    return file


def coco(file, clicks):
    names = [label for label, _ in clicks] + ["not_clicked"]
    numbers = [value for _, (x, y) in clicks for value in (x, y, 2)] + [0, 0, 0]
    content = {
        "images": [{"id": 7, "file_name": "east.png", "width": SIZE[0], "height": SIZE[1]}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 3, "keypoints": numbers}],
        "categories": [{"id": 3, "name": "pitch", "keypoints": names}],
    }
    file.write_text(json.dumps(content))
    return file


def labelme(file, clicks, lines=()):
    marked = [("point", label, [at]) for label, at in clicks] + [("line", *a) for a in lines]
    shapes = [
        {"label": label, "shape_type": kind, "points": (np.array(at) + 0.5).tolist()}
        for kind, label, at in marked
    ]
    about = {"imagePath": "..\\img\\east.png", "imageWidth": SIZE[0], "imageHeight": SIZE[1]}
    file.write_text(json.dumps({"version": "5.5.0", "shapes": shapes, "imageData": None, **about}))
    return file


def clicked(folder, camera="east"):
    spec = read_spec(folder)
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    found = read_clicked_markings(file, spec.camera(camera), read_pitch(folder, spec))
    return {point.name: point.xy for point in found.points}, found.drawn


@pytest.mark.parametrize("write", [cvat, label_studio, labelme, coco])
def test_every_form_gives_the_same_clicks(tmp_path, write):
    folder = match(tmp_path / "m")
    lines = [] if write is coco else [("touch_line_near", LINE)]
    file = write(tmp_path / "clicks", [*CLICKS.items()], *([lines] if lines else []))
    report = import_clicks(file, folder)
    assert report.files == ["annotations/static_calibration/east.json"]
    points, drawn = clicked(folder)
    assert points.keys() == CLICKS.keys()
    for name, pixel in CLICKS.items():
        np.testing.assert_allclose(points[name], pixel, atol=1e-9)
    for marking in drawn:
        assert marking.name == "touch_line_near"
        np.testing.assert_allclose(marking.xy, LINE, atol=1e-9)
    assert len(drawn) == len(lines)


@pytest.mark.parametrize("angle", [0, 90, 180, 270])
@pytest.mark.parametrize("kind", ["polygonlabels", "vectorlabels"])
def test_a_picture_that_the_annotator_turned_is_turned_back(tmp_path, angle, kind):
    file = label_studio(tmp_path / "clicks", [*CLICKS.items()], [("touch_line_near", LINE)])
    tasks = json.loads(file.read_text())
    turn = {0: lambda x, y: (x, y), 90: lambda x, y: (100 - y, x)}
    turn |= {180: lambda x, y: (100 - x, 100 - y), 270: lambda x, y: (y, 100 - x)}
    for region in tasks[0]["annotations"][0]["result"][1:]:
        region["image_rotation"], value = angle, region["value"]
        if "points" in value:
            turned = [turn[angle](*place) for place in value.pop("points")]
            named = {kind: value.pop("polygonlabels")}
            vertices = [{"x": x, "y": y} for x, y in turned]
            value |= named | ({"points": turned} if kind[0] == "p" else {"vertices": vertices})
            region["type"] = kind
        else:
            value["x"], value["y"] = turn[angle](value["x"], value["y"])
    tasks[0]["data"]["image"] = "/data/upload/1/0a1b2c3d-east.png"
    file.write_text(json.dumps(tasks))
    import_clicks(file, match(tmp_path / "m"))
    points, (drawn,) = clicked(tmp_path / "m")
    for name, pixel in CLICKS.items():
        np.testing.assert_allclose(points[name], pixel, atol=1e-9)
    np.testing.assert_allclose(drawn.xy, LINE, atol=1e-9)


@pytest.mark.parametrize("truth", [False, True])
def test_of_several_annotators_the_truth_or_the_last_is_read_and_told(tmp_path, truth):
    tasks = []
    for mark, x in (("first", 10.0), ("last", 20.0)):
        file = label_studio(tmp_path / mark, [("halfway_far", (x, 9.0))])
        tasks.append(json.loads(file.read_text())[0])
    first, last = (task["annotations"][0] for task in tasks)
    tasks[0]["annotations"] = [first | {"ground_truth": truth}, last]
    file.write_text(json.dumps(tasks[:1]))
    report = import_clicks(file, match(tmp_path / "m"))
    points, _ = clicked(tmp_path / "m")
    assert points["halfway_far"][0] == pytest.approx(10.0 if truth else 20.0)
    assert "one of 2 annotations" in report.notes[0]


def test_the_short_export_of_label_studio_gives_the_same_clicks(tmp_path):
    file = label_studio(tmp_path / "clicks", [*CLICKS.items()])
    (task,) = json.loads(file.read_text())
    given = task["annotations"][0]["result"][1:]
    values = [each["value"] | SIDES for each in given]
    turned = [v | {"x": 100 - v["x"], "y": 100 - v["y"], "image_rotation": 180} for v in values]
    short = {"image": "east.png", "id": 1, "kp": turned}
    for number, each in enumerate(([short], task)):  # and a task alone, as from the API
        file.write_text(json.dumps(each))
        import_clicks(file, match(tmp_path / f"m{number}"))
        points, _ = clicked(tmp_path / f"m{number}")
        for name, pixel in CLICKS.items():
            np.testing.assert_allclose(points[name], pixel, atol=1e-9)


def test_lines_of_soccernet_are_clicks_in_its_json_and_by_its_names(tmp_path):
    shares = [{"x": x / SIZE[0], "y": y / SIZE[1]} for x, y in LINE]
    outside = [{"x": 1.2, "y": 0.5}]
    names = {"Side LINE bottom": shares + outside, "goal left post left ": shares}
    (tmp_path / "00012.json").write_text(json.dumps({**names, "Line unknown": shares}))
    import_clicks(tmp_path / "00012.json", match(tmp_path / "m"), "east")
    _, drawn = clicked(tmp_path / "m")
    assert [each.name for each in drawn] == ["touch_line_near", "goal_post_left_near"]
    assert read_marked_images(tmp_path / "00012.json")[0].name == "00012"
    np.testing.assert_allclose(drawn[0].xy, LINE, atol=1e-9)
    lines = [("Side line bottom", LINE)]
    import_clicks(cvat(tmp_path / "clicks.xml", [], lines), match(tmp_path / "n"))
    assert clicked(tmp_path / "n")[1][0].name == "touch_line_near"


@pytest.mark.parametrize(("start", "first"), [(0, 10), (100, 110), (100, 2)])
def test_key_frames_of_tracks_are_clicks_at_their_frames(tmp_path, start, first):
    """The last numbers those of a task's own frames, each fifth one: 2 is frame 110."""
    shapes = "".join(
        f'<{kind} frame="{first + n}" keyframe="{int(n != 1)}" outside="{int(n == 3)}" '
        f'points="{text}"/>'
        for n in range(4)
        for kind, text in [("points", f"{400.75 + n},901.0")]
    )
    line = f'<polyline frame="{first}" keyframe="1" outside="0" points="100.5,200.5;300.5,251.0"/>'
    filtered = "<frame_filter>step=5</frame_filter>" if first < start else ""
    (tmp_path / "clicks.xml").write_text(
        f"<annotations><meta><task><start_frame>{start}</start_frame>{filtered}<original_size>"
        "<width>1920</width><height>1080</height></original_size></task></meta>"
        f'<track id="0" label="corner_left_near">{shapes}</track>'
        f'<track id="1" label="touch_line_near">{line}</track></annotations>'
    )
    images = read_marked_images(tmp_path / "clicks.xml")
    number = start + 5 * first if first < start else first
    step = 5 if first < start else 1
    assert [each.name for each in images] == [
        f"frame_{number:06d}",
        f"frame_{number + 2 * step:06d}",
    ]
    ((label, pixel),) = images[0].points
    np.testing.assert_allclose(pixel, CLICKS[label])
    np.testing.assert_allclose(images[0].lines[0][1], [(100.0, 200.0), (300.0, 250.5)])


def test_clicks_in_utf16_are_read_and_text_of_another_kind_is_refused(tmp_path):
    path = cvat(tmp_path / "clicks.xml", list(CLICKS.items()))
    text = path.read_text().replace("utf-8", "utf-16")
    path.write_text(text, encoding="utf-16")
    assert dict(read_marked_images(path)[0].points).keys() == CLICKS.keys()
    path.write_text("label;x;y\ncorner_left_near;400;900\n", encoding="utf-16")
    with pytest.raises(InputError, match="found neither XML nor JSON"):
        read_marked_images(path)


def test_points_of_a_skeleton_have_key_frames_of_their_own(tmp_path):
    """CVAT marks a skeleton as key frame at its first frame alone."""
    points = "".join(
        f'<skeleton frame="{n}" keyframe="{int(n == 0)}">'
        f'<points label="a" keyframe="{int(n in (0, 5))}" points="{10.5 + n},20.5"/>'
        f'<points label="b" keyframe="{int(n in (0, 7))}" points="{30.5 + n},40.5"/></skeleton>'
        for n in range(9)
    )
    (tmp_path / "clicks.xml").write_text(
        "<annotations><meta><task><original_size><width>1920</width><height>1080</height>"
        f'</original_size></task></meta><track id="0" label="body">{points}</track></annotations>'
    )
    images = read_marked_images(tmp_path / "clicks.xml")
    found = [(each.name[-1], label, *at) for each in images for label, at in each.points]
    assert found == [("0", "a", 10, 20), ("0", "b", 30, 40), ("5", "a", 15, 20), ("7", "b", 37, 40)]


def test_lines_of_game_states_are_key_frames_from_the_first_image(tmp_path):
    images = [{"image_id": f"30000{n}", "file_name": f"{n:06d}.jpg"} for n in (1, 2, 3)]
    share = [{"x": x / SIZE[0], "y": y / SIZE[1]} for x, y in LINE]
    marks = {"image_id": "300003", "category_id": 5, "lines": {"Side line bottom": share}}
    people = {"image_id": "300001", "category_id": 1, "bbox_image": {"x": 1}}
    content = {"images": images, "annotations": [people, marks], "categories": []}
    (tmp_path / "labels.json").write_text(json.dumps(content))
    folder = match(tmp_path / "m")
    import_clicks(tmp_path / "labels.json", folder, "goal")
    file = folder / "annotations/broadcast_calibration/goal.json"
    (frame,) = json.loads(file.read_text())["key_frames"]
    assert frame["frame"] == 2
    (line,) = frame["markings"]["drawn"]
    assert line["name"] == "touch_line_near"
    np.testing.assert_allclose(line["xy"], LINE, atol=1e-9)


def seen(places):
    """Pixels of world places (n, 2) from a mast behind the near touch line, looking across."""
    x, y = np.array(places).T
    depth = y + 80.0
    return np.stack([960.0 + 900.0 * x / depth, 300.0 + 900.0 * 20.0 / depth], axis=1)


@pytest.mark.parametrize(
    ("label", "mirrored"),
    [
        (lambda x, y: (x + 52.5, y + 34.0), False),
        (lambda x, y: (x + 52.5, 34.0 - y), True),
        (lambda x, y: (x, y), False),
        (lambda x, y: (x, -y), True),
    ],
)
def test_labels_are_places_from_a_corner_or_the_centre_on_either_side(tmp_path, label, mirrored):
    folder = match(tmp_path / "m")
    world = [(-52.5, 34.0), (-36.0, 20.16), (0.0, -34.0), (5.5, 34.0), (-30.5, -34.0), (-41.5, 0.0)]
    labels = ["({:g},{:g})".format(*label(*place)) for place in world]
    pixels = map(tuple, seen(world))
    report = import_clicks(cvat(tmp_path / "c.xml", zip(labels, pixels, strict=True)), folder)
    assert report.mirrored is mirrored
    assert clicked(folder)[0].keys() == {
        *("corner_left_far", "penalty_area_left_far_front", "halfway_near", "penalty_mark_left"),
        *("at_5.50_34.00", "at_-30.50_-34.00"),
    }
    pitch = json.loads((folder / "pitch.json").read_text())
    assert pitch["points"]["at_5.50_34.00"] == [5.5, 34.0]  # nobody measured its height
    assert read_pitch(folder, read_spec(folder)).points.keys() == report.own_points.keys()


QUADRANT = [(52.5, 34.0), (52.5, 20.16), (36.0, 20.16), (41.5, 0.0), (50.0, 30.0)]
"""Places from the centre spot in one quadrant, all but the last one on markings."""


@pytest.mark.parametrize("shift", [(0.0, 0.0), (52.5, 34.0)])
def test_places_of_one_quadrant_are_from_where_they_are_points_of_the_pitch(tmp_path, shift):
    labels = ["({:g},{:g})".format(*np.add(place, shift)) for place in QUADRANT]
    pixels = map(tuple, seen(QUADRANT))
    folder = match(tmp_path / "m")
    report = import_clicks(cvat(tmp_path / "c.xml", zip(labels, pixels, strict=True)), folder)
    assert report.own_points == {"at_50.00_30.00": (50.0, 30.0)}
    said = ["places are from the centre spot: 4 of 5 are points of the pitch then, and 1 if they"]
    assert [note[: len(said[0])] for note in report.notes] == ([] if any(shift) else said)


def test_two_points_by_chance_do_not_make_places_those_from_the_centre_spot(tmp_path):
    folder = match(tmp_path / "m")
    # From the centre spot, the first two would be the two penalty marks of one half.
    labels = np.array([(14.0, 0.0), (10.0, 0.0), (3.0, 4.0), (9.0, 7.0), (16.0, 3.0)])
    world = labels - [20.0, 10.0]
    clicks = zip(("({:g},{:g})".format(*at) for at in labels), map(tuple, seen(world)), strict=True)
    file = cvat(tmp_path / "c.xml", clicks)
    report = import_clicks(file, folder, pitch=PitchSpec(template="futsal"))
    assert [at[:2] for at in report.own_points.values()] == [tuple(at) for at in world.tolist()]


def test_places_depend_on_the_pitch_of_the_venue_and_names_do_not(tmp_path):
    folder = match(tmp_path / "m")
    with (folder / "match.yaml").open("a") as file:
        file.write("venue: parken\n")
    size = PitchSpec(length=101.0, width=66.0)
    labels = [f"({x + 50.5:g},{y + 33.0:g})" for x, y in QUADRANT]
    pixels = [*map(tuple, seen(QUADRANT))]
    twice = [*CLICKS.items(), ("halfway_far", (960.0, 301.0))]
    for clicks in ([*zip(labels, pixels, strict=True)], twice):
        with pytest.raises(InputError, match="the pitch of venue 'parken'"):
            import_clicks(cvat(tmp_path / "c.xml", clicks), folder)
    assert [file.name for file in folder.iterdir()] == ["match.yaml"]
    import_clicks(cvat(tmp_path / "c.xml", CLICKS.items()), folder)
    shutil.rmtree(folder / "annotations")
    import_clicks(cvat(tmp_path / "c.xml", twice), folder, pitch=size)
    own = {"halfway_far.again": (0.0, 33.0)}
    assert read_pitch(folder, read_spec(folder)) == size.model_copy(update={"points": own})


@pytest.mark.parametrize(
    ("change", "owner", "found"),
    [
        ({"clicks": [("corner_left_nera", (1.0, 2.0))]}, None, "corner_left_near"),
        ({"clicks": [("(900,2)", (1.0, 2.0))]}, None, "four places"),
        ({"lines": [("touch_line", LINE)]}, None, "touch_line_"),
        ({"size": (960, 540)}, None, "960 x 540"),
        ({"name": "north.png"}, None, "east, west"),
        ({"name": "still.png"}, "goal", "have their frame numbers"),
        ({}, "north", "goal"),
        ({"clicks": []}, None, "no labelled point"),
        ({"clicks": [], "areas": [("adboard", LINE)]}, None, "found 1 polygon of adboard"),
        ({"areas": [("halfway_lin", LINE)]}, None, "did you mean halfway_line"),
        ({"clicks": [("halfway_far", (np.nan, 2.0))]}, None, "points are"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path, change, owner, found):
    folder = match(tmp_path / "m")
    file = cvat(tmp_path / "c.xml", **{"clicks": CLICKS.items(), **change})
    with pytest.raises(InputError, match=found):
        import_clicks(file, folder, owner)
    assert {each.name for each in folder.iterdir()} == {"match.yaml"}


KINDS = {"keypointlabels": "corner_left_near", "brushlabels": "halfway_line"}
DRAWN = [{"type": k, "value": {"x": 50, "y": 50, k: [v]}, **SIDES} for k, v in KINDS.items()]
TASK = {"data": {"image": "east.png"}, "annotations": [{"result": DRAWN}]}
LEFT_OUT = {
    "cvat.xml": """<annotations><image name="east.png" width="1920" height="1080">
<points label="corner_left_near" points="100.5,200.5"/><box label="b"/><ellipse
label="center_circle"/><polygon label="adboard" points="1,2;3,4;5,6"/><polygon
label="halfway_line" points="1.5,2.5;3.5,4.5"/></image></annotations>""",
    "studio.json": json.dumps([TASK]),
    "coco.json": """{"images": [{"id": 1, "file_name": "east.png", "width": 1920, "height": 1080}],
"annotations": [{"image_id": 7, "category_id": 1, "keypoints": [1, 2, 2]},
{"image_id": 1, "category_id": 1, "keypoints": [100, 200, 2]}, {"image_id": 1, "category_id": 2,
"segmentation": [[1, 2, 3, 4, 5, 6]]}], "categories":
[{"id": 1, "name": "spot", "keypoints": ["corner_left_near"]},
{"id": 2, "name": "halfway_line"}]}""",
}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("cvat.xml", "lines: 1 box of b, 1 ellipse of center_circle, 1 polygon of adboard"),
        ("studio.json", "lines: 1 brushlabels of halfway_line"),
        ("coco.json", "lines: 1 annotation of an image not listed, 1 annotation without"),
    ],
)
def test_shapes_that_are_not_read_are_counted(tmp_path, name, said):
    folder = match(tmp_path / "m")
    (tmp_path / name).write_text(LEFT_OUT[name])
    report = import_clicks(tmp_path / name, folder)
    assert said in str(report.notes)
    assert report.clicks == {"east": 2 if name == "cvat.xml" else 1}


@pytest.mark.parametrize(
    ("content", "said"),
    [(each, "CVAT") for each in ("", "<html></html>", "[1]", "{}", "{", "\udcff\udcfe")]
    + [
        ("<annotations><image width='9' height='9'><mask/></image></annotations>", "but mask of"),
        ('{"_via_img_metadata": {}}', "VIA, which states no image sizes; convert it to COCO"),
        ('{"east.png123": {"filename": "east.png", "regions": []}}', "VIA"),
        ('{"size": {"height": 9, "width": 9}, "objects": []}', "Supervisely; convert it to COCO"),
    ],
)
def test_other_files_are_refused(tmp_path, content, said):
    (tmp_path / "c").write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=f"labelled points of .*{said}"):
        read_marked_images(tmp_path / "c")


REAL = Path(os.environ.get("WORLDPOSE_TEST_DATA", "absent")) / "static_pair"


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="WORLDPOSE_TEST_DATA has no static_pair")
def test_real_cvat_clicks_with_places_become_a_match(tmp_path):
    folder = match(tmp_path / "m", pitch={"crown": 0.1, "stripes": {"spacing": 5.5}})
    text = (folder / "match.yaml").read_text().replace("1920", "3072").replace("1080", "1728")
    (folder / "match.yaml").write_text(text)
    east = import_clicks(REAL / "left_keypoints.xml", folder, "east")
    west = import_clicks(REAL / "right_keypoints.xml", folder, "west")
    assert east.clicks | west.clicks == {"east": 38, "west": 39}
    assert east.mirrored and west.mirrored
    # Both are the other one's label: they were swapped with places that were clicked as well.
    assert [each.label for each in west.repeated] == ["(105,14.84)", "(99.5,0)"]
    # The question names both pixels, the wrong one, and the place that it really shows.
    first, second = explain_repeated(folder, REAL / "right_keypoints.xml", west.repeated)
    assert "(1394, 795) and at (1737, 805)" in first
    assert "the one at (1394, 795) shows" in first
    assert "near penalty_area_right_far_front" in first
    assert "the one at (2945, 1117) shows" in second
    assert "near stripe_right_1_near" in second
    assert "right_keypoints.xml" in second
    own = read_pitch(folder, read_spec(folder)).points
    assert not [name for name in own if name.startswith("at_") and "34.00" in name]  # all stripes
    assert {"corner_left_far", "goal_area_left_far_front"} <= clicked(folder, "east")[0].keys()


@pytest.fixture
def folder(tmp_path):
    match = tmp_path / "m"
    (match / "broadcast").mkdir(parents=True)
    for clip in ("goal", "shot"):
        (match / "broadcast" / f"{clip}.mp4").write_bytes(b"not opened here")
    (match / "match.yaml").write_text(
        "contract: 1\nmatch_id: m\nfps: 25\n"
        "cameras: [{id: main, width: 1920, height: 1080, kind: broadcast}]\n"
        "clips:\n"
        "  - {id: goal, first_frame: 0, frame_count: 3, broadcast: main,"
        " broadcast_offset_frames: 10}\n"
        "  - {id: shot, first_frame: 9, frame_count: 3, broadcast: main}\n"
    )
    return match


def test_camera_data_are_written_for_the_frames_of_the_video(folder, tmp_path):
    clicks = folder / "annotations/broadcast_calibration/shot.json"
    clicks.parent.mkdir(parents=True)
    marked = {"frame": 1, "markings": {"points": [{"name": "mast", "xy": [5, 6]}]}}
    clicks.write_text(json.dumps({"contract": 1, "key_frames": [marked]}))
    table = tmp_path / "viz.csv"
    table.write_text("pan,tilt,fov,x_mm,y,z\n1,-9,90,500,-70,15\n2,-9,90,500,-70,15\n")
    target, data = import_camera_data(table, folder, "goal", first=11)
    assert data.frame.tolist() == [11, 12]
    assert "1 of 3 images of goal have no camera data" in data.notes
    assert target == folder / "estimates" / "goal.csv"
    with pytest.raises(InputError, match="the name of a point of the pitch, found 'mast'"):
        read_match(folder)  # a venue of the project's settings can have it
    match = read_match(folder, pitch=PitchSpec(points={"mast": (0.0, 40.0, 10.0)}))
    assert match.camera_data == {"goal": target}
    assert match.calibrated_views == ("goal", "shot")
    again = read_given_camera(match, "goal", target)
    assert again.frame.tolist() == [11, 12]
    assert again.values[0, :7].tolist() == [1, -9, pytest.approx(float("nan"), nan_ok=True)] + [
        *(0.5, -70, 15, 960)
    ]
    with pytest.raises(UsageError, match="Remove it first"):
        import_camera_data(table, folder, "goal")


@pytest.mark.parametrize(
    ("view", "words"), [("goal", "frames 10 to 12 .*--first-frame"), (None, "Name one"), ("x", "x")]
)
def test_data_of_other_frames_or_clips_are_refused(folder, tmp_path, view, words):
    table = tmp_path / "viz.csv"
    table.write_text("pan,tilt\n1,-9\n2,-9\n")
    with pytest.raises(InputError, match=words):
        import_camera_data(table, folder, view)
    assert not (folder / "estimates").exists()
