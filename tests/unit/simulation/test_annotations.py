import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, CalibrationErrors
from worldpose.simulation.annotations import BORDER, PIVOT, add_calibration_errors, click, every
from worldpose.simulation.scene import look_at, place_camera
from worldpose.simulation.settings import ClickSettings

PITCH = PitchTemplate.standard()
NOBODY = np.empty((0, 17, 3))


@pytest.fixture(scope="module")
def camera():
    """Sees the left half of the pitch from the near stand."""
    return Camera(
        focal=np.array([1500.0, 1500.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
        cam_from_world=look_at(np.array([-30.0, -70.0, 22.0]), np.array([-32.0, 0.0, 0.0]), 0.0),
        image_size=np.array([1920, 1080]),
    )


def clicked(camera, seed, people=NOBODY, *, clustered=False, mistaken=False, **settings):
    return click(
        camera,
        PITCH,
        people,
        ClickSettings(**settings),
        clustered=clustered,
        mistaken=mistaken,
        rng=np.random.default_rng(seed),
    )


def offsets(camera, clicks):
    """Pixels from the named points to where they were clicked, (points, 2)."""
    names = [point.name for point in clicks.markings.points]
    found = np.array([point.xy for point in clicks.markings.points]).reshape(-1, 2)
    return found - camera.project(PITCH.positions(names))


def test_clicks_are_as_many_and_as_exact_as_stated(camera):
    errors = []
    for seed in range(20):
        clicks = clicked(camera, seed)
        assert 8 <= len(clicks.markings.points) <= 12
        assert len({point.name for point in clicks.markings.points}) == len(clicks.markings.points)
        assert not clicks.markings.drawn
        assert not clicks.wrong
        errors.append(offsets(camera, clicks).ravel())
    # Some 400 numbers: the spread is known to 3.5 %; the rounding to 0.01 px does not show.
    assert np.std(np.concatenate(errors)) == pytest.approx(1.0, rel=0.1)


def test_nobody_clicks_what_is_out_of_the_picture(camera):
    for seed in range(10):
        xy = np.array([point.xy for point in clicked(camera, seed, noise_px=0.0).markings.points])
        assert (xy >= BORDER - 0.01).all()
        assert (xy <= np.array([1919.0, 1079.0]) - BORDER + 0.01).all()


def test_all_clicks_of_a_clustered_camera_lie_in_a_third_of_the_picture(camera):
    for seed in range(20):
        clicks = clicked(camera, seed, clustered=True, noise_px=0.0)
        x = [point.xy[0] for point in clicks.markings.points]
        assert 5 <= len(x) <= 7
        assert np.ptp(x) <= 0.34 * 1920.0 + 0.01
        assert clicks.clustered


def test_a_mistake_is_one_click_named_for_another_or_far_off_and_the_truth_says_which(camera):
    kinds = set()
    for seed in range(30):
        clicks = clicked(camera, seed, mistaken=True, noise_px=0.0)
        far = np.linalg.norm(offsets(camera, clicks), axis=-1)
        # Clicks are written to a hundredth of a pixel.
        assert (far > 0.02).sum() == 1
        (wrong,) = clicks.wrong
        assert clicks.markings.points[int(np.argmax(far))].name == wrong
        assert far.max() > 19.9
        kinds.add(clicks.wrong[wrong] == wrong)
        if clicks.wrong[wrong] != wrong:
            xy = clicks.markings.points[int(np.argmax(far))].xy
            there = camera.project(PITCH.positions([clicks.wrong[wrong]]))[0]
            np.testing.assert_allclose(xy, there, atol=0.0051)
    assert kinds == {True, False}


def test_points_behind_somebody_are_not_clicked(camera):
    spot = PITCH.points["penalty_mark_left"]
    before = spot + 0.02 * (camera.center - spot)
    # A wall of joints from the ground to 2 m, half a metre wide, between camera and spot.
    wall = before + np.linspace(-1.0, 1.0, 17)[:, None] * np.array([0.25, 0.0, 1.0])
    behind = wall + 0.1 * (spot - camera.center)
    names = {point.name for point in clicked(camera, 1, points=(40, 40)).markings.points}
    hidden = clicked(camera, 1, wall[None], points=(40, 40)).markings.points
    assert names - {point.name for point in hidden} == {"penalty_mark_left"}
    others = clicked(camera, 1, behind[None], points=(40, 40)).markings.points
    assert "penalty_mark_left" in {point.name for point in others}


def test_lines_are_drawn_where_points_are_few(camera):
    clicks = clicked(camera, 2, enough=100, noise_px=0.0)
    names = {marking.name for marking in clicks.markings.drawn}
    assert {"penalty_area_left_front", "goal_line_left", "center_circle"} <= names
    assert "goal_line_right" not in names
    samples = PITCH.sample_lines(0.02)
    for marking in clicks.markings.drawn:
        assert 2 <= len(marking.xy) <= 8
        line = samples.points_world[samples.marking == samples.names.index(marking.name)]
        gap = np.linalg.norm(camera.project(line) - np.array(marking.xy)[:, None], axis=-1)
        # Samples 2 cm apart are up to half a pixel apart at 30 px per metre.
        assert gap.min(axis=1).max() < 0.5


def test_a_camera_that_sees_no_pitch_gets_no_clicks():
    up = Camera(
        focal=np.array([1500.0, 1500.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=look_at(np.array([0.0, 70.0, 20.0]), np.array([0.0, 200.0, 30.0]), 0.0),
        image_size=np.array([1920, 1080]),
    )
    for clustered in (True, False):
        clicks = clicked(up, 0, clustered=clustered, mistaken=True)
        assert not clicks.markings.points
        assert not clicks.markings.drawn
        assert not clicks.wrong


def test_no_click_is_all_that_is_off_a_line(camera):
    for seed in range(20):
        for clustered in (True, False):
            clicks = clicked(camera, seed, points=(5, 5), clustered=clustered)
            plan = PITCH.positions([point.name for point in clicks.markings.points])[:, :2]
            for one in range(len(plan)):
                rest = np.delete(plan, one, axis=0)
                assert np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)[1] > 2.0


@pytest.mark.parametrize("start", [0.0, 0.37, 0.99])
def test_one_in_five_is_exactly_one_of_every_five(start):
    picked = [every(0.2, index, start) for index in range(100)]
    assert all(sum(picked[first : first + 5]) == 1 for first in range(96))
    assert not any(every(0.0, index, start) for index in range(100))
    assert all(every(1.0, index, start) for index in range(100))


RIG = SCENARIOS["match"].rig


@pytest.fixture(scope="module")
def cameras():
    rngs = [np.random.default_rng(i) for i in range(18)]
    return {
        f"cam{i:02d}": place_camera(RIG, i, np.zeros(3), PitchSpec(), rng)
        for i, rng in enumerate(rngs)
    }


def misjudged(cameras, seed=0, **errors):
    return add_calibration_errors(cameras, CalibrationErrors(**errors), np.random.default_rng(seed))


def angles(cameras, given):
    turned = [
        given[name].cam_from_world.rotation @ camera.cam_from_world.rotation.T
        for name, camera in cameras.items()
    ]
    return np.arccos(np.clip([(np.trace(turn) - 1.0) / 2.0 for turn in turned], -1.0, 1.0))


def test_no_errors_give_the_true_cameras(cameras):
    for name, camera in misjudged(cameras).items():
        assert camera is cameras[name]


def test_rotations_err_as_stated_about_an_unmoved_center(cameras):
    given = misjudged(cameras, rotation_rad=0.001)
    # 18 angles, chi with 3 degrees of freedom: mean 1.6 of the spread per axis, give or take 10 %.
    assert angles(cameras, given).mean() == pytest.approx(0.0016, rel=0.35)
    for name, camera in given.items():
        np.testing.assert_allclose(camera.center, cameras[name].center, atol=1e-9)
        np.testing.assert_array_equal(camera.focal, cameras[name].focal)


def test_a_wrong_center_keeps_the_middle_of_the_picture(cameras):
    given = misjudged(cameras, center_m=0.5)
    shifts = [np.linalg.norm(given[n].center - camera.center) for n, camera in cameras.items()]
    assert np.mean(shifts) == pytest.approx(0.8, rel=0.35)  # 1.6 spreads again
    for name, camera in cameras.items():
        pivot = camera.center + PIVOT * camera.cam_from_world.rotation[2]
        before, after = camera.project(pivot[None]), given[name].project(pivot[None])
        np.testing.assert_allclose(after, before, atol=1e-6)
        # Rounding aside it is still a rotation.
        rotation = given[name].cam_from_world.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_focal_lengths_err_relatively(cameras):
    given = misjudged(cameras, focal=0.01)
    off = [given[name].focal[0] / camera.focal[0] - 1.0 for name, camera in cameras.items()]
    assert np.std(off) == pytest.approx(0.01, rel=0.5)  # 18 draws


def test_bad_cameras_are_as_many_and_as_bad_as_stated(cameras):
    usual = angles(cameras, misjudged(cameras, rotation_rad=0.0001))
    some = angles(cameras, misjudged(cameras, rotation_rad=0.0001, bad_cameras=3, bad_factor=100.0))
    ratio = some / usual
    assert np.sort(ratio)[-3:] == pytest.approx(100.0, rel=0.01)
    assert np.sort(ratio)[:-3] == pytest.approx(1.0, rel=0.01)
