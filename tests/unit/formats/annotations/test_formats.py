"""Written files are read unchanged, and invalid files are refused with a reason."""

import json
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.formats.annotations import (
    FORMATS,
    detect_format,
    format_suffix,
    read_annotations,
    write_annotations,
)
from worldpose.formats.annotations.annotated_images import AnnotatedImage, AnnotatedPerson
from worldpose.formats.annotations.marked_images import read_marked_images

SIZE = (1920, 1080)


def person(rng, **known):
    """A random person with coordinates in single precision, as detections are stored."""
    keypoints = rng.uniform(-0.5, 1079.5, (17, 2)).astype(np.float32).astype(np.float64)
    visible = rng.integers(0, 3, 17).astype(np.int8)
    keypoints[visible == 0] = np.nan
    corner = rng.uniform(-0.5, 900, 2).astype(np.float32)
    box = np.concatenate([corner, corner + rng.uniform(20, 100, 2).astype(np.float32)])
    return AnnotatedPerson(box.astype(np.float64), keypoints, visible, **known)


def pictures(seed=0):
    rng = np.random.default_rng(seed)
    return [
        AnnotatedImage(
            "pictures/cam00_000050.png",
            SIZE,
            (
                person(rng, detection=4, origin="automatic", score=0.1 + 0.2),
                person(rng, detection=0, origin="corrected"),
                person(rng),
            ),
        ),
        AnnotatedImage('pictures/<&"é>_000051.png', SIZE),
    ]


def assert_same(one, other):
    assert [(each.name, each.size) for each in one] == [(each.name, each.size) for each in other]
    for a, b in zip(one, other, strict=True):
        for left, right in zip(a.people, b.people, strict=True):
            for field in fields(AnnotatedPerson):
                np.testing.assert_equal(getattr(left, field.name), getattr(right, field.name))


@pytest.mark.parametrize("form", FORMATS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_every_bit_comes_back(tmp_path_factory, form, seed):
    file = tmp_path_factory.mktemp("out") / f"labels{format_suffix(form)}"
    write_annotations(file, pictures(seed), form)
    assert detect_format(file.read_bytes()) == form
    assert_same(read_annotations(file), pictures(seed))


def test_formats_count_from_where_their_annotators_do(tmp_path):
    """A keypoint at the centre of the first pixel, in an image of 200 x 100."""
    keypoints, visible = np.full((17, 2), np.nan), np.zeros(17, dtype=np.int8)
    keypoints[0], visible[0] = 0.0, 2
    one = AnnotatedPerson(np.array([0.0, 0.0, 20.0, 10.0]), keypoints, visible)
    given = [AnnotatedImage("a.png", (200, 100), (one,))]
    content = {}
    for form in FORMATS:
        write_annotations(tmp_path / form, given, form)
        content[form] = (tmp_path / form).read_text()
    coco = json.loads(content["coco"])["annotations"][0]
    assert coco["keypoints"][:3] == [0.0, 0.0, 2]
    assert coco["bbox"] == [0.0, 0.0, 20.0, 10.0]
    assert 'xtl="0.5" ytl="0.5" xbr="20.5" ybr="10.5"' in content["cvat"]
    assert (
        'label="nose" source="manual" occluded="0" outside="0" points="0.5,0.5"'
        in (content["cvat"])
    )
    box, nose = json.loads(content["label-studio"])[0]["predictions"][0]["result"]
    assert [box["value"][name] for name in ("x", "y", "width", "height")] == [0.25, 0.5, 10, 10]
    assert (nose["value"]["x"], nose["value"]["y"]) == (0.25, 0.5)  # percent


def test_what_people_add_in_cvat_needs_no_number_and_no_box(tmp_path):
    points = "".join(
        f'<points label="{joint}" outside="{k // 2}" occluded="{k}" points="{10 + k},{20 + k}"/>'
        for k, joint in enumerate(COCO17[:3])
    )
    (tmp_path / "a.xml").write_text(
        '<annotations><meta><task/></meta><image id="0" name="a.png" width="9" height="9">'
        f'<skeleton label="pose" z_order="0">{points}</skeleton>'
        '<box label="person" xtl="1" ytl="2" xbr="3" ybr="4"/><box label="ball" xtl="no"/>'
        "</image></annotations>"
    )
    ((drawn, boxed),) = (each.people for each in read_annotations(tmp_path / "a.xml"))
    assert drawn.box.tolist() == [9.5, 19.5, 10.5, 20.5]  # around its two points
    assert drawn.visible.tolist() == [2, 1, *[0] * 15]
    assert (drawn.detection, boxed.detection) == (None, None)
    assert boxed.box.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert not boxed.visible.any()


def region(kind, value, **other):
    common = {"id": kind, "type": kind, "original_width": 100, "original_height": 100}
    return common | {"value": value} | other


def task(*regions, **other):
    return {
        "data": {"image": "x/ab12-a.png", "width": 100, "height": 100},
        "annotations": [{"result": [region("brushlabels", {})], "was_cancelled": True} | other]
        + [{"result": regions}],
        "predictions": [{"result": []}],
    }


BOX = region("rectanglelabels", {"x": 10, "y": 10, "width": 20, "height": 20})


def test_a_label_studio_point_without_a_parent_belongs_to_the_rectangle_around_it(tmp_path):
    nose = region("keypointlabels", {"x": 20, "y": 20, "keypointlabels": ["nose"]})
    (tmp_path / "a.json").write_text(json.dumps([task(BOX, nose)]))
    (picture,) = read_annotations(tmp_path / "a.json")
    assert picture.people[0].keypoints[0].tolist() == [19.5, 19.5]
    other = BOX | {"id": "another"}
    for regions in ([nose], [BOX, other, nose], [BOX, nose, nose], [BOX, BOX]):
        (tmp_path / "a.json").write_text(json.dumps([task(*regions)]))
        with pytest.raises(InputError, match=r"rectangles|of one person|one id"):
            read_annotations(tmp_path / "a.json")


BOMB = (
    "<!DOCTYPE a ["
    + '<!ENTITY a "aaaaaaaaaa">'
    + (
        "".join(
            f'<!ENTITY {b} "{f"&{a};" * 10}">'
            for a, b in zip("abcdefghi", "bcdefghij", strict=True)
        )
    )
)
IMAGE = '<annotations><image id="0" name="a" width="9" height="9">{}</image></annotations>'


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (BOMB + "]><annotations>&j;</annotations>", "document type"),
        (
            '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]><annotations>&x;</annotations>',
            "document type",
        ),
        ("<annotations>&x;</annotations>", "undefined entity"),
        ("<a>" * 1000 + "</a>" * 1000, "nested"),
        ("<coco/>", "<coco>"),
        ("<annotations><track/></annotations>", "for video"),
        (IMAGE.format('<box label="person" xtl="1"/>'), "no ytl"),
        (IMAGE.format('<box label="person" xtl="1" ytl="nan" xbr="2" ybr="3"/>'), "not finite"),
        (IMAGE.format('<box label="person" xtl="5" ytl="1" xbr="2" ybr="3"/>'), "negative"),
        (IMAGE.format('<skeleton><points label="tail" points="1,2"/></skeleton>'), "'tail'"),
        (IMAGE.format('<skeleton><points label="nose" points="1"/></skeleton>'), "not one place"),
        (IMAGE.replace('"9"', '"0"').format(""), "width 0"),
        ("", "Invalid JSON"),
        (json.dumps([task(BOX | {"meta": {"text": ["score=high"]}})]), "score is 'high'"),
        ("[" * 100000, "recursion limit"),
        ('{"images": [], "annotations": [{"image_id": 1, "bbox": [0, 0, 1, 1]}]}', "image 1"),
        ('{"images": [], "annotations": [{"image_id": 1, "bbox": [0, 0, 1, 1e999]}]}', "finite"),
        ('{"images": [], "annotations": [], "categories": [{"keypoints": ["a"]}]}', "17"),
        (json.dumps([{"data": {"image": "a"}}]), r"0\.data\.width"),
        (json.dumps([task(BOX | {"original_width": 50})]), "another size"),
        (json.dumps([task(BOX | {"image_rotation": 90})]), "rotated"),
        (json.dumps([task(BOX | {"meta": {"text": ["detection=-1"]}})]), "detection"),
        (json.dumps([task(), task()]), "one name"),
        ('<?xml version="1.0" encoding="utf-7"?><annotations/>', "no XML"),
    ],
)
def test_what_is_hostile_or_damaged_is_refused_with_its_file_and_reason(tmp_path, content, found):
    file = tmp_path / "labels.any"
    file.write_text(content)
    with pytest.raises(InputError, match=found) as refusal:
        read_annotations(file)
    assert str(file) in str(refusal.value)
    assert len(str(refusal.value)) < 600  # no content of the file is poured out


@pytest.mark.parametrize("unit", [0.01, 10.0], ids=["shares", "pixels"])
def test_clicks_in_another_unit_than_per_cent_are_refused(tmp_path, unit):
    region = {"type": "keypointlabels", "original_width": 1000, "original_height": 1000}
    places = [(20.0, 30.0), (70.0, 40.0), (55.0, 90.0), (104.0, 50.0)]

    def write(scale):
        values = [{"x": scale * x, "y": scale * y, "keypointlabels": ["a"]} for x, y in places]
        result = [{**region, "value": value} for value in values]
        task = {"data": {"image": "a.png"}, "annotations": [{"result": result}]}
        (tmp_path / "a.json").write_text(json.dumps([task]))
        return tmp_path / "a.json"

    assert len(read_marked_images(write(1.0))[0].points) == 4
    with pytest.raises(InputError, match=r"places of .* in another unit"):
        read_marked_images(write(unit))


@pytest.mark.parametrize(
    ("size", "places", "is_right"),
    [
        ((1920, 1080), [[(10, 20), (90, 30)], [(50, 80)]], False),
        ((96, 54), [[(0.1, 0.2), (0.9, 0.3), (0.5, 0.8)]], False),
        ((1920, 1080), [[(0.1, 0.2), (0.9, 0.3)], [(0.5, 0.8)]], False),
        ((3840, 2160), [[(5, 5), (20, 10), (30, 20)]], True),
        ((1920, 1080), [[(5, 5), (90, 10), (30, 80)], [(900, 500)]], True),
    ],
)
def test_shares_and_per_cent_in_coco_are_refused_and_a_corner_is_not(
    tmp_path, size, places, is_right
):
    images = [
        {"id": n, "file_name": f"{n}.png", "width": size[0], "height": size[1]}
        for n in range(len(places))
    ]
    clicks = [
        {"image_id": n, "category_id": len(each), "keypoints": [v for at in each for v in (*at, 2)]}
        for n, each in enumerate(places)
    ]
    names = [{"id": n, "name": "p", "keypoints": list("abc"[:n])} for n in (1, 2, 3)]
    content = {"images": images, "annotations": clicks, "categories": names}
    (tmp_path / "a.json").write_text(json.dumps(content))
    if is_right:
        assert len(read_marked_images(tmp_path / "a.json")) == len(places)
        return
    with pytest.raises(InputError, match=r"places of .* in another unit"):
        read_marked_images(tmp_path / "a.json")
