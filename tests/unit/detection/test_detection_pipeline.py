"""Players are found and the crowd is not, by a detector that knows the truth."""

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People
from worldpose.detection.pipeline import PeopleFinder, Place, detect_people, on_pitch
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate

SIZE = (1920, 1080)
PITCH = PitchTemplate.standard()


@pytest.fixture(scope="module")
def camera():
    """From a stand's roof at the half-way line, looking across the pitch."""
    lens = (-0.05, 0.01, 0.0, 0.0, 0.0)
    return look_at_camera((0.0, -75.0, 22.0), (0.0, 5.0, 0.0), 1300.0, SIZE, lens=lens)


def boxes_of(camera, feet, height=1.8):
    """Boxes of people who stand at `feet` (people, 3) [m]."""
    low, high = camera.project(feet), camera.project(feet + [0.0, 0.0, height])
    half = 0.2 * (low[:, 1] - high[:, 1])
    return np.stack([low[:, 0] - half, high[:, 1], low[:, 0] + half, low[:, 1]], axis=1)


def test_players_stay_over_the_touch_line_too_and_the_crowd_goes(camera):
    rng = np.random.default_rng(5)
    xy = rng.uniform([-40.0, -34.0], [40.0, 34.0], (200, 2))
    throwing_in = np.array([[10.0, 35.5], [-20.0, -35.0], [0.0, 36.0]])
    xy = np.vstack([xy, throwing_in])
    players = np.column_stack([xy, PITCH.height(xy[:, 0], xy[:, 1])])
    # Behind boards and a track, in a stand that rises by 0.5 m per metre.
    away = rng.uniform(42.0, 70.0, 500)
    crowd = np.column_stack([rng.uniform(-50.0, 50.0, 500), away, 1.0 + 0.5 * (away - 42.0)])
    boxes = boxes_of(camera, np.vstack([players, crowd]))
    boxes += rng.normal(0.0, 1.0, boxes.shape)  # a detector's error at 40 px
    inside = on_pitch(boxes, camera, SIZE, PITCH, DetectionSettings().pitch_margin_m)
    visible = (boxes[:203, 0] > 0) & (boxes[:203, 2] < SIZE[0]) & (boxes[:203, 3] < SIZE[1])
    assert visible.sum() > 150
    assert inside[:203][visible].all()
    assert inside[203:].mean() <= 0.01


class Knowing:
    """Detector and estimator that return the truth of the frame whose number the image holds."""

    view_size = None

    def __init__(self, boxes, scores):
        self.boxes, self.scores = boxes, scores

    def detect(self, pictures):
        return [People(self.boxes[n], self.scores[n]) for n in (int(p[0, 0, 0]) for p in pictures)]

    def estimate(self, picture, boxes):
        across = np.linspace(0.0, 1.0, 17)
        keypoints = boxes[:, None, :2] + (boxes[:, 2:] - boxes[:, :2])[:, None] * across[:, None]
        confidence = np.full((len(boxes), 17), 0.8)
        confidence[:, 3] = 0.01  # an ear that is not there
        return KeypointDetections.from_keypoints(keypoints, confidence)


def test_a_video_becomes_arrays_in_the_form_of_given_poses(camera):
    frames, players = 70, 5
    paths = np.linspace([-20.0, -20.0], [-5.0, 10.0], frames)[:, None] + 7.0 * np.arange(players)[
        :, None
    ] * [1.0, 0.2]
    crowd = np.array([[0.0, 60.0, 10.0]])
    boxes = [
        boxes_of(camera, np.vstack([np.column_stack([xy, np.zeros(players)]), crowd]))
        for xy in paths
    ]
    truth = Knowing(boxes, np.full((frames, players + 1), 0.9))
    blank = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)

    def shown():
        for n in range(frames):
            picture = blank.copy()
            picture[0, 0] = n
            yield 100 + n, None if n == 30 else picture

    finder = PeopleFinder([truth], truth, DetectionSettings())
    stretches = list(finder.find(shown(), Place(camera, PITCH)))
    found = {
        name: np.concatenate([stretch.arrays()[name] for stretch in stretches])
        for name in stretches[0].arrays()
    }
    assert found["keypoints"].shape == (frames, 64, 17, 2)
    there = np.delete(np.arange(frames), 30)
    assert np.isfinite(found["score"]).sum(axis=1)[there].tolist() == [players] * 69
    assert np.isnan(found["score"][30]).all()
    np.testing.assert_allclose(found["boxes"][:, :players][there][8], boxes[8][:5], atol=1e-3)
    assert np.isnan(found["confidence"][:, :, 3]).all()
    assert np.array_equal(np.isnan(found["confidence"]), np.isnan(found["keypoints"]).any(axis=3))
    report = finder.report
    assert (report.crowd, report.unreadable, report.empty, report.flickers) == (69, [130], 0, 0)


def test_a_clip_without_people_has_a_true_reason(camera):
    feet = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 0.0]])
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)

    def reason(nets, frames=20, **settings):
        finder = PeopleFinder([nets], nets, DetectionSettings(**settings))
        frames = [(number, image) for number in range(frames)]
        list(finder.find(frames, Place(camera, PITCH)))
        return finder.report.why_no_person()

    on_pitch = boxes_of(camera, feet)
    assert reason(Knowing([on_pitch], [np.array([0.9, 0.8])])) is None
    assert "no person in 20 frames: the detector gave no box" in reason(
        Knowing([on_pitch], [np.array([0.09, 0.0])])
    )
    assert reason(Knowing([on_pitch], [np.array([0.09, 0.0])]), frames=19) is None
    crowd = boxes_of(camera, feet + [0.0, 60.0, 0.0])
    assert "all 40 boxes of the detector lie outside of the pitch" in reason(
        Knowing([crowd], [np.array([0.9, 0.8])])
    )
    weak = Knowing([on_pitch], [np.array([0.3, 0.3])])  # below the score that begins a track
    assert "of 40 boxes of the detector 0 lie outside" in reason(weak)


IMAGE = np.zeros((48, 64, 3), np.uint8)


@pytest.mark.parametrize(
    "images",
    [
        [IMAGE.astype(np.float32)],
        [IMAGE.astype(np.uint16)],
        [IMAGE[..., 0]],
        [np.dstack([IMAGE, IMAGE[..., :1]])],
        [IMAGE, IMAGE[:40]],
    ],
    ids=["float", "16 bits", "grey", "rgba", "sizes"],
)
def test_images_that_no_net_takes_are_refused(images):
    with pytest.raises(InputError, match=f"image {len(images) - 1}.*uint8 RGB.* 64 x 48 px"):
        detect_people(images, detectors=[Knowing([], [])])


def test_images_are_of_the_camera_s_size_and_may_be_views(camera):
    nobody = Knowing([np.empty((0, 4))], [np.empty(0)])
    with pytest.raises(InputError, match="1920 x 1080 px"):
        detect_people([IMAGE], detectors=[nobody], camera=camera)
    nobody.detect = lambda images: [
        People(np.empty((0, 4)), np.empty(0)) for each in images if each.flags.c_contiguous
    ]
    assert detect_people([IMAGE[..., ::-1]], detectors=[nobody]).frame.tolist() == [0]


def test_given_boxes_beyond_the_limit_stay_and_detected_ones_are_counted():
    x = 24.0 * np.arange(70)
    boxes = np.stack([x, np.full(70, 10.0), x + 20.0, np.full(70, 40.0)], axis=1)
    one, image = Knowing([boxes], [np.full(70, 0.9)]), np.zeros((48, 1920, 3), np.uint8)
    finder = PeopleFinder([one], one, DetectionSettings(max_people=60))
    for given, count in (({0: People(boxes, np.ones(70))}, 70), (None, 60)):
        (found,) = finder.find([(0, image)], None, given)
        assert (np.isfinite(found.score).sum(), finder.report.cut) == (count, 70 - count)
