"""Gait: 17 joints of people who stand, walk, run and act, from a path over the ground.

A kinematic model: planted feet follow the path's footholds, knees follow by two-bone inverse
kinematics, arms swing against the legs. Bones between joints keep their lengths exactly. Actions
are timed motions that are blended into the gait.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from data_contracts.arrays import Floats
from worldpose.simulation.motions import (
    ARMS,
    AWAY,
    BEND,
    FREE,
    LEGS,
    NOD,
    TURN,
    Action,
    Motion,
    Stance,
)
from worldpose.simulation.paths import STANDING_SPEED, GroundPath
from worldpose.simulation.recordings import play_clip
from worldpose.simulation.skeletons import Body, Pose, level_axes, pose_joints, unit

CLEARANCE: Final = 0.05
"""Height of wrists and ankles on the ground above it [m]: half a hand, half a foot."""
SOFTNESS: Final = 0.04
"""Height over which the ground limits a limb gradually [m]."""
STRADDLE: Final = 0.4
"""Maximum distance of a standing foot ahead of or behind the mid-hip [m]."""
STEP_LIFT: Final = 0.07
"""Lift of a foot that steps within an action [m]."""
STEP_BACK: Final = 0.4
"""Time in which a foot returns to the gait [s]."""


@dataclass(frozen=True, eq=False)
class _Stage:
    """An action with the person's body and path and the ground."""

    body: Body
    way: GroundPath
    ground: Callable[[Floats, Floats], Floats]
    action: Action

    def place(self, time: Floats) -> tuple[Floats, Floats]:
        """Return position (..., 2) [m] and heading (...) [rad] of the person at a time [s]."""
        at = [np.interp(time, self.way.time, axis) for axis in self.way.position.T]
        return np.stack(at, axis=-1), np.interp(time, self.way.time, self.way.heading)


def act(
    body: Body,
    way: GroundPath,
    action: Action,
    times: Floats,
    ground: Callable[[Floats, Floats], Floats],
    pose: Pose,
) -> None:
    """Blend an action into a pose.

    Args:
        body: measures.
        way: path of the person.
        action: the action to blend in.
        times: (frames,) [s], ascending.
        ground: height of the ground [m] at x and y [m].
        pose: pose of the gait at these times; overwritten while the action lasts.
    """
    first, behind = np.searchsorted(times, [action.begin, action.end])
    if first == behind:
        return
    frames = slice(int(first), int(behind))
    before = Pose(*(getattr(pose, field.name)[frames] for field in fields(pose)))
    stage = _Stage(body, way, ground, action)
    acted = _blend_action(stage, times[frames], before)
    for field in fields(pose):
        getattr(pose, field.name)[frames] = getattr(acted, field.name)


def _blend_action(stage: _Stage, times: Floats, gait: Pose) -> Pose:
    action, motion, body = stage.action, stage.action.motion, stage.body
    since = times - action.begin
    channels = PchipInterpolator(motion.time, motion.channels, axis=0)(
        np.clip(since, motion.time[0], motion.time[-1])
    )
    if not action.left:
        channels = _mirror_channels(channels)
    share = _motion_weight(motion, since)
    _, heading = stage.place(times)
    forward, left = level_axes(heading + action.turn * share)
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    level = np.stack([forward, left, up], axis=-2)
    pelvis_axes = _rotate_axes(channels[:, TURN], level)
    chest = _rotate_axes(channels[:, BEND], pelvis_axes)

    away = channels[:, AWAY] * share[:, None]
    pelvis = gait.pelvis + away[:, :1] * forward + away[:, 1:] * left
    floor = stage.ground(*pelvis[:, :2].T) + body.ankle_height
    pelvis[:, 2] += share * (floor + _hip_heights(body, motion, since) - pelvis[:, 2])

    def blend(before: Floats, now: Floats) -> Floats:
        weight = share.reshape(-1, *(1 for _ in now.shape[1:]))
        return (1.0 - weight) * before + weight * now

    hips_left = unit(blend(gait.hips_left, pelvis_axes[:, 1]))
    trunk = unit(blend(gait.trunk, chest[:, 2]))
    shoulders_left = unit(blend(gait.shoulders_left, chest[:, 1]))
    sides = np.array([1.0, -1.0])
    mirror = np.stack([np.ones(2), sides, np.ones(2)], axis=-1)
    arms = channels[:, ARMS].reshape(-1, 2, 2, 3) * mirror[:, None]
    arms = unit(blend(gait.arms, unit(np.einsum("fsbi,fij->fsbj", arms, chest))))
    neck = pelvis + body.trunk * trunk
    shoulders = neck[:, None] + sides[:, None] * (
        body.shoulder_half_width * shoulders_left[:, None]
    )
    arms = _raise_arms(stage, shoulders, arms)

    legs = channels[:, LEGS].reshape(-1, 2, 3, 3) * mirror[:, None]
    legs = unit(np.einsum("fsbi,fij->fsbj", legs, pelvis_axes))
    free = (channels[:, FREE] * share[:, None])[..., None]
    hips = pelvis[:, None] + sides[:, None] * (body.hip_half_width * hips_left[:, None])
    held = hips + body.thigh * legs[:, :, 0] + body.shank * legs[:, :, 1]
    lowest = stage.ground(*np.moveaxis(held[..., :2], -1, 0)) + CLEARANCE
    held[..., 2] = _soft_maximum(held[..., 2], lowest, SOFTNESS)
    stances = motion.stances if action.left else motion.stances[::-1]
    on_ground, feet = gait.ankles.copy(), gait.feet.copy()
    for side, sign in enumerate((1.0, -1.0)):
        on_ground[:, side], feet[:, side] = _plant_foot(
            stage, times, on_ground[:, side], feet[:, side], stances[side], sign
        )
    return Pose(
        pelvis=pelvis,
        hips_left=hips_left,
        trunk=trunk,
        shoulders_left=shoulders_left,
        head=_orthonormalize(blend(gait.head, _rotate_axes(channels[:, NOD], level))),
        arms=arms,
        ankles=(1.0 - free) * on_ground + free * held,
        knees=(1.0 - free) * unit(blend(gait.knees, level[:, None, 0])) + free * legs[:, :, 2],
        feet=feet,
    )


def _motion_weight(motion: Motion, since: Floats) -> Floats:
    """Return the motion's weight in the pose (frames,), which rises and falls smoothly."""
    rise, fall = motion.ease
    return _smooth(since / rise) * _smooth((motion.duration - since) / fall)


def _smooth(done: Floats) -> Floats:
    done = np.clip(done, 0.0, 1.0)
    smooth: Floats = done**3 * (10.0 - 15.0 * done + 6.0 * done**2)
    return smooth


def _mirror_channels(channels: Floats) -> Floats:
    """Return the motion mirrored left to right."""
    mirrored = channels.copy()
    for turn in (TURN, BEND, NOD):
        mirrored[:, turn] *= (1.0, -1.0, -1.0)
    mirrored[:, AWAY] *= (1.0, -1.0)
    for pair in (FREE, ARMS, LEGS):
        half = (pair.start + pair.stop) // 2
        mirrored[:, pair.start : half] = channels[:, half : pair.stop]
        mirrored[:, half : pair.stop] = channels[:, pair.start : half]
    return mirrored


def _rotate_axes(angles: Floats, axes: Floats) -> Floats:
    """Return axes (frames, 3, 3), rows forward, left, up, after yaw, pitch and roll (frames, 3)."""
    pitch, roll, yaw = angles.T
    one, zero = np.ones_like(pitch), np.zeros_like(pitch)

    def rows(*entries: Floats) -> Floats:
        return np.stack(entries, axis=-1).reshape(-1, 3, 3)

    cos, sin = np.cos(yaw), np.sin(yaw)
    about_up = rows(cos, sin, zero, -sin, cos, zero, zero, zero, one)
    cos, sin = np.cos(pitch), np.sin(pitch)
    about_left = rows(cos, zero, -sin, zero, one, zero, sin, zero, cos)
    cos, sin = np.cos(roll), np.sin(roll)
    about_front = rows(one, zero, zero, zero, cos, -sin, zero, sin, cos)
    turned: Floats = about_front @ about_left @ about_up @ axes
    return turned


def _orthonormalize(axes: Floats) -> Floats:
    """Return close axes (frames, 3, 3) at right angles; up is kept."""
    up = unit(axes[:, 2])
    forward = axes[:, 0] - (axes[:, 0] * up).sum(-1, keepdims=True) * up
    forward = unit(forward)
    return np.stack([forward, np.cross(up, forward), up], axis=-2)


def _hip_heights(body: Body, motion: Motion, since: Floats) -> Floats:
    """Return the height of the mid-hip above a standing ankle (frames,) [m]."""
    leg = body.leg
    time = np.array([height.time for height in motion.heights])
    above = np.array([height.legs * leg + height.metres for height in motion.heights])
    if len(time) == 1:
        return np.full(len(since), above[0])
    climb = PchipInterpolator(time, above).derivative()(time)
    given = [height.climb for height in motion.heights]
    climb = np.array([c if g is None else g for c, g in zip(climb, given, strict=True)])
    heights: Floats = CubicHermiteSpline(time, above, climb)(np.clip(since, time[0], time[-1]))
    return heights


def _plant_foot(
    stage: _Stage,
    times: Floats,
    gait: Floats,
    course: Floats,
    stances: tuple[Stance, ...],
    sign: float,
) -> tuple[Floats, Floats]:
    """Return the ankle (frames, 3) of a foot from stance to stance and back into the gait.

    The second result is the foot's direction (frames,) [rad].
    """
    if not stances:
        return gait, course
    begin = stage.action.begin
    ankle, points, lift = gait, course, np.zeros(len(times))
    for stance in stances:
        under = begin + stance.under
        place, heading = stage.place(np.array(under))
        heading = heading + stage.action.turn
        forward, left = level_axes(heading)
        outward = sign * (0.8 * stage.body.hip_half_width + stance.outward)
        place = place + stance.ahead * forward[:2] + outward * left[:2]
        high = stage.ground(place[:1], place[1:]) + stage.body.ankle_height
        # A runner leaves a foothold before it is out of reach.
        pace = float(np.interp(under, stage.way.time, stage.way.speed))
        most = STRADDLE / max(pace, 1e-9)
        late = max(0.0, stance.under - most - stance.land)
        leave = min(stance.leave, stance.under + most)
        done = (times - begin - stance.lift - late) / (stance.land - stance.lift)
        ankle, points, lift = _step_to(done, ankle, points, lift, np.append(place, high), heading)
    back = min(STEP_BACK, stage.action.motion.duration - leave)
    done = (times - begin - leave) / back
    ankle, points, lift = _step_to(done, ankle, points, lift, gait, course)
    return ankle + lift[:, None] * [0.0, 0.0, 1.0], points


def _step_to(
    done: Floats, ankle: Floats, points: Floats, lift: Floats, place: Floats, course: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return a step from an ankle's position to a place; `done` goes from 0 to 1."""
    moved, done = _smooth(done), np.clip(done, 0.0, 1.0)
    ankle = (1.0 - moved)[:, None] * ankle + moved[:, None] * place
    lift = np.maximum(lift, STEP_LIFT * np.sin(np.pi * done) ** 2)
    return ankle, (1.0 - moved) * points + moved * course, lift


def _raise_arms(stage: _Stage, shoulders: Floats, arms: Floats) -> Floats:
    """Return arms (frames, 2, 2, 3), raised where an elbow or a wrist would be below the ground."""
    arms, start = arms.copy(), shoulders
    for bone, length in enumerate((stage.body.upper_arm, stage.body.forearm)):
        floor = stage.ground(*np.moveaxis(start[..., :2], -1, 0)) + CLEARANCE
        along = arms[:, :, bone]
        least = np.minimum((floor - start[..., 2]) / length, 0.9)
        steep = _soft_maximum(along[..., 2], least, SOFTNESS / length)
        level = np.maximum(np.linalg.norm(along[..., :2], axis=-1), 1e-9)
        changed = steep > along[..., 2]
        shorter = np.where(changed, np.sqrt(np.maximum(1.0 - steep**2, 0.0)) / level, 1.0)
        arms[:, :, bone, :2] = along[..., :2] * shorter[..., None]
        arms[:, :, bone, 2] = steep
        arms[:, :, bone] = unit(arms[:, :, bone])
        start = start + length * arms[:, :, bone]
    return arms


def _soft_maximum(value: Floats, least: Floats, softness: float) -> Floats:
    """Return the greater of two, rounded where they are less than `softness` apart."""
    above = value - least
    near = (above + softness) ** 2 / (4.0 * softness)
    return least + np.where(above > softness, above, np.where(above < -softness, 0.0, near))


Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""

STRIDES: Final = (
    (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 9.0),
    (0.91, 1.0, 1.10, 1.26, 1.36, 1.43, 1.53, 1.68, 1.85, 2.2),
)
"""Speeds [m/s] and strides per second at them: walkers up to 2 m/s, runners beyond."""
STANDING_TIME: Final = 0.3
"""A person who is slower than `STANDING_SPEED` for this time stands [s]."""
TURNING_ARM: Final = 0.5
"""Turning by 1 rad/s needs as many steps as walking at this many metres per second [m]; a turn of
less than half of that uses the hips alone."""


def walk(
    body: Body,
    path: GroundPath,
    times: Floats,
    ground: Ground,
    rng: np.random.Generator,
) -> Floats:
    """Return joints (frames, 17, 3) [m], world, of a person who follows a path; see `tread`."""
    return tread(body, path, times, ground, rng)[0]


def tread(
    body: Body,
    path: GroundPath,
    times: Floats,
    ground: Ground,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return joints (frames, 17, 3) [m], world, and feet directions of a person on a path.

    Feet point (frames, 2) [rad], left and right, from the x axis towards y, along the path at the
    time of their placement. Actions of the path are blended in.

    Args:
        body: measures.
        path: covers `times` and a stride before and after.
        times: (frames,) [s].
        ground: height of the ground under the feet.
        rng: draws the stride phase at the start of the path and the turns of the head.
    """
    cycle = stride_cycle(path, rng.random())
    swing = 2.0 * np.pi * np.interp(times, path.time, cycle)
    speed, heading = (np.interp(times, path.time, x) for x in (path.speed, path.heading))
    run = _running_share(speed)
    # Slow people hardly swing their arms.
    pace = np.minimum(speed, 1.0)
    sway = pace * np.sin(swing)

    up = np.array([0.0, 0.0, 1.0])
    pelvis_xy = np.stack([np.interp(times, path.time, x) for x in path.position.T], axis=-1)
    # Walkers rise over the planted leg, runners sink onto it.
    rise = (0.945 - 0.04 * run) * body.leg + pace * (0.015 - 0.05 * run) * np.cos(2.0 * swing)
    pelvis = np.concatenate(
        [pelvis_xy, (ground(*pelvis_xy.T) + body.ankle_height + rise)[:, None]], axis=-1
    )
    forward, leftward = level_axes(heading + np.radians(6.0) * sway)
    chest_forward, chest_left = level_axes(heading - np.radians(8.0) * sway)
    lean = np.radians(2.0 + 6.0 * run)[:, None]
    look = np.radians(35.0) * np.sin(2.0 * np.pi * (times / rng.uniform(3.0, 6.0) + rng.random()))
    gaze, gaze_left = level_axes(heading + look)
    arms, ankles = np.empty((len(times), 2, 2, 3)), np.empty((len(times), 2, 3))
    courses = np.empty((len(times), 2))
    for side, (sign, offset) in enumerate(((1.0, 0.0), (-1.0, 0.5))):  # left, right
        ankles[:, side], courses[:, side] = _place_ankles(
            body, path, cycle + offset, times, ground, sign
        )
        # The left arm is forward when the left leg is back.
        raised = (0.35 + 0.35 * run) * sign * sway - 0.15 * run
        bent = raised + np.radians(20.0 + 65.0 * run)
        outward = 0.15 * sign * chest_left
        arms[:, side, 0] = _arm_directions(raised, chest_forward, outward)
        arms[:, side, 1] = _arm_directions(bent, chest_forward, 0.0 * outward)
    pose = Pose(
        pelvis=pelvis,
        hips_left=leftward,
        trunk=np.cos(lean) * up + np.sin(lean) * level_axes(heading)[0],
        shoulders_left=chest_left,
        head=np.stack([gaze, gaze_left, np.broadcast_to(up, gaze.shape)], axis=-2),
        arms=arms,
        ankles=ankles,
        knees=np.stack([forward, forward], axis=1),
        feet=courses,
    )
    for action in path.actions:
        act(body, path, action, times, ground, pose)
    joints = pose_joints(body, pose)
    if path.clip is not None:
        joints = play_clip(body, path.clip, times, ground, joints)
    return joints, pose.feet


def stride_cycle(path: GroundPath, phase: float) -> Floats:
    """Return strides made (samples,): whole at mid-stance of the left foot, half at the right's.

    Strides get longer and faster with speed: 0.9 per second at 1 m/s, 1.4 at 4 m/s, 2.2 at 9 m/s.
    Sources are in docs/explanation/simulation.md.
    A standing person rests a quarter of the way between the two, with both feet on the ground.

    Args:
        path: one person's path.
        phase: stride at the start of the path [1], for a person who never stands.
    """
    pace = _pace(path)
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


def _pace(path: GroundPath) -> Floats:
    """Return the speed that determines steps (samples,) [m/s], turning on the spot included."""
    turning = TURNING_ARM * np.abs(np.gradient(path.heading, path.time))
    return np.maximum(path.speed, np.minimum(turning, 1.0))


def _rest_samples(path: GroundPath, pace: Floats) -> list[tuple[int, int]]:
    """Return the intervals of samples, first and behind the last, in which a person stands."""
    slow = np.concatenate([[False], pace < STANDING_SPEED, [False]])
    begins, ends = np.flatnonzero(~slow[:-1] & slow[1:]), np.flatnonzero(slow[:-1] & ~slow[1:])
    long = path.time[np.minimum(ends, len(path.time) - 1)] - path.time[begins] >= STANDING_TIME
    return [(int(a), int(b)) for a, b in zip(begins[long], ends[long], strict=True)]


def _running_share(speed: Floats) -> Floats:
    """Return the running share: 0 at a walk of 1 m/s, 1 at 4 m/s, at most 1.5."""
    return np.clip((speed - 1.0) / 3.0, 0.0, 1.5)


def _arm_directions(angle: Floats, forward: Floats, outward: Floats) -> Floats:
    """Return unit vectors from hanging, raised forward by `angle` [rad] and a little outward."""
    down = np.array([0.0, 0.0, -1.0])
    vector = np.cos(angle)[:, None] * down + np.sin(angle)[:, None] * forward + outward
    return unit(vector)


def _place_ankles(
    body: Body,
    path: GroundPath,
    cycle: Floats,
    times: Floats,
    ground: Ground,
    sign: float,
) -> tuple[Floats, Floats]:
    """Return ankles (frames, 3) and the directions of the feet (frames,) [rad].

    An ankle is planted around whole cycles, and moves to the next foothold in between.
    """
    now = np.interp(times, path.time, cycle)
    before = np.floor(now)
    places, courses, stance = [], [], []
    for count in (before, before + 1.0):
        when = np.interp(count, cycle, path.time)
        speed, heading = (np.interp(when, path.time, x) for x in (path.speed, path.heading))
        beneath = np.stack([np.interp(when, path.time, x) for x in path.position.T], axis=-1)
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
