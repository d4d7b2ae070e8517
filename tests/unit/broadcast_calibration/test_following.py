"""A turning camera is followed from frame to frame and solved for in whole clips."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import turning_clip as clip
from pydantic import ValidationError

from data_contracts.broadcast_calibration import KeyFrame
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.broadcast_calibration.clip_problem import ClipProblem, TermWeights
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence, whiten_points
from worldpose.broadcast_calibration.key_frames import calibrate_keys
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.players import People, estimate_feed_offset
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.residuals import linearize
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings, BroadcastPrior
from worldpose.broadcast_calibration.solver import solve
from worldpose.broadcast_calibration.tracking import (
    Followed,
    chain,
    follow,
    modified_z_scores,
    turn,
)
from worldpose.broadcast_calibration.uncertainty import pool_centers
from worldpose.errors import DegenerateError, InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.ingest.clock import ImageClock, rows_at
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scene import look_at
from worldpose.static_calibration.estimate import calibrate_camera


def pairs_of(camera, rng):
    flow = clip.followed_points(camera, rng, each=80, noise=0.05)
    return [
        Followed(flow.start[flow.frame == t], flow.end[flow.frame == t], 1.0)
        for t in range(len(camera) - 1)
    ]


@pytest.mark.parametrize(
    ("center", "distance"),
    [
        ((0.0, -75.0, 17.0), 75.0),
        ((0.0, 75.0, 17.0), 75.0),  # on the far side
        ((-80.0, 0.0, 17.0), 80.0),  # behind a goal
        ((30.0, 40.0, 17.0), 50.0),
        ((0.0, 0.0, 17.0), 20.0),  # on a cable: its standard deviation
    ],
)
def test_a_mean_center_on_any_side_is_a_prior_of_key_frames(center, distance):
    prior = BroadcastCalibrationSettings(prior=BroadcastPrior(center_m=center)).key_frame.prior
    assert (prior.distance_m, prior.height_m) == (distance, 17.0)


@pytest.mark.parametrize("height", [0.0, -2.0])
def test_a_mean_center_is_above_the_pitch(height):
    with pytest.raises(ValidationError, match="center_m"):
        BroadcastPrior(center_m=(0.0, -75.0, height))


def test_key_frames_of_a_wide_lens_keep_the_model_of_the_clip():
    pose, size = look_at(np.array([0.0, -60.0, 18.0]), np.zeros(3), 0.0), (1920, 1080)
    matrix, middle = np.diag([900.0, 900.0, 1.0]), (959.5, 539.5)
    matrix[:2, 2] = middle
    true = Camera.from_matrices(
        matrix, (-0.25, 0.07, 0.0, 0.0, -0.008), pose.rotation, pose.translation, size
    )
    seen = true.project(clip.PITCH.positions(list(clip.PITCH.points)))
    seen += np.random.default_rng(1).normal(0.0, 0.7, seen.shape)
    inside = ((seen > 5.0) & (seen < np.array(size) - 6.0)).all(axis=1)
    pixels = {name: seen[n] for n, name in enumerate(clip.PITCH.points) if inside[n]}
    clicked = ClickedMarkings.model_validate(
        {"points": [{"name": name, "xy": tuple(xy)} for name, xy in pixels.items()]}
    )
    # The clicks alone are those of a fisheye, whose k1, k2 and k3 are another polynomial's.
    alone = calibrate_camera(clip.PITCH, clicked, size).estimate.camera
    assert alone.lens_model == LensModel.FISHEYE
    with pytest.raises(InputError, match="model brown, found fisheye"):
        MovingCamera.from_batch(Camera.stack([alone]))
    key = KeyFrame(frame=0, markings=clicked)
    found = calibrate_keys(clip.PITCH, [key], size, {}, BroadcastCalibrationSettings(), "clip")
    places = clip.PITCH.positions(list(pixels))
    off = np.linalg.norm(found.camera.camera[0].project(places) - true.project(places), axis=1)
    assert off.max() < 9.0  # k1, k2 and k3 of the fisheye, read as Brown's: over 300 px


@pytest.mark.parametrize(("mean", "names"), [(-75.0, 2), (75.0, 2), (75.0, 3)])
def test_key_frames_stand_on_the_side_of_the_others_or_else_of_the_prior(mean, names):
    true, rng = clip.moving(2, pan=(-2.0, 6.0)), np.random.default_rng(2)
    drawn = [clip.draw(true, 0, 1.0, rng)[:2], clip.draw(true, 1, 1.0, rng)[:names]]
    keys = [
        KeyFrame(frame=n, markings=ClickedMarkings.model_validate({"points": [], "drawn": each}))
        for n, each in enumerate(drawn)
    ]
    settings = BroadcastCalibrationSettings(prior=BroadcastPrior(center_m=(0.0, mean, 17.0)))
    found = calibrate_keys(clip.PITCH, keys, clip.SIZE, {}, settings, "clip")
    assert not found.refused
    # The third marking is the far touch line, and the camera is near.
    assert np.sign(found.camera.center[1]) == (np.sign(mean) if names == 2 else -1.0)


def test_a_survey_without_errors_leaves_its_points_in_place():
    places = {name: tuple(at.tolist()) for name, at in clip.PITCH.points.items() if "left" in name}
    surveyed = PitchTemplate.from_spec(PitchSpec(points=places))
    before = PitchErrors.of(surveyed, BroadcastCalibrationSettings(survey_error_m=0.0))
    ends = np.stack([np.arange(len(surveyed.points)), np.full(len(surveyed.points), -1)], axis=1)
    points = PointEvidence.observe(
        0,
        np.zeros(len(ends), dtype=np.int64),
        surveyed.positions(list(surveyed.points)),
        np.zeros((len(ends), 2)),
        whiten_points(np.ones(len(ends))),
        loss=np.inf,
    )
    first = before.apply(points, ends, np.ones(ends.shape))
    again = replace(before, shown_m=0.5 * before.shown_m).rescale(first, before).shares
    expected = np.where(before.surveyed, 0.0, 0.5 * before.paint_m)
    np.testing.assert_allclose(again, np.stack([expected, np.zeros(len(ends))], axis=1))


def test_a_turn_and_a_zoom_are_found_among_movers():
    rng = np.random.default_rng(4)
    true = clip.moving(2, pan=(0.0, 0.6), zoom=(2000.0, 2020.0))
    (pair,) = pairs_of(true, rng)
    # A third of the points move on their own.
    end = pair.end.copy()
    end[:25] += rng.uniform(-15.0, 15.0, (25, 2))
    found = turn(true.frames(slice(0, 1)), Followed(pair.start, end, 1.0))
    assert found.determined
    pixels = np.array([[100.0, 100.0], [800.0, 450.0]])
    one, two = (each.camera[1].unproject(pixels).directions for each in (found.camera, true))
    # 55 points of 0.05 px: a hundredth of a pixel, of 2000 px.
    assert np.abs(one - two).max() < 2e-5
    assert (modified_z_scores(found.residual)[:25] > 3.5).mean() > 0.9


def test_a_chain_meets_its_key_frames_and_says_what_it_missed():
    rng = np.random.default_rng(5)
    true = clip.moving(30)
    keys = true.frames(np.array([3, 24]))
    links = chain([3, 24], keys, pairs_of(true, rng), 3.5)
    for index, frame in enumerate((3, 24)):
        np.testing.assert_allclose(links.camera.rotation[frame], keys.rotation[index], atol=1e-12)
    assert links.determined.all()
    # 21 steps of about a hundredth of a pixel.
    assert 0.0 < links.drift[0] < 0.3


def test_the_drift_over_a_broken_pair_is_all_in_that_pair():
    rng = np.random.default_rng(6)
    true = clip.moving(30)
    pairs = pairs_of(true, rng)
    pairs[20] = Followed(np.empty((0, 2)), np.empty((0, 2)), np.nan)
    links = chain([3, 24], true.frames(np.array([3, 24])), pairs, 3.5)
    turn = links.camera.rotation @ np.swapaxes(true.rotation, 1, 2)
    # A pair turns by 4e-3; twenty pairs add up to 1e-4.
    assert np.abs(turn - np.eye(3)).max() < 2e-4


def test_points_are_followed_across_a_black_frame():
    rng = np.random.default_rng(7)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (270, 500)).astype(np.uint8), (0, 0), 2.0)
    shown = [np.ascontiguousarray(wide[:, 4 * n : 4 * n + 480]) for n in range(4)]
    shown[1] = np.zeros_like(shown[1])
    first, across, last = follow(shown, None, 100)
    assert np.isnan(first.inlier_share) and not len(first.start)
    assert (across.step, last.step) == (2, 1)
    # Two frames of 4 px each.
    np.testing.assert_allclose(np.median(across.end - across.start, axis=0), [-8.0, 0.0], atol=0.1)


FRAMES, FPS = 120, 50.0


def people(late, speed, rng, noise=1.0):
    """Eight people who run to and fro along x; the feed shows them `late` frames on."""
    camera = clip.moving(FRAMES)
    start = np.stack([np.linspace(-6.0, 8.0, 8), np.tile([-6.0, -2.0, 4.0, 8.0], 2)], axis=-1)
    phase = rng.uniform(0.0, 6.0, 8)

    def joints(frames):
        time = frames[:, None] / FPS
        x = start[:, 0] + speed / 2.0 * np.sin(2.0 * time + phase)
        places = np.stack([x, np.broadcast_to(start[:, 1], x.shape), 0.0 * x], axis=-1)
        return places[:, :, None] + clip.SHAPE

    frames = np.arange(FRAMES, dtype=float)
    seen = camera.camera.project(joints(frames + late).reshape(FRAMES, -1, 3))
    seen = seen.reshape(FRAMES, 8, 17, 2) + noise * rng.standard_normal((FRAMES, 8, 17, 2))
    given = joints(frames) + 0.01 * rng.standard_normal((FRAMES, 8, 17, 3))
    return camera, People(given, seen, FPS)


@pytest.mark.parametrize(("rate", "late"), [(2.0, 0.5), (2.0, -3.0), (1.2, 1.4)])
def test_the_offset_of_a_faster_camera_is_in_match_frames(rate, late):
    rng, frames = np.random.default_rng(2), np.arange(int(FRAMES / rate))
    clock = ImageClock.of(frames, 0.0, rate, 0.0)
    camera, exact = people(late * rate, 5.0, rng)
    # What static cameras of this lower rate triangulate, with the noise of single frames.
    joints = rows_at(exact.joints, frames * rate)
    joints = joints + 0.04 * rng.standard_normal(joints.shape)
    moving = People.in_images(joints, exact.keypoints[clock.number], FPS / rate, clock)
    images = np.arange(len(clock.images))
    moving = replace(moving, keypoints=exact.keypoints[images])
    found = estimate_feed_offset(camera.frames(images), moving, reach=10.0)
    assert found.determined
    assert (found.frames, found.rate) == pytest.approx((late, rate), abs=0.15)


def test_clips_that_agree_give_their_weighted_mean_and_those_of_two_places_none():
    wide, narrow = 4.0 * np.eye(3), np.eye(3)
    places = [np.array([x, -70.0, 15.0]) for x in (0.0, 1.0, 10.0)]
    pooled = pool_centers(places[:2], [wide, narrow])
    assert pooled.agree
    # Weights of 1/4 and 1.
    np.testing.assert_allclose(pooled.center, [0.8, -70.0, 15.0])
    np.testing.assert_allclose(pooled.covariance, 0.8 * np.eye(3))
    apart = pool_centers(places[::2], [narrow, narrow])
    assert not apart.agree and np.isnan(apart.center).all()
    # Half of ten to either side.
    np.testing.assert_allclose(apart.distance, [5.0, 5.0])


def off(true, rng):
    step = 1e-3 * rng.standard_normal((len(true), 7))
    step[:, 3] *= 5.0
    return true.take_step(step, [0.4, -0.5, 0.3, 3.0, 2.0])


def test_exact_evidence_gives_the_exact_camera():
    rng = np.random.default_rng(1)
    true = clip.moving(20)
    points = clip.ground_points(true, rng, noise=1e-6)
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    problem = ClipProblem(points, FlowEvidence.none(), prior, smoothness=np.full(4, np.inf))
    found = solve(off(true, rng), problem, 60).camera
    # A prior of pixels against evidence of 1e-6 px.
    np.testing.assert_allclose(found.center, true.center, atol=1e-3)
    pixels = np.array([[100.0, 100.0], [480.0, 270.0], [860.0, 440.0]])
    one, two = (each.camera.unproject(pixels).directions for each in (found, true))
    assert np.degrees(np.median(np.linalg.norm(one - two, axis=-1))) < 1e-5


def test_a_frame_with_neither_evidence_nor_prior_is_named_as_undetermined():
    true = clip.moving(4)
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    with pytest.raises(DegenerateError, match="neither evidence nor prior"):
        solve(true, ClipProblem(PointEvidence.none(), FlowEvidence.none(), prior), 5)


def test_the_gradient_is_the_slope_of_the_cost():
    rng = np.random.default_rng(4)
    true = clip.moving(6)
    points, flow = clip.ground_points(true, rng, each=8), clip.followed_points(true, rng, each=8)
    # On nothing, one point, two points, or one twice, as arcs do.
    ends = rng.integers(-1, 4, (len(points), 2))
    shares = 0.01 * rng.uniform(0.2, 1.0, ends.shape)
    by_size = 0.01 * rng.standard_normal((len(points), 2, 3))
    by_size[:, 1, :2] = 0.0  # the end fall moves places along z alone
    known = {"ends": ends, "shares": shares, "by_size": by_size}
    robust = replace(points, loss=np.full(len(points), 3.0), **known)
    problem = ClipProblem(
        robust,
        flow,
        replace(
            build_prior(BroadcastPrior(), true.focal, true.image_size),
            rotation=true.rotation,
            rotation_std=np.array([np.inf, *[2e-3] * 5]),
        ),
        TermWeights(field=1.3, player=0.4, flow=0.7),
        smoothness=np.array([np.inf] * 3 + [1e-3]),
        lens_walk=np.linspace(0.1, 0.3, 5),
        flow_loss=2.0,
    )
    camera = true.take_step(1e-4 * rng.standard_normal((6, 7)), [0.02, -0.01, 0.03, 0.5, -0.4])
    beside = 0.3 * rng.standard_normal((problem.paint_count, 3))
    here = linearize(camera, beside, problem)
    step, shared = rng.standard_normal((6, 7)), rng.standard_normal(5)
    paint = rng.standard_normal(beside.shape)
    size = 1e-8
    ahead, behind = (
        linearize(camera.take_step(by * step, by * shared), beside + by * paint, problem).cost
        for by in (size, -size)
    )
    slope = float(
        (here.system.right * step).sum() + here.system.right_corner @ [*shared, *paint.ravel()]
    )
    # Differences of a cost of 1e3 known to 1e-13, over 2e-8; the slope is 1e5.
    assert (ahead - behind) / (2.0 * size) == pytest.approx(slope, rel=1e-5)
