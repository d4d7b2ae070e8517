"""Joints are judged by their views; missing people are searched for; lasting errors are found."""

from dataclasses import replace

import numpy as np
import pytest
from bystander import NOISE, SIZE, as_stated, expected
from planted_errors import plant

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.judging import Residuals, judge_detections, learn_keypoint_spread
from worldpose.filtering.redetection import (
    MissingPeople,
    judge_search_results,
    search_missing_people,
    select_missing_people,
)
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.systematic_errors import (
    TERMS,
    SystematicErrors,
    ViewBias,
    learn_systematic_errors,
    learn_view_bias,
    watch_motion,
)

SETTINGS = FilteringSettings()


@pytest.fixture(scope="module")
def scene():
    return plant(31)


def judged(scene, dropped=None, exchanged=None, **changes):
    suspects = replace(
        scene.suspects,
        detections=replace(scene.suspects.detections, **changes),
        dropped=scene.suspects.dropped if dropped is None else dropped,
        exchanged=scene.suspects.exchanged if exchanged is None else exchanged,
    )
    spread = learn_keypoint_spread(scene.views, suspects)
    return judge_detections(scene.views, suspects, spread, SETTINGS)


def test_nine_of_ten_planted_keypoints_are_found_and_few_honest_ones_rejected(scene):
    found = judged(scene)
    seen = np.isfinite(scene.suspects.detections.confidence) & (scene.person >= 0)[..., None]
    planted = scene.displaced & seen
    assert planted.sum() > 500
    assert found.rejected[planted].mean() >= 0.9
    assert found.rejected[seen & ~planted].mean() < 0.02


def test_a_box_that_nobody_claims_is_given_to_the_body_that_it_fits(scene):
    frame, camera, person = 3, 1, 2
    index = scene.suspects.detections.detection_index.copy()
    place = index[frame, camera, person]
    assert place >= 0
    index[frame, camera, person] = -1
    found = judged(scene, detection_index=index)
    assert found.fits[frame, camera, place] == person
    assert not found.dropped[frame, camera, place]


def test_a_box_that_fits_nobody_is_dropped_whole(scene):
    keypoints = scene.suspects.detections.keypoints.copy()
    frame, camera, person = 4, 2, 1
    place = scene.suspects.detections.detection_index[frame, camera, person]
    keypoints[frame, camera, place, :, 0] += 400.0
    found = judged(scene, keypoints=keypoints)
    assert found.dropped[frame, camera, place]
    there = np.isfinite(scene.suspects.detections.confidence[frame, camera, place])
    np.testing.assert_array_equal(found.rejected[frame, camera, place], there)
    assert found.fits[frame, camera, place] == -1


def test_sides_that_were_put_right_are_no_contradiction(scene):
    frame, camera, person = 6, 3, 0
    place = scene.suspects.detections.detection_index[frame, camera, person]
    honest = judged(scene).mahalanobis_distance[frame, camera, place]
    left_right = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
    keypoints, confidence = (
        scene.suspects.detections.keypoints.copy(),
        scene.suspects.detections.confidence.copy(),
    )
    for array in (keypoints, confidence):
        array[frame, camera, place] = array[frame, camera, place][left_right]
    exchanged = scene.suspects.exchanged.copy()
    exchanged[frame, camera, person] = True
    found = judged(scene, keypoints=keypoints, confidence=confidence, exchanged=exchanged)
    # Each keypoint keeps its verdict at the place where the detector put it.
    np.testing.assert_allclose(
        found.mahalanobis_distance[frame, camera, place], honest[left_right], rtol=1e-3
    )


def select(bodies, *seen):
    known = np.zeros(bodies.image.shape[:2], dtype=bool)
    known[:, list(seen)] = True
    return select_missing_people(bodies, known, SIZE, RESULT_SETTINGS)


@pytest.mark.parametrize(
    ("places", "deviation", "seen", "person", "hidden"),
    [
        ([(0.0, 0.0), (3.0, 0.0)], 0.02, [0], [1], 0),
        ([(0.0, 40.0)], 0.02, [], [], 0),  # 31 px high
        ([(0.0, 0.0)], 0.2, [], [], 0),  # may be any person there
        ([(10.05, 0.0)], 0.02, [], [], 0),  # at the border: seven joints are in the image
        ([(0.0, -30.0)], 0.02, [], [], 0),  # behind the camera
        ([(0.0, 0.0), (0.0, 1.0)], 0.02, [0], [], 1),  # behind the first
        ([(0.0, 0.0), (0.0, 1.0)], 0.02, [1], [0], 0),
    ],
)
def test_who_was_not_detected_is_looked_for_unless_hardly_to_be_seen_or_hidden(
    places, deviation, seen, person, hidden
):
    bodies = expected(*places, deviation=deviation)
    found = select(bodies, *seen)
    assert (found.person.tolist(), found.hidden) == (person, hidden)
    np.testing.assert_array_equal(found.boxes, bodies.boxes[0, person])


RESULT_SETTINGS = RedetectionSettings()
KINDS = ("found", "unsure", "elsewhere", "another")


def answer(bodies, *persons, off=(0.0, 0.0), confidence=0.9):
    """Return detections of these bodies with an offset [px]."""
    keypoints = bodies.image[0, list(persons)] + off
    count = len(persons)
    return KeypointDetections(
        keypoints, np.full((count, 17), confidence), bodies.boxes[0, persons] + 0.0, np.ones(count)
    )


def judge(bodies, answers, *persons, detected=()):
    """Return who was found of these persons of the only frame, and the rejected keypoints."""
    sought = MissingPeople(
        *(np.zeros(len(persons), int), np.array(persons)), bodies.boxes[0, persons], 0
    )
    pose, boxes = (each[:, list(detected)] for each in (bodies.image, bodies.boxes))
    none = np.full(pose.shape[:3], np.nan)
    given = KeypointDetections(pose, none, boxes, none[..., 0])
    found = judge_search_results(
        answers, sought, bodies, given, as_stated(), NOISE, RESULT_SETTINGS
    )
    kinds = [next(k for k in KINDS if getattr(found, k)[n]) for n in range(len(persons))]
    return kinds, np.argwhere(found.rejected).tolist()


def test_an_answer_is_the_person_s_where_the_body_is_without_a_wrist_that_is_not_the_body_s():
    bodies = expected((0.0, 0.0), (3.0, 0.0))
    seen = answer(bodies, 0, off=(1.0, -1.0))
    assert judge(bodies, seen, 0, detected=[1]) == (["found"], [])
    seen.keypoints[0, 9] += 25.0
    assert judge(bodies, seen, 0) == (["found"], [[0, 9]])


def test_a_pose_is_the_nearer_one_s():
    # A hand's breadth apart, and so unsure that either pose would do for both.
    bodies = expected((0.0, 0.0), (0.2, 0.0), deviation=0.14)
    assert judge(bodies, answer(bodies, 1), 0)[0] == ["another"]
    bodies = expected((0.0, 0.0), (0.08, 0.0), deviation=0.1)
    assert judge(bodies, answer(bodies, 0, 0), 0, 1)[0] == ["found", "another"]
    # Four pixels from one to the next: the similarity of poses is 0.8, and 0.5 over eight.
    bodies = expected((0.0, 0.0), (0.08, 0.0), (0.16, 0.0), deviation=0.1)
    off = np.array([0.0, 0.2, 0.4])[:, None, None] * [1.0, 0.0]
    assert judge(bodies, answer(bodies, 0, 1, 2, off=off), 0, 1, 2)[0] == [
        *("found", "another", "found")
    ]


class Seeing:
    """Finds a person in the middle of each box, and records the boxes."""

    def estimate(self, picture, boxes):
        self.boxes = boxes.tolist()
        middle = 0.5 * (boxes[:, None, :2] + boxes[:, None, 2:])
        points = np.repeat(middle, 17, axis=1)
        return KeypointDetections.from_keypoints(points, np.full((len(boxes), 17), 0.8))


def test_neighbours_who_overlap_are_shown_to_the_net_and_answered_for_by_nobody():
    sought = select(expected((0.0, 0.0)))
    left, top, right, bottom = sought.boxes[0].tolist()
    beside = [right - 1.0, top, right + 30.0, bottom]
    touching = [left - 30.0, top, left, bottom]
    detected = np.array([[touching, beside, [np.nan] * 4]])
    net, picture = Seeing(), np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    answers = search_missing_people([(0, picture)], sought, net, 0.05, detected)
    assert net.boxes == [[left, top, right, bottom], beside]
    np.testing.assert_allclose(answers.keypoints[0, 0, 0], 0.5 * (left + right), atol=1e-12)


ROWS = 3000


def seen_from_all_sides(shift, noise=1.0):
    """Residuals of one joint after another, with a direction and a size for each row."""
    rng = np.random.default_rng(2)
    azimuth, scale = rng.uniform(-np.pi, np.pi, ROWS), rng.uniform(30.0, 80.0, ROWS)
    missed = shift(azimuth, scale) + noise * rng.normal(size=(ROWS, 17, 2))
    zero = np.zeros(ROWS, dtype=np.int64)
    variance = np.full((ROWS, 17), noise**2)
    return Residuals(zero, zero, zero, missed, variance, 1.0), azimuth, scale


def test_a_bias_that_goes_with_the_side_is_found():
    bias = ViewBias(np.random.default_rng(1).normal(0.0, 0.02, (17, 2, TERMS)))
    misses, *seen = seen_from_all_sides(bias.shift)
    misses.missed[:1000, 3] = np.nan
    found = learn_view_bias(misses, *seen)
    # 1 px at 55 px per metre over 3,000 rows: 0.5 mm; five of these.
    np.testing.assert_allclose(found.coefficient, bias.coefficient, atol=0.0025)


def with_a_late_camera(scene, frames, held):
    """The scene's systematic, and what was detected there with a camera of which that is late.

    Args:
        held: share of the clock offset in people's offsets.
    """
    motion = watch_motion(scene.cameras, scene.joints, np.gradient(scene.joints, axis=0))
    late = np.array([0.0, frames, 0.0, 0.0, 0.0, 0.0])
    at = np.nonzero(scene.suspects.detections.detection_index >= 0)
    keypoints = scene.suspects.detections.keypoints.copy()
    shift = late[:, None, None, None] * motion.image_motion
    keypoints[(*at[:2], scene.suspects.detections.detection_index[at])] += shift[at]
    offsets = held * np.nan_to_num(shift.mean(axis=-2))
    detections = replace(scene.suspects.detections, keypoints=keypoints)
    suspects = replace(scene.suspects, detections=detections, offsets=offsets)
    return SystematicErrors(ViewBias.none(), late), motion, suspects


def test_a_late_clock_is_learned_beside_sides_and_its_shift_brings_keypoints_back():
    scene = plant(31, duration=2.0)
    true, motion, suspects = with_a_late_camera(scene, 0.6, held=0.0)
    people = (scene.cameras, scene.joints, scene.views, motion, suspects)
    systematic = learn_systematic_errors(*people, FilteringSettings(), 25.0)
    # The coupling between viewing-angle errors and clocks is below 0.1 frame.
    late = true.late - true.late.mean()
    np.testing.assert_allclose(systematic.late - systematic.late.mean(), late, atol=0.07)
    right = suspects.subtract(systematic.shift(motion, scene.views))
    exact = replace(systematic, late=np.zeros(6)).shift(motion, scene.views)
    on_time = scene.suspects.subtract(exact).detections.keypoints
    at = np.nonzero(scene.suspects.detections.detection_index >= 0)
    place = (*at[:2], scene.suspects.detections.detection_index[at])
    here = at[1] == 1
    honest = ~scene.displaced[place][here]

    def beside(found):
        return np.linalg.norm((found - on_time)[place][here][honest], axis=-1)

    assert np.nanmean(beside(right.detections.keypoints)) < 0.4 * np.nanmean(
        beside(suspects.subtract(exact).detections.keypoints)
    )
