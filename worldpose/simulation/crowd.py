"""People in motion: bodies, paths and gaits, evaluated at any camera's times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body import BodyParameters
from worldpose.body.parameters import BODY_POSE
from worldpose.pitch import PitchTemplate
from worldpose.simulation.bodies import Body, draw_body
from worldpose.simulation.bvh import Clip
from worldpose.simulation.clips import clip_path
from worldpose.simulation.contests import run_through, take_corner
from worldpose.simulation.football import play
from worldpose.simulation.gait import tread
from worldpose.simulation.idling import stand_about
from worldpose.simulation.inverse_kinematics import Embodied, embody
from worldpose.simulation.paths import GroundPath, wander
from worldpose.simulation.settings import Scenario

CONTESTS: Final = {"corner": take_corner, "crossing": run_through}
"""Movements in which people make contact."""


@dataclass(frozen=True, eq=False)
class Crowd:
    """All people on the pitch.

    Attributes:
        bodies: measures of each person.
        paths: path of each person.
        action: (samples, 2) [m], world; the point that people and the broadcast camera follow.
        action_times: (samples,) [s].
    """

    bodies: Sequence[Body]
    paths: Sequence[GroundPath]
    action: Floats
    action_times: Floats
    pitch: PitchTemplate
    gaits: Sequence[np.random.SeedSequence]

    def joints(self, times: Floats) -> Floats:
        """Return joints (frames, persons, 17, 3) [m], world, at `times` [s]; repeatable."""
        joints = np.empty((len(times), len(self.paths), 17, 3))
        for person in range(len(self.paths)):
            joints[:, person] = self._embodied(person, times).keypoints()
        return joints

    def poses(self, times: Floats) -> BodyParameters:
        """Return the bodies (persons, frames) whose keypoints the joints are."""
        shape = (len(self.paths), len(times))
        betas, orient, transl = np.empty((*shape, 10)), np.empty((*shape, 3)), np.empty((*shape, 3))
        angles = np.empty((*shape, BODY_POSE))
        for person in range(len(self.paths)):
            body = self._embodied(person, times).parameters()
            betas[person], orient[person] = body.betas, body.global_orient
            angles[person], transl[person] = body.body_pose, body.transl
        return BodyParameters(betas, orient, angles, transl)

    def _embodied(self, person: int, times: Floats) -> Embodied:
        body, rng = self.bodies[person], np.random.default_rng(self.gaits[person])
        joints, courses = tread(body, self.paths[person], times, self.pitch.height, rng)
        return embody(body.figure, joints, self.pitch.height, courses)

    @property
    def heights(self) -> Floats:
        """Return body heights (persons,) [m]."""
        return np.array([body.height for body in self.bodies])


def gather(
    scenario: Scenario,
    pitch: PitchTemplate,
    seed: np.random.SeedSequence,
    driven: Sequence[GroundPath] | None = None,
    clip: Clip | None = None,
) -> Crowd:
    """Return the people of a scenario.

    Args:
        scenario: people, place and duration.
        pitch: the ground under them.
        seed: every person draws from a separate stream; only football couples the paths.
        driven: paths from tracking data, one per person.
        clip: motion capture that the third person plays, the first who is no goalkeeper, or the
            last of fewer.
    """
    settings = scenario.crowd
    count = settings.people if driven is None else len(driven)
    person_seeds = seed.spawn(count)
    generators = [np.random.default_rng(each) for each in person_seeds]
    bodies = [draw_body(settings.height, rng) for rng in generators]
    paths: list[GroundPath] = []
    action = None
    if driven is not None:
        paths = list(driven)
    elif settings.movement == "football":
        (game,) = seed.spawn(1)
        paths, ball = play(settings, scenario.duration, np.random.default_rng(game))
        action = ball.position
    elif settings.movement in CONTESTS:
        (contest,) = seed.spawn(1)
        paths = CONTESTS[settings.movement](
            settings, scenario.duration, np.random.default_rng(contest)
        )
    else:
        for rng in generators:
            paths.append(wander(settings, scenario.duration, paths, rng))
    times = paths[0].time if paths else np.array([0.0, scenario.duration])
    if action is None:
        action = np.broadcast_to(np.array(settings.area_center), (len(times), 2))
        if paths:
            action = np.mean([path.position for path in paths], axis=0)
    if clip is not None and paths:
        actor = min(2, count - 1)
        paths[actor] = clip_path(clip, paths[actor], bodies[actor])
    gaits, moods = (
        zip(*(each.spawn(2) for each in person_seeds), strict=True) if count else ((), ())
    )
    paths = [
        stand_about(path, settings.actions, np.random.default_rng(mood))
        for path, mood in zip(paths, moods, strict=True)
    ]
    return Crowd(bodies, paths, action, times, pitch, gaits)
