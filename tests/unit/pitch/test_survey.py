"""A pitch with known truth, surveyed in other frames, comes back; a wrong survey is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.pitch.survey import Survey, SurveySettings, fit_survey, read_survey
from worldpose.pitch.template import PitchTemplate

TRUE = PitchSpec(length=101.3, width=66.2, crown=0.31)
CORNERS = [f"corner_{side}_{end}" for side in ("left", "right") for end in ("near", "far")]
NAMES = (
    *CORNERS,
    "center_mark",
    "halfway_near",
    "halfway_far",
    "goal_post_left_near_top",
    *(f"penalty_area_{s}_{e}_front" for s in ("left", "right") for e in ("near", "far")),
    "penalty_mark_left",
)


def surveyed(
    pitch=TRUE, names=NAMES, angle=0.0, shift=(0.0, 0.0, 0.0), slope=(0.0, 0.0), noise=0.0, seed=0
):
    """The pitch in another frame: tilted by a slope along its own axes, turned, shifted."""
    places = PitchTemplate.from_spec(pitch).positions(names)
    normal = np.array([-slope[0], -slope[1], 1.0])
    normal /= np.linalg.norm(normal)
    # The smallest rotation that takes z to the normal of the sloping plane.
    axis = np.cross([0.0, 0.0, 1.0], normal)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    tilt = np.eye(3) + cross + cross @ cross / (1.0 + normal[2])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = places @ tilt.T @ turn.T + shift
    moved += np.random.default_rng(seed).normal(0.0, noise, moved.shape)
    return Survey("survey.csv", tuple(names), moved)


def points(fit):
    return np.array([fit.pitch.points[name] for name in fit.names])


# A grid's zone, a pitch that falls by 0.6 %; places are rounded to 0.1 mm in the record.
@pytest.mark.parametrize(("angle", "slope"), [(0.0, (0.0, 0.0)), (-2.5, (0.006, -0.003))])
def test_an_exact_survey_in_any_frame_gives_the_pitch_back(angle, slope):
    fit = fit_survey(surveyed(angle=angle, shift=(512345.6, 5345678.9, 517.25), slope=slope))
    assert fit.pitch.length == pytest.approx(TRUE.length, abs=1e-3)
    assert fit.pitch.width == pytest.approx(TRUE.width, abs=1e-3)
    # Slope and crown are held by priors of 1 % and 0.1 m against 0.03 m of the marks.
    assert fit.pitch.crown == pytest.approx(TRUE.crown, abs=5e-3)
    assert fit.slope == pytest.approx(slope, abs=2e-4)
    assert fit.scale == pytest.approx(1.0, abs=1e-4)
    assert fit.measured == ("length", "width", "crown")
    truth = PitchTemplate.from_spec(TRUE).positions(NAMES)
    np.testing.assert_allclose(points(fit), truth, atol=8e-3)
    assert PitchTemplate.from_spec(fit.pitch).positions(NAMES) == pytest.approx(points(fit))


@settings(max_examples=5)
@given(angle=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_a_noisy_survey_keeps_its_own_distances(angle, seed):
    survey = surveyed(angle=angle, noise=0.02, seed=seed, shift=(10.0, -20.0, 3.0))
    fit = fit_survey(survey)
    ours, theirs = points(fit), survey.places
    # Rigid: nothing is stretched, whatever the residuals; 0.1 mm is the record's rounding.
    distances = [np.linalg.norm(each[:, None] - each, axis=-1) for each in (ours, theirs)]
    np.testing.assert_allclose(*distances, atol=5e-4)
    # Five standard deviations, of which the next test tells.
    assert fit.pitch.length == pytest.approx(TRUE.length, abs=0.065)
    assert fit.pitch.width == pytest.approx(TRUE.width, abs=0.082)
    assert 0.005 < np.sqrt(np.mean(fit.offset_plan**2)) < 0.06


def test_a_left_handed_frame_is_refused_unless_it_is_said():
    survey = surveyed(angle=0.7)
    survey = Survey(survey.where, survey.names, survey.places * (1.0, -1.0, 1.0))
    with pytest.raises(InputError, match=r"mirror image.*left and right.*left-handed"):
        fit_survey(survey)
    fit = fit_survey(survey, SurveySettings(left_handed=True))
    assert fit.pitch.length == pytest.approx(TRUE.length, abs=1e-3)
    with pytest.raises(InputError, match="right-handed"):
        fit_survey(surveyed(), SurveySettings(left_handed=True))


@pytest.mark.parametrize(("unit", "said"), [(1 / 0.9144, "yards"), (1e3, "")])
def test_other_units_are_named(unit, said):
    survey = surveyed()
    with pytest.raises(InputError, match=f"times the true length.*{said}") as caught:
        fit_survey(Survey("survey.csv", survey.names, survey.places * unit))
    assert caught.value.expected == "metres"


@pytest.mark.parametrize(
    ("template", "size"),
    [("football", (70.0, 50.0)), ("football", (64.0, 45.0)), ("futsal", (25.0, 16.0))],
)
def test_a_full_survey_of_a_small_pitch_is_in_metres(template, size):
    true = PitchTemplate.from_spec(PitchSpec(template=template, length=size[0], width=size[1]))
    places = true.positions(list(true.points)) @ [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0, 0, 1.0]]
    fit = fit_survey(Survey("survey.csv", tuple(true.points), places, template))
    assert (fit.pitch.length, fit.pitch.width) == pytest.approx(size, abs=1e-3)
    assert fit.scale == pytest.approx(1.0, abs=1e-4)
    # Two thirds of the usual pitch is another unit: its penalty areas are smaller than prescribed.
    usual = PitchTemplate.from_spec(PitchSpec(template=template))
    places = usual.positions(list(usual.points)) * 0.65
    with pytest.raises(InputError, match=r"of the true length"):
        fit_survey(Survey("survey.csv", tuple(usual.points), places, template))
    # Four corners do not tell.
    corners = true.positions(CORNERS)
    with pytest.raises(InputError, match=r"0\.\d+ of the true length.*Corners alone"):
        fit_survey(Survey("survey.csv", tuple(CORNERS), corners, template))


def test_the_scale_is_reported_and_taken_out_on_request():
    survey = surveyed()
    grid = Survey("survey.csv", survey.names, survey.places * 1.0004)
    fit = fit_survey(grid)
    assert fit.scale == pytest.approx(1.0004, abs=5e-5)
    # Rigid, the penalty areas take a part of the 4 cm: they keep their prescribed size.
    assert fit.pitch.length == pytest.approx(TRUE.length * 1.0004, abs=0.01)
    fit = fit_survey(grid, SurveySettings(fit_scale=True))
    assert fit.pitch.length == pytest.approx(TRUE.length, abs=5e-3)


@pytest.mark.parametrize(
    "names",
    [
        (),
        CORNERS[:3],
        ("halfway_near", "center_circle_near", "center_mark", "center_circle_far", "halfway_far"),
    ],
)
def test_too_few_points_or_a_line_of_them_are_refused(names):
    survey = surveyed(names=names) if names else Survey("survey.csv", (), np.zeros((0, 3)))
    with pytest.raises(InputError, match="at least four points"):
        fit_survey(survey)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("separator", [";", "\t", ","])
def test_a_file_is_read_as_spreadsheets_save_it(tmp_path, encoding, separator):
    sign = "." if separator == "," else ","
    rows = [["Point", "X (m)", "y", "Elevation [m]"], ["center_mark", "1.5", "-2", "0.25"]]
    text = "\r\n".join(separator.join(row) for row in rows).replace(".", sign)
    path = tmp_path / "survey.csv"
    hinted = f"sep={separator}\r\n" + text.replace("\r\n", 2 * separator + "\r\n")
    quoted = '"Point","x","y","z"\n"center_mark","1,5","-2","0,25"'
    for content in (text, hinted, quoted):  # Excel's hint, and its empty columns
        path.write_bytes((content + "\r\n").encode(encoding))
        np.testing.assert_array_equal(read_survey(path).places, [[1.5, -2.0, 0.25]])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"name;x;y\ncenter_mark;1,5;1.234\n", "a point and numbers with a comma"),
        (b"PK\x03\x04 name", "a damaged or locked archive"),
        (b"name,x [mm],y\ncenter_mark,1,2\n", "row 1"),
    ],
)
def test_other_tables_are_refused(tmp_path, content, words):
    (tmp_path / "survey.csv").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_survey(tmp_path / "survey.csv")


def test_a_file_is_read_by_its_header(tmp_path):
    path = tmp_path / "survey.csv"
    path.write_text(
        "Northing;Easting;Name;Height\n"
        "20;10;corner_left_near;1.5\n"
        "21;11;halfway_line.end;\n"
        "\n"
        "22;12;touch_line_near.end;-2\n"
    )
    survey = read_survey(path)
    assert survey.names == ("corner_left_near", "halfway_far", "corner_right_near")
    np.testing.assert_array_equal(survey.places, [[10, 20, 1.5], [11, 21, np.nan], [12, 22, -2]])
    path.write_text("name,x,y\ncenter_mark,1,2\n")
    np.testing.assert_array_equal(read_survey(path).places, [[1, 2, np.nan]])


@pytest.mark.parametrize(
    ("text", "place", "told"),
    [
        ("", "", "nothing"),
        ("name,x,y,easting\n", "row 1", "columns name, x, y"),
        ("name,x,y\ncenter_mrk,1,2\n", "row 2: name", "Did you mean 'center_mark'"),
        ("name,x,y\ncenter_mark,1,2\ncenter_mark,1,2\n", "row 3: name", "again"),
        (
            "name,x,y\ncorner_left_near,1,2\ntouch_line_near.start,1,2\n",
            "row 3: name",
            "which is corner_left_near again",
        ),
        ("name,x,y\ncenter_mark,1\n", "row 2", "3 columns"),
        ('name,x,y\ncenter_mark,"1,500",2\n', "row 2: x", "'1,500'"),  # or 1500
        ("name,x,y\ncenter_mark,nan,2\n", "row 2: x", "number"),
    ],
)
def test_a_wrong_file_is_refused_by_row(tmp_path, text, place, told):
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"survey\.csv") as caught:
        read_survey(path)
    assert caught.value.where == (f"{path}: {place}" if place else str(path))
    assert told in str(caught.value)
