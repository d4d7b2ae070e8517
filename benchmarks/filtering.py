"""Prints recall of planted gross errors in keypoints by bodies, and rejections of good keypoints.

    python benchmarks/filtering.py [--scenario match] [--seeds 401 402 403] [--duration 1.0]

Cameras with the scenario's errors, tracking, triangulation, bodies, then the filter; no adjustment.
The first line of a seed has planted errors only: joints 4 to 10 of the detector's deviations off.
The second also has all errors of the scenario's detector, such as left-right swaps and joints of an
occluding person, which then count as good.
"""

from __future__ import annotations

import argparse

import numpy as np

from worldpose.body.body_file import find_body
from worldpose.body_fitting.body_fit import ClipEvidence, fit_bodies
from worldpose.body_fitting.objective import perceived_joints
from worldpose.body_fitting.ray_constraints import find_ray_constraints
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.filtering.judging import (
    TriangulatedDetections,
    judge_detections,
    learn_keypoint_spread,
    perceived_covariance,
    view_bodies,
)
from worldpose.filtering.settings import FilteringSettings
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import Scenario
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.settings import TriangulationSettings

PLANTED = 0.06
"""Share of joints with planted gross errors."""


def main() -> None:
    """Print two lines per seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="match")
    parser.add_argument("--seeds", type=int, nargs="+", default=[401, 402, 403])
    parser.add_argument("--duration", type=float, default=1.0)
    options = parser.parse_args()
    base = SCENARIOS[options.scenario]
    share = max(PLANTED, base.noise.displaced)
    alone = {"displaced": share, "swapped": 0.0, "stolen": 0.0, "merged": 0.0}
    for seed in options.seeds:
        for about, changes in (("planted alone", alone), ("all errors", {"displaced": share})):
            noise = base.noise.model_copy(update=changes)
            changed = {"duration": options.duration, "noise": noise, "broadcast": None}
            found, rejected, planted, honest = count_rejected(base.model_copy(update=changed), seed)
            print(
                f"{options.scenario} {seed}, {about}: {100 * found / planted:.1f} % of {planted} "
                f"planted found, {100 * rejected / honest:.2f} % of {honest} others rejected"
            )


def count_rejected(scenario: Scenario, seed: int) -> tuple[int, int, int, int]:
    """Return planted keypoints found, others rejected, and totals of planted and others."""
    scene = simulate_scene(scenario, seed)
    seen = scene.static_views()
    cameras = Camera.stack(list(scene.given.values()))
    tracks = track_people(cameras, seen.detections, scenario.fps, TrackingSettings())
    settings, how = TriangulationSettings(), BodyFittingSettings()
    detections = seen.detections.assign_people(tracks.detection_index)
    placed = reconstruct_joints(cameras, detections, scenario.fps, settings).triangulation
    ground = PitchTemplate.from_spec(scene.surveyed).height
    unswapped = undo_swaps(detections, placed.exchanged)
    alone = find_ray_constraints(cameras, unswapped, placed.joints)
    fit = fit_bodies(
        find_body(how.body_model),
        ClipEvidence(
            placed.joints,
            placed.covariance,
            scenario.fps,
            ray_constraints=[alone],
            common_bias=placed.common_bias,
        ),
        how,
        ground,
    )
    sure = perceived_covariance(fit.covariance, placed.common_bias)
    views = view_bodies(cameras, perceived_joints(fit.joints, fit.offsets), sure)
    suspects = TriangulatedDetections(
        detections,
        placed.offsets,
        placed.exchanged,
        np.zeros(seen.person.shape, dtype=bool),
        settings.noise,
    )
    spread = learn_keypoint_spread(views, suspects)
    rejected = judge_detections(views, suspects, spread, FilteringSettings()).rejected
    there = np.isfinite(seen.detections.confidence) & (seen.person >= 0)[..., None]
    wrong, others = there & seen.displaced, there & ~seen.displaced
    found, lost = int(rejected[wrong].sum()), int(rejected[others].sum())
    return found, lost, int(wrong.sum()), int(others.sum())


if __name__ == "__main__":
    main()
