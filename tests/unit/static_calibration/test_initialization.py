import clicking_people as people
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.evidence import gather_evidence
from worldpose.static_calibration.initialization import (
    camera_from_homography,
    homographies,
    plane_from_image,
)

SIZE = people.SIZE
MIDDLE = np.array([959.5, 539.5])
FLAT = PitchTemplate.from_spec(PitchSpec(crown=0.0))


def pinhole(focal=2100.0, center=(10.0, -60.0, 22.0), aim=(15.0, 0.0, 0.0), roll=0.01):
    return people.pinhole(center, aim, focal, SIZE, roll=roll)


def test_points_on_one_line_give_no_homography():
    plane = np.stack([np.linspace(0, 10, 6), np.zeros(6)], axis=1)
    pixels = np.stack([np.linspace(0, 900, 6), np.full(6, 500.0)], axis=1)
    none = np.empty((0, 2)), np.empty((0, 3))
    assert plane_from_image(pixels, plane, *none, 1000.0, MIDDLE) is None


def test_four_lines_alone_give_the_homography():
    camera = pinhole(focal=1300.0)
    names = [f"penalty_area_right_{part}" for part in ("front", "near", "far")]
    lines, pixels = [], []
    for name in (*names, "touch_line_far", "halfway_line"):
        ends = FLAT.marking_points(name, 500.0)
        along = (ends[-1] - ends[0])[:2] / np.linalg.norm(ends[-1] - ends[0])
        normal = np.array([-along[1], along[0]])
        for share in (0.2, 0.7):
            pixels.append(camera.project((ends[0] + share * (ends[-1] - ends[0]))[None])[0])
            lines.append([*normal, -normal @ ends[0, :2]])
    found = plane_from_image(
        np.empty((0, 2)), np.empty((0, 2)), np.array(pixels), np.array(lines), 1000.0, MIDDLE
    )
    corner = camera.project(FLAT.positions(["penalty_area_right_far_front"]))[0]
    place = found @ [*corner, 1.0]
    # Exact pixels: what is left is rounding through a 9 x 9 system.
    np.testing.assert_allclose(place[:2] / place[2], [36.0, 20.16], atol=1e-6)


@given(
    focal=st.floats(900, 6000),
    x=st.floats(-40, 40),
    height=st.floats(8, 40),
    aim=st.floats(-40, 40),
    roll=st.floats(-0.05, 0.05),
)
def test_the_camera_in_an_exact_homography_is_found(focal, x, height, aim, roll):
    camera = pinhole(focal, (x, -70.0, height), (aim, 3.0, 0.0), roll)
    pose = camera.cam_from_world
    k = np.array([[focal, 0, MIDDLE[0]], [0, focal, MIDDLE[1]], [0, 0, 1]])
    homography = -3.0 * k @ np.column_stack([pose.rotation[:, :2], pose.translation])
    found = camera_from_homography(homography, SIZE, MIDDLE, (300.0, 20000.0))
    np.testing.assert_allclose(found.focal, focal, rtol=1e-6)
    np.testing.assert_allclose(found.center, camera.center, rtol=1e-5, atol=1e-5)


def test_a_view_straight_down_takes_the_focal_length_from_its_range():
    homography = np.array([[20.0, 0.0, 960.0], [0.0, -20.0, 540.0], [0.0, 0.0, 1.0]])
    found = camera_from_homography(homography, SIZE, MIDDLE, (1000.0, 4000.0))
    assert 1000.0 <= found.focal[0] <= 4000.0
    assert found.center[2] > 0.0


def test_two_wrong_clicks_of_nine_do_not_bend_the_homography():
    camera = pinhole()
    seen = dict(list(people.visible(camera).items())[:9])
    names = list(seen)
    for name in names[:2]:
        seen[name] = seen[name] + np.array([150.0, -90.0]) * np.where(seen[name] < 600, 1, -1)
    evidence = gather_evidence(FLAT, people.points(seen), SIZE, 0.5, "test")
    best = homographies(evidence, SIZE, 10.0, leave_out=False)[0]
    place = best @ np.append(FLAT.points[names[5]][:2], 1.0)
    # The crown is not in the flat homography: it moves pixels by up to 5.
    assert np.linalg.norm(place[:2] / place[2] - seen[names[5]]) == pytest.approx(0.0, abs=6.0)
