"""Trajectories of people over the ground: social forces, or tracking data of real players.

People without tracking data follow D. Helbing, P. Molnar, Social force model for pedestrian
dynamics, Physical Review E 51, 1995: each person relaxes to the velocity that leads to a goal, and
other people push them away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.simulation.recorded_files import FACING_SPEED, turn_along

Role = Literal["roam", "duel", "cross", "stand", "sprint"]

LEAD: Final = 2.0
"""Time before the first frame and after the last in which people already move [s]."""
TRACK_SMOOTHING: Final = 0.3
"""Standard deviation in time of the smoothing of tracking data [s]."""
_SPEEDS: Final[dict[Role, tuple[float, float]]] = {
    "roam": (0.6, 4.5),
    "duel": (0.8, 5.0),
    "cross": (1.0, 3.5),
    "stand": (0.3, 1.2),
    "sprint": (4.5, 8.5),
}
"""Minimum and maximum desired speed of a role [m/s]."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One person's trajectory.

    Attributes:
        times: (samples,) [s], evenly spaced.
        root: (samples, 2) middle of the hips [m], world.
        heading: (samples,) direction of the body [rad], continuous.
        source: origin, for the reference.
    """

    times: Floats
    root: Floats
    heading: Floats
    source: str


def wander(
    times: Floats,
    roles: Sequence[Role],
    center: Floats,
    size: Floats,
    obstacles: Sequence[Trajectory],
    rng: np.random.Generator,
) -> list[Trajectory]:
    """Return trajectories of people who keep clear of each other within an area.

    `times` (samples,) [s] are evenly spaced; the area has center and size (2,) [m]. Duels are with
    the previous person in the list of roles. `obstacles` have fixed trajectories.
    """
    hardest = (6.0, 25.0)  # maximum acceleration by legs, and by others [m/s^2]
    relaxation = 0.45  # time constant of a person's velocity [s]
    if not roles:
        return []
    count, step = len(roles), float(times[1] - times[0])
    substeps = max(1, int(np.ceil(step / 0.02)))
    place = _draw_places(count, center, size, [trajectory.root[0] for trajectory in obstacles], rng)
    for person in range(1, count):
        if roles[person] == "duel":
            angle = rng.uniform(0.0, 2.0 * np.pi)
            near = np.array([np.cos(angle), np.sin(angle)])
            place[person] = place[person - 1] + rng.uniform(0.5, 0.9) * near
    velocity = np.zeros((count, 2))
    goal = np.array([_draw_goal(roles[p], place[p], center, size, rng) for p in range(count)])
    want = np.array([rng.uniform(*_SPEEDS[role]) for role in roles])
    rest = np.where([role == "stand" for role in roles], rng.uniform(2.0, 9.0, count), 0.0)
    shift = rng.uniform(-0.5, 0.5, (count, 2))
    root = np.empty((len(times), count, 2))
    moved = np.empty((len(times), count, 2))
    for index in range(len(times)):
        root[index], moved[index] = place, velocity
        others = np.array([trajectory.root[index] for trajectory in obstacles]).reshape(-1, 2)
        for _ in range(substeps):
            h = step / substeps
            for person, role in enumerate(roles):
                if role == "duel" and person:
                    goal[person] = place[person - 1] + 0.6 * velocity[person - 1] + shift[person]
            away = goal - place
            far = np.linalg.norm(away, axis=-1)
            arrived = far < np.where(rest > 0.0, 1e9, 0.6)
            for person in np.flatnonzero(arrived & (rest <= 0.0)).tolist():
                role = roles[person]
                if role == "duel" and person:
                    continue
                goal[person] = _draw_goal(role, place[person], center, size, rng)
                want[person] = rng.uniform(*_SPEEDS[role])
                if rng.random() < (0.7 if role == "stand" else 0.15):
                    rest[person] = rng.uniform(0.8, 6.0)
            rest = np.maximum(rest - h, 0.0)
            pace = np.where(rest > 0.0, 0.0, np.minimum(want, 1.6 * far))
            wanted = away / np.maximum(far, 1e-6)[:, None] * pace[:, None]
            drive = _limit_length((wanted - velocity) / relaxation, hardest[0])
            push = _limit_length(_repulsion(place, others), hardest[1])
            velocity = velocity + h * (drive + push)
            place = place + h * velocity
    root = gaussian_filter1d(root, 0.06 / step, axis=0, mode="nearest")
    trajectories = []
    for person, role in enumerate(roles):
        towards = None
        if role == "duel" and person:
            towards = root[:, person - 1] - root[:, person]
        heading = _headings(moved[:, person], step, towards, rng)
        trajectories.append(Trajectory(times, root[:, person], heading, f"social forces: {role}"))
    return trajectories


def _draw_places(
    count: int, center: Floats, size: Floats, taken: list[Floats], rng: np.random.Generator
) -> Floats:
    """Return places (count, 2) in an area, apart from each other where there is room."""
    places: list[Floats] = []
    for _ in range(count):
        drawn = center + size * rng.uniform(-0.48, 0.48, (30, 2))
        known = np.array(taken + places).reshape(-1, 2)
        room = np.linalg.norm(drawn[:, None] - known, axis=-1).min(axis=1, initial=2.0)
        places.append(drawn[int(room.argmax())])
    return np.array(places).reshape(-1, 2)


def _draw_goal(
    role: Role, place: Floats, center: Floats, size: Floats, rng: np.random.Generator
) -> Floats:
    if role == "cross":
        # To the other side, through the middle.
        return np.asarray(center - 0.9 * (place - center) + 0.12 * size * rng.standard_normal(2))
    if role == "stand":
        return np.asarray(
            np.clip(place + rng.normal(0.0, 1.2, 2), center - 0.5 * size, center + 0.5 * size)
        )
    return np.asarray(center + size * rng.uniform(-0.5, 0.5, 2))


def _repulsion(place: Floats, others: Floats) -> Floats:
    """Return accelerations (persons, 2) [m/s^2] by which people repel each other."""
    body = 0.42  # distance between the middles of two people in contact [m]
    push = (12.0, 0.25)  # acceleration in contact [m/s^2], and its decay distance [m]
    everyone = np.concatenate([place, others])
    apart = place[:, None] - everyone
    far = np.linalg.norm(apart, axis=-1)
    far[np.arange(len(place)), np.arange(len(place))] = np.inf
    strength = push[0] * np.exp(np.clip((body - far) / push[1], -30.0, 2.0))
    return np.asarray(((strength / np.maximum(far, 1e-3))[..., None] * apart).sum(axis=1))


def _limit_length(vectors: Floats, most: float) -> Floats:
    """Return vectors (persons, 2) of length at most `most`."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, most / np.maximum(size, 1e-9)))


def _headings(
    velocity: Floats, step: float, towards: Floats | None, rng: np.random.Generator
) -> Floats:
    """Return the heading (samples,) [rad]: direction of motion, or of `towards` while slow."""
    speed = np.linalg.norm(velocity, axis=-1)
    begin = float(rng.uniform(-np.pi, np.pi))
    if towards is None:
        return turn_along(velocity + 1e-9, speed > FACING_SPEED, begin, step)
    share = np.clip((2.5 - speed) / 1.5, 0.0, 1.0)[:, None]
    aim = (1.0 - share) * velocity + share * 2.0 * towards
    return turn_along(aim, np.ones(len(speed), bool), begin, step)
