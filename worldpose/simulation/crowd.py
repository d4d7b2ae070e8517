"""The people of a scene at any camera's times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.geometry.rigid import unit
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.movements import play, run_through, take_corner, wander
from worldpose.simulation.paths import Clip, GroundPath
from worldpose.simulation.recordings import clip_path, play_clip
from worldpose.simulation.settings import CrowdSettings, Scenario
from worldpose.simulation.skeletons import (
    Body,
    Ground,
    PosedBody,
    draw_body,
    level_axes,
    solve_body,
)

STRIDES: Final = (
    (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 9.0),
    (0.91, 1.0, 1.10, 1.26, 1.36, 1.43, 1.53, 1.68, 1.85, 2.2),
)
"""Speeds [m/s] and strides per second at them: walkers up to 2 m/s, runners beyond."""


def walk(
    body: Body, path: GroundPath, times: Floats, ground: Ground, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return joints (frames, 17, 3) [m], world, and feet directions of a person on a path.

    Feet point (frames, 2) [rad], left and right, from the x axis towards y, along the path when
    they are placed. The path covers `times` (frames,) [s] and a stride before and after. `rng`
    draws the stride phase at the start of the path and the turns of the head.
    """
    cycle = stride_cycle(path, rng.random())
    swing = 2.0 * np.pi * np.interp(times, path.time, cycle)
    pelvis_xy, heading, speed = path.at(times)
    run = _running_share(speed)
    # Slow people hardly swing their arms.
    pace = np.minimum(speed, 1.0)
    sway = pace * np.sin(swing)

    up = np.array([0.0, 0.0, 1.0])
    # Walkers rise over the planted leg, runners sink onto it.
    rise = (0.945 - 0.04 * run) * body.leg + pace * (0.015 - 0.05 * run) * np.cos(2.0 * swing)
    pelvis = np.concatenate(
        [pelvis_xy, (ground(*pelvis_xy.T) + body.ankle_height + rise)[:, None]], axis=-1
    )
    forward, leftward = level_axes(heading + np.radians(6.0) * sway)
    chest_forward, chest_left = level_axes(heading - np.radians(8.0) * sway)
    lean = np.radians(2.0 + 6.0 * run)[:, None]
    neck = pelvis + body.trunk * (np.cos(lean) * up + np.sin(lean) * level_axes(heading)[0])
    look = np.radians(35.0) * np.sin(2.0 * np.pi * (times / rng.uniform(3.0, 6.0) + rng.random()))
    gaze, gaze_left = level_axes(heading + look)
    head = np.stack([gaze, gaze_left, np.broadcast_to(up, gaze.shape)], axis=-2)

    joints, courses = np.empty((len(times), 17, 3)), np.empty((len(times), 2))
    joints[:, :5] = neck[:, None] + body.face @ head
    for side, (sign, offset) in enumerate(((1.0, 0.0), (-1.0, 0.5))):  # left, right
        # The left arm is forward when the left leg is back.
        raised = (0.35 + 0.35 * run) * sign * sway - 0.15 * run
        bent = raised + np.radians(20.0 + 65.0 * run)
        upper = _arm_directions(raised, chest_forward, 0.15 * sign * chest_left)
        fore = _arm_directions(bent, chest_forward, np.zeros(3))
        joints[:, 5 + side] = neck + sign * body.shoulder_half_width * chest_left
        joints[:, 7 + side] = joints[:, 5 + side] + body.upper_arm * upper
        joints[:, 9 + side] = joints[:, 7 + side] + body.forearm * fore
        hip = pelvis + sign * body.hip_half_width * leftward
        joints[:, 11 + side], joints[:, 13 + side] = hip, hip + body.thigh * forward
        joints[:, 15 + side], courses[:, side] = _place_ankles(
            body, path, cycle + offset, times, ground, sign
        )
    if path.clip is not None:
        joints = play_clip(body, path.clip, times, ground, joints)
    return joints, courses


def stride_cycle(path: GroundPath, phase: float) -> Floats:
    """Return strides made (samples,): whole at mid-stance of the left foot, half at the right's.

    Strides get longer and faster with speed; a standing person rests a quarter of the way between
    the two, both feet on the ground. `phase` is the stride at the start for a person who never
    stands [1].
    """
    turning_arm = 0.5  # turning by 1 rad/s takes as many steps as walking at this many m/s [m]
    turning = turning_arm * np.abs(np.gradient(path.heading, path.time))
    pace = np.maximum(path.speed, np.minimum(turning, 1.0))
    rate = np.where(pace < 1.0, 0.91 * np.sqrt(pace), np.interp(pace, STRIDES[0], STRIDES[1]))
    cycle = phase + np.concatenate(
        [[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(path.time))]
    )
    rests = _rest_samples(path, pace)
    if not rests:
        return cycle
    made = np.empty_like(cycle)
    first = rests[0][0]
    here = np.round(2.0 * cycle[first] - 0.5) / 2.0 + 0.25
    made[: first + 1] = cycle[: first + 1] + here - cycle[first]
    for (begin, end), (following, _) in zip(rests, [*rests[1:], (len(cycle), 0)], strict=True):
        made[begin:end] = here
        natural = cycle[end - 1 : following + 1] - cycle[end - 1]
        if following < len(cycle):
            # Whole steps lead from one rest to the next; a shift sideways takes one or two.
            moved = float(np.linalg.norm(path.position[following] - path.position[end - 1]))
            steps = max(round(2.0 * natural[-1]), min(2, int(np.ceil(moved / 0.2 - 0.25))))
            natural = natural * (0.5 * steps / natural[-1])
        made[end - 1 : following + 1] = here + natural
        here = made[min(following, len(cycle) - 1)]
    return made


def _rest_samples(path: GroundPath, pace: Floats) -> list[tuple[int, int]]:
    """Return the intervals of samples, first and behind the last, in which a person stands."""
    standing_time, standing_speed = 0.3, 0.25  # [s], [m/s]: who is slower for so long stands
    slow = np.concatenate([[False], pace < standing_speed, [False]])
    begins, ends = np.flatnonzero(~slow[:-1] & slow[1:]), np.flatnonzero(slow[:-1] & ~slow[1:])
    long = path.time[np.minimum(ends, len(path.time) - 1)] - path.time[begins] >= standing_time
    return [(int(a), int(b)) for a, b in zip(begins[long], ends[long], strict=True)]


def _running_share(speed: Floats) -> Floats:
    """Return the running share: 0 at a walk of 1 m/s, 1 at 4 m/s, at most 1.5."""
    return np.clip((speed - 1.0) / 3.0, 0.0, 1.5)


def _arm_directions(angle: Floats, forward: Floats, outward: Floats) -> Floats:
    """Return unit vectors from hanging, raised forward by `angle` [rad] and a little outward."""
    down = np.array([0.0, 0.0, -1.0])
    return unit(np.cos(angle)[:, None] * down + np.sin(angle)[:, None] * forward + outward)


def _place_ankles(
    body: Body, path: GroundPath, cycle: Floats, times: Floats, ground: Ground, sign: float
) -> tuple[Floats, Floats]:
    """Return ankles (frames, 3) and the directions of the feet (frames,) [rad].

    An ankle is planted around whole cycles, and moves to the next foothold in between.
    """
    now = np.interp(times, path.time, cycle)
    before = np.floor(now)
    places, courses, stance = [], [], []
    for count in (before, before + 1.0):
        beneath, heading, speed = path.at(np.interp(count, cycle, path.time))
        courses.append(heading)
        places.append(beneath + sign * 0.8 * body.hip_half_width * level_axes(heading)[1][:, :2])
        # Share of the cycle on the ground: 62 % at a walk, 30 % at 4 m/s.
        stance.append(0.62 - 0.32 * _running_share(speed))
    leave, land = before + 0.5 * stance[0], before + 1.0 - 0.5 * stance[1]
    done = np.clip((now - leave) / (land - leave), 0.0, 1.0)
    moved = done**2 * (3.0 - 2.0 * done)
    course = (1.0 - moved) * courses[0] + moved * courses[1]
    place = (1.0 - moved)[:, None] * places[0] + moved[:, None] * places[1]
    run = _running_share(np.interp(times, path.time, path.speed))
    lift = (0.08 + 0.27 * run) * np.sin(np.pi * done) ** 2
    height = ground(*place.T) + body.ankle_height + lift
    return np.concatenate([place, height[:, None]], axis=-1), course


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
        """Return joints (frames, persons, 17, 3) [m], world, at `times` [s]; NaN while away."""
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
    """Return the people of a scenario, each from a separate stream of random numbers.

    `driven` are paths from tracking data, one per person. The third person plays `clip`, the first
    who is no goalkeeper, or the last of fewer.
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
    gone = 10.0  # time without these people, in the middle of the match [s]
    away = np.full((len(paths), 2), np.inf)
    # Each leaves a second after the one before.
    count, pairs = settings.leavers, settings.substitutes
    begin = 0.5 * (duration - gone) + np.arange(count + pairs) - 0.5 * (count + pairs)
    begin, last = np.maximum(begin, 0.0), count + 2 * pairs
    away[:count, 0], away[:count, 1] = begin[:count], begin[:count] + gone
    away[count : count + pairs, 0] = begin[count:]
    away[count + pairs : last, 0] = -np.inf
    away[count + pairs : last, 1] = begin[count:] + gone
    return away
