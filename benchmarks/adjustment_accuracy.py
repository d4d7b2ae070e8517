"""Prints accuracy and coverage of static cameras before and after bundle adjustment.

    python benchmarks/adjustment_accuracy.py [--scenario match] [--seeds 601 602] [--duration 4]

Cameras are calibrated from the scenario's clicks and one image each ("alone"), then on the pitch
that all of them show ("calibrated"), as the stages take them. People are tracked and triangulated
with them, and all cameras are adjusted together. Ground: the true pixel of a player's position,
projected back through the camera onto the pitch, median / 95 %. Regions: share of the positions in
a camera's image whose image error is within the camera's covariance.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np
from scipy.stats import chi2
from static_accuracy import SHARES, ground_errors

from data_contracts.arrays import Floats
from worldpose.bundle_adjustment.adjustment import adjust_cameras
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import Scenario
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.parameters import project_with_jacobian
from worldpose.static_calibration.report import StaticCalibration, calibration_arrays
from worldpose.static_calibration.venue import Venue, join_cameras
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.passes import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

MOMENTS = 6
"""Number of frames of a clip whose players count."""


def calibrate_static(scene: Scene, scenario: Scenario, seed: int) -> dict[str, StaticCalibration]:
    """Return every static camera from clicks and the lines of one image."""
    surveyed = PitchTemplate.from_spec(scene.surveyed)
    painted = PitchTemplate.from_spec(scenario.pitch)
    found = {}
    for name, camera in scene.cameras.items():
        still = render_pitch(camera, painted, scene.truth.joints[0], seed)
        grey = np.asarray(cv2.cvtColor(still, cv2.COLOR_RGB2GRAY), np.uint8)
        size = (int(camera.image_size[0]), int(camera.image_size[1]))
        found[name] = calibrate_camera(surveyed, scene.clicks[name].markings, size, picture=grey)
    return found


def as_clip(scene: Scene, fps: float, known: dict[str, StaticCalibration], venue: Venue) -> Clip:
    """Return the clip in bundle adjustment's format."""
    seen, settings = scene.static_views(list(known)), TriangulationSettings()
    cameras, covariance = venue.cameras, venue.covariance
    index = track_people(cameras, seen.detections, fps, TrackingSettings()).detection_index
    detections = seen.detections.assign_people(index)
    placed = triangulate_joints(cameras, detections, settings, covariance)
    surveyed = PitchTemplate.from_spec(scene.surveyed)
    if venue.surface is not None:
        surveyed = surveyed.with_surface(venue.surface.shape)
    return Clip(
        cameras=cameras,
        covariance=covariance,
        clicks=tuple(Clicks.of(each, surveyed) for each in known.values()),
        fps=fps,
        detections=detections,
        joints=placed.joints,
        views=placed.views.astype(np.int64),
        triangulation=settings,
        pitch=surveyed,
        on_lines=np.array([each.report.stage == "lines" for each in known.values()]),
    )


def errors(
    cameras: Camera, covariance: Floats, true: Camera, places: Floats, pitch: PitchTemplate
) -> tuple[Floats, Floats]:
    """Return errors on the ground [m], and squared ones in the image over their covariance."""
    ground, squared = [], []
    for c in range(len(covariance)):
        pixels = true[c].project(places)
        inside = ((pixels > 0.0) & (pixels < true[c].image_size - 1.0)).all(axis=-1)
        found, slope = project_with_jacobian(cameras[c], places[inside])
        spread = np.einsum("nij,jk,nlk->nil", slope, covariance[c], slope)
        off = found - pixels[inside]
        squared.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off))
        ground.append(ground_errors(cameras[c], true[c], places, pitch))
    return np.concatenate(ground), np.concatenate(squared)


def tell(label: str, found: list[tuple[Floats, Floats]]) -> None:
    """Print a line of metrics."""
    ground, squared = (np.concatenate(part) for part in zip(*found, strict=True))
    held = [100.0 * np.mean(squared < chi2.ppf(share, 2)) for share in SHARES]
    print(
        f"  {label}: ground {100.0 * np.median(ground):.2f} / "
        f"{100.0 * np.percentile(ground, 95.0):.2f} cm, regions of "
        + " / ".join(f"{100.0 * share:g}" for share in SHARES)
        + " % hold "
        + " / ".join(f"{each:.1f}" for each in held),
        flush=True,
    )


def main() -> None:
    """Print three lines per match, and three for all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="match")
    parser.add_argument("--seeds", type=int, nargs="+", default=[601, 602])
    parser.add_argument("--duration", type=float, default=4.0)
    options = parser.parse_args()
    changes = {"duration": options.duration, "broadcast": None}
    scenario = SCENARIOS[options.scenario].model_copy(update=changes)
    painted = PitchTemplate.from_spec(scenario.pitch)
    alone: list[tuple[Floats, Floats]] = []
    before: list[tuple[Floats, Floats]] = []
    after: list[tuple[Floats, Floats]] = []
    for seed in options.seeds:
        scene = simulate_scene(scenario, seed)
        known = calibrate_static(scene, scenario, seed)
        venue = join_cameras([calibration_arrays(each) for each in known.values()])
        clip = as_clip(scene, scenario.fps, known, venue)
        begin = time.process_time()
        adjusted = adjust_cameras(clip)
        spent = time.process_time() - begin
        moments = np.linspace(0, len(clip.detections.frame) - 1, MOMENTS).astype(int)
        places = scene.truth.joints[moments][:, :, 15:17].mean(axis=2).reshape(-1, 3)
        places[:, 2] = painted.height(places[:, 0], places[:, 1])
        true = Camera.stack([scene.cameras[name] for name in known])
        own = Camera.stack([each.estimate.camera for each in known.values()])
        spread = np.stack([each.estimate.covariance for each in known.values()])
        alone.append(errors(own, spread, true, places, painted))
        before.append(errors(clip.cameras, clip.covariance, true, places, painted))
        after.append(errors(adjusted.cameras, adjusted.covariance, true, places, painted))
        print(
            f"{options.scenario} {seed}: {int(adjusted.accepted.sum())} of {len(known)} cameras "
            f"changed in {spent:.1f} s"
        )
        tell("alone", alone[-1:])
        tell("calibrated", before[-1:])
        tell("adjusted", after[-1:])
    print(f"all {len(options.seeds)}:")
    tell("alone", alone)
    tell("calibrated", before)
    tell("adjusted", after)


if __name__ == "__main__":
    main()
