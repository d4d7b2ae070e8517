"""Prints the accuracy of fitted bodies on simulated people, and gains in chunks with few cameras.

    python benchmarks/body_accuracy.py [--seeds 601 602 603] [--duration 4]
    python benchmarks/body_accuracy.py --thin [--seeds 411 412 413 414 415 416]

Scenario `match`, cameras as surveyed. Standing: feet with a true speed below 0.1 m/s within 12 cm
of the ground; height is that of their keypoints over the true ones'. Shape: of betas, height of the
body and six limbs, median over people.

With `--thin` 14 people for 3 s; for 0.6 to 1.2 s, each keeps one or two of the cameras that see the
person. Refitted as `refitting` does: with the broadcast camera's keypoints (S4), with bodies from a
simulated monocular method, with errors of 80 mm after alignment, and with both. Errors are of
people in the broadcast image, in those chunks.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body import BodyParameters, load_open_body
from worldpose.body_fitting import (
    BodyFit,
    BodyFittingSettings,
    ClipEvidence,
    MonocularPoses,
    RayConstraints,
    constrain_to_rays,
    find_ray_constraints,
    fit_bodies,
    identify_people,
    place_monocular_poses,
)
from worldpose.body_fitting.monocular import parse_monocular
from worldpose.evaluation import evaluate_joints
from worldpose.formats import JointTracks
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, Scene, simulate_scene
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.tracking import TrackingSettings, track_people
from worldpose.triangulation import TriangulationSettings, reconstruct_joints, undo_swaps

BODY = load_open_body()
SETTINGS, TRIANGULATION = BodyFittingSettings(), TriangulationSettings()
LIMBS = ((16, 18), (18, 20), (1, 4), (4, 7), (1, 2), (16, 17))
"""Upper arm, forearm, thigh, shin, hips and shoulders, as joints of the body."""
STILL, LOW = 0.1, 0.12
"""Maximum speed [m/s] and height [m] of a standing foot."""


def sizes(betas: Floats) -> tuple[float, Floats]:
    """Return a body's height and the lengths of its limbs [m]."""
    vertices = BODY.template[:, 1] + BODY.shape_directions[:, 1] @ betas
    joints = BODY.joint_template + BODY.joint_directions @ betas
    lengths = [np.linalg.norm(joints[one] - joints[two]) for one, two in LIMBS]
    return float(np.ptp(vertices)), np.array(lengths)


def jerk(joints: Floats, fps: float) -> float:
    """Return the root mean square of the third derivative [m/s^3]."""
    third = np.diff(joints, n=3, axis=0) * fps**3
    return float(np.sqrt(np.nanmean((third**2).sum(axis=-1))))


def nearest(joints: Floats, truth: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the true person of each body, and the median distance between the two [m]."""
    apart = np.linalg.norm(
        np.nanmean(joints[:, :, None, 5:] - truth[:, None, :, 5:], axis=3), axis=-1
    )
    away = np.nan_to_num(np.nanmedian(apart, axis=0), nan=9.0)
    return away.argmin(axis=1), away.min(axis=1)


def whole(seed: int, duration: float) -> dict[str, float]:
    """Return the metrics of one match."""
    scenario = SCENARIOS["match"].model_copy(update={"duration": duration, "broadcast": None})
    scene = simulate_scene(scenario, seed)
    seen = scene.static_views()
    cameras = Camera.stack(list(scene.given.values()))
    index = track_people(cameras, seen.detections, scenario.fps, TrackingSettings()).detection_index
    placed = reconstruct_joints(
        cameras, seen.detections.assign_people(index), scenario.fps, TRIANGULATION
    ).triangulation
    ground = PitchTemplate.from_spec(scene.surveyed).height
    begin = time.process_time()
    evidence = ClipEvidence(placed.joints, placed.covariance, scenario.fps, placed.common_bias)
    fit = fit_bodies(BODY, evidence, SETTINGS, ground)
    figures = {"seconds of one core": time.process_time() - begin}
    people = np.arange(index.shape[2])
    for label, joints in (("triangulated", placed.joints), ("fitted", fit.joints)):
        tracks = JointTracks(scene.truth.frames, people, joints)
        scores, _ = evaluate_joints(tracks, scene.truth, fps=scenario.fps)
        figures[f"{label}, MPJPE [mm]"] = scores.mpjpe_mm or np.nan
        figures[f"{label}, G-MPJPE [mm]"] = scores.g_mpjpe_mm or np.nan
        figures[f"{label}, PA-MPJPE [mm]"] = scores.pa_mpjpe_mm or np.nan
    who, _ = nearest(placed.joints, scene.truth.joints)
    truth = scene.truth.joints[:, who]
    feet, found = truth[:, :, 15:17], fit.joints[:, :, 15:17]
    painted = PitchTemplate.from_spec(scenario.pitch)
    low = feet[1:, ..., 2] - painted.height(feet[1:, ..., 0], feet[1:, ..., 1]) < LOW
    stands = low & (np.linalg.norm(np.diff(feet, axis=0), axis=-1) * scenario.fps < STILL)
    slides = np.linalg.norm(np.diff(found, axis=0), axis=-1)[stands]
    above = np.abs(found - feet)[1:, ..., 2][stands]
    pairs = zip(fit.parameters.betas[0], scene.poses.betas[who, 0], strict=True)
    shapes = [(sizes(one), sizes(two)) for one, two in pairs]
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


def thin_out(scene: Scene, index: NDArray[np.int16], left: int, seed: int) -> NDArray[np.bool_]:
    """Remove all but some cameras' detections for a while; return (frames, persons) when."""
    rng = np.random.default_rng(seed)
    frames, cameras, persons = index.shape
    dark = np.zeros((frames, persons), np.bool_)
    for person in range(persons):
        first = int(rng.integers(20, 60))
        last = first + int(rng.integers(30, 60))
        order = rng.permutation(cameras)
        dark[first:last, person] = True
        for frame in range(first, min(last, frames)):
            there = [c for c in order if index[frame, c, person] >= 0]
            index[frame, there[left:], person] = -1
    return dark


def thin(seed: int, left: int) -> tuple[int, dict[str, float]]:
    """Return the number of bodies in chunks with few cameras, and their errors [mm]."""
    scenario = SCENARIOS["match"]
    crowd = scenario.crowd.model_copy(update={"people": 14})
    scene = simulate_scene(scenario.model_copy(update={"duration": 3.0, "crowd": crowd}), seed)
    assert scene.broadcast is not None
    fps, frames = scenario.fps, scene.truth.frames
    seen = scene.static_views()
    cameras = Camera.stack(list(scene.cameras.values()))
    index = track_people(cameras, seen.detections, fps, TrackingSettings()).detection_index
    full = reconstruct_joints(
        cameras, seen.detections.assign_people(index), fps, TRIANGULATION
    ).triangulation.joints
    who, away = nearest(full, scene.truth.joints)
    index = index[:, :, away < 0.5].copy()
    who = who[away < 0.5]
    dark = thin_out(scene, index, left, seed)
    detections = seen.detections.assign_people(index)
    placed = reconstruct_joints(cameras, detections, fps, TRIANGULATION).triangulation
    joints, covariance = placed.joints, placed.covariance
    unswapped = undo_swaps(detections, placed.exchanged)
    static = find_ray_constraints(cameras, unswapped, joints)
    ground = PitchTemplate.from_spec(scene.surveyed).height

    def fit(views: list[RayConstraints], monocular: MonocularPoses | None = None) -> BodyFit:
        evidence = ClipEvidence(joints, covariance, fps, placed.common_bias, views, monocular)
        return fit_bodies(BODY, evidence, SETTINGS, ground)

    first = fit([static])
    own = identify_people(scene.broadcast, scene.observations["clip"].keypoints, first.joints)
    moving = constrain_to_rays(scene.broadcast, own, first.joints)
    bodies = BodyParameters(
        *(
            np.swapaxes(getattr(scene.poses, name), 0, 1)
            for name in ("betas", "global_orient", "body_pose", "transl")
        )
    )
    rng = np.random.default_rng(seed)
    drawn = estimate_bodies(BODY, bodies, scene.broadcast, fps, MonocularErrors(), rng)
    estimates = parse_monocular(drawn, Path("estimates"))
    monocular = place_monocular_poses(estimates, scene.broadcast, frames, first.joints)
    fits = {
        "static cameras alone": first,
        "+ estimates": fit([static], monocular),
        "+ broadcast keypoints": fit([static, moving]),
        "+ both": fit([static, moving], monocular),
    }
    counted = dark & np.isfinite(own[..., 0]).any(axis=-1) & np.isfinite(first.joints[..., 0, 0])
    truth = scene.truth.joints[:, who]
    errors = {
        label: 1e3 * float(np.nanmean(np.linalg.norm(fit.joints - truth, axis=-1)[counted]))
        for label, fit in fits.items()
    }
    return int(counted.sum()), errors


def main() -> None:
    """Print the metrics, means over seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--duration", type=float, default=4.0)
    parser.add_argument("--thin", action="store_true", help="where few cameras see people")
    options = parser.parse_args()
    if not options.thin:
        seeds = options.seeds or [601, 602, 603]
        rows = [whole(seed, options.duration) for seed in seeds]
        print(f"match, {options.duration:g} s, seeds {seeds}")
        for label in rows[0]:
            print(f"  {label:38s} {np.mean([row[label] for row in rows]):8.2f}")
        return
    seeds = options.seeds or [411, 412, 413, 414, 415, 416]
    for left in (1, 2):
        found = [thin(seed, left) for seed in seeds]
        counts = [count for count, _ in found]
        print(f"{left} static camera(s), {sum(counts)} bodies, seeds {seeds}")
        base = np.average([row["static cameras alone"] for _, row in found], weights=counts)
        for label in found[0][1]:
            value = np.average([row[label] for _, row in found], weights=counts)
            print(
                f"  {label:24s} {value:6.1f} mm  {100.0 * (value / base - 1.0):+.0f} %", flush=True
            )


if __name__ == "__main__":
    main()
