import pytest

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


def test_lines_in_pixels_are_named(tmp_path):
    file = tmp_path / "lines.json"
    file.write_text('{"Middle line": [{"x": 480.0, "y": 270.0}, {"x": 470.0, "y": 10.0}]}')
    with pytest.raises(InputError, match="Middle line: places in pixels"):
        read_marked_images(file)
