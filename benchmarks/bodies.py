"""Bodies of simulated people: of all cameras, and of one with given boxes as in the challenge."""

from __future__ import annotations

import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import simulate
from registry import Table, Tables, benchmark, duration, option, seeds

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import load_open_body
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import CHALLENGE15, fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.monocular import parse_monocular
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.residuals import Pose
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.standing import stand_on_ground
from worldpose.evaluation.challenge import HIPS
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.challenge import challenge_truth
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.tracking.plane.feet import GroundPositions, locate_feet
from worldpose.tracking.plane.tracker import locate_tracks
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

COLUMNS = ["scenario, seed", "method", "boxes", "world cm", "root cm", "local cm", "score"]


@benchmark(
    "challenge",
    "one broadcast camera with given boxes: error and score as in the pose challenge",
    seeds(701, 702, 703),
    duration(4.0),
    option("--scenarios", nargs="+", default=["broadcast-pan", "broadcast-zoom"]),
)
def score_challenge(options: Namespace) -> Tables:
    """True cameras and identities, simulated keypoints and monocular poses, no truth besides.

    `boxes` is the share of boxes with a pose; the others do not count. `mean pose` puts the mean
    pose of the prior on the feet, facing the way that the person goes.
    """
    rows: list[list[Any]] = []
    for name in options.scenarios:
        for seed in options.seeds:
            rows += [[f"{name} {seed}", *row] for row in score_clip(name, seed, options.duration)]
    for method in ("ours", "mean pose"):
        own = [row[2:] for row in rows if row[1] == method]
        rows.append(["all", method, *np.mean(own, axis=0).tolist()])
    return {"challenge": Table("means over boxes", COLUMNS, rows)}


def score_clip(name: str, seed: int, seconds: float) -> list[list[Any]]:
    """Return the rows of one clip."""
    scenario = SCENARIOS[name].model_copy(update={"duration": seconds})
    scene = simulate_scene(scenario, seed)
    model, (view, moving) = load_open_body(), next(iter(scene.broadcast.items()))
    camera, poses, pitch = moving.camera, scene.poses, PitchTemplate.from_spec(scenario.pitch)
    given = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    bodies = BodyParameters(*(np.swapaxes(values, 0, 1) for values in given))
    rng = np.random.default_rng([seed, 5])
    drawn = estimate_bodies(model, bodies, camera, scenario.fps, MonocularErrors(), rng)
    seen, person = scene.observations[view], scene.identities[view].person
    frames, persons = bodies.batch_shape
    index = np.full((frames, 1, persons), -1, np.int16)
    row, detection = np.nonzero(person >= 0)
    index[seen.frame[row], 0, person[row, detection]] = detection
    parts = []
    for frame in range(frames):
        people = KeypointDetections.stack([seen[frame : frame + 1]])
        found = locate_feet(camera[frame : frame + 1], people, pitch)
        parts.append(replace(found, is_whole=None, boxes=None))
    tracks = locate_tracks(GroundPositions.concatenate(parts), index, scenario.fps)
    rows, own = np.arange(frames)[:, None], index[:, 0]
    known = own >= 0
    evidence = PlaneEvidence(
        camera=camera,
        number=np.arange(frames),
        keypoints=np.where(known[..., None, None], seen.keypoints[rows, own], np.nan),
        confidence=np.where(known[..., None], seen.confidence[rows, own], np.nan),
        place=tracks.xy,
        place_covariance=tracks.covariance,
        calibration=np.zeros((frames, persons, 2, 2)),
        fps=scenario.fps,
    )
    fit = fit_bodies_on_plane(
        model, evidence, parse_monocular(drawn, Path("estimates")), pitch.height
    )
    points = fold_keypoints(model, CHALLENGE15)
    methods = {
        "ours": points(fit.fit.parameters),
        "mean pose": mean_pose(model, tracks.xy, tracks.velocity, pitch),
    }
    truth = challenge_truth(model, poses, camera)
    boxes = np.isfinite(truth.clip.boxes).all(-1)
    true = truth.submission.swapaxes(0, 1)
    scored = []
    for method, joints in methods.items():
        off = joints[:, truth.persons] - true
        has = boxes & np.isfinite(off).all((-1, -2))
        root = off[:, :, HIPS].mean(axis=2, keepdims=True)
        world, place, local = (
            float(np.linalg.norm(each[has], axis=-1).mean()) for each in (off, root, off - root)
        )
        figures = (100.0 * world, 100.0 * place, 100.0 * local, world + 5.0 * local)
        scored.append([method, float(has.sum() / boxes.sum()), *figures])
    return scored


def mean_pose(model: BodyModel, place: Floats, velocity: Floats, pitch: PitchTemplate) -> Floats:
    """Return the joints (frames, persons, 15, 3) [m] of the mean pose on the feet."""
    keypoints, prior = ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior()
    solver = PoseSolver(keypoints, prior, BodyFittingSettings(), pitch.height)
    points, joints = fold_keypoints(model, CHALLENGE15), []
    upright = Rigid.from_rotvec([0.5 * np.pi, 0.0, 0.0], np.zeros(3)).rotation
    for xy, way in zip(np.swapaxes(place, 0, 1), np.swapaxes(velocity, 0, 1), strict=True):
        turn = np.zeros((len(xy), 3))
        turn[:, 2] = np.nan_to_num(np.arctan2(way[:, 1], way[:, 0])) + 0.5 * np.pi
        orient = Rigid(Rigid.from_rotvec(turn, turn).rotation @ upright, turn).rotvec
        angles, betas = np.tile(prior.mean, (len(xy), 1)), np.zeros(model.shapes)
        pose = stand_on_ground(solver, Pose(np.zeros_like(turn), orient, angles, betas), xy)
        joints.append(points(pose.parameters()))
    return np.stack(joints, axis=1)


LIMBS = ((16, 18), (18, 20), (1, 4), (4, 7), (1, 2), (16, 17))
"""Upper arm, forearm, thigh, shin, hips and shoulders, as joints of the body."""

STILL, LOW = 0.1, 0.12
"""Maximum speed [m/s] and height [m] of a standing foot."""


@benchmark(
    "body_accuracy",
    "fitted bodies of simulated people: errors, shape, standing feet",
    seeds(601, 602, 603),
    duration(4.0),
)
def score_bodies(options: Namespace) -> Tables:
    """Scenario `match`, cameras as surveyed; means over seeds.

    Standing: feet with a true speed below 0.1 m/s within 12 cm of the ground; height is that of
    their keypoints over the true ones'. Shape: of betas, height of the body and six limbs, median
    over people.
    """
    rows = [fit_match(seed, options.duration) for seed in options.seeds]
    means = [[label, float(np.mean([row[label] for row in rows]))] for label in rows[0]]
    return {"bodies": Table(f"match, seeds {options.seeds}", ["figure", "mean"], means)}


def sizes(body: BodyModel, betas: Floats) -> tuple[float, Floats]:
    """Return a body's height and the lengths of its limbs [m]."""
    vertices = body.template[:, 1] + body.shape_directions[:, 1] @ betas
    joints = body.joint_template + body.joint_directions @ betas
    lengths = [np.linalg.norm(joints[one] - joints[two]) for one, two in LIMBS]
    return float(np.ptp(vertices)), np.array(lengths)


def jerk(joints: Floats, fps: float) -> float:
    """Return the root mean square of the third derivative [m/s^3]."""
    third = np.diff(joints, n=3, axis=0) * fps**3
    return float(np.sqrt(np.nanmean((third**2).sum(axis=-1))))


def fit_match(seed: int, duration: float) -> dict[str, float]:
    """Return the metrics of one match."""
    scenario, scene = simulate("match", seed, duration)
    body, seen = load_open_body(), scene.static_views()
    cameras = Camera.stack(list(scene.given.values()))
    index = track_people(cameras, seen.detections, scenario.fps, TrackingSettings()).detection_index
    placed = reconstruct_joints(
        cameras, seen.detections.assign_people(index), scenario.fps, TriangulationSettings()
    ).triangulation
    ground = PitchTemplate.from_spec(scene.surveyed).height
    begin = time.process_time()
    evidence = ClipEvidence(placed.joints, placed.covariance, scenario.fps, placed.common_bias)
    fit = fit_bodies(body, evidence, BodyFittingSettings(), ground)
    figures = {"seconds of one core": time.process_time() - begin}
    people = np.arange(index.shape[2])
    for label, joints in (("triangulated", placed.joints), ("fitted", fit.joints)):
        tracks = JointTracks(scene.truth.frames, people, joints)
        scores, _ = evaluate_joints(tracks, scene.truth, fps=scenario.fps)
        figures[f"{label}, MPJPE [mm]"] = scores.mpjpe_mm or np.nan
        figures[f"{label}, G-MPJPE [mm]"] = scores.g_mpjpe_mm or np.nan
        figures[f"{label}, PA-MPJPE [mm]"] = scores.pa_mpjpe_mm or np.nan
    apart = placed.joints[:, :, None, 5:] - scene.truth.joints[:, None, :, 5:]
    apart = np.linalg.norm(np.nanmean(apart, axis=3), axis=-1)
    who = np.nan_to_num(np.nanmedian(apart, axis=0), nan=9.0).argmin(axis=1)
    truth = scene.truth.joints[:, who]
    feet, found = truth[:, :, 15:17], fit.joints[:, :, 15:17]
    painted = PitchTemplate.from_spec(scenario.pitch)
    low = feet[1:, ..., 2] - painted.height(feet[1:, ..., 0], feet[1:, ..., 1]) < LOW
    stands = low & (np.linalg.norm(np.diff(feet, axis=0), axis=-1) * scenario.fps < STILL)
    slides = np.linalg.norm(np.diff(found, axis=0), axis=-1)[stands]
    above = np.abs(found - feet)[1:, ..., 2][stands]
    pairs = zip(fit.parameters.betas[0], scene.poses.betas[who, 0], strict=True)
    shapes = [(sizes(body, one), sizes(body, two)) for one, two in pairs]
    lengths = fit.joints[:, :, 5] - fit.joints[:, :, 7]
    spread = np.nanstd(np.linalg.norm(lengths, axis=-1), axis=0)
    figures |= {
        "jerk over the truth's": jerk(fit.joints, scenario.fps) / jerk(truth, scenario.fps),
        "standing feet, height [mm]": 1e3 * float(np.nanmedian(above)),
        "standing feet, skating [mm per frame]": 1e3 * float(np.nanmedian(slides)),
        "height of people [mm]": 1e3 * float(np.median([abs(a[0] - b[0]) for a, b in shapes])),
        "limbs [mm]": 1e3 * float(np.median([np.abs(a[1] - b[1]) for a, b in shapes])),
        "upper arm over time, spread [mm]": 1e3 * float(np.nanmax(spread)),
    }
    return figures
