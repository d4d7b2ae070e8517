"""People are followed over cameras, and placed on the ground by one."""

from dataclasses import replace

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.parameters import step_camera
from worldpose.tracking.plane.clocks import estimate_plane_clocks
from worldpose.tracking.plane.feet import ANKLE_HEIGHT, GroundPositions, locate_feet
from worldpose.tracking.plane.paths import PlanePath, merge_paths
from worldpose.tracking.plane.tracker import TriangulatedPeople, locate_tracks, track_on_plane
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

detections = KeypointDetections.from_keypoints

SETTINGS = TrackingSettings()
FPS = 50.0
PLACES = np.array([[0.0, 0.0], [0.9, 0.2], [-3.0, 2.0], [4.0, -3.0]])


def still(people, frames=20, places=PLACES):
    return people(np.broadcast_to(places, (frames, *places.shape)))


def owners(tracking):
    """The detection that each track holds everywhere it holds one: n is person n."""
    index = tracking.detection_index
    values = [np.unique(index[:, :, n][index[:, :, n] >= 0]) for n in range(index.shape[2])]
    assert all(len(value) == 1 for value in values)
    return [int(value[0]) for value in values]


@pytest.mark.parametrize("shape", [(0, 4, 3), (5, 4, 0)])
def test_nothing_to_see_gives_no_tracks(ring, shape):
    keypoints = np.full((*shape, 17, 2), np.nan)
    nobody = detections(keypoints, np.full((*shape, 17), np.nan))
    result = track_people(ring(4), nobody, FPS, SETTINGS)
    assert result.detection_index.shape == (shape[0], 4, 0)
    assert (result.joints.shape, result.tracks) == ((shape[0], 0, 17, 3), ())
    assert result.report.unmatched_share is None
    assert result.report.mean_ray_distance_m is None


def test_everyone_is_followed_in_every_camera(ring, people, seen):
    result = track_people(ring(5), detections(*seen(ring(5), still(people))), FPS, SETTINGS)
    assert sorted(owners(result)) == [0, 1, 2, 3]
    assert (result.detection_index >= 0).all()
    assert result.detection_index.dtype == np.int16
    assert result.ray_distance.dtype == result.joints.dtype == np.float32
    # 1 px is 2 cm at 30 m; the mean length of two such axes is 2.5 cm.
    assert 0.01 < result.ray_distance.mean() < 0.03
    truth = people(PLACES)[owners(result)]
    # Five views of 2 cm, 20400 coordinates: 4.5 standard deviations of 2 cm / sqrt(2.5).
    np.testing.assert_allclose(result.joints, np.broadcast_to(truth, (20, 4, 17, 3)), atol=0.06)
    assert result.person.tolist() == [0, 1, 2, 3]
    for track in result.tracks:
        assert (track.first_frame, track.last_frame, track.frames_seen) == (0, 19, 20)
        assert track.views == 5.0
    report = result.report
    assert (report.births, report.losses, report.dropped, report.merged) == (4, 0, 0, 0)
    assert (report.detections, report.unmatched_share) == (400, 0.0)


@pytest.mark.parametrize("fps", [12.5, 50.0])
def test_people_who_cross_keep_their_identity(ring, people, seen, fps):
    # Two run at each other at 6 m/s and pass at 0.6 m, shoulder to shoulder.
    time = np.arange(-1.0, 1.0, 1 / fps)
    places = np.stack(
        [np.stack([6 * time, 0 * time], -1), np.stack([-6 * time, 0 * time + 0.6], -1)], axis=1
    )
    result = track_people(ring(6), detections(*seen(ring(6), people(places))), fps, SETTINGS)
    assert sorted(owners(result)) == [0, 1]
    assert (result.detection_index >= 0).all()


def test_prediction_carries_a_sprinter_through_a_low_frame_rate(ring, people, seen):
    # From standing to 8 m/s at 5 m/s^2, at 10 frames per second: in the end 0.8 m per frame, beyond
    # the gate, but the change from frame to frame is 5 cm.
    time = np.arange(0.0, 2.4, 0.1)
    run = np.where(time < 1.6, 2.5 * time**2, 6.4 + 8.0 * (time - 1.6)) - 7.0
    keypoints, confidence = seen(ring(6), people(np.stack([run, 0 * run], -1)[:, None]))
    moving = track_people(ring(6), detections(keypoints, confidence), 10.0, SETTINGS)
    assert len(moving.tracks) == 1
    assert (moving.detection_index >= 0).all()
    at_rest = SETTINGS.model_copy(update={"predict_motion": False})
    resting = track_people(ring(6), detections(keypoints, confidence), 10.0, at_rest)
    assert (resting.detection_index[-5:] < 0).any()


def test_lost_person_is_found_again_under_the_same_identity(ring, people, seen):
    # 1 m/s to and fro, unseen for 0.8 s.
    time = np.arange(0, 3.0, 1 / FPS)
    places = np.stack([np.stack([np.sin(time), 0 * time], -1)], axis=1)
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[50:90] = np.nan
    result = track_people(ring(5), detections(keypoints, confidence), FPS, SETTINGS)
    assert (len(result.tracks), result.tracks[0].frames_seen) == (1, 110)
    assert (result.detection_index[50:90] == -1).all()
    assert np.isnan(result.joints[50:90]).all()
    assert np.isnan(result.ray_distance[50:90]).all()


def test_ghosts_of_two_people_in_two_cameras_make_no_tracks(ring, people, seen):
    # Two views of two people meet at four places; two of them are empty.
    camera = ring(5)[np.array([0, 1])]
    places = np.array([[-1.5, 0.5], [1.5, 1.0]])
    both = detections(*seen(camera, still(people, 40, places)))
    result = track_people(camera, both, FPS, SETTINGS)
    assert (sorted(owners(result)), result.report.births) == ([0, 1], 2)


def test_join_that_may_be_either_way_is_left_to_review(ring, people, seen):
    # Two people face each other, are unseen for 1 s, and stand across: each may be either.
    places = np.zeros((100, 2, 2))
    places[:30] = [[-0.8, 0.0], [0.8, 0.0]]
    places[80:] = [[0.0, -0.8], [0.0, 0.8]]
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[30:80] = np.nan
    result = track_people(ring(5), detections(keypoints, confidence), FPS, SETTINGS)
    assert len(result.tracks) == 4
    assert result.report.undecided == len(result.joins) == 2
    assert {(join.before, join.after) for join in result.joins} in (
        {(0, 2), (1, 3)},
        {(0, 3), (1, 2)},
    )
    for join in result.joins:
        assert not join.decided
        assert join.margin < np.log(SETTINGS.join_odds)
    assert result.joins[0].cost >= result.joins[1].cost


def test_person_whom_a_camera_loses_is_not_carried_away_by_a_neighbour(ring, people, seen):
    # Two cameras follow a person; then the second sees only a neighbour 0.45 m away, within
    # the gate: its ray misses the other camera's by more than two views of one body do.
    places = np.broadcast_to([[0.0, 0.0], [0.0, 0.45]], (40, 2, 2))
    camera = ring(2)
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, :, 1] = np.nan
    alone = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    assert owners(alone) == [0]
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, 0, 1] = np.nan
    keypoints[:20, 1, 1] = np.nan
    keypoints[20:, 1, 0] = np.nan
    taken = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    together = (taken.detection_index[20:] >= 0).all(axis=1)
    assert not together.any()


def test_one_camera_alone_follows_a_person_through_a_turn(ring, people, seen):
    # Walks to and fro at 1 m/s; from 0.5 to 1.2 s the first camera alone sees it.
    time = np.arange(0, 2.0, 1 / FPS)
    places = np.stack([0 * time, 0.5 * np.abs(2.0 * ((time + 0.2) % 1.0) - 1.0)], -1)[:, None]
    keypoints, confidence = seen(ring(3), people(places))
    keypoints[25:60, 1:] = np.nan
    result = track_people(ring(3), detections(keypoints, confidence), FPS, SETTINGS)
    assert result.report.births == 1
    assert (result.detection_index[:, 0, 0] == 0).all()
    assert np.isnan(result.joints[25:60]).all()
    assert (result.detection_index[60:] == 0).all()


def test_camera_that_shows_a_neighbour_for_a_while_is_left_out(ring, people, seen):
    # Three cameras follow a person; then the third sees only a neighbour 0.5 m behind, whose rays
    # pass the person within the gate.
    camera = ring(3)
    behind = -0.5 * camera.center[2, :2] / np.linalg.norm(camera.center[2, :2])
    places = np.broadcast_to([[0.0, 0.0], behind], (60, 2, 2))
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, :2, 1] = np.nan
    keypoints[:20, 2, 1] = np.nan
    keypoints[20:, 2, 0] = np.nan
    tracked = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    assert (tracked.detection_index[:, :2, 0] == 0).all()
    assert (tracked.detection_index[:20, 2, 0] == 0).all()
    assert (tracked.detection_index[40:, 2, 0] == -1).all()
    # 1 px is 2 cm: two views place the mean of 17 joints to some millimetres.
    away = tracked.joints[40:, 0].mean(axis=1) - people(places[40:])[:, 0].mean(axis=1)
    assert np.linalg.norm(away, axis=-1).max() < 0.02


def test_a_fall_is_followed_though_it_leaves_the_prediction(ring, people, seen):
    # From running at 6 m/s to lying still within 0.3 s, in a low camera rig.
    time = np.arange(0.0, 2.0, 1 / FPS)
    slowed = np.clip(time - 1.0, 0.0, 0.3)
    along = 6.0 * np.minimum(time, 1.0) + 6.0 * slowed - 10.0 * slowed**2
    joints = people(np.stack([along, 0 * along], -1)[:, None])
    tilt = np.clip((time - 1.0) / 0.3, 0.0, 1.0)[:, None] * np.pi / 2
    height = joints[:, 0, :, 2].copy()
    joints[:, 0, :, 0] += np.sin(tilt) * height
    joints[:, 0, :, 2] = np.cos(tilt) * height + 0.1
    result = track_people(ring(4), detections(*seen(ring(4), joints)), FPS, SETTINGS)
    assert owners(result) == [0]
    assert (result.detection_index >= 0).all()


PITCH = PitchTemplate.from_spec(PitchSpec(crown=0.0))
SIZE = (105.0, 68.0)
GROUND_FPS = 25.0


def seen_feet(cameras, places, *, height=ANKLE_HEIGHT):
    """Keypoints and confidence of people whose ankles are both at places (frames, people, 2)."""
    frames, people = places.shape[:2]
    ankles = np.concatenate([places, np.full((frames, people, 1), height)], axis=-1)
    keypoints = np.full((frames, len(cameras.focal), people, 17, 2), np.nan)
    confidence = np.full(keypoints.shape[:-1], np.nan)
    for c in range(len(cameras.focal)):
        pixels = cameras[c].project(ankles.reshape(-1, 3)).reshape(frames, people, 2)
        keypoints[:, c, :, 15:17] = pixels[:, :, None]
        confidence[:, c, :, 15:17] = np.isfinite(pixels[:, :, :1])
    return keypoints, confidence


def positions_at(places, std=0.1):
    """Places (frames, cameras, detections, 2) with round errors."""
    noise = np.broadcast_to(std**2 * np.eye(2), (*places.shape, 2)).copy()
    return GroundPositions(places, noise, np.zeros_like(noise), np.full(places.shape[:-1], 1.8))


def walkers(frames, starts, velocities):
    time = np.arange(frames)[:, None, None] / GROUND_FPS
    return np.asarray(starts)[None] + time * np.asarray(velocities)[None]


def test_feet_on_the_grass_are_found_where_they_are(ring):
    places = np.array([[[0.0, 0.0], [5.0, -8.0], [-11.0, 3.0]]])
    cameras = ring(3)
    found = locate_feet(cameras, detections(*seen_feet(cameras, places)), PITCH)
    known = np.isfinite(found.xy)
    assert known[:, :, 0].all()
    expected = np.broadcast_to(places[:, None], found.xy.shape)
    np.testing.assert_allclose(found.xy[known], expected[known], atol=1e-6)


def test_a_box_tells_the_place_without_ankles_unless_it_ends_with_the_image(ring):
    camera = ring(1)
    foot = camera[0].project(np.zeros((1, 3)))[0]
    around = [foot[0] - 20, foot[1] - 90, foot[0] + 20, foot[1]]
    boxes = np.array([[[around, [0, 900, 40, 1079.5]]]])
    keypoints = np.full((1, 1, 2, 17, 2), np.nan)
    bare = detections(keypoints, np.zeros((1, 1, 2, 17)))
    found = locate_feet(camera, replace(bare, boxes=boxes), PITCH)
    assert np.linalg.norm(found.xy[0, 0, 0]) < 0.5
    assert np.isnan(found.xy[0, 0, 1]).all()
    assert np.isnan(locate_feet(camera, bare, PITCH).xy).all()


@pytest.mark.slow
def test_calibration_errors_move_places_by_the_stated_covariance(ring):
    camera = ring(1)
    stated = np.zeros((1, 12, 12))
    stated[0, :7, :7] = np.diag(np.array([2e-3, 1e-3, 1e-3, 0.05, 0.04, 0.03, 2e-3]) ** 2)
    seen = seen_feet(camera, np.array([[[4.0, -6.0]]]))
    found = locate_feet(camera, detections(*seen), PITCH, camera_covariance=stated)
    rng = np.random.default_rng(0)
    moved = []
    for _ in range(2000):
        step = np.sqrt(np.diag(stated[0])) * rng.standard_normal(12)
        other = Camera.stack([step_camera(camera[0], step)])
        moved.append(locate_feet(other, detections(*seen), PITCH).xy[0, 0, 0])
    np.testing.assert_allclose(found.calibration[0, 0, 0], np.cov(np.array(moved).T), rtol=0.15)


def test_stated_regions_hold_the_truth():
    rng = np.random.default_rng(3)
    squared = []
    for _ in range(20):
        velocity = np.cumsum(rng.standard_normal((75, 2)) * 4.0 / np.sqrt(5 * GROUND_FPS), axis=0)
        truth = np.cumsum(velocity / GROUND_FPS, axis=0)
        error = np.zeros((75, 2))
        for f in range(1, 75):  # correlated over half a step
            error[f] = 0.78 * error[f - 1] + 0.63 * 0.15 * rng.standard_normal(2)
        seen = (truth + error)[:, None, None]
        tracks = track_on_plane(positions_at(seen, 0.15), GROUND_FPS, pitch_size=SIZE)
        off = tracks.xy[10:, 0] - truth[10:]
        inverse = np.linalg.inv(tracks.covariance[10:, 0])
        squared.append(np.einsum("fi,fij,fj->f", off, inverse, off))
    assert 0.9 < np.mean(np.concatenate(squared) < 5.99) <= 1.0


@pytest.mark.parametrize("late", [-7.0, 3.4])
def test_runners_tell_the_clock_offset_of_two_cameras(late):
    rng = np.random.default_rng(5)
    starts = rng.uniform([-30, -20], [30, 20], (8, 2))
    time = np.arange(100) / GROUND_FPS
    turn = rng.uniform(0, 6, 8)

    def places(at):
        phase = 0.8 * at[:, None] + turn
        return starts + 5.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    # Camera 1 shows the world `late` frames after camera 0, and its calibration is biased.
    seen = np.stack([places(time), 1.004 * places(time + late / GROUND_FPS) + [0.2, -0.1]], axis=1)
    seen += 0.1 * rng.standard_normal(seen.shape)
    clocks = estimate_plane_clocks(positions_at(seen), GROUND_FPS, pitch_size=SIZE)
    found = (clocks.seconds[1] - clocks.seconds[0]) * GROUND_FPS
    assert clocks.people >= 6
    assert abs(found - late) < max(0.3, 6.0 * clocks.std[0] * GROUND_FPS)
    assert clocks.std[0] * GROUND_FPS < 0.3
    tracks = track_on_plane(positions_at(seen), GROUND_FPS, clocks.seconds, pitch_size=SIZE)
    assert tracks.xy.shape[1] == 8


def test_a_person_keeps_the_identity_before_and_after_triangulation():
    """A runner in one camera, triangulated in frames 30 to 59, and a neighbour."""
    truth = walkers(100, [[0.0, 0.0], [2.0, 3.0]], [[4.0, 1.0], [4.0, 1.0]])
    noise = 0.1 * np.random.default_rng(6).standard_normal((100, 1, 2, 2))
    positions, middle = positions_at(truth[:, None] + noise), np.full((100, 1, 2), np.nan)
    middle[30:60] = truth[30:60, :1]
    people = TriangulatedPeople(middle, np.isfinite(middle[..., 0]))
    tracks = track_on_plane(positions, GROUND_FPS, pitch_size=SIZE, triangulated=people)
    assert sorted(tracks.continues.tolist()) == [-1, 0]
    (k,) = np.flatnonzero(tracks.continues == 0)
    alone = ~people.is_tracked[:, 0]
    np.testing.assert_array_equal(tracks.detection_index[:, 0, k], np.where(alone, 0, -1))
    np.testing.assert_array_equal(np.isfinite(tracks.xy[:, k, 0]), alone)
    off = np.linalg.norm(tracks.xy[:, k] - truth[:, 0], axis=-1)
    assert np.nanmax(off) < 0.3
    # The neighbour, 3.6 m away and never triangulated, is another person.
    assert (tracks.detection_index[:, 0, 1 - k] == 1).all()
    again = locate_tracks(positions, tracks.detection_index[:, :, [k]], GROUND_FPS, None, people.xy)
    assert np.nanmax(np.linalg.norm(again.xy[:, 0] - truth[:, 0], axis=-1)) < 0.3


@pytest.mark.parametrize("outside", [False, True])
def test_overlapping_boxes_are_two_people_where_their_joints_are_apart(ring, outside):
    """Two people behind each other stay two on the pitch; on a bench, boxes alone decide."""
    camera = ring(1)
    sight = -camera[0].center[:2] / np.linalg.norm(camera[0].center[:2])
    place = (40.0 if outside else 0.0) * sight
    places = np.stack([place, place + 1.2 * sight])
    truth = np.broadcast_to(places, (50, 2, 2))
    heights = np.linspace(1.8, 0.09, 17)  # the nose is the top, the ankles are the lowest
    points = np.concatenate(
        [np.broadcast_to(places[:, None], (2, 17, 2)), np.tile(heights[:, None], (2, 1, 1))], axis=2
    )
    pixels = camera[0].project(points.reshape(-1, 3)).reshape(2, 17, 2)
    size = pixels[:, -1, 1] - pixels[:, 0, 1]
    half = np.array([0.3 * size[0], 0.05 * size[0]])
    boxes = np.concatenate([pixels.min(axis=1) - half, pixels.max(axis=1) + half], axis=-1)
    keypoints = np.broadcast_to(pixels, (50, 1, 2, 17, 2)).copy()
    confidence = np.full((50, 1, 2, 17), 0.9)
    confidence[:, :, 1] = 0.8
    boxed = replace(
        detections(keypoints, confidence), boxes=np.broadcast_to(boxes, (50, 1, 2, 4)).copy()
    )
    found = locate_feet(camera, boxed, PITCH)
    assert found.is_whole[:, 0, 0].all()
    assert found.is_whole[:, 0, 1].all() == (not outside)
    tracks = track_on_plane(found, GROUND_FPS, pitch_size=SIZE, margin_m=10.0)
    assert tracks.xy.shape[1] == (1 if outside else 2)
    if not outside:
        off = np.linalg.norm(tracks.xy[:, :, None] - truth[:, None], axis=-1).min(axis=1)
        assert off.max() < 0.3
    keypoints[:, 0, 1] = keypoints[:, 0, 0] + 2.0  # a second box of the first person
    copied = replace(boxed, keypoints=keypoints)
    assert not locate_feet(camera, copied, PITCH).is_whole[:, 0, 1].any()


def test_cameras_that_share_no_runner_have_clocks_of_two_groups():
    rng = np.random.default_rng(7)
    turn = rng.uniform(0.0, 6.0, (2, 6))

    def places(frame, site):
        phase = 0.8 * frame[:, None] / GROUND_FPS + turn[site]
        return 20.0 * (site - 0.5) + 5.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    frame = np.arange(100)
    seen = np.stack([places(frame + late, c // 2) for c, late in enumerate((0, 5, 0, 2))], axis=1)
    starts = 3.0 * np.arange(6)[:, None] * [0.0, 1.0]
    clocks = estimate_plane_clocks(positions_at(seen + starts), GROUND_FPS, pitch_size=SIZE)
    assert clocks.groups == ((0, 1), (2, 3))
    late = GROUND_FPS * clocks.seconds
    assert (late[1] - late[0], late[3] - late[2]) == pytest.approx((5.0, 2.0), abs=0.3)


def test_clocks_of_a_long_clip_are_compared_where_two_cameras_show_the_same_people():
    fps, frame = 10.0, np.arange(1000)
    turn, apart = np.random.default_rng(9).uniform(0.0, 6.0, 5), 4.0 * np.arange(5)[:, None]

    def places(frame):
        phase = 0.8 * frame[:, None] / fps + turn
        return apart + 3.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    seen = np.stack([places(frame), places(frame + 5)], axis=1)
    seen[:680, 1] -= 30.0  # others
    found = estimate_plane_clocks(positions_at(seen), fps, pitch_size=SIZE)
    assert fps * (found.seconds[1] - found.seconds[0]) == pytest.approx(5.0, abs=0.3)


def path_of(first, frames, start, velocity, camera):
    """A path at constant velocity, seen by a camera."""
    xy = np.asarray(start) + np.arange(frames)[:, None] / GROUND_FPS * np.asarray(velocity)
    state = np.concatenate([xy, np.tile(velocity, (frames, 1))], axis=1)
    index = {first + n: {camera: 0} for n in range(frames)}
    return PlanePath(first, state, np.tile(0.01 * np.eye(4), (frames, 1, 1)), index)


@pytest.mark.parametrize(("velocity", "people"), [(-6.0, 2), (6.0, 1)])
def test_a_common_frame_joins_two_paths_with_one_velocity(velocity, people):
    east = path_of(0, 101, (-24.0, 0.0), (6.0, 0.0), 0)
    other = path_of(100, 101, (0.0, 0.9), (velocity, 0.0), 1)
    none = positions_at(np.empty((201, 2, 0, 2)))
    assert len(merge_paths([east, other], GROUND_FPS, none)) == people
