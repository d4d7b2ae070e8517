"""A pitch in other units than metres, or with points elsewhere, is refused by key and unit."""

import json

import pytest

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.pitch_file import read_pitch

SPEC = MatchSpec(
    match_id="m",
    fps=25,
    cameras=(CameraSpec(id="cam", width=1920, height=1080),),
    clips=(ClipSpec(id="clip", frame_count=1),),
)


def read(folder, content):
    (folder / "pitch.json").write_text(json.dumps(content))
    return read_pitch(folder, SPEC)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"length": 105000.0, "width": 68000.0}, "length: .*105000, which looks like millimetres"),
        ({"length": 10500, "width": 6800}, "length: .*10500, which looks like centimetres"),
        ({"length": 345.0, "width": 223.0}, "length: .*345, which looks like feet"),
        ({"width": 20.0}, "width: expected 40 to 100 metres, found 20. Give all lengths"),
        ({"crown": 50.0}, "crown"),
        ({"points": {"corner_left_near": [-52500.0, -34000.0, 0.0]}}, "looks like millimetres"),
        ({"points": {"corner_left_near": [-57.4, -37.2, 0.0]}}, "which looks like yards"),
        ({"points": {"corner_left_near": [52.5, -34.0, 0.0]}}, "points.corner_left_near: expected"),
        (
            {"arcs": {"a": {"center": "x", "radius": 1e9, "start_angle": 0, "end_angle": 1}}},
            "radiu",
        ),
    ],
)
def test_a_pitch_that_is_not_in_metres_is_refused(tmp_path, content, message):
    with pytest.raises(InputError, match=message) as refused:
        read(tmp_path, content)
    assert "pitch.json" in refused.value.where


def test_a_pitch_of_another_size_is_taken_where_the_file_says_so(tmp_path):
    assert read(tmp_path, {"length": 61.0, "width": 43.0, "any_size": True}).length == 61.0
