"""Actions of people: timed motions, blended into the gait."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from data_contracts.arrays import Floats
from worldpose.simulation.bodies import Body
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
from worldpose.simulation.paths import GroundPath
from worldpose.simulation.poses import Pose, level_axes, unit

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
        pose: of the gait at these times; overwritten while the action lasts.
    """
    first, behind = np.searchsorted(times, [action.begin, action.end])
    if first == behind:
        return
    frames = slice(int(first), int(behind))
    before = Pose(*(getattr(pose, field.name)[frames] for field in fields(pose)))
    stage = _Stage(body, way, ground, action)
    acted = _acted(stage, times[frames], before)
    for field in fields(pose):
        getattr(pose, field.name)[frames] = getattr(acted, field.name)


def _acted(stage: _Stage, times: Floats, gait: Pose) -> Pose:
    action, motion, body = stage.action, stage.action.motion, stage.body
    since = times - action.begin
    channels = PchipInterpolator(motion.time, motion.channels, axis=0)(
        np.clip(since, motion.time[0], motion.time[-1])
    )
    if not action.left:
        channels = _mirrored(channels)
    share = _share(motion, since)
    _, heading = stage.place(times)
    forward, left = level_axes(heading + action.turn * share)
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    level = np.stack([forward, left, up], axis=-2)
    pelvis_axes = _turned(channels[:, TURN], level)
    chest = _turned(channels[:, BEND], pelvis_axes)

    away = channels[:, AWAY] * share[:, None]
    pelvis = gait.pelvis + away[:, :1] * forward + away[:, 1:] * left
    floor = stage.ground(*pelvis[:, :2].T) + body.ankle_height
    pelvis[:, 2] += share * (floor + _height(body, motion, since) - pelvis[:, 2])

    def blended(before: Floats, now: Floats) -> Floats:
        weight = share.reshape(-1, *(1 for _ in now.shape[1:]))
        return (1.0 - weight) * before + weight * now

    hips_left = unit(blended(gait.hips_left, pelvis_axes[:, 1]))
    trunk = unit(blended(gait.trunk, chest[:, 2]))
    shoulders_left = unit(blended(gait.shoulders_left, chest[:, 1]))
    sides = np.array([1.0, -1.0])
    mirror = np.stack([np.ones(2), sides, np.ones(2)], axis=-1)
    arms = channels[:, ARMS].reshape(-1, 2, 2, 3) * mirror[:, None]
    arms = unit(blended(gait.arms, unit(np.einsum("fsbi,fij->fsbj", arms, chest))))
    neck = pelvis + body.trunk * trunk
    shoulders = neck[:, None] + sides[:, None] * (
        body.shoulder_half_width * shoulders_left[:, None]
    )
    arms = _off_ground(stage, shoulders, arms)

    legs = channels[:, LEGS].reshape(-1, 2, 3, 3) * mirror[:, None]
    legs = unit(np.einsum("fsbi,fij->fsbj", legs, pelvis_axes))
    free = (channels[:, FREE] * share[:, None])[..., None]
    hips = pelvis[:, None] + sides[:, None] * (body.hip_half_width * hips_left[:, None])
    held = hips + body.thigh * legs[:, :, 0] + body.shank * legs[:, :, 1]
    lowest = stage.ground(*np.moveaxis(held[..., :2], -1, 0)) + CLEARANCE
    held[..., 2] = _at_least(held[..., 2], lowest, SOFTNESS)
    stances = motion.stances if action.left else motion.stances[::-1]
    on_ground, feet = gait.ankles.copy(), gait.feet.copy()
    for side, sign in enumerate((1.0, -1.0)):
        on_ground[:, side], feet[:, side] = _stood(
            stage, times, on_ground[:, side], feet[:, side], stances[side], sign
        )
    return Pose(
        pelvis=pelvis,
        hips_left=hips_left,
        trunk=trunk,
        shoulders_left=shoulders_left,
        head=_orthonormal(blended(gait.head, _turned(channels[:, NOD], level))),
        arms=arms,
        ankles=(1.0 - free) * on_ground + free * held,
        knees=(1.0 - free) * unit(blended(gait.knees, level[:, None, 0])) + free * legs[:, :, 2],
        feet=feet,
    )


def _share(motion: Motion, since: Floats) -> Floats:
    """Return the motion's weight in the pose (frames,), which rises and falls smoothly."""
    rise, fall = motion.ease
    return _smooth(since / rise) * _smooth((motion.duration - since) / fall)


def _smooth(done: Floats) -> Floats:
    done = np.clip(done, 0.0, 1.0)
    smooth: Floats = done**3 * (10.0 - 15.0 * done + 6.0 * done**2)
    return smooth


def _mirrored(channels: Floats) -> Floats:
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


def _turned(angles: Floats, axes: Floats) -> Floats:
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


def _orthonormal(axes: Floats) -> Floats:
    """Return close axes (frames, 3, 3) at right angles; up is kept."""
    up = unit(axes[:, 2])
    forward = axes[:, 0] - (axes[:, 0] * up).sum(-1, keepdims=True) * up
    forward = unit(forward)
    return np.stack([forward, np.cross(up, forward), up], axis=-2)


def _height(body: Body, motion: Motion, since: Floats) -> Floats:
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


def _stood(
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
        ankle, points, lift = _stepped(done, ankle, points, lift, np.append(place, high), heading)
    back = min(STEP_BACK, stage.action.motion.duration - leave)
    done = (times - begin - leave) / back
    ankle, points, lift = _stepped(done, ankle, points, lift, gait, course)
    return ankle + lift[:, None] * [0.0, 0.0, 1.0], points


def _stepped(
    done: Floats, ankle: Floats, points: Floats, lift: Floats, place: Floats, course: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return a step from an ankle's position to a place; `done` goes from 0 to 1."""
    moved, done = _smooth(done), np.clip(done, 0.0, 1.0)
    ankle = (1.0 - moved)[:, None] * ankle + moved[:, None] * place
    lift = np.maximum(lift, STEP_LIFT * np.sin(np.pi * done) ** 2)
    return ankle, (1.0 - moved) * points + moved * course, lift


def _off_ground(stage: _Stage, shoulders: Floats, arms: Floats) -> Floats:
    """Return arms (frames, 2, 2, 3), raised where an elbow or a wrist would be below the ground."""
    arms, start = arms.copy(), shoulders
    for bone, length in enumerate((stage.body.upper_arm, stage.body.forearm)):
        floor = stage.ground(*np.moveaxis(start[..., :2], -1, 0)) + CLEARANCE
        along = arms[:, :, bone]
        least = np.minimum((floor - start[..., 2]) / length, 0.9)
        steep = _at_least(along[..., 2], least, SOFTNESS / length)
        level = np.maximum(np.linalg.norm(along[..., :2], axis=-1), 1e-9)
        changed = steep > along[..., 2]
        shorter = np.where(changed, np.sqrt(np.maximum(1.0 - steep**2, 0.0)) / level, 1.0)
        arms[:, :, bone, :2] = along[..., :2] * shorter[..., None]
        arms[:, :, bone, 2] = steep
        arms[:, :, bone] = unit(arms[:, :, bone])
        start = start + length * arms[:, :, bone]
    return arms


def _at_least(value: Floats, least: Floats, softness: float) -> Floats:
    """Return the greater of two, rounded where they are less than `softness` apart."""
    above = value - least
    near = (above + softness) ** 2 / (4.0 * softness)
    return least + np.where(above > softness, above, np.where(above < -softness, 0.0, near))
