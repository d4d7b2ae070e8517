import pytest
from line_sets import soccernet_markings

from worldpose.errors import InputError
from worldpose.formats.annotations.marked_images import SOCCERNET_MARKINGS, read_marked_images
from worldpose.pitch.template import PitchTemplate


def test_every_name_is_another_marking_of_the_template():
    ours = list(SOCCERNET_MARKINGS.values())
    assert len(ours) == len(set(ours)) == 26
    corners = {name for name in PitchTemplate.standard().marking_names if "corner" in name}
    assert set(ours) | corners == set(PitchTemplate.standard().marking_names)


def test_posts_are_named_as_seen_from_the_pitch():
    # Looking at the left goal (negative x) from the centre, the main camera's side is to the left.
    assert SOCCERNET_MARKINGS["Goal left post left"] == "goal_post_left_near"
    assert SOCCERNET_MARKINGS["Goal right post left"] == "goal_post_right_far"


def test_shares_become_pixels_and_what_is_unknown_or_outside_is_left_out():
    lines = {
        "Side line top": [[0.5, 0.25], [1.2, 0.3]],
        "Middle line": [[-0.1, 0.5]],
        "Line unknown": [[0.5, 0.5]],
    }
    (only,) = soccernet_markings(lines, (960, 540)).drawn
    assert only.name == "touch_line_far"
    assert only.xy == ((480.0, 135.0),)


def test_lines_in_pixels_are_named(tmp_path):
    file = tmp_path / "lines.json"
    file.write_text('{"Middle line": [{"x": 480.0, "y": 270.0}, {"x": 470.0, "y": 10.0}]}')
    with pytest.raises(InputError, match="Middle line: places in pixels"):
        read_marked_images(file)
