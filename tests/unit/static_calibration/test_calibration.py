import clicking_people as people
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.evidence import gather_evidence, has_enough_points
from worldpose.static_calibration.initialization import camera_from_homography
from worldpose.static_calibration.settings import StaticCalibrationSettings

PITCH, SIZE = people.PITCH, people.SIZE


def of(clicked, **settings):
    return calibrate_camera(PITCH, clicked, SIZE, settings=StaticCalibrationSettings(**settings))


# Degenerate input first.


@pytest.mark.parametrize(
    ("clicked", "message"),
    [
        (ClickedMarkings(), "found none"),
        (people.points({"center_mark": (1950.0, 10.0)}), "1950"),
        (people.points({"centre_mark": (10.0, 10.0)}), r"'centre_mark'.*center_mark"),
        (ClickedMarkings(points=people.points({"center_mark": (9.0, 9.0)}).points * 2), "2 times"),
    ],
    ids=["nothing", "off the image", "unknown name", "twice"],
)
def test_clicks_that_no_image_has_are_refused(clicked, message):
    with pytest.raises(InputError, match=message):
        of(clicked)


def test_three_points_are_too_few_and_the_message_names_others():
    camera, _ = people.seat(0)
    three = dict(list(people.visible(camera).items())[:3])
    with pytest.raises(
        InputError,
        match=r"4 clicked points.*Click further points, far from the others, for example \w+",
    ):
        of(people.points(three))


def test_points_on_one_line_are_an_error_and_the_message_names_points_off_it():
    names = [name for name in PITCH.points if "left" in name and name.endswith("back")]
    seen = {name: (400.0 + 90.0 * i, 300.0 + 50.0 * i) for i, name in enumerate(names)}
    assert len(seen) == 4
    with pytest.raises(InputError, match="all on one line") as error:
        of(people.points(seen))
    # No requested point lies on a goal line.
    assert "back" not in error.value.todo


@pytest.mark.parametrize(
    ("names", "enough"),
    [
        (("backboard_left_near_top", "backboard_left_far_top", "restricted_area_left_near_back",
          "restricted_area_left_far_back"), True),
        (("halfway_near", "halfway_far", "center_mark", "center_circle_near"), False),
    ],
)  # fmt: skip
def test_points_of_a_hall_are_off_one_line_by_its_size_and_by_their_heights(names, enough):
    hall = PitchTemplate.from_spec(PitchSpec(template="basketball"))
    clicked = people.points({name: (400.0 + n, 300.0) for n, name in enumerate(names)})
    assert has_enough_points(gather_evidence(hall, clicked, SIZE, 0.5, "here")) is enough


def test_corners_and_only_the_line_through_them_do_not_determine_a_camera():
    camera, rng = people.seat(9)
    two = people.visible(camera, ["penalty_area_left_near_back", "goal_area_left_far_back"])
    clicked = people.points(two)
    drawn = people.draw(camera, ["goal_line_left"], rng)
    with pytest.raises(InputError, match=r"leave \d of its 7 degrees of freedom open"):
        of(ClickedMarkings(points=clicked.points, drawn=drawn))


def test_left_and_right_exchanged_is_told_from_wrong_clicks():
    camera, _ = people.seat(1)
    swap = {"left": "right", "right": "left"}
    seen = {
        "_".join(swap.get(part, part) for part in name.split("_")): xy
        for name, xy in people.visible(camera).items()
    }
    with pytest.raises(InputError, match="only with left and right exchanged"):
        of(people.points(seen))


# Known truth.


@pytest.mark.parametrize("index", [0, 9])
def test_exact_clicks_give_the_camera_back(index):
    camera, _ = people.seat(index)
    seen = people.visible(camera)
    result = of(people.points(seen), click_noise_px=1e-4, survey_error_m=0.0)
    # The prior pulls by (noise / spread)^2: with clicks of 0.1 thousandth of a pixel, nothing.
    np.testing.assert_allclose(result.estimate.camera.center, camera.center, atol=2e-2)
    np.testing.assert_allclose(result.estimate.camera.focal, camera.focal, rtol=2e-4)
    places = people.on_the_pitch(np.random.default_rng(0))
    assert people.ground_errors(result.estimate.camera, camera, places).max() < 5e-3


def test_a_marking_under_another_ones_name_is_named_and_left_out():
    camera, rng = people.seat(1)
    drawn = list(people.draw(camera, list(PITCH.lines), rng, noise=0.5))
    wrong = next(i for i, m in enumerate(drawn) if m.name.startswith("goal_area"))
    other = next(m for m in drawn if m.name.startswith("touch_line"))
    drawn[wrong] = drawn[wrong].model_copy(update={"xy": other.xy})
    result = of(ClickedMarkings(drawn=tuple(drawn)))
    assert result.report.wrong == (drawn[wrong].name,)
    assert f"{drawn[wrong].name} left out: its pixels lie on {other.name}" in str(
        result.report.decisions
    )


def test_a_wrong_click_is_found_and_no_other():
    found = others = 0
    for index in range(12):
        camera, rng = people.seat(index, seed=5)
        clicks = people.click(camera, rng, count=11, wrong=rng.uniform(20.0, 80.0))
        wrong = of(clicks.clicked).report.wrong
        found += clicks.first in wrong
        others += len(set(wrong) - {clicks.first})
    # A click whose place nothing else tells, such as a lone far corner, cannot be judged.
    assert found >= 11
    assert others <= 1


@given(
    focal=st.floats(900, 6000),
    x=st.floats(-40, 40),
    height=st.floats(8, 40),
    aim=st.floats(-40, 40),
    roll=st.floats(-0.05, 0.05),
)
def test_the_camera_in_an_exact_homography_is_found(focal, x, height, aim, roll):
    camera = people.pinhole((x, -70.0, height), (aim, 3.0, 0.0), focal, people.SIZE, roll=roll)
    pose = camera.cam_from_world
    middle = camera.principal_point
    k = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    homography = -3.0 * k @ np.column_stack([pose.rotation[:, :2], pose.translation])
    found = camera_from_homography(homography, people.SIZE, middle, (300.0, 20000.0))
    np.testing.assert_allclose(found.focal, focal, rtol=1e-6)
    np.testing.assert_allclose(found.center, camera.center, rtol=1e-5, atol=1e-5)
