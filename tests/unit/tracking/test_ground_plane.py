"""People on the pitch plane: places of feet, tracks, clock offsets; known truth."""

from dataclasses import replace

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.parameters import step_camera
from worldpose.tracking.plane import paths
from worldpose.tracking.plane.clocks import estimate_plane_clocks
from worldpose.tracking.plane.feet import ANKLE_HEIGHT, GroundPositions, locate_feet
from worldpose.tracking.plane.paths import PlanePath, merge_paths
from worldpose.tracking.plane.tracker import TriangulatedPeople, locate_tracks, track_on_plane

detections = KeypointDetections.from_keypoints

PITCH = PitchTemplate.from_spec(PitchSpec(crown=0.0))
SIZE = (105.0, 68.0)
FPS = 25.0


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
    time = np.arange(frames)[:, None, None] / FPS
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
    boxes = np.array(
        [[[[foot[0] - 20, foot[1] - 90, foot[0] + 20, foot[1]], [0, 900, 40, 1079.5]]]]
    )
    keypoints = np.full((1, 1, 2, 17, 2), np.nan)
    bare = detections(keypoints, np.zeros((1, 1, 2, 17)))
    found = locate_feet(camera, replace(bare, boxes=boxes), PITCH)
    assert np.linalg.norm(found.xy[0, 0, 0]) < 0.5
    assert np.isnan(found.xy[0, 0, 1]).all()
    assert np.isnan(locate_feet(camera, bare, PITCH).xy).all()


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
        velocity = np.cumsum(rng.standard_normal((75, 2)) * 4.0 / np.sqrt(5 * FPS), axis=0)
        truth = np.cumsum(velocity / FPS, axis=0)
        error = np.zeros((75, 2))
        for f in range(1, 75):  # correlated over half a step
            error[f] = 0.78 * error[f - 1] + 0.63 * 0.15 * rng.standard_normal(2)
        seen = (truth + error)[:, None, None]
        tracks = track_on_plane(positions_at(seen, 0.15), FPS, pitch_size=SIZE)
        off = tracks.xy[10:, 0] - truth[10:]
        inverse = np.linalg.inv(tracks.covariance[10:, 0])
        squared.append(np.einsum("fi,fij,fj->f", off, inverse, off))
    assert 0.9 < np.mean(np.concatenate(squared) < 5.99) <= 1.0


@pytest.mark.parametrize("late", [-7.0, 3.4])
def test_runners_tell_the_clock_offset_of_two_cameras(late):
    rng = np.random.default_rng(5)
    starts = rng.uniform([-30, -20], [30, 20], (8, 2))
    time = np.arange(100) / FPS
    turn = rng.uniform(0, 6, 8)

    def places(at):
        phase = 0.8 * at[:, None] + turn
        return starts + 5.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    # Camera 1 shows the world `late` frames after camera 0, and its calibration is biased.
    seen = np.stack([places(time), 1.004 * places(time + late / FPS) + [0.2, -0.1]], axis=1)
    seen += 0.1 * rng.standard_normal(seen.shape)
    clocks = estimate_plane_clocks(positions_at(seen), FPS, pitch_size=SIZE)
    found = (clocks.seconds[1] - clocks.seconds[0]) * FPS
    assert clocks.people >= 6
    assert abs(found - late) < max(0.3, 6.0 * clocks.std[0] * FPS)
    assert clocks.std[0] * FPS < 0.3
    tracks = track_on_plane(positions_at(seen), FPS, clocks.seconds, pitch_size=SIZE)
    assert tracks.xy.shape[1] == 8


def mixed_run(frames=100):
    """A runner in one camera, triangulated in frames 30 to 59, and a neighbour."""
    rng = np.random.default_rng(6)
    truth = walkers(frames, [[0.0, 0.0], [2.0, 3.0]], [[4.0, 1.0], [4.0, 1.0]])
    seen = truth[:, None] + 0.1 * rng.standard_normal((frames, 1, 2, 2))
    middle = np.full((frames, 1, 2), np.nan)
    middle[30:60] = truth[30:60, :1]
    return truth, positions_at(seen), TriangulatedPeople(middle, np.isfinite(middle[..., 0]))


def test_a_person_keeps_the_identity_before_and_after_triangulation():
    truth, positions, people = mixed_run()
    tracks = track_on_plane(positions, FPS, pitch_size=SIZE, triangulated=people)
    assert sorted(tracks.continues.tolist()) == [-1, 0]
    (k,) = np.flatnonzero(tracks.continues == 0)
    seen = tracks.detection_index[:, 0, k]
    assert (seen[~people.is_tracked[:, 0]] == 0).all() and (
        seen[people.is_tracked[:, 0]] == -1
    ).all()
    np.testing.assert_array_equal(np.isfinite(tracks.xy[:, k, 0]), ~people.is_tracked[:, 0])
    off = np.linalg.norm(tracks.xy[:, k] - truth[:, 0], axis=-1)
    assert np.nanmax(off) < 0.3
    # The neighbour, 3.6 m away and never triangulated, is another person.
    assert (tracks.detection_index[:, 0, 1 - k] == 1).all()
    again = locate_tracks(positions, tracks.detection_index[:, :, [k]], FPS, None, people.xy)
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
    tracks = track_on_plane(found, FPS, pitch_size=SIZE, margin_m=10.0)
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
        phase = 0.8 * frame[:, None] / FPS + turn[site]
        return 20.0 * (site - 0.5) + 5.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    frame = np.arange(100)
    seen = np.stack([places(frame + late, c // 2) for c, late in enumerate((0, 5, 0, 2))], axis=1)
    starts = 3.0 * np.arange(6)[:, None] * [0.0, 1.0]
    clocks = estimate_plane_clocks(positions_at(seen + starts), FPS, pitch_size=SIZE)
    assert clocks.groups == ((0, 1), (2, 3))
    late = FPS * clocks.seconds
    assert (late[1] - late[0], late[3] - late[2]) == pytest.approx((5.0, 2.0), abs=0.3)


def path_of(first, frames, start, velocity, camera):
    """A path at constant velocity, seen by a camera."""
    xy = np.asarray(start) + np.arange(frames)[:, None] / FPS * np.asarray(velocity)
    state = np.concatenate([xy, np.tile(velocity, (frames, 1))], axis=1)
    index = {first + n: {camera: 0} for n in range(frames)}
    return PlanePath(first, state, np.tile(0.01 * np.eye(4), (frames, 1, 1)), index)


@pytest.mark.parametrize(("velocity", "people"), [(-6.0, 2), (6.0, 1)])
def test_a_common_frame_joins_two_paths_with_one_velocity(velocity, people):
    east = path_of(0, 101, (-24.0, 0.0), (6.0, 0.0), 0)
    other = path_of(100, 101, (0.0, 0.9), (velocity, 0.0), 1)
    none = positions_at(np.empty((201, 2, 0, 2)))
    assert len(merge_paths([east, other], FPS, none)) == people


def test_paths_without_a_common_frame_are_not_compared(monkeypatch):
    compared = []

    def compare(*given, compare=paths._is_same_person):
        compared.append(given)
        return compare(*given)

    monkeypatch.setattr(paths, "_is_same_person", compare)
    none = positions_at(np.empty((1000, 2, 0, 2)))
    alone = [path_of(20 * n, 20, (0.0, 0.0), (0.0, 0.0), 0) for n in range(50)]
    again = [path_of(20 * n, 20, (0.1, 0.0), (0.0, 0.0), 1) for n in range(50)]
    assert len(merge_paths(alone + again, FPS, none)) == len(compared) == 50
