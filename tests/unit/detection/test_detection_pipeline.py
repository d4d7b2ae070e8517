"""From the images of a video to people: tiles, duplicates, tracks of boxes, and turned cameras."""

import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.box_tracking import BoxCleaner, BoxTracker, detect_strided
from worldpose.detection.interfaces import People
from worldpose.detection.pipeline import PeopleFinder, Place, detect_people, on_pitch
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import combine_boxes
from worldpose.detection.turning import QuarterTurn
from worldpose.detection.views import TiledDetector
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
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

    def reason(feet, scores, frames=20):
        nets = Knowing([boxes_of(camera, feet)], [np.array(scores)])
        finder = PeopleFinder([nets], nets, DetectionSettings())
        list(finder.find([(number, image) for number in range(frames)], Place(camera, PITCH)))
        return finder.report.why_no_person()

    assert reason(feet, [0.9, 0.8]) is None
    assert "no person in 20 frames: the detector gave no box" in reason(feet, [0.09, 0.0])
    assert reason(feet, [0.09, 0.0], frames=19) is None
    said = reason(feet + [0.0, 60.0, 0.0], [0.9, 0.8])
    assert "all 40 boxes of the detector lie outside of the pitch" in said
    # Below the score that begins a track.
    assert "of 40 boxes of the detector 0 lie outside" in reason(feet, [0.3, 0.3])


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
        assert (np.isfinite(found.score).sum(), finder.report.cut) == (count, int(count < 70))


def test_no_one_found_beside_given_people_displaces_them():
    boxes = 24.0 * np.arange(3)[:, None] + [0.0, 10.0, 20.0, 40.0]
    one, image = Knowing([boxes], [np.full(3, 0.5)]), np.zeros((96, 96, 3), np.uint8)
    one.estimate_frames = lambda images, boxes: [one.estimate(images[0], boxes[0])]
    beyond = People(boxes[:1] + [0.0, 45.0, 0.0, 45.0], np.ones(1))
    behind = combine_boxes(beyond, one.estimate(image, beyond.boxes))
    one.find_occluded = lambda images, people: [behind]
    finder = PeopleFinder([one], one, DetectionSettings(max_people=3, find_occluded=True))
    for given, beside in (({0: People(boxes, np.full(3, 0.5))}, 0), (None, 1)):
        list(finder.find([(0, image)], None, given))
        assert (finder.report.beside, finder.report.cut) == (beside, beside)


PICTURE = np.zeros((4, 4, 3), dtype=np.uint8)


def walker(frame, start=100.0, speed=4.0, height=60.0):
    x = start + speed * frame
    return [x, 200.0, x + 0.4 * height, 200.0 + height]


def people(*rows):
    rows = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return People(rows[:, :4], rows[:, 4])


def test_a_gap_is_filled_evenly_and_a_longer_one_is_not():
    for gap, filled in ((4, 4), (6, 0)):
        seen = [people() if 10 <= n < 10 + gap else people([*walker(n), 0.9]) for n in range(30)]
        cleaner = BoxCleaner(DetectionSettings(max_gap_frames=5))
        given = [(number, PICTURE, one) for number, one in enumerate(seen)]
        frames = [(number, out) for number, _, out in cleaner.clean(given)]
        assert [number for number, _ in frames] == list(range(30))
        counts = [len(one.scores) for _, one in frames]
        assert (counts.count(1), cleaner.bridged) == (30 - gap + filled, filled)
        if filled:
            np.testing.assert_allclose(frames[12][1].boxes, [walker(12)])


def test_two_people_who_cross_keep_their_tracks():
    tracker = BoxTracker(high_score_threshold=0.4, track_buffer_frames=25)
    ids = []
    for frame in range(40):
        boxes = np.array([walker(frame, 100, 4, 60), walker(frame, 260, -4, 80)])
        ids.append(tracker.update(boxes, np.array([0.9, 0.9])))
    assert np.unique(np.array(ids), axis=0).tolist() == [[0, 1]]


class Blobs:
    """Finds white rectangles of 3 px and more: truth to the pixel, in whatever view."""

    view_size = (64, 48)

    def detect(self, pictures):
        found = []
        for picture in pictures:
            assert picture.shape == (48, 64, 3)
            _, _, stats, _ = cv2.connectedComponentsWithStats(
                (picture[..., 0] > 200).astype(np.uint8)
            )
            found.append(
                people(*[(x, y, x + w - 1, y + h - 1, 0.9) for x, y, w, h, _ in stats[1:] if w > 2])
            )
        return found


def test_everybody_is_found_once_and_whole_whichever_view_shows_them():
    picture = np.zeros((150, 230, 3), dtype=np.uint8)
    rng = np.random.default_rng(1)
    true = []
    for column in range(9):
        for row in range(4):
            x, y = 5 + 25 * column + rng.integers(0, 8), 5 + 36 * row + rng.integers(0, 8)
            picture[y : y + 12, x : x + 6] = 255
            true.append([x, y, x + 5, y + 11])
    found = TiledDetector(Blobs(), (1.0,), view_overlap=0.4, overlap=0.3).detect([picture])[0]
    whole = found.boxes[np.lexsort(found.boxes.T)]
    expected = np.array(true, dtype=np.float64)[np.lexsort(np.array(true).T)]
    # The whole image in one view is blurred: it may find a box as well, never another person.
    assert len(whole) == len(expected)
    assert np.abs(whole - expected).max() <= 4.0


TURNED_SIZE = (64, 48)


def rolled(quarters, size=TURNED_SIZE):
    """A camera whose images np.rot90 turns upright, with a lens that has tangential terms."""
    upright = look_at_camera([0.0, -9.0, 2.0], [0.5, 0.0, 1.0], 60.0, size)
    turn = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(90.0 * quarters)]))[0]
    pose = upright.cam_from_world
    matrix = np.array([[60.0, 0.0, 30.0], [0.0, 61.0, 25.0], [0.0, 0.0, 1.0]])
    lens = np.array([-0.1, 0.02, 0.01, -0.02, 0.003])
    return Camera.from_matrices(matrix, lens, turn @ pose.rotation, turn @ pose.translation, size)


class Net:
    """Finds the brightest pixel as a person if the image is wider than high, as upright ones are.

    It also stands for the pose net: all keypoints are the middle of the box.
    """

    view_size = None

    def __init__(self, upright):
        self.upright = upright

    def detect(self, images):
        found = []
        for image in images:
            y, x = np.unravel_index(image[..., 0].argmax(), image.shape[:2])
            is_seen = (image.shape[1], image.shape[0]) == self.upright and image[y, x, 1] == 9
            box = np.array([[x - 2.0, y - 4.0, x + 2.0, y + 4.0]])
            found.append(People(box[: int(is_seen)], np.full(int(is_seen), 0.9)))
        return found

    def estimate(self, image, boxes):
        middle = (boxes[:, None, :2] + boxes[:, None, 2:]) / 2.0
        points = np.repeat(middle, 17, axis=1) + np.arange(17)[:, None] * [0.1, 0.2]
        return KeypointDetections.from_keypoints(points, np.full((len(boxes), 17), 0.9))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_turned_camera_sees_points_where_the_turned_image_shows_them(quarters):
    camera = rolled(quarters)
    turn = QuarterTurn.of(camera)
    assert (0 if turn is None else turn.quarters) == quarters
    if turn is None:
        return
    places = np.random.default_rng(1).uniform([-2.0, -1.0, 0.0], [2.0, 1.0, 2.0], (20, 3))
    pixels = camera.project(places)
    turned = turn.camera(camera)
    np.testing.assert_allclose(turned.project(places), turn.points(pixels), atol=1e-9)
    np.testing.assert_allclose(turn.points(turn.points(pixels), back=True), pixels, atol=1e-12)
    assert QuarterTurn.of(turned) is None
    image = np.zeros((TURNED_SIZE[1], TURNED_SIZE[0], 3), np.uint8)
    image[7, 20] = 255
    x, y = turn.points([20.0, 7.0]).astype(int)
    assert turn.image(image)[y, x, 0] == 255
    box = np.array([[3.0, 5.0, 9.0, 20.0]])
    np.testing.assert_allclose(turn.boxes(turn.boxes(box), back=True), box)


@pytest.mark.parametrize(
    ("quarters", "is_given", "turned"),
    # In the last row, the nets find people in the images as they are: z of the world is not up.
    [(0, False, 0), (1, False, 1), (3, False, 3), (1, True, 1), (3, True, 3), (1, False, 0)],
)
def test_people_of_a_camera_on_its_side_are_found_where_they_are(quarters, is_given, turned):
    image = np.full((TURNED_SIZE[1], TURNED_SIZE[0], 3), 9, np.uint8)
    image[20, 30, 0] = 255
    net = Net(TURNED_SIZE[::-1] if turned % 2 else TURNED_SIZE)
    finder = PeopleFinder([net], net, DetectionSettings(find_occluded=False, min_hits=1))
    box = np.array([[28.0, 16.0, 32.0, 24.0]])
    given = {n: People(box, np.array([0.9])) for n in range(20)} if is_given else None
    frames = ((n, image) for n in range(20))
    (found,) = finder.find(frames, Place(rolled(quarters), None), given)
    assert finder.report.quarters == turned
    np.testing.assert_allclose(found.keypoints[:, 0, 0], np.tile([30.0, 20.0], (20, 1)), atol=0.01)


@pytest.mark.parametrize(
    ("lost", "begin", "settings"),
    [
        ({50}, 0, {"stride": 10}),
        ({50, 51, 52}, 0, {"stride": 10}),
        ({49, 50}, 0, {"stride": 10}),
        ({55}, 0, {"stride": 10, "max_gap_frames": 0, "batch": 3}),
        ({*range(6, 14), *range(17, 21)}, 0, {"stride": 10, "batch": 1}),
        (set(range(1, 100, 2)), 24, {"stride": 5, "min_hits": 3}),
        (set(), 30, {"stride": 10, "min_hits": 3}),
        (set(), 30, {"min_hits": 12}),
    ],
)
def test_no_frame_of_a_true_track_is_lost_and_boxes_lie_between_those_that_were_seen(
    lost, begin, settings
):
    looked = []

    def look(pictures):
        numbers = [int(picture[0, 0, 0]) for picture in pictures]
        looked.extend(numbers)
        return [people(*[[*walker(n, speed=0.1), 0.9]] * (n >= begin)) for n in numbers]

    asked = DetectionSettings(**settings)
    frames = ((n, None if n in lost else np.full((4, 4, 3), n, np.uint8)) for n in range(100))
    shown = set()
    for number, _, one in BoxCleaner(asked).clean(detect_strided(frames, look, asked)):
        if len(one.scores):
            shown.add(number)
            np.testing.assert_allclose(one.boxes, [walker(number, speed=0.1)], atol=1e-9)
    assert shown == set(range(begin, 100)) - lost
    assert 99 in looked or 99 in lost  # so that boxes reach the end


def test_frames_in_memory_do_not_grow_with_batch_times_stride():
    taken = []
    frames = (taken.append(n) or (n, PICTURE) for n in range(500))
    most, settings = 0, DetectionSettings(stride=25)
    for n, _, _ in detect_strided(frames, lambda each: [people()] * len(each), settings):
        most = max(most, len(taken) - n)
    assert most <= 51
