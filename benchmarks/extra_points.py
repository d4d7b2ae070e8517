"""Prints errors of feet and ankles with and without a detector's heels and toes, in simulation.

    python benchmarks/extra_points.py [--scenario match] [--seeds 801 802 803] [--duration 4]
        [--landmarks] [--difficulty 0.84]

The simulated detector gives `FEET` besides COCO-17 (`worldpose.simulation.scene.detect_points`),
and with `--landmarks` also the 64 `LANDMARKS` of the surface, with independent errors: this shows
how accurate a net of landmarks has to be. The columns are bodies fitted without the points, bodies
fitted with them, and the triangulated points. Errors are mean distances to the truth [mm]; the
direction of a foot is that from the heel to the middle of the toes [degrees]. Settings were not
chosen on seeds 801 and above.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import FEET
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import LANDMARKS, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.body_fit import BodyFit, ClipEvidence, fit_bodies
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import POINT_DIFFICULTY, Scene, detect_points, simulate_scene
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.passes import Triangulation
from worldpose.triangulation.settings import TriangulationSettings

NEAR_M = 0.5
"""Largest distance of a person from the true one [m]."""
TOES, HEELS = [0, 1, 3, 4], [2, 5]
MODEL = load_open_body()
POINTS = fold_keypoints(MODEL, FEET)


def true_feet(scene: Scene) -> Floats:
    """Return the true points (frames, persons, 6, 3) [m], world."""
    return np.asarray(POINTS(scene.poses).swapaxes(0, 1))


def directions(feet: Floats) -> Floats:
    """Return unit vectors (frames, persons, 2, 3) from heels to toes."""
    sides = feet.reshape(*feet.shape[:2], 2, 3, 3)
    along = sides[..., :2, :].mean(axis=-2) - sides[..., 2, :]
    return np.asarray(along / np.linalg.norm(along, axis=-1, keepdims=True))


def measure(joints: Floats, feet: Floats, truth: tuple[Floats, Floats]) -> dict[str, float]:
    """Return mean errors [mm, degrees] of joints and feet of matched people."""
    off = 1e3 * np.linalg.norm(joints - truth[0], axis=-1)
    points = 1e3 * np.linalg.norm(feet - truth[1], axis=-1)
    cosine = (directions(feet) * directions(truth[1])).sum(axis=-1).clip(-1.0, 1.0)
    return {
        "17 joints [mm]": float(np.nanmean(off)),
        "knees [mm]": float(np.nanmean(off[..., 13:15])),
        "ankles [mm]": float(np.nanmean(off[..., 15:17])),
        "heels [mm]": float(np.nanmean(points[..., HEELS])),
        "toes [mm]": float(np.nanmean(points[..., TOES])),
        "direction of the foot [degrees]": float(np.nanmean(np.degrees(np.arccos(cosine)))),
    }


def compare(asked: argparse.Namespace, seed: int) -> dict[str, dict[str, float]]:
    """Return the metrics of one scene by column."""
    name, duration = asked.scenario, asked.duration
    scenario = SCENARIOS[name].model_copy(update={"duration": duration, "broadcast": None})
    points = (*FEET, *(LANDMARKS if asked.landmarks else ()))
    scene = simulate_scene(scenario, seed)
    scene = detect_points(scene, scenario, seed, points, asked.difficulty)
    seen = scene.static_views().detections
    cameras = Camera.stack(list(scene.given.values()))
    fps = scenario.fps
    index = track_people(cameras, seen, fps, TrackingSettings()).detection_index
    placed = reconstruct_joints(
        cameras, seen.assign_people(index), fps, TriangulationSettings()
    ).triangulation
    assert placed.extra is not None
    off = placed.joints[:, :, None, 5:] - scene.truth.joints[:, None, :, 5:]
    apart = np.nanmedian(np.linalg.norm(off, axis=-1), axis=(0, 3))
    apart = np.nan_to_num(apart, nan=9.0)
    kept, who = apart.min(axis=1) < NEAR_M, apart.argmin(axis=1)
    truth = scene.truth.joints[:, who][:, kept], true_feet(scene)[:, who][:, kept]
    ground = PitchTemplate.from_spec(scene.surveyed).height
    found = {}
    for label, extra in (("without", None), ("with", placed.extra)):
        begin = time.process_time()
        fit = fit_clip(replace(placed, extra=extra), fps, ground)
        seconds = time.process_time() - begin
        bodies = BodyParameters(
            *(
                getattr(fit.parameters, each)[:, kept]
                for each in ("betas", "global_orient", "body_pose", "transl")
            )
        )
        found[label] = measure(fit.joints[:, kept], POINTS(bodies), truth)
        found[label]["CPU time [s]"] = seconds
        if fit.extra is not None:
            found[label] |= coverage(fit, kept, truth[1])
    feet = placed.extra.joints[:, kept, : len(FEET)]
    found["triangulated"] = measure(placed.joints[:, kept], feet, truth)
    return found


def coverage(fit: BodyFit, kept: Floats, truth: Floats) -> dict[str, float]:
    """Return the share of points in their 95 % regions [%]."""
    assert fit.extra is not None
    feet = slice(len(FEET))
    away = fit.extra.joints[:, kept, feet] - truth
    there = np.isfinite(away).all(axis=-1)
    matrices = fit.extra.covariance[:, kept, feet][there]
    square = np.einsum("na,nab,nb->n", away[there], np.linalg.inv(matrices), away[there])
    return {"points in 95 % regions [%]": 100.0 * float((square < 7.815).mean())}


def fit_clip(placed: Triangulation, fps: float, ground: object) -> BodyFit:
    """Return the bodies of triangulated people."""
    evidence = ClipEvidence(
        placed.joints,
        placed.covariance,
        fps,
        common_bias=placed.common_bias,
        shared_covariance=placed.shared_covariance,
        extra=placed.extra,
    )
    return fit_bodies(MODEL, evidence, BodyFittingSettings(), ground)  # type: ignore[arg-type]


def main() -> None:
    """Print a table of means over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="match", choices=sorted(SCENARIOS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[801, 802, 803])
    parser.add_argument("--duration", type=float, default=4.0)
    parser.add_argument("--landmarks", action="store_true")
    parser.add_argument("--difficulty", type=float, default=POINT_DIFFICULTY)
    asked = parser.parse_args()
    each = [compare(asked, seed) for seed in asked.seeds]
    what = f", {len(LANDMARKS)} landmarks, difficulty {asked.difficulty:g}"
    print(f"{asked.scenario}, seeds {asked.seeds}, {asked.duration:g} s{what * asked.landmarks}")
    for row in each[0]["with"]:
        cells = []
        for column in each[0]:
            values = [one[column][row] for one in each if row in one[column]]
            cells.append(f"{column} {np.mean(values):7.2f}" if values else "")
        print(f"{row:32s} " + "  ".join(cells))


if __name__ == "__main__":
    main()
