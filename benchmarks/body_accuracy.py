"""Bodies fitted to simulated people: errors, shape and standing feet."""

from __future__ import annotations

import time
from argparse import Namespace

import numpy as np
from common import simulate
from registry import Table, Tables, benchmark, duration, seeds

from data_contracts.arrays import Floats
from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyModel
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

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
