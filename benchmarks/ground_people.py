"""Prints how well single cameras track people on the pitch plane by their feet, in both worlds.

    python benchmarks/ground_people.py [match:5501 hard:5503 foreign-match:5503 ...] [--cameras 6]

A match is scenario:seed. 2D poses are simulated. Cameras of our scenarios are calibrated from their
clicks alone, those of foreign scenarios are exact; each is alone. The truth is the place under the
middle of the hips of people whom the camera detects. Found: share of these person-frames with a
track within 1 m; right: share of tracked places with a person within 1 m; regions: share of places
inside their 95 % regions; switches: changes of a person's track, mean per camera.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.foreign.matches import FOREIGN_SCENARIOS, simulate_foreign_scene
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.tracking.feet import locate_feet
from worldpose.tracking.ground_tracks import track_on_plane

MATCHES = ["match:5501", "hard:5503", "foreign-match:5503", "foreign-many:5502"]
GATE_M = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """A camera alone: (1,) camera and covariance, (frames, 1, n) detections, their true person."""

    camera: Camera
    covariance: Floats | None
    detections: KeypointDetections
    person: NDArray[np.int16]
    pitch: PitchTemplate
    fps: float


def views(name: str, seed: int, cameras: int, duration: float) -> tuple[list[View], Floats]:
    """Return cameras of a match, and the true joints (frames, persons, 17, 3) [m]."""
    if name in FOREIGN_SCENARIOS:
        scenario = FOREIGN_SCENARIOS[name].model_copy(update={"unsynchronised": 0.0})
        other = simulate_foreign_scene(scenario, seed, duration=duration, calibrated=True)
        assert other.pitch is not None
        pitch = PitchTemplate.from_spec(other.pitch.painted)
        found = [
            View(
                Camera.stack([other.cameras[camera].camera]),
                None,
                KeypointDetections.stack([report.observations]),
                report.person,
                pitch,
                other.fps,
            )
            for camera, report in list(other.reports.items())[:cameras]
        ]
        return found, other.truth.joints
    ours = SCENARIOS[name].model_copy(update={"duration": duration, "broadcast": None})
    scene = simulate_scene(ours, seed)
    surveyed, found = PitchTemplate.from_spec(scene.surveyed), []
    for camera in list(scene.cameras)[:cameras]:
        width, height = scene.cameras[camera].image_size.tolist()
        known = calibrate_camera(surveyed, scene.clicks[camera].markings, (width, height)).estimate
        seen = scene.static_views([camera])
        found.append(
            View(
                Camera.stack([known.camera]),
                known.covariance[None],
                seen.detections,
                seen.person[:, 0],
                surveyed,
                ours.fps,
            )
        )
    return found, scene.truth.joints


class Score(NamedTuple):
    """Errors [m] and squared deviations of places, counts of places, switches of tracks."""

    errors: list[float]
    squared: list[float]
    true: int
    tracked: int
    right: int
    switches: int


def score(view: View, joints: Floats) -> Score:
    """Return the errors of a camera's tracks."""
    feet = locate_feet(view.camera, view.detections, view.pitch, camera_covariance=view.covariance)
    size = (view.pitch.length, view.pitch.width)
    tracks = track_on_plane(feet, view.fps, pitch_size=size)
    hips = joints[:, :, 11:13, :2].mean(axis=2)
    errors, squared, last = list[float](), list[float](), dict[int, int]()
    true = tracked = right = switches = 0
    for frame, places in enumerate(tracks.xy):
        people = np.unique(view.person[frame][view.person[frame] >= 0])
        there = np.flatnonzero(np.isfinite(places[:, 0]))
        true, tracked = true + len(people), tracked + len(there)
        nearest = np.linalg.norm(hips[frame][:, None] - places[there], axis=-1).min(axis=0)
        right += int((nearest < GATE_M).sum())
        distance = np.linalg.norm(hips[frame, people][:, None] - places[there], axis=-1)
        for row, column in zip(*linear_sum_assignment(distance), strict=True):
            if distance[row, column] > GATE_M:
                continue
            person, track = int(people[row]), int(there[column])
            errors.append(float(distance[row, column]))
            off = hips[frame, person] - places[track]
            squared.append(float(off @ np.linalg.solve(tracks.covariance[frame, track], off)))
            switches += last.get(person, track) != track
            last[person] = track
    return Score(errors, squared, true, tracked, right, switches)


def main() -> None:
    """Print one line per match."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("matches", nargs="*", default=MATCHES)
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--duration", type=float, default=4.0)
    options = parser.parse_args()
    for match in options.matches:
        name, seed = match.split(":")
        cameras, joints = views(name, int(seed), options.cameras, options.duration)
        parts = [score(each, joints) for each in cameras]
        errors = np.concatenate([part.errors for part in parts])
        inside = np.concatenate([part.squared for part in parts]) < chi2.ppf(0.95, 2)
        true, tracked = sum(part.true for part in parts), sum(part.tracked for part in parts)
        right = sum(part.right for part in parts)
        switches = sum(part.switches for part in parts) / len(parts)
        print(
            f"{match}: found {100 * len(errors) / true:.1f} %, "
            f"right {100 * right / tracked:.1f} %, error {np.median(errors):.2f} / "
            f"{np.quantile(errors, 0.95):.2f} m, in 95 % regions {100 * inside.mean():.1f} %, "
            f"switches {switches:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
