"""Prints the accuracy of fitted bodies on simulated people, and gains in chunks with few cameras.

    python benchmarks/body_accuracy.py [--seeds 601 602 603] [--duration 4]
    python benchmarks/body_accuracy.py --thin [--foreign] [--seeds 411 412 413 414 415 416]

Scenario `match`, cameras as surveyed. Standing: feet with a true speed below 0.1 m/s within 12 cm
of the ground; height is that of their keypoints over the true ones'. Shape: of betas, height of the
body and six limbs, median over people.

With `--thin` 14 people for 3 s; for 0.6 to 1.2 s, each keeps one or two of the cameras that see the
person. Refitted as `refitting` does: with the broadcast camera's keypoints (S4), with bodies from a
simulated monocular method, with errors of 80 mm after alignment, and with both. Errors are of
people in the broadcast image, in those chunks. With --foreign, people, detector and cameras are
those of `foreign-match`, which has no moving camera: the static camera with most detections gives
the further view, and estimates are drawn from bodies fitted to the true joints.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.body_fit import BodyFit, ClipEvidence, fit_bodies
from worldpose.body_fitting.monocular import MonocularPoses, parse_monocular, place_monocular_poses
from worldpose.body_fitting.ray_constraints import (
    RayConstraints,
    constrain_to_rays,
    find_ray_constraints,
    identify_people,
)
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.foreign.matches import FOREIGN_SCENARIOS, simulate_foreign_scene
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.settings import TriangulationSettings

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


def thin_out(fps: float, index: NDArray[np.int16], left: int, seed: int) -> NDArray[np.bool_]:
    """Remove all but some cameras' detections for a while; return (frames, persons) when."""
    rng = np.random.default_rng(seed)
    frames, cameras, persons = index.shape
    dark = np.zeros((frames, persons), np.bool_)
    for person in range(persons):
        first = round(fps / 50.0 * int(rng.integers(20, 60)))
        last = first + round(fps / 50.0 * int(rng.integers(30, 60)))
        order = rng.permutation(cameras)
        dark[first:last, person] = True
        for frame in range(first, min(last, frames)):
            there = [c for c in order if index[frame, c, person] >= 0]
            index[frame, there[left:], person] = -1
    return dark


@dataclass(frozen=True, eq=False)
class ThinScene:
    """A match with a further view.

    Attributes:
        fps: [1/s].
        cameras: true static cameras, a batch (cameras,).
        detections: (frames, cameras, detections).
        further: camera of the further view, a batch (frames,).
        keypoints: (frames, detections, 17, 2) [px] of the further view.
        truth: (frames, persons, 17, 3) [m].
        bodies: bodies (frames, persons) that the estimates show.
        ground: height of the pitch.
    """

    fps: float
    cameras: Camera
    detections: KeypointDetections
    further: Camera
    keypoints: Floats
    truth: Floats
    bodies: BodyParameters
    ground: Callable[[Floats, Floats], Floats]


def own_scene(seed: int) -> ThinScene:
    """Return 3 s of `match` with 14 people and its broadcast camera."""
    scenario = SCENARIOS["match"]
    crowd = scenario.crowd.model_copy(update={"people": 14})
    scene = simulate_scene(scenario.model_copy(update={"duration": 3.0, "crowd": crowd}), seed)
    assert scene.broadcast is not None
    names = ("betas", "global_orient", "body_pose", "transl")
    return ThinScene(
        scenario.fps,
        Camera.stack(list(scene.cameras.values())),
        scene.static_views().detections,
        scene.broadcast,
        np.asarray(scene.observations["clip"].keypoints, np.float64),
        scene.truth.joints,
        BodyParameters(*(np.swapaxes(getattr(scene.poses, name), 0, 1) for name in names)),
        PitchTemplate.from_spec(scene.surveyed).height,
    )


def foreign_scene(seed: int) -> ThinScene:
    """Return 3 s of `foreign-match` with 14 people and one of its cameras as the further view."""
    scenario = FOREIGN_SCENARIOS["foreign-match"].model_copy(update={"unsynchronised": 0.0})
    scene = simulate_foreign_scene(scenario, seed, duration=3.0, people=14, calibrated=True)
    assert scene.pitch is not None
    seen = {name: report.observations for name, report in scene.reports.items()}
    aside = max(seen, key=lambda name: int(np.isfinite(seen[name].score).sum()))
    kept = [name for name in seen if name != aside]
    joints, ground = scene.truth.joints, PitchTemplate.from_spec(scene.pitch.painted).height
    covariance = np.array(np.broadcast_to(1e-4 * np.eye(3), (*joints.shape, 3)))
    evidence = ClipEvidence(joints, covariance, scene.fps)
    return ThinScene(
        scene.fps,
        Camera.stack([scene.cameras[name].camera for name in kept]),
        KeypointDetections.stack([seen[name] for name in kept]),
        Camera.stack([scene.cameras[aside].camera] * len(joints)),
        np.asarray(seen[aside].keypoints, np.float64),
        joints,
        fit_bodies(BODY, evidence, SETTINGS, ground).parameters,
        ground,
    )


def thin(scene: ThinScene, seed: int, left: int) -> tuple[int, dict[str, float]]:
    """Return the number of bodies in chunks with few cameras, and their errors [mm]."""
    fps, cameras, ground = scene.fps, scene.cameras, scene.ground
    index = track_people(cameras, scene.detections, fps, TrackingSettings()).detection_index
    full = reconstruct_joints(
        cameras, scene.detections.assign_people(index), fps, TRIANGULATION
    ).triangulation.joints
    who, away = nearest(full, scene.truth)
    index = index[:, :, away < 0.5].copy()
    who = who[away < 0.5]
    dark = thin_out(fps, index, left, seed)
    detections = scene.detections.assign_people(index)
    placed = reconstruct_joints(cameras, detections, fps, TRIANGULATION).triangulation
    joints, covariance = placed.joints, placed.covariance
    unswapped = undo_swaps(detections, placed.exchanged)
    static = find_ray_constraints(cameras, unswapped, joints)

    def fit(views: list[RayConstraints], monocular: MonocularPoses | None = None) -> BodyFit:
        evidence = ClipEvidence(joints, covariance, fps, placed.common_bias, views, monocular)
        return fit_bodies(BODY, evidence, SETTINGS, ground)

    first = fit([static])
    own = identify_people(scene.further, scene.keypoints, first.joints)
    moving = constrain_to_rays(scene.further, own, first.joints)
    rng = np.random.default_rng(seed)
    drawn = estimate_bodies(BODY, scene.bodies, scene.further, fps, MonocularErrors(), rng)
    estimates = parse_monocular(drawn, Path("estimates"))
    frames = np.arange(len(joints))
    monocular = place_monocular_poses(estimates, scene.further, frames, first.joints)
    fits = {
        "static cameras alone": first,
        "+ estimates": fit([static], monocular),
        "+ broadcast keypoints": fit([static, moving]),
        "+ both": fit([static, moving], monocular),
    }
    counted = dark & np.isfinite(own[..., 0]).any(axis=-1) & np.isfinite(first.joints[..., 0, 0])
    truth = scene.truth[:, who]
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
    parser.add_argument("--foreign", action="store_true", help="in the second world, with --thin")
    options = parser.parse_args()
    if not options.thin:
        seeds = options.seeds or [601, 602, 603]
        rows = [whole(seed, options.duration) for seed in seeds]
        print(f"match, {options.duration:g} s, seeds {seeds}")
        for label in rows[0]:
            print(f"  {label:38s} {np.mean([row[label] for row in rows]):8.2f}")
        return
    seeds = options.seeds or [411, 412, 413, 414, 415, 416]
    scene_of = foreign_scene if options.foreign else own_scene
    for left in (1, 2):
        found = [thin(scene_of(seed), seed, left) for seed in seeds]
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
