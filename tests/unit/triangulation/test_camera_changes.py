"""Cameras that are knocked, sway, or lose frames within a clip: which one, when and how much."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from running_samples import FPS, detections, runner

from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import HEALTH_MEASURES, CameraChange
from worldpose.camera_consistency.health import CameraHealth, judge_health, measure_health
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.camera_changes import (
    correct_views,
    find_changes,
    join_changes,
    move_on,
    refine_change,
    sum_clip,
)
from worldpose.triangulation.change_parts import Part, find_sway, fit_parts
from worldpose.triangulation.change_sums import ChangeSums
from worldpose.triangulation.clock_courses import add_slow_drifts, shift_by_courses, trace_clocks
from worldpose.triangulation.clocks import triangulate_views
from worldpose.triangulation.lost_views import find_lone_views, find_lost_views
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.settings import TriangulationSettings

FRAMES = 240
BAD = 2
SETTINGS = TriangulationSettings()


@pytest.fixture
def cameras(ring):
    return ring(4)


def view(cameras, spoil):
    """People as the cameras see them, with the pixels of one camera changed by `spoil`."""
    pixels, confidence, index = detections(cameras, runner(FRAMES + 10, 3), 1.0)
    frame = np.arange(FRAMES + 10)[:, None, None]
    changed = spoil(pixels[:, BAD], frame, cameras[BAD])
    pixels = pixels[:FRAMES]
    pixels[:, BAD] = changed[:FRAMES]
    frame = np.arange(FRAMES)
    return KeypointDetections.from_keypoints(pixels, confidence[:FRAMES], index[:FRAMES], frame)


def explain(cameras, people):
    rows = np.arange(FRAMES)
    sums = sum_clip(cameras, people, FPS, rows, settings=SETTINGS)
    return find_changes(cameras, people, FPS, rows, sums)


def measure(cameras, people, stated=None, **frames):
    """Health of the cameras over time, and in which share of it each one is bad."""
    health = CameraHealth.empty(FRAMES, len(cameras.focal), people.detection_index.shape[2], FPS)
    health.add(
        cameras, people, triangulate_views(Rig.from_cameras(cameras), people, SETTINGS), 0, stated
    )
    sums = sum_clip(cameras, people, FPS, np.arange(FRAMES), settings=SETTINGS)
    departures = sums.departures(cameras, len(health.sums), health.length)
    values = measure_health(health, departures, frames)
    return dict(zip(HEALTH_MEASURES, np.moveaxis(values, -1, 0), strict=True)), (
        judge_health(values) > 1.0
    ).mean(axis=0)


def test_health_over_time_shows_a_knock_and_lost_frames_and_no_healthy_camera(cameras):
    healthy, bad = measure(cameras, view(cameras, lambda pixels, *_: pixels))
    assert np.nanmax(healthy["misfit"]) < 2.0
    assert np.nanmax(np.abs(healthy["clock_frames"])) < 0.3
    assert (bad == 0.0).all()
    knocked, bad = measure(cameras, view(cameras, knock(90.0, 40.0)))
    half = len(knocked["misfit"]) // 2
    assert 0.4 < bad[BAD] < 0.6
    # The whole of it: the camera's own share in the people is taken out.
    assert np.nanmedian(knocked["shift_px"][half + 3 :, BAD]) == pytest.approx(98.5, abs=3.0)
    assert np.nanmedian(knocked["shift_px"][: half - 3, BAD]) < 2.0
    lost, _ = measure(cameras, view(cameras, lose))
    assert np.nanmedian(lost["clock_frames"][half + 3 :, BAD]) > 3.0


def test_a_camera_departs_no_farther_than_its_calibration_states(cameras):
    people = view(cameras, lambda pixels, *_: pixels + [40.0, 0.0])
    for variance, expected in ((0.0, 1.0), (40.0**2, 0.0)):
        stated = np.zeros(people.detection_index.shape)
        stated[:, BAD] = variance
        _, bad = measure(cameras, people, lambda joints, stated=stated: stated[: len(joints)])
        assert bad[BAD] == expected
    assert (bad == 0.0).all()


def test_health_counts_the_people_whom_a_camera_shows_and_has_not_found(cameras):
    people = view(cameras, lambda pixels, *_: pixels)
    joints = triangulate_views(Rig.from_cameras(cameras), people, SETTINGS)
    people.detection_index[:180, BAD, 1] = -1
    health = CameraHealth.empty(FRAMES, 4, people.detection_index.shape[2], FPS)
    health.add(cameras, people, joints, 0)
    joints[:, 1] += [0.0, 0.0, 500.0]  # out of the images
    health.add(cameras, people, joints, 0)
    expected = np.zeros_like(health.missed)
    expected[BAD, 1] = 179 / health.every
    assert health.missed == pytest.approx(expected, abs=1.0)


def test_health_tells_images_that_are_missing_dark_or_blurred(cameras):
    people = view(cameras, lambda pixels, *_: pixels)
    frame = np.arange(FRAMES)[:, None] * np.ones(4)
    frames = {
        "missing": np.where((frame >= 180) & (np.arange(4) == 0), 1.0, 0.0),
        "brightness": np.where((frame >= 120) & (frame < 144) & (np.arange(4) == 1), 30.0, 90.0),
        "sharpness": np.where((frame < 60) & (np.arange(4) == 3), 3.0, 8.0),
    }
    found, bad = measure(cameras, people, **frames)
    assert bad == pytest.approx([0.25, 0.1, 0.0, 0.25], abs=0.02)
    assert found["brightness"][[0, 13], 1] == pytest.approx([90.0, 30.0])
    assert np.isnan(found["unmatched"]).all()


def lose(pixels, *_, after=119, count=5):
    """The recorder lost frames."""
    return np.concatenate([pixels[: after + 1], pixels[after + 1 + count :]])


def fast(pixels, *_, rate=1.02):
    """Each image shows a moment 2 % later than the one before."""
    at = np.arange(FRAMES) * rate
    low = at.astype(int)
    share = (at - low)[:, None, None, None]
    return (1.0 - share) * pixels[low] + share * pixels[low + 1]


CENTER = np.array([950.0, 545.0])


def turn(camera, pixels, share, x, y):
    """A camera that turns by shares (frames, 1, 1) of a shift at its centre, by OpenCV."""
    matrix = np.array([[1500.0, 0.0, CENTER[0]], [0.0, 1500.0, CENTER[1]], [0.0, 0.0, 1.0]])
    lens, turned = camera.distortion[:5], pixels.copy()
    for k, part in enumerate(np.ravel(share)):
        plane = cv2.undistortPoints(pixels[k].reshape(-1, 1, 2), matrix, lens)[:, 0]
        rays = np.column_stack([plane, np.ones(len(plane))])
        rotation = part * np.array([-y, x, 0.0]) / 1500.0
        seen, _ = cv2.projectPoints(rays, rotation, np.zeros(3), matrix, lens)
        turned[k] = seen.reshape(pixels[k].shape)
    return turned


def knock(x, y):
    return lambda pixels, frame, camera: turn(camera, pixels, frame >= 120, x, y)


def sink(pixels, frame, camera):
    return turn(camera, pixels, frame / (FRAMES - 1), 0.0, 20.0)


@pytest.mark.parametrize(
    ("spoil", "row", "amount"),
    [
        (knock(12.0, -5.0), 120, (12.0, -5.0, 0.0, 0.0)),
        (knock(90.0, 40.0), 120, (90.0, 40.0, 0.0, 0.0)),
        (sink, None, (0.0, 20.0, 0.0, 0.0)),
        (lambda x, f, _: x + (f[..., None] >= 90) * 0.05 * (x - CENTER), 90, (0.0, 0.0, 0.05, 0.0)),
        (lose, 120, 5.0),
        (fast, None, 0.0196 * (FRAMES - 1)),
    ],
    ids=["knocked", "knocked far", "sinking", "zoomed", "lost frames", "fast clock"],
)
def test_the_changed_camera_is_named_and_measured(cameras, spoil, row, amount):
    (found,) = explain(cameras, view(cameras, spoil))
    assert found.camera == BAD
    assert found.is_explained
    assert (found.row is None) == (row is None)
    if row is not None:
        assert abs(found.row - row) <= 5
    if isinstance(amount, tuple):
        np.testing.assert_allclose(found.amount[:2], amount[:2], atol=0.6)
        np.testing.assert_allclose(found.amount[2:4], amount[2:], atol=0.005)
    else:
        assert found.amount[4] == pytest.approx(amount, abs=0.25)


def test_all_frames_tell_when_a_view_steps_between_sampled_ones(cameras):
    people = view(
        cameras, lambda pixels, frame, camera: turn(camera, pixels, frame >= 131, 30.0, 9.0)
    )
    rows = np.arange(0, FRAMES, 8)
    sums = sum_clip(cameras, people, FPS / 8, rows, settings=SETTINGS)
    (found,) = find_changes(cameras, people, FPS / 8, rows, sums, ("view",))
    assert found.camera == BAD
    assert found.row == 131
    np.testing.assert_allclose(found.amount[:2], [30.0, 9.0], atol=0.6)


@pytest.mark.parametrize(
    ("spoil", "row", "amount"),
    [
        (lambda pixels, *_: pixels, None, None),
        (knock(90.0, 40.0), 120, (90.0, 40.0, 0.0, 0.0, 0.0)),
        (partial(lose, after=99, count=9), 100, (0.0, 0.0, 0.0, 0.0, 9.0)),
    ],
    ids=["healthy", "knocked", "lost frames"],
)
def test_a_camera_whose_people_meet_nobody_is_lost(cameras, spoil, row, amount):
    people = view(cameras, spoil)
    found = find_lost_views(cameras, people, runner(FRAMES, 3), FPS)
    assert [each.camera for each in found] == [BAD] * (row is not None)
    if found:
        assert abs(found[0].row - row) <= 1
        # What is left is measured when people are tracked again.
        np.testing.assert_allclose(found[0].amount[:4], amount[:4], atol=4.0)
        np.testing.assert_allclose(found[0].amount[4], amount[4], atol=0.3)


@pytest.mark.parametrize("newcomers", [0, 1])
def test_people_whom_the_others_place_no_more_accuse_no_clock(cameras, newcomers):
    """Two stand; the others lose one in frame 150. A newcomer is hidden from the camera."""
    people = np.repeat(runner(1, 2 + newcomers), FRAMES, axis=0)
    pixels, confidence, index = detections(cameras, people, 1.0)
    joints, confidence[:, BAD, 2:] = people.copy(), 0.0
    joints[150:, 1], joints[:150, 2:] = np.nan, np.nan
    seen = KeypointDetections.from_keypoints(pixels, confidence, index, np.arange(FRAMES))
    # Before, the one who is lost stood where the camera sees him: no clock is that late.
    assert BAD not in [each.camera for each in find_lost_views(cameras, seen, joints, FPS)]


def hide(pixels, frame, _):
    """Something hides the person from frame 120 on."""
    return np.where(frame[..., None] < 120, pixels, np.nan)


@pytest.mark.parametrize(
    ("spoil", "lone"),
    [(knock(90.0, 40.0), {BAD: 120}), (hide, {}), (lambda pixels, *_: pixels, {})],
)
@pytest.mark.parametrize("bystander", [False, True])
def test_a_camera_that_meets_its_only_person_no_more_is_told(cameras, spoil, lone, bystander):
    joints, frame = runner(FRAMES, 1), np.arange(FRAMES)
    pixels, confidence, index = detections(cameras, joints, 1.0)
    pixels[:, BAD] = spoil(pixels[:, BAD], frame[:, None, None], cameras[BAD])
    if bystander:  # whom no other camera sees
        pixels, confidence = (np.repeat(each, 2, axis=2) for each in (pixels, confidence))
        pixels[:, :, 1] = np.nan
        pixels[:, BAD, 1] = pixels[0, BAD, 0] + [0.0, 300.0]
    confidence = confidence * np.isfinite(pixels[..., 0])
    seen = KeypointDetections.from_keypoints(pixels, confidence, index, frame)
    assert find_lone_views(cameras, seen, joints, FPS) == lone


@pytest.mark.parametrize(("seconds", "found"), [(2, None), (4, BAD)])
def test_one_difference_between_two_seconds_is_no_sway(cameras, seconds, found):
    def jump(pixels, frame, _):
        return pixels + 60.0 * (frame // round(FPS) % 2)[..., None] * np.array([1.0, 0.5])

    people = view(cameras, jump)[: seconds * round(FPS)]
    sums = sum_clip(cameras, people, FPS, np.arange(seconds * round(FPS)), settings=SETTINGS)
    swaying = find_sway(sums, sums, [])
    assert (None if swaying is None else swaying[0]) == found


def test_a_camera_that_sways_is_not_explained(cameras):
    def sway(pixels, frame, _):
        phase = frame[..., None] / FRAMES * 2.0 * np.pi
        return pixels + np.concatenate([30.0 * np.sin(phase), 15.0 * np.cos(phase)], axis=-1)

    (found,) = explain(cameras, view(cameras, sway))
    assert found.camera == BAD
    assert not found.is_explained


def test_clocks_that_step_are_traced_from_a_wrong_constant(cameras):
    people = view(cameras, lose)
    untracked = replace(people, detection_index=np.empty((0, 0, 0), np.int16))
    courses = trace_clocks(cameras, untracked, FPS, np.array([0.0, 0.0, 2.4, 0.0]))
    assert [len(course) for course in courses] == [1, 1, 3, 1]
    rows, values = np.array(courses[BAD]).T
    assert abs(rows[-1] - 120) <= 5
    np.testing.assert_allclose(values, [0.0, 0.0, 5.0], atol=0.15)


@pytest.mark.slow
def test_a_drift_with_a_step_and_a_step_of_another_camera_are_traced_together(cameras):
    frames, rate = 600, 1.008
    pixels, confidence, _ = detections(cameras, runner(frames + 10, 3), 1.0)
    frame = np.arange(frames)
    at = frame * rate + np.where(frame >= 370, -4.0, 0.0)  # 4 images come again
    low = at.astype(int)
    share = (at - low)[:, None, None, None]
    seen = np.array(pixels[:frames])
    seen[:, BAD] = (1.0 - share) * pixels[low, BAD] + share * pixels[low + 1, BAD]
    seen[:, 0] = pixels[frame + np.where(frame >= 200, 3, 0), 0]
    untracked = KeypointDetections.from_keypoints(seen, confidence[:frames], frame=frame)
    courses = trace_clocks(cameras, untracked, FPS, np.zeros(4))
    late = np.stack([np.interp(frame, *np.array(course).T) for course in courses])
    first, last = [50, 150, 300, 350], [400, 450, 500, 550]
    off = (late - late[1])[:, first + last]
    np.testing.assert_allclose(off[3], 0.0, atol=0.1)
    np.testing.assert_allclose(off[0], [0.0, 0.0, *[3.0] * 6], atol=0.15)
    there = np.array(first + last)
    drift = there - (there + np.repeat([0.0, 4.0], 4)) / rate
    np.testing.assert_allclose(off[BAD], drift, atol=0.2)


def test_a_drift_too_slow_to_be_traced_is_told_by_both_ends(cameras):
    people = view(cameras, partial(fast, rate=1.01))
    untracked = replace(people, detection_index=np.empty((0, 0, 0), np.int16))
    # The offsets of the ends count, also where the given one is that of another part.
    given = [[(0, 0.0)]] * 4
    courses = add_slow_drifts(given, cameras, untracked, FPS, max_offset_s=0.4)
    assert [len(course) for course in courses] == [1, 1, 2, 1]
    rows, values = np.array(courses[BAD]).T
    assert rows.tolist() == [0, FRAMES - 1]
    np.testing.assert_allclose(values, [0.0, 0.01 * FRAMES], atol=0.3)
    # Both ends of a clip of one frame are the same.
    assert add_slow_drifts(given, cameras, untracked[:1], FPS, max_offset_s=0.4) == given


def test_what_is_left_of_a_drifting_clock_is_counted_by_match_frames():
    """A camera 40 frames late that takes 0.6 % fewer images: f shows as its frame f - o(f)."""
    rows = np.arange(200.0)
    seen = KeypointDetections.from_keypoints(
        np.tile(rows[:, None, None, None, None], (1, 1, 1, 17, 2)), np.ones((200, 1, 1, 17))
    )
    course = 40.0 + 0.006 * rows
    shifted, rest = shift_by_courses(seen, [[(0, 40.0), (199, float(course[-1]))]])
    shown = shifted.keypoints[:, 0, 0, 0, 0]
    there = np.isfinite(shown)
    assert there.sum() == 160
    np.testing.assert_allclose(rest[there, 0], (shown + course - rows)[there], atol=1e-9)
    assert np.abs(rest).max() <= 0.5


CAMERA = Camera.from_matrices(
    [[1500.0, 0.0, 950.0], [0.0, 1500.0, 545.0], [0.0, 0.0, 1.0]],
    [-0.2, 0.05, 0.0, 0.0, 0.0],
    np.eye(3),
    np.zeros(3),
    (1920, 1080),
)


KNOCK = CameraChange(
    camera="b", kind="view", frame=12, first_frame=10, frame_count=4, shift_px=(3.0, -1.0), std=0.1
)


@pytest.mark.parametrize(
    ("change", "moved"),
    [
        ({}, [0.0, 0.0, 3.0, 3.0, 0.0]),
        ({"frame": None}, [0.0, 1.0, 2.0, 3.0, 0.0]),
        ({"is_explained": False}, [0.0] * 5),
        ({"is_explained": False, "is_left_out": True}, [np.nan] * 4 + [0.0]),
    ],
)
def test_a_known_change_is_taken_back_within_its_clip(change, moved):
    pixels = np.full((5, 2, 1, 1, 2), CENTER)
    known = [KNOCK.model_copy(update=change)]
    corrected = correct_views(pixels, np.arange(10, 15), {"a": CAMERA, "b": CAMERA}, known)
    shift = corrected - pixels
    np.testing.assert_allclose(shift[:, 1, 0, 0, 0], -np.array(moved), atol=1e-5)
    assert not shift[:, 0].any()


def test_what_people_show_of_a_slow_change_is_that_of_the_whole_clip(cameras):
    update = {"camera": "a", "frame": None, "first_frame": 0, "frame_count": FRAMES}
    known = KNOCK.model_copy(update=update | {"shift_px": (0.0, 12.0)})
    people = view(cameras, sink)
    pixels = np.array(people.keypoints)
    own = pixels[:, [BAD]]
    pixels[:, [BAD]] = correct_views(own, people.frame, {"a": cameras[BAD]}, [known])
    found = refine_change(cameras, replace(people, keypoints=pixels), FPS, BAD, known)
    assert found.frame is None
    np.testing.assert_allclose(found.shift_px, [0.0, 20.0], atol=0.6)


def test_a_far_knock_and_what_its_correction_leaves_are_one_motion():
    far = KNOCK.model_copy(update={"frame": 10, "shift_px": (60.0, -50.0)})
    rest = far.model_copy(update={"shift_px": (2.0, 1.0), "zoom": -0.003, "roll_rad": 0.02})
    corner = [50.0, 60.0]
    pixels = np.array([[CENTER, corner, 2.0 * CENTER - corner]])
    both = move_on(pixels, np.array([12]), CAMERA, [far, rest])
    joined = move_on(pixels, np.array([12]), CAMERA, [join_changes(CAMERA, far, rest)])
    # A zoom after a turn is no turn after a zoom: 0.003 of 78 px.
    np.testing.assert_allclose(joined, both, atol=0.24)


def test_cameras_that_all_sway_agree_with_nobody(cameras):
    def misfit(size):
        people = view(cameras, lambda pixels, *_: pixels)
        phase = np.arange(FRAMES)[:, None] / FRAMES * 2.0 * np.pi + np.arange(4)
        sway = size * np.stack([np.sin(phase), np.cos(1.3 * phase)], axis=-1)
        people = replace(people, keypoints=people.keypoints + sway[:, :, None, None])
        health = CameraHealth.empty(FRAMES, 4, people.detection_index.shape[2], FPS)
        health.add(
            cameras, people, triangulate_views(Rig.from_cameras(cameras), people, SETTINGS), 0
        )
        return np.median(health.misfit)

    assert misfit(0.0) < 1.0
    assert misfit(30.0) > 3.0


def test_a_step_that_covers_a_short_clip_stays_as_it_is():
    parts = [Part(0, "constant", 0, (0.0,)), Part(0, "step", 12, (12.0,))]
    rows = np.arange(2.0, 25.0, 5.0)
    sums = ChangeSums(
        np.tile(np.eye(5), (len(rows), 1, 1)), np.zeros((len(rows), 5)), rows, 25.0, np.ones(1)
    )
    assert fit_parts(sums, parts, 25, ("clock",)) == parts


def test_a_bin_of_two_chunks_is_one_bin(cameras):
    size = 5 * len(cameras.focal)

    def chunk(*rows):
        matrix, score = np.tile(np.eye(size), (len(rows), 1, 1)), np.ones((len(rows), size))
        return ChangeSums(matrix, score, np.array(rows), FPS, np.ones(len(cameras.focal)))

    joined = ChangeSums.join([chunk(2.0, 7.0), chunk(7.0, 12.0)], cameras, FPS)
    assert joined.rows.tolist() == [2.0, 7.0, 12.0]
    assert joined.matrix[:, 0, 0].tolist() == joined.score[:, 3].tolist() == [1.0, 2.0, 1.0]
    # A clip without people has no bins.
    assert ChangeSums.join([], cameras, FPS).matrix.shape == (0, size, size)
