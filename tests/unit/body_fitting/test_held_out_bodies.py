"""Bodies judged by held-out cameras, and bodies of people whom one camera places."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import ring_of_cameras
from scipy.special import chdtri
from walking_bodies import KEYPOINTS, MODEL, panning_camera, walker

from data_contracts.conventions import JOINT_GROUPS
from data_contracts.keypoints import KeypointDetections
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.evidence import ankle_height
from worldpose.body_fitting.from_poses import reconstruct_bodies
from worldpose.body_fitting.held_out import SeenClip, compare_held_out
from worldpose.body_fitting.monocular import parse_monocular
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.errors import InputError
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

SETTINGS = BodyFittingSettings()
GROUPS = list(JOINT_GROUPS)


def ring(count):
    """Cameras around the origin, 40 m away."""
    angles = np.linspace(0.0, 5.5, count)
    return ring_of_cameras(angles, 12.0, (0.0, 0.0, 1.0), 3000.0, away=40.0)


def filmed(cameras, noise_px, seed, people=3, frames=60):
    """People who walk past each other, seen by all cameras with noise."""
    return filmed_with_truth(cameras, noise_px, seed, people, frames)[0]


def filmed_with_truth(cameras, noise_px, seed, people=3, frames=60):
    """People of `filmed`, and their joints."""
    rng = np.random.default_rng(seed)
    joints = []
    for person in range(people):
        body = walker(frames, rng)
        place = body.transl + [-0.9, 1.5 * (person - 1), 0.0]
        joints.append(KEYPOINTS(replace(body, transl=place)))
    truth = np.stack(joints, axis=1)
    count = len(cameras.focal)
    image = cameras.project(truth.reshape(frames, 1, -1, 3)).reshape(frames, count, people, 17, 2)
    image = image + noise_px * rng.standard_normal(image.shape)
    index = np.tile(np.arange(people, dtype=np.int16), (frames, count, 1))
    seen = KeypointDetections.from_keypoints(image, np.full(image.shape[:-1], 0.8), index)
    return seen, truth


@pytest.fixture(scope="module")
def clip():
    cameras = ring(6)
    detections = filmed(cameras, 1.5, 7)
    return SeenClip(cameras, None, detections, TriangulationSettings(), 50.0)


@pytest.fixture(scope="module")
def fit(clip):
    placed = triangulate_joints(clip.cameras, clip.detections, clip.settings)
    evidence = ClipEvidence(
        placed.joints, placed.covariance, clip.fps, common_bias=placed.common_bias
    )
    return fit_bodies(MODEL, evidence, SETTINGS)


def test_bodies_of_the_right_shape_are_nearer_and_none_is_named(clip, fit):
    found = compare_held_out(MODEL, SETTINGS, None, clip, fit)
    assert found.keypoints.sum() > 10_000
    # Keypoints are 1.5 px off per axis, and 3000 px at 41 m are 73 px per metre.
    np.testing.assert_allclose(found.fitted, np.sqrt(2.0) * 1.5 / 73.0, rtol=0.2)
    assert (found.excess < 0.0).all()
    assert (found.certain_excess == 0.0).all()
    assert found.figures()["held_out_excess_m.knee"] == found.excess[GROUPS.index("knee")]


def test_a_body_whose_shanks_are_wrong_is_named_at_knees_or_ankles(clip, fit):
    spans = np.zeros((17, 3))
    spans[15:17, 2] = -0.08  # the detector's ankles 8 cm below the body's: shanks of 8 cm more
    wrong = compare_held_out(MODEL, SETTINGS, None, clip, replace(fit, offsets=spans))
    named = {group for group, value in zip(GROUPS, wrong.certain_excess, strict=True) if value > 0}
    assert "ankle" in named
    assert not named & {"head", "shoulder", "elbow", "wrist"}
    # Half of the 8 cm goes into the pose, at most, and image planes show two axes of three.
    assert 0.01 < wrong.certain_excess[GROUPS.index("ankle")] < 0.08


@pytest.mark.parametrize("known", [True, False])
def test_one_call_places_bodies_better_than_triangulation(known):
    """Three cameras, 1.5 px noise; in frame 20 nobody is seen, and the files do not have it."""
    cameras = {f"cam{n}": each for n, each in enumerate(ring(3))}
    seen, truth = filmed_with_truth(ring(3), 1.5, 7, people=2, frames=30)
    rows = np.delete(np.arange(30), 20)
    if known:
        given = replace(seen, frame=np.arange(30))[rows]
    else:
        given = [
            KeypointDetections.from_keypoints(
                seen.keypoints[rows, c], seen.confidence[rows, c], frame=rows
            )
            for c in range(3)
        ]
    found = reconstruct_bodies(cameras, given, 50.0)
    assert found.frame.tolist() == list(range(30))
    order = np.argsort(np.nanmedian(found.bodies.joints[..., 0, 1], axis=0))
    errors = [
        np.nanmean(np.linalg.norm((joints[:, order] - truth)[rows], axis=-1))
        for joints in (found.joints.triangulation.joints, found.joints.joints, found.bodies.joints)
    ]
    assert len(order) == 2
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.02


def test_every_second_frame_is_half_the_frame_rate_and_rows_are_frames_without_numbers():
    seen = filmed(ring(3), 1.5, 7, people=1, frames=24)
    every = replace(seen, frame=np.arange(24))[np.arange(0, 24, 2)]
    rows = replace(every, frame=every.frame[:0])
    one, other = (reconstruct_bodies(ring(3), *given) for given in ((every, 50.0), (rows, 25.0)))
    assert one.frame.tolist() == list(range(0, 24, 2))
    assert other.tracks.frames.tolist() == list(range(12))
    np.testing.assert_array_equal(one.bodies.joints, other.bodies.joints)


@pytest.mark.parametrize(
    ("cameras", "frame", "fps", "words"),
    [
        (4, [0, 1, 2], 50.0, "cameras .cameras,. of 2 or more"),
        (3, [0, 1], 50.0, "found .2,. int64. Give each row the number"),
        (3, [0.0, 0.5, 1.0], 50.0, "expected 3 whole numbers, one for each row, or none, found"),
        (3, [0, 0, 1], 50.0, "found numbers that repeat or fall"),
        (3, [0, 40, 10**9], 50.0, "at most 200000 from first to last"),
        (3, [0, 1, 2], 0.0, "frames per second, above 0"),
        (3, [0, 1, 2], "25", "frames per second, above 0"),
    ],
)
def test_one_call_refuses_what_it_cannot_place(cameras, frame, fps, words):
    seen = replace(filmed(ring(3), 1.5, 7, frames=3), frame=np.array(frame))
    with pytest.raises(InputError, match=words):
        reconstruct_bodies(ring(cameras), seen, fps)


@pytest.mark.parametrize(("points", "sure"), [(25, 25), (17, 16)])
def test_one_call_names_the_points_that_it_takes(points, sure):
    seen = KeypointDetections.from_keypoints(
        np.ones((2, 3, 1, points, 2)), np.ones((2, 3, 1, sure))
    )
    for call in (reconstruct_bodies, track_people):
        with pytest.raises(InputError, match=r"17, 2|joints, 2"):
            call(ring(3), seen, 50.0)
    with pytest.raises(InputError, match="of 2 or more"):
        reconstruct_bodies(ring(3), [], 50.0)


def test_rows_without_numbers_keep_their_place_and_people():
    seen = KeypointDetections.from_keypoints(
        np.ones((6, 3, 1, 17, 2)), np.ones((6, 3, 1, 17)), np.zeros((6, 3, 1), int)
    )
    part = seen[2:4]
    assert part.frame.tolist() == [2, 3]
    for each in (seen[:2], part):
        found = each.reindex(np.arange(1, 4))
        known = np.isin([1, 2, 3], each.frame)
        np.testing.assert_array_equal(np.isfinite(found.keypoints).all((1, 2, 3, 4)), known)
        np.testing.assert_array_equal((found.detection_index == 0).all((1, 2)), known)
    fractions = KeypointDetections.from_keypoints(
        seen.keypoints, seen.confidence, None, np.full(6, 0.5)
    )
    with pytest.raises(InputError, match="6 whole numbers"):
        track_people(ring(3), fractions, 50.0)


FPS, FRAMES = 25.0, 30
CENTER = np.array([0.0, -60.0, 14.0])
PLACE_STD = np.array([0.08, 0.30])
"""Errors of places across and along the line of sight [m]."""


class Clip:
    """Two people who walk on flat ground, their estimates and detections."""

    def __init__(self, seed, *, frames=FRAMES, errors=None, speed=1.0, place_std=PLACE_STD):
        rng = np.random.default_rng(seed)
        walkers = [walker(frames, rng, fps=FPS) for _ in range(2)]
        values = []
        for k, body in enumerate(walkers):
            joints = KEYPOINTS(body)
            lowest = joints[:, 15:17, 2].min(axis=1)
            transl = body.transl + [-3.0 + 6.0 * k, 4.0 * k, 0.0]
            transl[:, 2] += ankle_height(MODEL, body.betas[0]) - lowest
            values.append((body.betas, body.global_orient, body.body_pose, transl))
        self.bodies = BodyParameters(*(np.stack(v, axis=1) for v in zip(*values, strict=True)))
        self.truth = KEYPOINTS(self.bodies)
        self.camera = panning_camera(frames, (-0.03, 0.08), CENTER, 3500.0, 1.0)
        drawn = estimate_bodies(
            MODEL, self.bodies, self.camera, FPS, errors or MonocularErrors(), rng
        )
        self.estimates = parse_monocular(drawn, "estimates")
        flat = self.truth.reshape(frames, -1, 3)
        image = self.camera.project(flat).reshape(frames, 2, 17, 2)
        slow, quick = rng.normal(0.0, 1.2, (1, 2, 17, 2)), rng.normal(0.0, 1.2, image.shape)
        self.keypoints = image + slow + quick
        hips = self.truth[:, :, 11:13, :2].mean(axis=2)
        sight = hips - CENTER[:2]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        across = np.stack([sight[..., 1], -sight[..., 0]], axis=-1)
        axes = np.stack([across, sight], axis=-1)
        off = rng.normal(0.0, place_std, (1, 2, 2))
        self.place = hips + (axes @ off[..., None])[..., 0]
        self.covariance = axes @ np.diag(place_std**2) @ np.swapaxes(axes, -1, -2)

    def evidence(self, **changes):
        given = {
            "camera": self.camera,
            "number": np.arange(len(self.truth)),
            "keypoints": self.keypoints,
            "confidence": np.full(self.truth.shape[:3], 0.9),
            "place": self.place,
            "place_covariance": self.covariance,
            "calibration": np.zeros_like(self.covariance),
            "fps": FPS,
        }
        return PlaneEvidence(**{**given, **changes})

    def fit(self, estimates=None, **changes):
        estimates = self.estimates if estimates is None else estimates
        return fit_bodies_on_plane(
            MODEL, self.evidence(**changes), estimates, lambda x, y: 0.0 * (x + y)
        )

    def rows_of(self, person):
        """Rows of the estimates that show a person."""
        image = self.camera.project(self.truth.reshape(len(self.truth), -1, 3))
        middle = image.reshape(len(self.truth), 2, 17, 2).mean(axis=2)
        center, frame = self.estimates.center, self.estimates.frame
        return np.linalg.norm(middle[frame] - center[:, None], axis=-1).argmin(axis=1) == person


@pytest.fixture(scope="module")
def fits():
    clips = [Clip(seed) for seed in range(4)]
    return [(clip, clip.fit()) for clip in clips]


def test_fitted_bodies_are_nearer_to_the_truth_than_placed_ones(fits):
    placed, fitted, placed_around, fitted_around = [], [], [], []
    for clip, bodies in fits:
        assert bodies.missing == (None, None)
        assert np.isfinite(bodies.fit.joints).all()
        for off, all_of_it, centred in (
            (bodies.placed - clip.truth, placed, placed_around),
            (bodies.fit.joints - clip.truth, fitted, fitted_around),
        ):
            all_of_it.append(np.linalg.norm(off, axis=-1))
            centred.append(np.linalg.norm(off - off.mean(axis=2, keepdims=True), axis=-1))
    assert np.nanmean(fitted) < 0.75 * np.nanmean(placed)
    assert np.nanmean(placed_around) > 0.12
    assert np.nanmean(fitted_around) < 0.07


def test_regions_hold_the_truth_and_are_long_in_depth(fits):
    inside, ratios = [], []
    for clip, bodies in fits:
        fit = bodies.fit
        off = fit.joints - clip.truth
        square = (off * np.linalg.solve(fit.covariance, off[..., None])[..., 0]).sum(axis=-1)
        inside.append(square < chdtri(3, 0.05))
        sight = clip.truth[:, :, 11] - CENTER
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        hips = fit.covariance[:, :, 11]
        along = np.einsum("fpa,fpab,fpb->fp", sight, hips, sight)
        ratios.append(along / hips[..., 0, 0])
    assert np.mean(inside) > 0.9
    assert np.median(ratios) > 4.0


@pytest.mark.parametrize("seen", [0, 3])
def test_people_whose_ankles_are_hidden_stay_at_their_places(seen):
    clip = Clip(3)
    keypoints = clip.keypoints.copy()
    keypoints[seen:, 1, 15:17] = np.nan
    bodies = clip.fit(keypoints=keypoints)
    assert bodies.missing == (None, None)
    hips = bodies.fit.joints[:, 1, 11:13].mean(axis=1)[:, :2]
    # Places are 0.3 m off along the line of sight; at most half of it comes back by the pose.
    assert np.linalg.norm(hips - clip.place[:, 1], axis=-1).max() < 0.3


@pytest.mark.slow
def test_people_whose_ankles_are_hidden_are_no_surer_than_their_places():
    """Places 1 m off in all of 30 frames; squares of errors are 1 of their stated variance."""
    squares = []
    for seed in range(8):
        clip = Clip(seed, place_std=np.array([0.08, 1.0]))
        keypoints = clip.keypoints.copy()
        keypoints[:, 1, 15:17] = np.nan
        fit = clip.fit(keypoints=keypoints).fit
        sight = (clip.truth[:, 1, 11] - CENTER) * [1.0, 1.0, 0.0]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        off = ((fit.joints - clip.truth)[:, 1, 11:13].mean(axis=1) * sight).sum(axis=-1)
        squares.append(off**2 / np.einsum("fa,fab,fb->f", sight, fit.covariance[:, 1, 11], sight))
    assert np.mean(squares) < 1.4


@pytest.mark.parametrize("case", ["upside down", "turned round"])
def test_estimates_that_contradict_the_keypoints_are_refused_with_the_reason(case):
    clip = Clip(10)
    rotations, wrong = clip.estimates.rotations.copy(), clip.rows_of(1)
    if case == "upside down":
        rotations[wrong, 0] = np.diag([-1.0, -1.0, 1.0]) @ rotations[wrong, 0]
    else:
        rotations[wrong, 0] = rotations[wrong, 0] @ np.diag([-1.0, 1.0, -1.0])
    bodies = clip.fit(replace(clip.estimates, rotations=rotations))
    assert bodies.missing[0] is None
    assert "the keypoints" in bodies.missing[1]
    assert np.isnan(bodies.fit.joints[:, 1]).all()
    assert np.isnan(bodies.fit.betas_covariance[1]).all()
    assert np.isfinite(bodies.fit.joints[:, 0]).all()
