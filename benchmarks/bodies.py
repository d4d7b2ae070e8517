"""Bodies of simulated people before one camera, with given boxes as in the challenge."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from registry import Table, Tables, benchmark, duration, option, seeds

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import load_open_body
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import CHALLENGE15, fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.monocular import parse_monocular
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.body_fitting.pose_space import load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.residuals import Pose
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.standing import stand_on_ground
from worldpose.evaluation.challenge import HIPS
from worldpose.formats.challenge import challenge_truth
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.tracking.plane.feet import GroundPositions, locate_feet
from worldpose.tracking.plane.tracker import locate_tracks

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
