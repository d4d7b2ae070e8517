"""Templates of other games: places by their rules, dimensions that differ, and refusals."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from data_contracts.pitch import TEMPLATES, PitchSpec
from worldpose.errors import InputError
from worldpose.ingest.pitch_file import read_pitch
from worldpose.pitch.survey import Survey, fit_survey
from worldpose.pitch.template import PitchTemplate, Surface

MATCH = MatchSpec(
    match_id="m",
    fps=25,
    cameras=(CameraSpec(id="cam", width=1920, height=1080),),
    clips=(ClipSpec(id="clip", frame_count=1),),
)


def pitch(template, **dimensions):
    return PitchTemplate.from_spec(PitchSpec(template=template, dimensions=dimensions))


@pytest.mark.parametrize(
    ("template", "name", "place"),
    [
        ("football_9v9", "penalty_area_right_far_front", (36.575 - 11.89, 14.63)),
        ("football_9v9", "goal_post_left_near_top", (-36.575, -2.44, 2.13)),
        ("futsal", "penalty_area_left_far_front", (-14.0, 1.58)),
        ("futsal", "penalty_area_right_near_back", (20.0, -7.58)),
        ("futsal", "second_penalty_mark_left", (-10.0, 0.0)),
        ("handball", "goal_area_right_far_front", (14.0, 1.5)),
        # The circle of 9 m about (-20, 1.5) meets the touch line 8.5 m aside: 81 - 72.25 = 8.75.
        ("handball", "free_throw_left_far_back", (-20.0 + np.sqrt(8.75), 10.0)),
        ("handball", "seven_meter_left_near", (-13.0, -0.5)),
        ("basketball", "restricted_area_left_near_front", (-8.2, -2.45)),
        # 6.75^2 - 6.6^2 = 2.0025 beyond the basket, 1.575 m off the end line.
        ("basketball", "three_point_right_far_front", (14.0 - 1.575 - np.sqrt(2.0025), 6.6)),
        ("basketball", "backboard_left_near_top", (-12.8, -0.9, 3.95)),
        ("volleyball", "attack_right_far", (3.0, 4.5)),
        ("volleyball", "net_near_top", (0.0, -4.5, 2.43)),
    ],
)
def test_points_are_where_the_rules_put_them(template, name, place):
    found = pitch(template)
    height = float(found.height(*place[:2])) + (place[2] if len(place) > 2 else 0.0)
    assert found.points[name] == pytest.approx([*place[:2], height])


@pytest.mark.parametrize("template", TEMPLATES)
def test_markings_are_on_the_court_and_arcs_end_at_their_lines(template):
    found = pitch(template)
    half = [0.5 * found.length, 0.5 * found.width]
    painted = found.sample_lines(0.5).points_world
    assert (np.abs(painted[:, :2]) <= np.add(half, 1e-9)).all()
    assert {tuple(np.abs(at).round(6)) for at in painted[:, :2]} == {
        tuple(np.abs(at).round(6)) for at in painted[:, :2] * [-1.0, -1.0]
    }
    for stem in ("penalty_area", "goal_area", "free_throw"):
        name = f"{stem}_right_near"
        if name in found.arcs:
            ends = found.marking_points(name, 0.5)[[0, -1]]
            for part in ("back", "front"):
                gaps = np.linalg.norm(ends - found.points[f"{name}_{part}"], axis=1)
                assert gaps.min() == pytest.approx(0.0, abs=1e-9)


def test_dimensions_replace_those_of_the_template_and_zero_is_not_there():
    found = pitch("football", goal_width=5.0, goal_height=2.0, goal_area_depth=0.0)
    assert found.points["goal_post_left_far_top"] == pytest.approx([-52.5, 2.5, 2.0], abs=2e-3)
    assert not [name for name in (*found.points, *found.lines) if name.startswith("goal_area")]
    # Closer to the area's line than the radius from the mark: there is no arc outside of the area.
    short = pitch("football", penalty_arc_radius=5.0)
    assert "penalty_arc_left" not in short.arcs
    assert "penalty_arc_left_near" not in short.points
    assert "center_circle" not in pitch("handball").arcs
    assert "crossbar_left" not in pitch("futsal", goal_height=0.0).goals


def test_the_floor_of_a_hall_is_level_and_a_lawn_is_not_known():
    assert pitch("futsal").assumed == {"length", "width"}
    assert pitch("football_9v9").assumed == {"length", "width", "crown", "end_fall"}
    lawn, hall = (Surface.of(pitch(name)).covariance for name in ("football", "basketball"))
    assert np.sqrt(np.diagonal(lawn)) == pytest.approx([0.1, 0.25])
    assert np.sqrt(np.diagonal(hall)) == pytest.approx([0.001, 0.0025])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"template": "cricket"}, "template.*'basketball' or 'volleyball'"),
        ({"template": "futsal", "dimensions": {"penalty_area_depth": 6.0}}, "penalty_area_radius"),
        ({"dimensions": {"length": 90.0}}, "keys beside dimensions"),
        ({"dimensions": {"goal_width": -1.0}}, "goal_width"),
        ({"template": "basketball", "length": 92.0}, "16.8 to 42 metres.*looks like feet"),
        ({"length": 73.0}, "name the game as template"),
        ({"dimensions": {"penalty_area_width": 16.5}}, "rising order.*found 7.32, 18.32, 16.5"),
        ({"dimensions": {"corner_arc_radius": 30.0}}, "corner_arc_radius.*at most 13.84 m"),
        ({"template": "basketball", "dimensions": {"three_point_radius": 20}}, "at most 12.425 m"),
        ({"template": "basketball", "dimensions": {"backboard_bottom": 4.5}}, "found 4.5, 3.95"),
        ({"template": "futsal", "dimensions": {"penalty_mark_distance": 12}}, "found 12, 10"),
        ({"dimensions": {"center_circle_radius": 40.0}}, "pitch.json: length and width"),
        ({"template": "futsal", "points": {"penalty_mark_left": [-9.0, 0.0]}}, "futsal.*-14.00, 0"),
        ({"template": "volleyball", "lines": {"x": {"start": "center_mark", "end": "net"}}}, "x"),
    ],
)
def test_other_names_and_sizes_are_refused_by_name(tmp_path, content, said):
    (tmp_path / "pitch.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=said) as refused:
        read_pitch(tmp_path, MATCH)
    assert "pitch.json" in refused.value.where


def test_length_and_crown_of_a_file_stand_beside_the_template(tmp_path):
    (tmp_path / "pitch.json").write_text('{"template": "futsal", "length": 38.0}')
    found = read_pitch(tmp_path, MATCH)
    assert (found.length, found.width, found.crown) == (38.0, 20.0, 0.0)
    with pytest.raises(ValidationError):
        PitchSpec(template="curling")


def test_a_survey_of_a_hall_is_of_its_game():
    true = PitchTemplate.from_spec(PitchSpec(template="futsal", length=38.4, width=18.7))
    names = ("corner_left_near", "corner_right_far", "corner_left_far", "penalty_mark_right",
             "second_penalty_mark_left", "halfway_near")  # fmt: skip
    places = true.positions(names) @ [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    fit = fit_survey(Survey("hall.csv", names, places + [7.0, 3.0, 0.5], "futsal"))
    assert fit.pitch.template == "futsal"
    assert (fit.pitch.length, fit.pitch.width) == pytest.approx((38.4, 18.7), abs=0.01)


@pytest.mark.parametrize(
    ("template", "size"), [("basketball", (26.0, 14.0)), ("handball", (38.0, 18.0))]
)
def test_a_survey_of_round_areas_gives_another_size_back(template, size):
    """Their lines meet the end lines at places that do not follow the width in proportion."""
    true = PitchTemplate.from_spec(PitchSpec(template=template, length=size[0], width=size[1]))
    names = tuple(name for name in true.points if not name.endswith(("_top", "_bottom")))
    fit = fit_survey(Survey("hall.csv", names, true.positions(names), template))
    assert (fit.pitch.length, fit.pitch.width) == pytest.approx(size, abs=0.002)
