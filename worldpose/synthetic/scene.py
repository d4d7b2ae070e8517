"""A whole synthetic scene: people, cameras, detections and the truth behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras import Camera
from worldpose.ingest import Observations
from worldpose.pitch import PitchTemplate
from worldpose.release import JointTracks
from worldpose.synthetic.gait import draw_body, walk
from worldpose.synthetic.observing import Bodies, detect, report, see
from worldpose.synthetic.paths import GroundPath, wander
from worldpose.synthetic.phantoms import PHANTOMS, draw_phantoms
from worldpose.synthetic.scenarios import Scenario
from worldpose.synthetic.stadium import place_camera


@dataclass(frozen=True, eq=False)
class Scene:
    """What happened, and what detectors made of it; cameras by id in the order of the rig."""

    truth: JointTracks
    """`views` counts the cameras that have the joint in their picture with nobody before it."""
    cameras: dict[str, Camera]
    observations: dict[str, Observations]
    identities: dict[str, NDArray[np.int16]]
    """(frames, detections) person of every detection as index into `truth.person_ids`; -1 for
    false people and padding."""


def simulate_scene(scenario: Scenario, seed: int) -> Scene:
    """Return a scene; the same scenario and seed give the same numbers.

    Every person and every camera draws from a stream of its own: a further camera changes nothing
    that was there, a further person only whom it hides and the order of detections.
    """
    people_seed, rig_seed = np.random.SeedSequence(seed).spawn(2)
    pitch = PitchTemplate.from_spec(scenario.pitch)
    bodies = _people(scenario, pitch, people_seed)
    frames, persons = bodies.joints.shape[:2]
    x, y = scenario.crowd.area_center
    target = np.array([x, y, float(pitch.height(x, y))])

    cameras: dict[str, Camera] = {}
    observations: dict[str, Observations] = {}
    identities: dict[str, NDArray[np.int16]] = {}
    views = np.zeros((frames, persons, 17), dtype=np.int64)
    for index, seeds in enumerate(rig_seed.spawn(scenario.rig.cameras)):
        name = f"cam{index:02d}"
        place, order, deception, errors = seeds.spawn(4)
        figures, *figure_errors = deception.spawn(1 + PHANTOMS)
        camera = place_camera(scenario.rig, index, target, np.random.default_rng(place))
        sight = see(camera, bodies)
        views += sight.seen
        keypoints, confidence = detect(
            sight, scenario.noise, scenario.fps, _generators(errors.spawn(persons))
        )
        phantoms = draw_phantoms(scenario, pitch, frames, np.random.default_rng(figures))
        deceit = see(camera, phantoms)
        false_keypoints, false_confidence = detect(
            deceit, scenario.noise, scenario.fps, _generators(figure_errors)
        )
        observations[name], identity = report(
            0,
            np.concatenate([keypoints, false_keypoints], axis=1),
            np.concatenate(
                [confidence, false_confidence * (1.0 - scenario.noise.false_doubt)], axis=1
            ),
            np.concatenate([sight.size, deceit.size], axis=1),
            np.random.default_rng(order),
        )
        cameras[name] = camera
        identities[name] = np.where(identity < persons, identity, -1).astype(np.int16)
    truth = JointTracks(np.arange(frames), np.arange(persons), bodies.joints, views=views)
    return Scene(truth, cameras, observations, identities)


def _people(scenario: Scenario, pitch: PitchTemplate, seed: np.random.SeedSequence) -> Bodies:
    times = np.arange(round(scenario.duration * scenario.fps)) / scenario.fps
    paths: list[GroundPath] = []
    joints = np.empty((len(times), scenario.crowd.people, 17, 3))
    heights = np.empty(scenario.crowd.people)
    for person, rng in enumerate(_generators(seed.spawn(scenario.crowd.people))):
        body = draw_body(scenario.crowd.height, rng)
        path = wander(scenario.crowd, scenario.duration, paths, rng)
        joints[:, person] = walk(body, path, times, pitch.height, rng)
        heights[person] = body.height
        paths.append(path)
    return Bodies(joints, heights)


def _generators(seeds: list[np.random.SeedSequence]) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]
