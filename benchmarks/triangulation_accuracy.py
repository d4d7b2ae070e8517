"""Prints pose errors from calibration errors, with and without offsets of the cameras (T3, T4).

    python benchmarks/triangulation_accuracy.py [--scenario penalty-box] [--seeds 501 502 503 504]

Tracked and triangulated with exact cameras, then with cameras with random rotation, shift and zoom
errors that misplace people by 5 cm (root mean square over cameras and joints of the distance of the
joint to the ray of its true pixel). "none" takes cameras as exact, "midhip" is the paper's second
stage, "body" ours.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.simulation.annotations import add_calibration_errors
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import CalibrationErrors
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.passes import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

SMALL = CalibrationErrors(rotation_rad=3e-4, center_m=0.1, focal=1e-3)
WAYS = ("none", "midhip", "body")
WANTED = 0.05
"""Misplacement of people by the cameras [m]."""


def rms_ray_distance(given: Camera, true: Camera, joints: NDArray[np.float64]) -> float:
    """Return the root mean square over cameras of people's distances to their rays [m]."""
    points = joints[::10].reshape(-1, 3)
    pixels = true.project(points)
    seen = ((pixels > 0.0) & (pixels < true.image_size[:, None] - 1.0)).all(axis=-1)
    rays = given.unproject(pixels)
    away = points - rays.origins
    along = (away * rays.directions).sum(axis=-1, keepdims=True) * rays.directions
    return float(np.sqrt(((away - along) ** 2).sum(axis=-1)[seen].mean()))


def some_way_off(scene: Scene, seed: int) -> Camera:
    """Return cameras that misplace people by 5 cm."""
    true, size, errors = Camera.stack(list(scene.cameras.values())), 1.0, SMALL
    for _ in range(5):
        errors = SMALL.model_copy(
            update={
                name: size * getattr(SMALL, name) for name in ("rotation_rad", "center_m", "focal")
            }
        )
        given = add_calibration_errors(scene.cameras, errors, np.random.default_rng(seed))
        off = rms_ray_distance(Camera.stack(list(given.values())), true, scene.truth.joints)
        size *= WANTED / off
    return Camera.stack(list(given.values()))


def score_ways(scene: Scene, cameras: Camera, fps: float) -> NDArray[np.float64]:
    """Return MPJPE, G-MPJPE and PA-MPJPE (3, ways) [mm]."""
    seen, rows = scene.static_views(), []
    tracks = track_people(cameras, seen.detections, fps, TrackingSettings())
    for way in WAYS:
        placed = triangulate_joints(
            cameras,
            seen.detections.assign_people(tracks.detection_index),
            TriangulationSettings(offsets=way),
        )
        found = JointTracks(scene.truth.frames, np.asarray(tracks.person), placed.joints)
        scores, _ = evaluate_joints(found, scene.truth, fps=fps)
        rows.append([scores.mpjpe_mm, scores.g_mpjpe_mm, scores.pa_mpjpe_mm])
    return np.array(rows, dtype=np.float64).T


def main() -> None:
    """Print one block for exact cameras and one for inexact ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="penalty-box")
    parser.add_argument("--seeds", type=int, nargs="+", default=[501, 502, 503, 504])
    options = parser.parse_args()
    scenario = SCENARIOS[options.scenario].model_copy(update={"broadcast": None})
    results: dict[str, list[NDArray[np.float64]]] = {"exact cameras": [], "5 cm off": []}
    for seed in options.seeds:
        scene = simulate_scene(scenario, seed)
        exact = Camera.stack(list(scene.cameras.values()))
        results["exact cameras"].append(score_ways(scene, exact, scenario.fps))
        results["5 cm off"].append(score_ways(scene, some_way_off(scene, seed), scenario.fps))
    for label, rows in results.items():
        print(f"{options.scenario}, {len(rows)} seeds, {label}: " + " / ".join(WAYS))
        for name, values in zip(
            ("MPJPE", "G-MPJPE", "PA-MPJPE"), np.mean(rows, axis=0), strict=True
        ):
            print(f"  {name:9s}" + " / ".join(f"{value:.1f}" for value in values) + " mm")


if __name__ == "__main__":
    main()
