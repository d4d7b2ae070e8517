"""The pitch of the laws, and the pitches of other games."""

import json
import math

import numpy as np
import pytest
from pydantic import ValidationError
from run_records import match_spec

from data_contracts.pitch import TEMPLATES, ArcSpec, LineSpec, PitchSpec
from worldpose.errors import InputError
from worldpose.ingest.pitch_file import read_pitch
from worldpose.pitch.survey import Survey, fit_survey
from worldpose.pitch.template import PitchTemplate, Surface

# Coordinates up to 53 m round at 1e-14.
ROUNDING = 1e-13


@pytest.fixture(scope="module")
def flat():
    return PitchTemplate.from_spec(PitchSpec(crown=0.0))


@pytest.fixture(scope="module")
def standard():
    return PitchTemplate.standard()


def marking(template, name, spacing=0.5):
    samples = template.sample_lines(spacing)
    return samples.points_world[samples.marking == samples.names.index(name)]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("center_mark", (0.0, 0.0, 0.0)),
        ("corner_left_near", (-52.5, -34.0, 0.0)),
        ("halfway_near", (0.0, -34.0, 0.0)),
        ("center_circle_near", (0.0, -9.15, 0.0)),
        ("penalty_mark_left", (-41.5, 0.0, 0.0)),
        ("penalty_area_left_near_back", (-52.5, -20.16, 0.0)),
        ("penalty_area_right_far_front", (36.0, 20.16, 0.0)),
        ("goal_area_left_far_back", (-52.5, 9.16, 0.0)),
        ("goal_post_left_near_bottom", (-52.5, -3.66, 0.0)),
        # 9.15^2 - 5.5^2 = 53.4725 = 7.31249^2
        ("penalty_arc_left_far", (-36.0, math.sqrt(53.4725), 0.0)),
    ],
)
def test_points_are_where_law_1_puts_them(flat, name, place):
    np.testing.assert_allclose(flat.points[name], place, atol=ROUNDING)


def test_penalty_arcs_begin_and_end_on_the_line_of_the_area(standard):
    for side, inward in (("left", 1.0), ("right", -1.0)):
        arc = marking(standard, f"penalty_arc_{side}")
        ends = standard.positions([f"penalty_arc_{side}_near", f"penalty_arc_{side}_far"])
        order = slice(None) if side == "left" else slice(None, None, -1)
        np.testing.assert_allclose(arc[[0, -1]][order], ends, atol=ROUNDING)
        # Outside the area, 9.15 m from the mark; the middle is 20.15 m from the goal line.
        assert np.all(inward * arc[1:-1, 0] > -36.0)
        radius = np.linalg.norm(arc[:, :2] - standard.points[f"penalty_mark_{side}"][:2], axis=1)
        np.testing.assert_allclose(radius, 9.15, atol=ROUNDING)
        assert np.abs(arc[:, 0]).min() == pytest.approx(52.5 - 20.15, abs=0.01)


SIDES_OF_Y, BOTH = ("near", "far"), {"length", "width"}


def test_surveyed_points_replace_nominal_ones_and_carry_their_markings():
    spec = PitchSpec(
        points={"corner_left_near": (-52.4, -33.9, -0.15), "penalty_mark_left": (-41.4, 0.1, 0.02)}
    )
    template = PitchTemplate.from_spec(spec)
    assert template.points["corner_left_near"].tolist() == [-52.4, -33.9, -0.15]
    line = marking(template, "touch_line_near")
    np.testing.assert_allclose(line[0], [-52.4, -33.9, -0.15], atol=ROUNDING)
    np.testing.assert_allclose(line[-1], [52.5, -34.0, -0.2], atol=ROUNDING)
    # Halfway the line has half of the corner's offset from the crown.
    offset = -0.15 - float(template.height(-52.4, -33.9))
    middle = line[len(line) // 2]
    share = (middle[0] - 52.5) / (-52.4 - 52.5)
    assert middle[2] == pytest.approx(
        float(template.height(middle[0], middle[1])) + share * offset, abs=1e-12
    )
    arc = marking(template, "penalty_arc_left")
    np.testing.assert_allclose(np.linalg.norm(arc[:, :2] - [-41.4, 0.1], axis=1), 9.15, atol=1e-12)
    # The mark lies 0.02 m above the axis, and so does the whole arc above the crown.
    above = arc[:, 2] - template.height(arc[:, 0], arc[:, 1])
    np.testing.assert_allclose(above, 0.02 + 0.2 * (0.1 / 34.0) ** 2, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "known"),
    [
        ({f"penalty_area_left_{y}_{x}" for y in SIDES_OF_Y for x in ("back", "front")}, set()),
        ({f"corner_{x}_{y}" for x in ("left", "right") for y in SIDES_OF_Y}, BOTH),
        (PitchTemplate.standard().points, BOTH | {"crown", "end_fall"}),
    ],
    ids=["one area", "corners", "all"],
)
def test_surveyed_points_say_the_dimensions_that_they_determine(standard, names, known):
    places = {name: tuple(standard.points[name]) for name in names} | {"mast": (-58.0, 12.0, 0.4)}
    found = PitchTemplate.from_spec(PitchSpec(points=places))
    assert found.assumed == standard.assumed - known


def test_further_markings_join_the_standard_ones():
    spec = PitchSpec(
        points={"hash_left": (-20.0, 5.0, 0.0), "hash_right": (20.0, 5.0, 0.0)},
        lines={"hash": LineSpec(start="hash_left", end="hash_right")},
        arcs={"center_circle": ArcSpec(center="center_mark", radius=3.0, start_angle=0.0,
                                       end_angle=math.pi)},
    )  # fmt: skip
    template = PitchTemplate.from_spec(spec)
    assert np.ptp(marking(template, "hash")[:, 0]) == pytest.approx(40.0)
    half_circle = marking(template, "center_circle")
    np.testing.assert_allclose(half_circle[[0, -1], :2], [[3.0, 0.0], [-3.0, 0.0]], atol=ROUNDING)
    assert "touch_line_far" in template.lines


def arc(center="center_mark", start=0, end=1):
    about = {"center": center, "radius": 1, "start_angle": start, "end_angle": end}
    return PitchSpec(arcs={"x": ArcSpec(**about)})


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (PitchSpec(length=105.0, width=40.0), r"room for the markings, found 105 x 40"),
        (PitchSpec(length=58.0), r"more than 58\.6 x 40\.32 m"),
        (
            PitchSpec(lines={"x": LineSpec(start="nowhere", end="center_mark")}),
            r"lines\.x: expected the name of a point, found 'nowhere'",
        ),
        (arc(center="away"), r"arcs\.x: expected the name of a point, found 'away'"),
        (arc(start=1, end=0), r"end_angle above start_angle by at most 2 pi, found 1 to 0 rad"),
        (arc(end=7), r"found 0 to 7 rad"),
    ],
)
def test_impossible_pitches_are_refused(spec, message):
    with pytest.raises(InputError, match=message):
        PitchTemplate.from_spec(spec)


def test_edges_of_mowing_stripes_have_names_on_either_half_and_no_paint(standard):
    spec = PitchSpec(crown=0.1, stripes={"spacing": 5.5})
    pitch = PitchTemplate.from_spec(spec)
    assert len(pitch.unpainted) == 18  # nine in each half of 52.5 m
    assert pitch.points["stripe_left_3_far"].tolist() == pytest.approx([-36.0, 34.0, -0.1])
    assert pitch.points["stripe_right_1_near"].tolist() == pytest.approx([47.0, -34.0, -0.1])
    line = pitch.marking_points("stripe_right_9", 1.0)
    assert line[:, 0] == pytest.approx(3.0)
    assert line[len(line) // 2].tolist() == pytest.approx([3.0, 0.0, 0.0])  # it follows the crown
    # Nothing white is expected there.
    assert pitch.white_names == standard.marking_names
    assert pitch.sample_lines(1.0).names == standard.sample_lines(1.0).names
    first = PitchTemplate.from_spec(PitchSpec(stripes={"spacing": 10.0, "first": 2.5}))
    assert [float(first.points[f"stripe_left_{n}_far"][0]) for n in (1, 5)] == [-50.0, -10.0]
    assert "stripe_left_6" not in first.unpainted  # the halfway line has its own name


def test_surface_falls_to_touch_lines_and_goal_lines():
    pitch = PitchTemplate.from_spec(PitchSpec(crown=0.2, end_fall=0.4))
    assert float(pitch.height(0.0, 0.0)) == 0.0
    assert float(pitch.height(52.5, 0.0)) == pytest.approx(-0.4)
    assert float(pitch.height(0.0, -34.0)) == pytest.approx(-0.2)
    assert pitch.points["corner_left_far"][2] == pytest.approx(-0.6)
    line = pitch.marking_points("touch_line_near", 0.5)
    assert line[:, 2] == pytest.approx(pitch.height(line[:, 0], line[:, 1]))


def test_another_surface_moves_all_but_surveyed_heights():
    points = {
        "corner_left_far": (-52.5, 34.0, -0.3),
        "mast": (-60.0, 0.0),
        "corner_left_near": (-52.5, -34.0),
    }
    spec = PitchSpec(crown=0.2, points=points)
    moved = PitchTemplate.from_spec(spec).with_surface([0.1, 0.3])
    made = PitchTemplate.from_spec(spec.model_copy(update={"crown": 0.1, "end_fall": 0.3}))
    for name, place in made.points.items():
        assert moved.points[name] == pytest.approx(place, abs=1e-12)
    assert moved.points["corner_left_far"][2] == -0.3
    assert moved.by_surface(["corner_left_far", "corner_left_near"]).tolist() == [[0, 0], [-1, -1]]


@pytest.mark.parametrize("spacing", [0.0, -1.0, math.nan])
@pytest.mark.parametrize("name", ["halfway_line", "center_circle", "crossbar_left"])
def test_samples_need_a_positive_spacing(standard, name, spacing):
    with pytest.raises(InputError, match="expected a positive distance"):
        standard.marking_points(name, spacing)
    assert len(standard.marking_points(name, math.inf)) >= 2  # the ends alone


@pytest.mark.parametrize("surface", [[math.nan, 0.0], [0.1, math.inf], [0.1], 0.1])
def test_a_surface_is_two_finite_numbers(standard, surface):
    with pytest.raises(InputError, match="a finite crown and end fall"):
        standard.with_surface(surface)


def test_derivatives_of_samples_are_those_of_their_heights():
    pitch = PitchTemplate.from_spec(PitchSpec(points={"corner_right_near": (52.5, -34.0, -0.1)}))
    change = np.array([-0.05, 0.25])
    other = pitch.with_surface(pitch.surface + change)
    here, there = (each.sample_lines(1.0).points_world[:, 2] for each in (pitch, other))
    assert there - here == pytest.approx(pitch.samples_by_surface(1.0) @ change, abs=1e-12)


MATCH = match_spec(["cam"])


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


def test_the_second_penalty_mark_of_the_smallest_court_lies_in_its_centre_circle():
    small = PitchTemplate.from_spec(PitchSpec(template="futsal", length=25.0, width=16.0))
    assert small.points["second_penalty_mark_right"].tolist() == [2.5, 0.0, 0.0]  # circle: 3 m
    # Twice the 10 m of the mark, and the areas' front edges at 6 m with the 3 m of the circle.
    for marks, least in (({}, "20"), ({"second_penalty_mark_distance": 0.0}, "18")):
        spec = PitchSpec(template="futsal", length=18.0, width=16.0, dimensions=marks)
        with pytest.raises(InputError, match=f"more than {least} x"):
            PitchTemplate.from_spec(spec)


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
