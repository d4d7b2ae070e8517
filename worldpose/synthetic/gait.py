"""People who stand, walk and run: 17 joints from a path over the ground.

A kinematic model: planted feet follow the path's footholds, knees follow by two-bone inverse
kinematics, arms swing against the legs. Bones between joints keep their lengths exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.synthetic.paths import GroundPath

Floats = NDArray[np.float64]
Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""

RIGID_BONES: Final = (
    *((5, 7), (7, 9), (6, 8), (8, 10), (5, 6), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16)),
    *((0, 1), (0, 2), (1, 3), (2, 4)),
)
"""Pairs of joints whose distance never changes in a person; the spine twists and the head turns."""

_HEAD: Final = np.array(
    # nose, left eye, right eye, left ear, right ear
    [
        [0.060, 0.0, 0.095],
        [0.048, 0.018, 0.115],
        [0.048, -0.018, 0.115],
        [-0.004, 0.042, 0.105],
        [-0.004, -0.042, 0.105],
    ]
)
"""Forward, left, up from the mid-shoulder, as fractions of body height."""


STANDING_SPEED: Final = 0.25
"""Who is slower than this for `STANDING_TIME` stands [m/s]."""
STANDING_TIME: Final = 0.3
"""[s]"""
TURNING_ARM: Final = 0.5
"""Turning by 1 rad/s asks for as many steps as walking this much a second [m]; who turns by less
than half that does it with the hips."""


@dataclass(frozen=True)
class Body:
    """A person's constant measures [m]."""

    height: float
    thigh: float
    shank: float
    ankle_height: float
    """Ankle above the sole."""
    hip_half_width: float
    trunk: float
    """Mid-hip to mid-shoulder."""
    shoulder_half_width: float
    upper_arm: float
    forearm: float

    @property
    def leg(self) -> float:
        """Hip to ankle when stretched [m]."""
        return self.thigh + self.shank


def draw_body(height: tuple[float, float], rng: np.random.Generator) -> Body:
    """A person of random height [m] and slightly random proportions.

    Mean segment lengths as fractions of height after Drillis and Contini (1966) as tabulated in
    Winter, Biomechanics and Motor Control of Human Movement; hips and shoulders between joint
    centres. Each varies by 2 % between people.
    """
    tall = rng.uniform(*height)
    fractions = np.array([0.245, 0.246, 0.045, 0.050, 0.288, 0.110, 0.186, 0.146])
    lengths = tall * fractions * (1.0 + 0.02 * rng.standard_normal(len(fractions)))
    return Body(tall, *(float(length) for length in lengths))


def walk(
    body: Body,
    path: GroundPath,
    times: Floats,
    ground: Ground,
    rng: np.random.Generator,
) -> Floats:
    """Joints (frames, 17, 3) [m], world, of a person who follows a path.

    Args:
        body: measures.
        path: covers `times` and a stride before and after.
        times: (frames,) [s].
        ground: what feet stand on.
        rng: draws where in the stride the path begins and how the head turns.
    """
    cycle = stride_cycle(path, rng.random())
    swing = 2.0 * np.pi * np.interp(times, path.time, cycle)
    speed, heading = (np.interp(times, path.time, x) for x in (path.speed, path.heading))
    run = _running(speed)
    # Who hardly moves hardly swings.
    pace = np.minimum(speed, 1.0)
    sway = pace * np.sin(swing)

    up = np.array([0.0, 0.0, 1.0])
    pelvis_xy = np.stack([np.interp(times, path.time, x) for x in path.position.T], axis=-1)
    # Walkers rise over the planted leg, runners sink onto it.
    rise = (0.945 - 0.04 * run) * body.leg + pace * (0.015 - 0.05 * run) * np.cos(2.0 * swing)
    pelvis = np.concatenate(
        [pelvis_xy, (ground(*pelvis_xy.T) + body.ankle_height + rise)[:, None]], axis=-1
    )
    forward, leftward = _axes(heading + np.radians(6.0) * sway)
    chest_forward, chest_left = _axes(heading - np.radians(8.0) * sway)
    lean = np.radians(2.0 + 6.0 * run)[:, None]
    spine = np.cos(lean) * up + np.sin(lean) * _axes(heading)[0]
    neck = pelvis + body.trunk * spine

    joints = np.empty((len(times), 17, 3))
    look = np.radians(35.0) * np.sin(2.0 * np.pi * (times / rng.uniform(3.0, 6.0) + rng.random()))
    gaze, gaze_left = _axes(heading + look)
    head = np.stack([gaze, gaze_left, np.broadcast_to(up, gaze.shape)], axis=-2)
    joints[:, :5] = neck[:, None] + body.height * _HEAD @ head
    for side, (sign, offset) in enumerate(((1.0, 0.0), (-1.0, 0.5))):  # left, right
        ankle = _ankles(body, path, cycle + offset, times, ground, sign)
        hip = pelvis + sign * body.hip_half_width * leftward
        joints[:, 11 + side] = hip
        joints[:, 13 + side], joints[:, 15 + side] = _leg(body, hip, ankle, forward)
        shoulder = neck + sign * body.shoulder_half_width * chest_left
        # The left arm is forward when the left leg is back.
        raised = (0.35 + 0.35 * run) * sign * sway - 0.15 * run
        bent = raised + np.radians(20.0 + 65.0 * run)
        outward = 0.15 * sign * chest_left
        joints[:, 5 + side] = shoulder
        elbow = shoulder + body.upper_arm * _arm(raised, chest_forward, outward)
        joints[:, 7 + side] = elbow
        joints[:, 9 + side] = elbow + body.forearm * _arm(bent, chest_forward, 0.0 * outward)
    return joints


def stride_cycle(path: GroundPath, phase: float) -> Floats:
    """Strides made (samples,): whole when the left foot is in mid-stance, half when the right is.

    Strides get longer and faster with speed: 0.9 a second at 1 m/s, 1.4 at 4 m/s, 2.2 at 9 m/s.
    Who stands rests a quarter of the way between the two, where both feet are on the ground.

    Args:
        path: of a person.
        phase: stride at the path's beginning [1], for a person who never stands.
    """
    pace = _pace(path)
    rate = np.where(pace < 1.0, 0.91 * np.sqrt(pace), 0.75 + 0.16 * pace)
    cycle = phase + np.concatenate(
        [[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(path.time))]
    )
    rests = _rests(path, pace)
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
            # Whole steps lead from one rest to the next; a pace aside takes one or two.
            moved = float(np.linalg.norm(path.position[following] - path.position[end - 1]))
            steps = max(round(2.0 * natural[-1]), min(2, int(np.ceil(moved / 0.2 - 0.25))))
            natural = natural * (0.5 * steps / natural[-1])
        made[end - 1 : following + 1] = here + natural
        here = made[min(following, len(cycle) - 1)]
    return made


def _pace(path: GroundPath) -> Floats:
    """Speed that steps answer to (samples,) [m/s]: turning on the spot takes steps too."""
    turning = TURNING_ARM * np.abs(np.gradient(path.heading, path.time))
    return np.maximum(path.speed, np.minimum(turning, 1.0))


def _rests(path: GroundPath, pace: Floats) -> list[tuple[int, int]]:
    """Stretches of samples, first and behind the last, in which a person stands."""
    slow = np.concatenate([[False], pace < STANDING_SPEED, [False]])
    begins, ends = np.flatnonzero(~slow[:-1] & slow[1:]), np.flatnonzero(slow[:-1] & ~slow[1:])
    long = path.time[np.minimum(ends, len(path.time) - 1)] - path.time[begins] >= STANDING_TIME
    return [(int(a), int(b)) for a, b in zip(begins[long], ends[long], strict=True)]


def _running(speed: Floats) -> Floats:
    """How much of a run it is: 0 at a walk of 1 m/s, 1 at 4 m/s, at most 1.5."""
    return np.clip((speed - 1.0) / 3.0, 0.0, 1.5)


def _axes(heading: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (frames, 3) forward and to the left, level."""
    zero = np.zeros_like(heading)
    forward = np.stack([np.cos(heading), np.sin(heading), zero], axis=-1)
    return forward, np.stack([-np.sin(heading), np.cos(heading), zero], axis=-1)


def _arm(angle: Floats, forward: Floats, outward: Floats) -> Floats:
    """Unit vectors from hanging down, raised forward by `angle` [rad] and a little outward."""
    down = np.array([0.0, 0.0, -1.0])
    vector = np.cos(angle)[:, None] * down + np.sin(angle)[:, None] * forward + outward
    unit: Floats = vector / np.linalg.norm(vector, axis=-1, keepdims=True)
    return unit


def _ankles(
    body: Body,
    path: GroundPath,
    cycle: Floats,
    times: Floats,
    ground: Ground,
    sign: float,
) -> Floats:
    """Ankles (frames, 3): planted around whole cycles, in between carried to the next foothold."""
    now = np.interp(times, path.time, cycle)
    before = np.floor(now)
    places, stance = [], []
    for count in (before, before + 1.0):
        when = np.interp(count, cycle, path.time)
        speed, heading = (np.interp(when, path.time, x) for x in (path.speed, path.heading))
        beneath = np.stack([np.interp(when, path.time, x) for x in path.position.T], axis=-1)
        places.append(beneath + sign * 0.8 * body.hip_half_width * _axes(heading)[1][:, :2])
        # Share of the cycle on the ground: 62 % at a walk, 30 % at 4 m/s.
        stance.append(0.62 - 0.32 * _running(speed))
    leave, land = before + 0.5 * stance[0], before + 1.0 - 0.5 * stance[1]
    done = np.clip((now - leave) / (land - leave), 0.0, 1.0)
    moved = (done**2 * (3.0 - 2.0 * done))[:, None]
    place = (1.0 - moved) * places[0] + moved * places[1]
    run = _running(np.interp(times, path.time, path.speed))
    lift = (0.08 + 0.27 * run) * np.sin(np.pi * done) ** 2
    return np.concatenate([place, (ground(*place.T) + body.ankle_height + lift)[:, None]], axis=-1)


def _leg(body: Body, hip: Floats, ankle: Floats, forward: Floats) -> tuple[Floats, Floats]:
    """Knee and ankle (frames, 3); an ankle out of reach is drawn to the hip: the heel rises."""
    along = ankle - hip
    far = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / far
    # Reach ends softly and short of a straight leg, whose knee would snap.
    free, spare = 0.965 * body.leg, 0.03 * body.leg
    beyond = np.maximum(far - free, 0.0)
    reach = np.minimum(far, free) + spare * (1.0 - np.exp(-beyond / spare))
    to_knee = (body.thigh**2 - body.shank**2 + reach**2) / (2.0 * reach)
    aside = np.sqrt(body.thigh**2 - to_knee**2)
    front = forward - (forward * along).sum(-1, keepdims=True) * along
    front /= np.linalg.norm(front, axis=-1, keepdims=True)
    return hip + to_knee * along + aside * front, hip + reach * along
