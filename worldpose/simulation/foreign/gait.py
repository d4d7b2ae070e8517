"""Posture of walking and running people: joint angles of published gait curves, gestures, gaze.

Hip and knee angles over the gait cycle are those of walking in D. A. Winter, The biomechanics and
motor control of human gait, 1991, and of running in T. F. Novacheck, The biomechanics of running,
Gait and Posture 7, 1998; their size follows the speed. The rate of walking steps is D. W. Grieve's,
Gait patterns and the speed of walking, 1968.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.geometry.rigid import unit
from worldpose.simulation.foreign.skeletons import Posture

_WALK: Final = np.array(
    [
        [0, 10, 16, 30, 40, 50, 60, 67, 73, 80, 88, 95],
        [28, 23, 18, 5, -5, -11, -4, 8, 16, 25, 30, 29],
        [5, 16, 19, 12, 6, 12, 36, 56, 62, 50, 22, 6],
    ],
    dtype=np.float64,
).T
"""Walking: share of the cycle from the foot's strike [%], hip flexion, knee flexion [deg]."""
_RUN: Final = np.array(
    [
        [0, 8, 15, 22, 30, 38, 46, 57, 66, 75, 86, 94],
        [40, 37, 29, 15, 2, -8, -7, 10, 30, 46, 52, 45],
        [20, 35, 42, 38, 25, 18, 38, 80, 100, 92, 48, 22],
    ],
    dtype=np.float64,
).T
"""Running: share of the cycle from the foot's strike [%], hip flexion, knee flexion [deg]."""
_HOLD: Final = (0.04, 0.42, 0.24)
"""Rest of the ankle: from this share of the cycle to these, walking and running [1]."""


class Gesture(NamedTuple):
    """An action besides walking, which rises from zero to its peak and falls back."""

    kind: str
    """One of `GESTURES`."""
    time: float
    """Time of its peak [s]."""
    length: float
    """Duration from begin to end [s]."""
    strength: float
    """1 = fully."""
    side: int
    """The arm, 0 left, 1 right."""
    towards: Floats
    """Direction (3,) of an arm: forward, left, up."""


GESTURES: Final = ("point", "both_arms", "bend", "crouch", "hips", "twist")


def _draw_gestures(
    rate: float, begin: float, end: float, rng: np.random.Generator
) -> list[Gesture]:
    """Return gestures between two times [s], `rate` per minute."""
    drawn = []
    for _ in range(rng.poisson(rate * (end - begin) / 60.0)):
        direction = rng.normal([0.8, 0.0, 0.3])
        direction /= np.linalg.norm(direction)
        kind, time = str(rng.choice(GESTURES)), rng.uniform(begin, end)
        length, strength = rng.uniform(0.9, 2.6), rng.uniform(0.5, 1.0)
        drawn.append(Gesture(kind, time, length, strength, int(rng.integers(2)), direction))
    return drawn


def walk_posture(
    times: Floats,
    root: Floats,
    heading: Floats,
    leg: float,
    gesture_rate: float,
    rng: np.random.Generator,
) -> Posture:
    """Return the posture of a person who walks or runs along a trajectory.

    `times` (frames,) [s] are evenly spaced, `root` (frames, 2) [m] is the middle of the hips in
    plan, world, `heading` (frames,) [rad] the direction that the body faces; gestures come at a
    rate [1/min]. `rng` draws the person's manner and gestures, the first step and the gaze.
    """
    still = 0.05  # A slower person keeps both feet down [m/s]
    roll = 0.5  # of the hips past a resting ankle at most; then the heel rises [leg]
    flight = 0.05  # rise and fall of a runner's pelvis, peak to peak [share of the leg]
    running_from = (1.9, 2.6)  # speeds between which a walk becomes a run [m/s]
    own_lean = np.radians(3.0 + 3.0 * rng.standard_normal())  # of the trunk, forward
    own_swing = float(np.exp(0.3 * rng.standard_normal()))  # of the arms, relative to the usual
    own_bend = np.radians(12.0 * rng.standard_normal())  # of the elbows, further
    own_splay = np.radians(9.0 + 4.0 * rng.standard_normal())  # of the arms, outward
    own_stride = float(np.exp(0.06 * rng.standard_normal()))  # relative to the usual
    own_sway = float(np.exp(0.3 * rng.standard_normal()))  # of pelvis and shoulders
    own_width = float(rng.uniform(0.45, 1.15))  # of the steps, as a share of the hips' width
    gestures = _draw_gestures(gesture_rate, times[0], times[-1], rng)
    step = times[1] - times[0]
    velocity = np.gradient(root, step, axis=0)
    pace = np.linalg.norm(velocity, axis=-1)
    pace = np.hypot(pace, 0.2 * np.gradient(heading, step))  # turning on the spot takes steps
    ahead = (velocity * np.stack([np.cos(heading), np.sin(heading)], axis=-1)).sum(-1)
    run = np.clip((pace - running_from[0]) / np.diff(running_from), 0.0, 1.0)
    run = run**2 * (3.0 - 2.0 * run)
    walking = 64.8 / 60.0 * (pace / (leg / 0.49)) ** 0.57  # strides per second by Grieve
    rate = ((1.0 - run) * walking + run * (1.15 + 0.09 * pace)) / own_stride
    cycle = rng.random() + np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])

    moving = np.clip(pace / 0.6, 0.0, 1.0)
    size = _stride_size(pace, rate, leg, run) * np.where(
        pace > 0.0, ahead / np.maximum(pace, 1e-9), 0
    )
    flexed = [_angles((cycle + half) % 1.0, size, np.abs(size), run) for half in (0.0, 0.5)]
    angles = np.stack(flexed, axis=1)  # (frames, 2, 2): side, hip and knee
    inward = 0.5 * (own_width - 1.0) * 0.11
    outward = np.array([1.0, -1.0]) * inward
    thigh = _sagittal(angles[..., 0], outward)
    shank = _sagittal(angles[..., 0] - angles[..., 1], outward)
    tall = -0.5 * (thigh[..., 2] + shank[..., 2]).min(axis=1)
    height = gaussian_filter1d(tall, 0.12 / step, mode="nearest")
    height = np.minimum(height + 0.03 * run, 0.995) + run * 0.5 * flight * np.cos(
        4.0 * np.pi * (cycle - 0.42)
    )

    swing = own_sway * moving * np.sin(2.0 * np.pi * cycle + 0.6)
    up = np.array([0.0, 0.0, 1.0])
    tilt = np.radians(3.0) * moving * np.cos(2.0 * np.pi * cycle)
    hips = _lateral_axis(np.radians(6.0) * swing) + tilt[:, None] * up
    lean = own_lean + np.radians(7.0) * run + 0.5 * np.arctan(np.gradient(ahead, step) / 9.81)
    lean = gaussian_filter1d(lean, 0.15 / step, mode="nearest")
    look = _random_course(times, 2.5, rng) * np.radians(28.0)
    nod = _random_course(times, 3.0, rng) * np.radians(9.0) - np.radians(6.0)
    arm = np.empty((len(times), 2, 2))
    for side, sign in enumerate((1.0, -1.0)):
        reach = own_swing * np.radians(14.0 + 22.0 * run) * moving
        arm[:, side, 0] = -sign * reach * np.sin(2.0 * np.pi * cycle + 1.5) - np.radians(4.0)
        bend = np.radians(14.0 + 10.0 * moving + 62.0 * run) + own_bend
        arm[:, side, 1] = np.clip(bend + 0.35 * arm[:, side, 0], 0.03, 2.4)
    splay = np.array([1.0, -1.0]) * own_splay
    hold = _HOLD[1] + (_HOLD[2] - _HOLD[1]) * run - _HOLD[0]
    hold = np.minimum(hold, roll * leg * rate / np.maximum(pace, 1e-9))
    part = np.stack([cycle % 1.0, (cycle + 0.5) % 1.0], axis=1)
    middle = 0.5 * (_HOLD[0] + _HOLD[1] + (_HOLD[2] - _HOLD[1]) * run)[:, None]
    planted = np.abs(part - middle) <= 0.5 * hold[:, None]
    planted |= (pace < still)[:, None]
    posture = Posture(
        hips=unit(hips),
        trunk=unit(np.stack([np.sin(lean), 0.02 * swing, np.cos(lean)], axis=-1)),
        shoulders=_lateral_axis(-np.radians(8.0) * swing),
        head_up=unit(np.stack([np.sin(-nod), 0.0 * nod, np.cos(nod)], axis=-1)),
        gaze=np.stack([np.cos(look) * np.cos(nod), np.sin(look) * np.cos(nod), np.sin(nod)], -1),
        upper_arm=_sagittal(arm[..., 0], splay),
        forearm=_sagittal(arm[..., 0] + arm[..., 1], 0.2 * splay),
        thigh=thigh,
        shank=shank,
        height=height,
        planted=planted,
    )
    for gesture in gestures:
        posture = _add_gesture(posture, gesture, times)
    return posture


def _stride_size(pace: Floats, rate: Floats, leg: float, run: Floats) -> Floats:
    """Return the leg swing relative to the curves (frames,) [1], such that feet match the speed."""
    sizes = []
    for curve, end in ((_WALK, _HOLD[1]), (_RUN, _HOLD[2])):
        part = np.array([_HOLD[0], end])
        hip, knee = np.radians(_curve(curve, part)).T
        sweep = leg * 0.5 * (np.sin(hip) + np.sin(hip - knee))
        length = pace / np.maximum(rate, 1e-3) * (end - _HOLD[0])
        sizes.append(length / float(sweep[0] - sweep[1]))
    return np.asarray(np.clip((1.0 - run) * sizes[0] + run * sizes[1], 0.0, 1.5))


def _angles(part: Floats, size: Floats, bend: Floats, run: Floats) -> Floats:
    """Return hip and knee flexion (frames, 2) [rad]; walking backwards mirrors the hips' swing."""
    neutral = (4.0, 6.0)  # hip and knee flexion of a standing person [deg]
    both = (1.0 - run)[:, None] * _curve(_WALK, part) + run[:, None] * _curve(_RUN, part)
    mean = (1.0 - run)[:, None] * _WALK[:, 1:].mean(0) + run[:, None] * _RUN[:, 1:].mean(0)
    share = np.minimum(bend, 1.0)[:, None]
    middle = (1.0 - share) * np.array(neutral) + share * mean
    swung = middle + np.stack([size, np.minimum(bend, 1.1)], axis=-1) * (both - mean)
    swung[:, 1] = np.maximum(swung[:, 1], 2.0)
    return np.asarray(np.radians(swung))


def _curve(table: Floats, part: Floats) -> Floats:
    """Return hip and knee flexion (..., 2) [deg] over the cycle, by the table's Fourier series."""
    share, values = table[:, 0] / 100.0, table[:, 1:]
    orders = np.arange(1, 6)

    def waves(x: Floats) -> Floats:
        angle = 2.0 * np.pi * x[..., None] * orders
        return np.concatenate([np.ones((*x.shape, 1)), np.cos(angle), np.sin(angle)], axis=-1)

    return np.asarray(
        waves(np.asarray(part)) @ np.linalg.lstsq(waves(share), values, rcond=None)[0]
    )


def _sagittal(angle: Floats, outward: Floats) -> Floats:
    """Return directions (frames, 2, 3) from hanging, swung forward, and outward on both sides."""
    out = np.broadcast_to(outward, angle.shape)
    return unit(np.stack([np.sin(angle), np.tan(out), -np.cos(angle)], axis=-1))


def _lateral_axis(angle: Floats) -> Floats:
    """Return the right-to-left axis of a part turned by an angle [rad] (frames, 3)."""
    return np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=-1)


def _random_course(times: Floats, period: float, rng: np.random.Generator) -> Floats:
    """Return a smooth random signal (frames,) of unit size, of three waves; period [s]."""
    waves = [
        np.sin(2.0 * np.pi * (times / (period * rng.uniform(0.6, 2.2)) + rng.random()))
        for _ in range(3)
    ]
    return np.asarray(np.sqrt(2.0 / 3.0) * np.sum(waves, axis=0))


def _add_gesture(posture: Posture, gesture: Gesture, times: Floats) -> Posture:
    """Return the posture with a gesture blended in."""
    near = np.clip(2.0 * np.abs(times - gesture.time) / gesture.length, 0.0, 1.0)
    on = gesture.strength * 0.5 * (1.0 + np.cos(np.pi * near))
    arms, hands = posture.upper_arm.copy(), posture.forearm.copy()
    sign = 1.0 - 2.0 * gesture.side
    if gesture.kind in ("point", "both_arms"):
        for side in (0, 1) if gesture.kind == "both_arms" else (gesture.side,):
            mirror = np.array([1.0, sign * (1.0 - 2.0 * side), 1.0])
            goal = mirror * gesture.towards
            # An upper arm does not reach across the body.
            goal[1] = (1.0 - 2.0 * side) * max((1.0 - 2.0 * side) * goal[1], -0.2)
            arms[:, side] = _blend(arms[:, side], goal, on)
            hands[:, side] = _blend(hands[:, side], goal + np.array([0.15, 0.0, 0.25]), on)
    elif gesture.kind == "hips":
        for side in (0, 1):
            out = 1.0 - 2.0 * side
            arms[:, side] = _blend(arms[:, side], np.array([-0.35, 0.75 * out, -0.65]), on)
            hands[:, side] = _blend(hands[:, side], np.array([0.5, -0.75 * out, -0.45]), on)
    elif gesture.kind == "bend":
        trunk = _blend(posture.trunk, np.array([0.85, 0.1 * sign, 0.55]), on)
        head = _blend(posture.head_up, np.array([0.6, 0.0, 0.8]), on)
        gaze = _blend(posture.gaze, np.array([0.7, 0.0, -0.7]), on)
        for side in (0, 1):
            arms[:, side] = _blend(arms[:, side], np.array([0.45, 0.0, -0.9]), on)
        posture = replace(posture, trunk=trunk, head_up=head, gaze=gaze)
    elif gesture.kind == "crouch":
        lean = _blend(posture.trunk, np.array([0.55, 0.0, 0.85]), on)
        low = posture.height * (1.0 - on) + 0.62 * on
        posture = replace(posture, trunk=lean, height=np.minimum(posture.height, low))
    elif gesture.kind == "twist":
        turned = np.array([-0.6 * sign, 0.8, 0.0])
        posture = replace(
            posture,
            shoulders=_blend(posture.shoulders, turned, on),
            gaze=_blend(posture.gaze, np.array([0.4, 0.9 * sign, 0.0]), on),
        )
    return replace(posture, upper_arm=arms, forearm=hands)


def _blend(vectors: Floats, goal: Floats, share: Floats) -> Floats:
    """Return unit vectors turned towards a goal by a share (frames,) of the way."""
    mixed = (1.0 - share)[:, None] * vectors + share[:, None] * goal / np.linalg.norm(goal)
    return unit(mixed)
