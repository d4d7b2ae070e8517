"""Prints how far bodies of a broadcast camera alone are from the truth, on two simulated worlds.

    python benchmarks/plane_bodies.py [--seeds 901 902 903] [--duration 2]

People are detected, tracked and placed on the pitch by one camera, as stage `broadcast_tracking`
does it. `placed` is the mean body in the estimated monocular pose, with its lower ankle on the
ground at the person's place; `fitted` is `fit_bodies_on_plane`. Errors are mean distances of joints
to the truth, and after alignment of each body (PA); `hips` is the horizontal distance of the
mid-hip, of `feet` that of the tracked place. Regions: share of joints in the stated 95 % region.

World 1 is scenario `broadcast-pan` with its moving camera, exact or with the error of a calibrated
one. World 2 has people of other proportions and gaits, another detector and one static camera.
Monocular errors are those of `MonocularErrors` (80 mm after alignment); `tilted` adds a lean of 8
degrees towards the camera in all frames, twice the errors of angles, and a half turn in 5 % of the
frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.body import BodyParameters, load_open_body
from worldpose.body_fitting import (
    BodyFittingSettings,
    ClipEvidence,
    PlaneBodies,
    PlaneEvidence,
    fit_bodies,
    fit_bodies_on_plane,
)
from worldpose.body_fitting.monocular import MonocularEstimates, parse_monocular
from worldpose.geometry import Camera, Rigid, align
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.foreign import FOREIGN_SCENARIOS
from worldpose.simulation.foreign.matches import simulate_foreign_scene
from worldpose.simulation.scene import simulate_scene
from worldpose.tracking import GroundPositions, locate_feet, track_on_plane

BODY: Final = load_open_body()
LEAN: Final = np.radians(8.0)
TURNED: Final = 0.05
"""Share of half turns among tilted estimates."""
NEAR: Final = 1.0
"""Largest median distance of a track from its person [m]."""


@dataclass(frozen=True, eq=False)
class World:
    """One camera's clip with its truth.

    Attributes:
        name: the world.
        fps: [1/s].
        camera: batch (frames,).
        detections: (frames, detections).
        pitch: surface.
        truth: (frames, people, 17, 3) [m].
        bodies: bodies (frames, people) of our model whose poses the estimates show.
    """

    name: str
    fps: float
    camera: Camera
    detections: KeypointDetections
    pitch: PitchTemplate
    truth: Floats
    bodies: BodyParameters


def first_world(seed: int, duration: float) -> World:
    """Return scenario `broadcast-pan`."""
    scenario = SCENARIOS["broadcast-pan"].model_copy(update={"duration": duration})
    scene = simulate_scene(scenario, seed)
    assert scene.broadcast is not None
    names = ("betas", "global_orient", "body_pose", "transl")
    bodies = BodyParameters(*(np.swapaxes(getattr(scene.poses, name), 0, 1) for name in names))
    return World(
        "first",
        scenario.fps,
        scene.broadcast,
        scene.observations["clip"],
        PitchTemplate.from_spec(scenario.pitch),
        scene.truth.joints,
        bodies,
    )


def second_world(seed: int, duration: float) -> World:
    """Return one camera of `foreign-match`, the one with most detections."""
    scenario = FOREIGN_SCENARIOS["foreign-match"].model_copy(update={"unsynchronised": 0.0})
    scene = simulate_foreign_scene(scenario, seed, duration=duration, calibrated=True)
    assert scene.pitch is not None
    joints = scene.truth.joints
    found = {
        name: int(np.isfinite(report.observations.score).sum())
        for name, report in scene.reports.items()
    }
    name = max(found, key=lambda each: found[each])
    pitch = PitchTemplate.from_spec(scene.pitch.painted)
    covariance = np.array(np.broadcast_to(1e-4 * np.eye(3), (*joints.shape, 3)))
    fit = fit_bodies(
        BODY, ClipEvidence(joints, covariance, scene.fps), BodyFittingSettings(), pitch.height
    )
    camera = Camera.stack([scene.cameras[name].camera] * len(joints))
    detections = scene.reports[name].observations
    return World("second", scene.fps, camera, detections, pitch, joints, fit.parameters)


def draw_estimates(world: World, seed: int, *, tilted: bool) -> MonocularEstimates:
    """Return simulated monocular estimates of a world's bodies."""
    rng, errors = np.random.default_rng([seed, 5]), MonocularErrors()
    if tilted:
        errors = errors.model_copy(update={"turn": 2.0 * errors.turn})
    drawn = estimate_bodies(BODY, world.bodies, world.camera, world.fps, errors, rng)
    if tilted:
        orient = np.asarray(drawn["global_orient"], dtype=np.float64)
        orient = Rigid.from_rotvec([LEAN, 0.0, 0.0], np.zeros(3)).rotation @ orient
        half = Rigid.from_rotvec([0.0, np.pi, 0.0], np.zeros(3)).rotation
        turned = rng.random(len(orient)) < TURNED
        orient[turned] = orient[turned] @ half
        drawn["global_orient"] = orient
    return parse_monocular(drawn, Path("estimates"))


def place_people(world: World) -> tuple[PlaneEvidence, NDArray[np.int64]]:
    """Return the tracked people of a world's camera, and the true person of each; -1 = none."""
    frames = len(world.camera.focal)
    parts = [
        locate_feet(
            world.camera[f : f + 1],
            KeypointDetections.stack([world.detections[f : f + 1]]),
            world.pitch,
        )
        for f in range(frames)
    ]
    positions = GroundPositions.concatenate(parts)
    size = (world.pitch.length, world.pitch.width)
    tracks = track_on_plane(positions, world.fps, pitch_size=size)
    index = tracks.detection_index[:, 0]
    row = np.arange(frames)[:, None]
    seen = index >= 0
    keypoints = np.where(seen[..., None, None], world.detections.keypoints[row, index], np.nan)
    confidence = np.where(seen[..., None], world.detections.confidence[row, index], np.nan)
    evidence = PlaneEvidence(
        world.camera,
        row[:, 0],
        keypoints.astype(np.float64),
        confidence.astype(np.float64),
        tracks.xy,
        tracks.covariance,
        np.zeros_like(tracks.covariance),
        world.fps,
    )
    hips = world.truth[:, :, 11:13, :2].mean(axis=2)
    apart = np.linalg.norm(tracks.xy[:, :, None] - hips[:, None], axis=-1)
    away = np.nanmedian(apart, axis=0) if apart.size else np.empty((0, 1))
    person = np.where(away.min(axis=1) < NEAR, away.argmin(axis=1), -1)
    return evidence, person.astype(np.int64)


def score(
    world: World, evidence: PlaneEvidence, person: NDArray[np.int64], bodies: PlaneBodies
) -> dict[str, Floats]:
    """Return errors [mm] of all bodies, shares of joints in regions, and counts."""
    known = person >= 0
    truth = world.truth[:, person[known]]
    placed, fitted = bodies.placed[:, known], bodies.fit.joints[:, known]
    both = np.isfinite(placed[..., 0, 0]) & np.isfinite(fitted[..., 0, 0])
    truth, placed, fitted = truth[both], placed[both], fitted[both]
    covariance = bodies.fit.covariance[:, known][both]
    off = fitted - truth
    square = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(axis=-1)
    hips = truth[:, 11:13, :2].mean(axis=1)
    feet = np.linalg.norm(evidence.place[:, known][both] - hips, axis=-1)

    def distance_after_alignment(joints: Floats) -> Floats:
        moved = align(joints, truth, with_scale=True).apply(joints)
        return np.asarray(np.linalg.norm(moved - truth, axis=-1))

    def distance_after_shift(joints: Floats) -> Floats:
        middle = joints - truth
        return np.asarray(np.linalg.norm(middle - middle.mean(axis=1, keepdims=True), axis=-1))

    return {
        "placed": 1e3 * np.linalg.norm(placed - truth, axis=-1),
        "fitted": 1e3 * np.linalg.norm(off, axis=-1),
        "centred placed": 1e3 * distance_after_shift(placed),
        "centred fitted": 1e3 * distance_after_shift(fitted),
        "PA placed": 1e3 * distance_after_alignment(placed),
        "PA fitted": 1e3 * distance_after_alignment(fitted),
        "feet": 1e3 * feet,
        "hips": 1e3 * np.linalg.norm(fitted[:, 11:13, :2].mean(axis=1) - hips, axis=-1),
        "regions %": 1e2 * (square <= chdtri(3, 0.05)),
        "stated std": 1e3 * np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)),
    }


def measure(world: World, seed: int, *, tilted: bool) -> tuple[str, dict[str, Floats]]:
    """Return a line of a clip's results, and its metrics."""
    evidence, person = place_people(world)
    estimates = draw_estimates(world, seed, tilted=tilted)
    bodies = fit_bodies_on_plane(BODY, evidence, estimates, world.pitch.height)
    found = score(world, evidence, person, bodies)
    people = sum(reason is None for reason in bodies.missing)
    head = f"{world.name} {seed} {'tilted' if tilted else 'usual '}"
    return f"{head} {people:2d} of {len(person):2d} people  {describe(found)}", found


def describe(found: dict[str, Floats]) -> str:
    """Return means as text."""
    return ", ".join(f"{name} {np.mean(values):.0f}" for name, values in found.items())


def cases(seeds: list[int], duration: float) -> Iterator[tuple[str, World, int, bool]]:
    """Yield all clips: label, world, seed, and whether estimates are tilted."""
    for make in (first_world, second_world):
        for seed in seeds:
            world = make(seed, duration)
            for tilted in (False, True):
                yield f"{world.name}, {'tilted' if tilted else 'usual'}", world, seed, tilted


def main() -> None:
    """Print one line per clip, and means over all bodies."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[901, 902, 903])
    parser.add_argument("--duration", type=float, default=2.0)
    options = parser.parse_args()
    rows: dict[str, list[dict[str, Floats]]] = {}
    for label, world, seed, tilted in cases(options.seeds, options.duration):
        line, found = measure(world, seed, tilted=tilted)
        rows.setdefault(label, []).append(found)
        print(line, flush=True)
    for label, some in rows.items():
        print(label, describe({k: np.concatenate([r[k].ravel() for r in some]) for k in some[0]}))


if __name__ == "__main__":
    main()
