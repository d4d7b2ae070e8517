"""The people of a scene at any camera's times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.gait import walk
from worldpose.simulation.movements import play, run_through, take_corner, wander
from worldpose.simulation.paths import Clip, GroundPath
from worldpose.simulation.recordings import clip_path
from worldpose.simulation.settings import CrowdSettings, Scenario
from worldpose.simulation.skeletons import Body, PosedBody, draw_body, solve_body


@dataclass(frozen=True, eq=False)
class Crowd:
    """All people on the pitch.

    Attributes:
        bodies: measures of each person.
        paths: path of each person.
        action: (samples, 2) [m], world; the point that people and the broadcast camera follow.
        action_times: (samples,) [s].
        away: (persons, 2) begin and end of the time in which nobody sees a person [s].
    """

    bodies: Sequence[Body]
    paths: Sequence[GroundPath]
    action: Floats
    action_times: Floats
    pitch: PitchTemplate
    gaits: Sequence[np.random.SeedSequence]
    away: Floats

    def joints(self, times: Floats) -> Floats:
        """Return joints (frames, persons, 17, 3) [m], world, at `times` [s]; repeatable.

        NaN while a person is away.
        """
        joints = np.empty((len(times), len(self.paths), 17, 3))
        for person in range(len(self.paths)):
            joints[:, person] = self._solve_person(person, times).keypoints()
        gone = (times[:, None] >= self.away[:, 0]) & (times[:, None] < self.away[:, 1])
        joints[gone] = np.nan
        return joints

    def poses(self, times: Floats) -> BodyParameters:
        """Return the bodies (persons, frames), whose keypoints are the people's joints."""
        shape = (len(self.paths), len(times))
        betas, orient, transl = np.empty((*shape, 10)), np.empty((*shape, 3)), np.empty((*shape, 3))
        angles = np.empty((*shape, BODY_POSE))
        for person in range(len(self.paths)):
            body = self._solve_person(person, times).parameters()
            betas[person], orient[person] = body.betas, body.global_orient
            angles[person], transl[person] = body.body_pose, body.transl
        return BodyParameters(betas, orient, angles, transl)

    def _solve_person(self, person: int, times: Floats) -> PosedBody:
        body, rng = self.bodies[person], np.random.default_rng(self.gaits[person])
        joints, courses = walk(body, self.paths[person], times, self.pitch.height, rng)
        return solve_body(body, joints, self.pitch.height, courses)

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
        seed: every person draws from a separate stream; the paths of those who wander, too.
        driven: paths from tracking data, one per person.
        clip: motion capture that the third person plays, the first who is no goalkeeper, or the
            last of fewer.
    """
    settings, duration = scenario.crowd, scenario.duration
    person_seeds = seed.spawn(settings.people if driven is None else len(driven))
    rngs = [np.random.default_rng(each) for each in person_seeds]
    bodies = [draw_body(settings.height_m, rng) for rng in rngs]
    game = np.random.default_rng(seed.spawn(1)[0])
    action = None
    if driven is not None:
        paths = list(driven)
    elif settings.movement == "football":
        paths, action = play(settings, duration, game)
    elif settings.movement == "corner":
        paths = take_corner(settings, duration, game)
    elif settings.movement == "crossing":
        paths = run_through(settings, duration, game)
    else:
        paths = wander(settings, duration, rngs)
    times = paths[0].time if paths else np.array([0.0, duration])
    if action is None:
        action = np.broadcast_to(np.array(settings.area_center_m), (len(times), 2))
        if paths:
            action = np.mean([path.position for path in paths], axis=0)
    if clip is not None and paths:
        actor = min(2, len(paths) - 1)
        paths[actor] = clip_path(clip, paths[actor], bodies[actor])
    gaits = [each.spawn(1)[0] for each in person_seeds]
    return Crowd(bodies, paths, action, times, pitch, gaits, _absences(settings, duration, paths))


def _absences(settings: CrowdSettings, duration: float, paths: Sequence[GroundPath]) -> Floats:
    """Return the time (persons, 2) [s] in which nobody sees a person; infinite = never."""
    away = np.full((len(paths), 2), np.inf)
    # Each leaves a second after the one before.
    count, pairs = settings.leavers, settings.substitutes
    begin = 0.5 * (duration - settings.away_s) + np.arange(count + pairs) - 0.5 * (count + pairs)
    begin, last = np.maximum(begin, 0.0), count + 2 * pairs
    away[:count, 0], away[:count, 1] = begin[:count], begin[:count] + settings.away_s
    away[count : count + pairs, 0] = begin[count:]
    away[count + pairs : last, 0] = -np.inf
    away[count + pairs : last, 1] = begin[count:] + settings.away_s
    return away
