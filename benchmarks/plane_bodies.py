"""Prints how far bodies of a broadcast camera alone are from the truth, on two simulated worlds.

    python benchmarks/plane_bodies.py [--seeds 901 902 903] [--duration 2]
    python benchmarks/plane_bodies.py --shelf DATA

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

With --shelf, real detections of the Shelf sequence (`DATA/shelf_dev`), each of its five cameras
alone, against the labels of 12 joints. No monocular estimates of it are at hand: simulated errors
are added to the bodies that all five cameras give. Its cameras are 4 to 6 m away, so that lines of
sight of a person are not parallel, as they are on a pitch.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.body_fit import ClipEvidence, fit_bodies
from worldpose.body_fitting.monocular import MonocularEstimates, parse_monocular
from worldpose.body_fitting.objective import ankle_height
from worldpose.body_fitting.plane_bodies import PlaneBodies, PlaneEvidence, fit_bodies_on_plane
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, align
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.foreign.matches import FOREIGN_SCENARIOS, simulate_foreign_scene
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.tracking.feet import GroundPositions, locate_feet
from worldpose.tracking.ground_tracks import track_on_plane
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

BODY: Final = load_open_body()
LEAN: Final = np.radians(8.0)
TURNED: Final = 0.05
"""Share of half turns among tilted estimates."""
SHELF_RATE: Final = 25.0
"""Frames per second of the Shelf sequence [1/s]."""
TRIANGULATION: Final = TriangulationSettings()
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


LABELLED: Final = (16, 14, 12, 11, 13, 15, 10, 8, 6, 5, 7, 9)
"""Joint in COCO-17 of each of the labels' first twelve."""


def shelf_worlds(data: Path) -> Iterator[World]:
    """Yield every camera of the Shelf sequence, in a world whose floor is at z = 0."""
    given = json.loads((data / "cameras.json").read_text())
    with np.load(data / "detections.npz") as stored:
        seen = stored["kp_coco17"].astype(np.float64)
    keypoints, confidence = seen[..., :2], np.clip(seen[..., 2], 0.0, 1.0)
    keypoints[confidence <= 0.0] = np.nan
    confidence[confidence <= 0.0] = np.nan
    detections = KeypointDetections.from_keypoints(
        keypoints, confidence, frame=np.arange(len(keypoints))
    )
    cameras = Camera.stack([_shelf_camera(given[name]) for name in sorted(given)])
    index = track_people(cameras, detections, SHELF_RATE, TrackingSettings()).detection_index
    people = detections.assign_people(index)
    placed = reconstruct_joints(cameras, people, SHELF_RATE, TRIANGULATION).triangulation
    evidence = ClipEvidence(placed.joints, placed.covariance, SHELF_RATE, placed.common_bias)
    fit = fit_bodies(BODY, evidence)
    standing = np.nanquantile(fit.joints[:, :, 15:17, 2], 0.1)
    floor = standing - ankle_height(BODY, np.zeros(BODY.shapes))
    with np.load(data / "gt.npz") as stored:
        labels = stored["gt"][:, [0, 2]]
    truth = np.full((*labels.shape[:2], 17, 3), np.nan)
    truth[:, :, LABELLED] = labels[:, :, :12]
    truth[..., 2] -= floor
    parameters = fit.parameters
    bodies = replace(parameters, transl=parameters.transl - [0.0, 0.0, floor])
    pitch = PitchTemplate.from_spec(PitchSpec(crown=0.0))
    for c, name in enumerate(sorted(given)):
        at = cameras[c].cam_from_world
        moved = Rigid(at.rotation, at.translation + floor * at.rotation[:, 2])
        camera = Camera.stack([replace(cameras[c], cam_from_world=moved)] * len(truth))
        own = KeypointDetections.from_keypoints(
            keypoints[:, c], confidence[:, c], frame=np.arange(len(truth))
        )
        yield World(f"shelf {name}", SHELF_RATE, camera, own, pitch, truth, bodies)


def _shelf_camera(given: dict[str, Any]) -> Camera:
    matrix = np.array(given["K"])
    return Camera(
        focal=np.diag(matrix)[:2].copy(),
        principal_point=matrix[:2, 2],
        distortion=np.zeros(5),
        cam_from_world=Rigid(np.array(given["R"]), np.array(given["t"])),
        image_size=np.array(given["image_size"]),
    )


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
    met = np.isfinite(apart).any(axis=0)
    away = np.where(met, np.nanmedian(np.where(met, apart, 0.0), axis=0), np.inf)
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
    both &= np.isfinite(truth[..., 11:13, 0]).all(axis=-1)
    truth, placed, fitted = truth[both], placed[both], fitted[both]
    covariance = bodies.fit.covariance[:, known][both]
    off = fitted - truth
    square = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(axis=-1)
    inside = np.where(np.isnan(square), np.nan, square <= chdtri(3, 0.05))
    hips = truth[:, 11:13, :2].mean(axis=1)
    feet = np.linalg.norm(evidence.place[:, known][both] - hips, axis=-1)

    def distance_after_alignment(joints: Floats) -> Floats:
        moved = align(joints, truth, with_scale=True).apply(joints)
        return np.asarray(np.linalg.norm(moved - truth, axis=-1))

    def distance_after_shift(joints: Floats) -> Floats:
        middle = joints - truth
        middle -= np.nanmean(middle, axis=1, keepdims=True)
        return np.asarray(np.linalg.norm(middle, axis=-1))

    return {
        "placed": 1e3 * np.linalg.norm(placed - truth, axis=-1),
        "fitted": 1e3 * np.linalg.norm(off, axis=-1),
        "centred placed": 1e3 * distance_after_shift(placed),
        "centred fitted": 1e3 * distance_after_shift(fitted),
        "PA placed": 1e3 * distance_after_alignment(placed),
        "PA fitted": 1e3 * distance_after_alignment(fitted),
        "feet": 1e3 * feet,
        "hips": 1e3 * np.linalg.norm(fitted[:, 11:13, :2].mean(axis=1) - hips, axis=-1),
        "regions %": 1e2 * inside,
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
    return ", ".join(f"{name} {np.nanmean(values):.0f}" for name, values in found.items())


def cases(
    seeds: list[int], duration: float, shelf: Path | None
) -> Iterator[tuple[str, World, int, bool]]:
    """Yield all clips: label, world, seed, and whether estimates are tilted."""
    worlds = (
        ((seed, make(seed, duration)) for make in (first_world, second_world) for seed in seeds)
        if shelf is None
        else ((1, world) for world in shelf_worlds(shelf / "shelf_dev"))
    )
    for seed, world in worlds:
        for tilted in (False, True):
            yield f"{world.name.split()[0]}, {'tilted' if tilted else 'usual'}", world, seed, tilted


def main() -> None:
    """Print one line per clip, and means over all bodies."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[901, 902, 903])
    parser.add_argument("--duration", type=float, default=2.0)
    parser.add_argument("--shelf", type=Path, metavar="DATA")
    options = parser.parse_args()
    rows: dict[str, list[dict[str, Floats]]] = {}
    for label, world, seed, tilted in cases(options.seeds, options.duration, options.shelf):
        line, found = measure(world, seed, tilted=tilted)
        rows.setdefault(label, []).append(found)
        print(line, flush=True)
    for label, some in rows.items():
        print(label, describe({k: np.concatenate([r[k].ravel() for r in some]) for k in some[0]}))


if __name__ == "__main__":
    main()
