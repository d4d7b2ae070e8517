"""A complete synthetic scene: people, cameras, detections and ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.body import BodyParameters
from worldpose.formats import JointTracks
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.annotations import Clicks, add_calibration_errors, click, every, survey
from worldpose.simulation.bvh import Clip
from worldpose.simulation.cameras import move_broadcast_camera, place_camera
from worldpose.simulation.crowd import Crowd, gather
from worldpose.simulation.detector_errors import (
    MAX_FALSE_POSITIVES,
    Detections,
    Report,
    SystematicErrors,
    detect,
    draw_false_positives,
    draw_systematic_errors,
    perceived_bias,
    report,
)
from worldpose.simulation.occlusion import Bodies, Projections, project_bodies
from worldpose.simulation.paths import GroundPath
from worldpose.simulation.random_processes import bursts
from worldpose.simulation.settings import Scenario

Seed = np.random.SeedSequence


@dataclass(frozen=True, eq=False)
class Identities:
    """Person of each detection of one camera.

    Attributes:
        person: (frames, detections) int16 index into the truth's `person_ids`; -1 for false
            positives and padding.
        displaced: (frames, detections, 17) bool, keypoints with deliberate gross errors.
    """

    person: NDArray[np.int16]
    displaced: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class StaticViews:
    """Detections of static cameras per frame, the input of tracking.

    Attributes:
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where there is none.
        confidence: (frames, cameras, detections, 17); NaN where there is none.
        person: (frames, cameras, detections) index into the truth's `person_ids`; -1 for false
            positives and padding.
        displaced: (frames, cameras, detections, 17) bool, keypoints with deliberate gross errors.
    """

    keypoints: NDArray[np.float64]
    confidence: NDArray[np.float64]
    person: NDArray[np.int16]
    displaced: NDArray[np.bool_]

    def index(self, persons: int) -> NDArray[np.int16]:
        """Return each person's detection index (frames, cameras, persons); -1 = not found."""
        index = np.full((*self.person.shape[:2], persons), -1, np.int16)
        frame, camera, place = np.nonzero(self.person >= 0)
        index[frame, camera, self.person[frame, camera, place]] = place
        return index


@dataclass(frozen=True, eq=False)
class Scene:
    """Ground truth of a match, and its detections.

    Attributes:
        truth: `views` counts the static cameras that have the joint in their image without an
            occluding person.
        crowd: the people, at any time.
        poses: the bodies (persons, frames) whose keypoints the truth's joints are.
        cameras: the true static cameras by id, in the order of the rig.
        given: the same with the errors of calibration.toml.
        broadcast: the moving camera, a batch (frames,); None without.
        observations: by id of a static camera, or of the clip for the broadcast camera.
        identities: by the same ids.
        clocks: offset of a static camera behind its stated clock, by id [frame].
        clicks: a person's clicks in the first frame of every static camera, by id.
        surveyed: the pitch of pitch.json; the scenario has the painted one.
    """

    truth: JointTracks
    crowd: Crowd
    poses: BodyParameters
    cameras: dict[str, Camera]
    given: dict[str, Camera]
    broadcast: Camera | None
    observations: dict[str, KeypointDetections]
    identities: dict[str, Identities]
    clocks: dict[str, float]
    clicks: dict[str, Clicks]
    surveyed: PitchSpec

    def static_views(self, names: Sequence[str] | None = None) -> StaticViews:
        """Return the detections of static cameras in one array, by default of all of them."""
        names = list(self.cameras) if names is None else names
        seen = [self.observations[name] for name in names]
        frames = self.truth.frames
        shape = (len(frames), len(seen), max(each.keypoints.shape[1] for each in seen), 17)
        keypoints, confidence = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
        person, displaced = np.full(shape[:3], -1, np.int16), np.zeros(shape, np.bool_)
        for c, (name, each) in enumerate(zip(names, seen, strict=True)):
            rows, last = np.searchsorted(frames, each.frame), each.keypoints.shape[1]
            keypoints[rows, c, :last] = each.keypoints
            confidence[rows, c, :last] = each.confidence
            person[rows, c, :last] = self.identities[name].person
            displaced[rows, c, :last] = self.identities[name].displaced
        return StaticViews(keypoints, confidence, person, displaced)


@dataclass(frozen=True, eq=False)
class _World:
    """Subject of all cameras, with the detector's systematic errors."""

    scenario: Scenario
    crowd: Crowd
    pitch: PitchTemplate
    systematic: SystematicErrors
    own_bias: NDArray[np.float64]

    def bodies(self, times: NDArray[np.float64]) -> Bodies:
        joints, noise = self.crowd.joints(times), self.scenario.noise
        bias = None
        if noise.shared_bias > 0.0 or noise.own_bias > 0.0:
            bias = perceived_bias(joints, self.systematic, noise, self.own_bias)
        return Bodies(joints, self.crowd.heights, bias)


def simulate_scene(
    scenario: Scenario,
    seed: int,
    *,
    clip_id: str = "clip",
    driven: Sequence[GroundPath] | None = None,
    clip: Clip | None = None,
) -> Scene:
    """Return a scene; the same scenario and seed give the same numbers.

    Every person and every camera draws from a separate stream: an additional camera changes no
    existing number; an additional person, if people wander independently, changes only occlusions
    and the order of detections.

    Args:
        scenario: everything but the seed.
        seed: from 0.
        clip_id: names the broadcast camera's detections.
        driven: paths of the people, instead of the scenario's movement.
        clip: motion capture for one of them.
    """
    people_seed, rig_seed, systematic_seed, broadcast_seed, error_seed, survey_seed, click_seed = (
        Seed(seed).spawn(7)
    )
    pitch = PitchTemplate.from_spec(scenario.pitch)
    crowd = gather(scenario, pitch, people_seed, driven, clip)
    persons = len(crowd.paths)
    common, own = systematic_seed.spawn(2)
    own_bias = np.array([_rng(each).standard_normal((17, 3)) for each in own.spawn(persons)])
    systematic = draw_systematic_errors(_rng(common))
    world = _World(scenario, crowd, pitch, systematic, own_bias.reshape(persons, 17, 3))
    times = np.arange(round(scenario.duration * scenario.fps)) / scenario.fps
    bodies = world.bodies(times)
    x, y = scenario.crowd.area_center
    target = np.array([x, y, float(pitch.height(x, y))])

    cameras: dict[str, Camera] = {}
    reports: dict[str, Report] = {}
    clocks: dict[str, float] = {}
    clicks: dict[str, Clicks] = {}
    views = np.zeros(bodies.joints.shape[:3], dtype=np.int64)
    from_wrong, from_clustered = _rng(click_seed).random(2)
    for index, camera_seed in enumerate(rig_seed.spawn(scenario.rig.cameras)):
        name = f"cam{index:02d}"
        place, clock, *errors, hand = camera_seed.spawn(7)
        camera = place_camera(scenario.rig, index, target, scenario.pitch, _rng(place))
        clock_offset = scenario.rig.clock_spread * float(_rng(clock).standard_normal())
        seen_bodies = (
            bodies if clock_offset == 0.0 else world.bodies(times + clock_offset / scenario.fps)
        )
        projections = project_bodies(camera, seen_bodies)
        views += projections.seen
        clicks[name] = click(
            camera,
            pitch,
            bodies.joints[0],
            scenario.clicks,
            clustered=every(scenario.clicks.clustered, index, from_clustered),
            mistaken=every(scenario.clicks.wrong, index, from_wrong),
            rng=_rng(hand),
        )
        cameras[name], clocks[name] = camera, clock_offset
        reports[name] = _report_detections(world, camera, projections, errors)
    broadcast = None
    if scenario.broadcast is not None:
        place, *errors = broadcast_seed.spawn(5)
        size = scenario.rig.image_size
        broadcast = move_broadcast_camera(
            scenario.broadcast, times, crowd.action, crowd.action_times, size, _rng(place)
        )
        reports[clip_id] = _report_detections(
            world, broadcast, project_bodies(broadcast, bodies), errors
        )
    return Scene(
        truth=JointTracks(np.arange(len(times)), np.arange(persons), bodies.joints, views=views),
        crowd=crowd,
        poses=crowd.poses(times),
        cameras=cameras,
        given=add_calibration_errors(cameras, scenario.calibration, _rng(error_seed)),
        broadcast=broadcast,
        observations={name: each.observations for name, each in reports.items()},
        identities={name: _identities(each, persons) for name, each in reports.items()},
        clocks=clocks,
        clicks=clicks,
        surveyed=survey(scenario.pitch, scenario.survey_error, _rng(survey_seed)),
    )


def _report_detections(
    world: _World, camera: Camera, projections: Projections, seeds: list[Seed]
) -> Report:
    """Return a camera's detections, false positives included; `seeds` are four."""
    order, false_seed, errors, loss = seeds
    scenario, noise = world.scenario, world.scenario.noise
    frames, persons = projections.size.shape
    real = detect(projections, noise, world.systematic, scenario.fps, _rngs(errors.spawn(persons)))
    figures, *figure_errors = false_seed.spawn(1 + MAX_FALSE_POSITIVES)
    projected = project_bodies(
        camera, draw_false_positives(scenario, world.pitch, frames, _rng(figures))
    )
    false = detect(projected, noise, world.systematic, scenario.fps, _rngs(figure_errors))
    merged = np.where(false.merged_into >= 0, false.merged_into + persons, -1)
    together = Detections(
        np.concatenate([real.keypoints, false.keypoints], axis=1),
        np.concatenate([real.confidence, false.confidence * (1.0 - noise.false_doubt)], axis=1),
        np.concatenate([real.displaced, false.displaced], axis=1),
        np.concatenate([real.merged_into, merged], axis=1),
    )
    dropped = bursts(noise.dropped_frames, noise.dropped_time, (frames,), scenario.fps, _rng(loss))
    size = np.concatenate([projections.size, projected.size], axis=1)
    return report(together, size, dropped, _rng(order))


def _identities(given: Report, persons: int) -> Identities:
    person = np.where(given.person < persons, given.person, -1).astype(np.int16)
    return Identities(person, given.displaced)


def _rng(seed: Seed) -> np.random.Generator:
    return np.random.default_rng(seed)


def _rngs(seeds: list[Seed]) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]
