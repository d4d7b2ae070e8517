"""People in motion: bodies, ways and gaits, evaluated at any camera's times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.pitch import PitchTemplate
from worldpose.synthetic.football import play
from worldpose.synthetic.gait import Body, draw_body, walk
from worldpose.synthetic.paths import GroundPath, wander
from worldpose.synthetic.settings import Scenario

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Crowd:
    """Everybody on the pitch.

    Attributes:
        bodies: measures of each.
        paths: ways of each.
        action: (samples, 2) [m], world; what everybody, and the broadcast camera, follows.
        action_times: (samples,) [s].
    """

    bodies: Sequence[Body]
    paths: Sequence[GroundPath]
    action: Floats
    action_times: Floats
    pitch: PitchTemplate
    gaits: Sequence[np.random.SeedSequence]

    def joints(self, times: Floats) -> Floats:
        """Joints (frames, persons, 17, 3) [m], world, at `times` [s]; always the same ones."""
        joints = np.empty((len(times), len(self.paths), 17, 3))
        for person, seed in enumerate(self.gaits):
            rng = np.random.default_rng(seed)
            joints[:, person] = walk(
                self.bodies[person], self.paths[person], times, self.pitch.height, rng
            )
        return joints

    @property
    def heights(self) -> Floats:
        """Body heights (persons,) [m]."""
        return np.array([body.height for body in self.bodies])


def gather(
    scenario: Scenario,
    pitch: PitchTemplate,
    seed: np.random.SeedSequence,
    driven: Sequence[GroundPath] | None = None,
) -> Crowd:
    """Return the people of a scenario.

    Args:
        scenario: who, where and how long.
        pitch: what they stand on.
        seed: every person draws from a stream of their own; only football ties their ways.
        driven: their ways, where tracking data gives them; there are as many people.
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
    else:
        for rng in generators:
            paths.append(wander(settings, scenario.duration, paths, rng))
    times = paths[0].time if paths else np.array([0.0, scenario.duration])
    if action is None:
        action = np.broadcast_to(np.array(settings.area_center), (len(times), 2))
        if paths:
            action = np.mean([path.position for path in paths], axis=0)
    gaits = [each.spawn(1)[0] for each in person_seeds]
    return Crowd(bodies, paths, action, times, pitch, gaits)
