"""Body measures, and bodies from joints by inverse kinematics.

Every frame is solved independently, in closed form and continuously: no rotation depends on a sign
or an angle that jumps as limbs pass through straight. So a body depends on its time alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import VERTEX_OF_POINT
from worldpose.body.model import BODY_POSE, BodyModel, BodyParameters
from worldpose.geometry.rigid import Rigid, cross, orthonormal_frame, unit


@dataclass(frozen=True, eq=False)
class Body:
    """A person's constant measures [m], in the open body's own frame: y up, facing z."""

    model: BodyModel
    betas: Floats
    """(10,)"""
    height: float
    """Sole to crown."""
    joints: Floats
    """(24, 3), those of the model before it is posed."""
    head: Floats
    """(5, 3): nose, eyes and ears."""
    face: Floats
    """(5, 3): the same forward, left and up from the mid-shoulder."""
    toe: float
    """Length of the toes in front of their joint."""
    heel: float
    """Distance of the heel behind the ankle."""
    ankle_height: float
    """Height of the ankle above the sole."""
    thigh: float
    shank: float
    hip_half_width: float
    trunk: float
    """Mid-hip to mid-shoulder."""
    shoulder_half_width: float
    upper_arm: float
    forearm: float

    @property
    def leg(self) -> float:
        """Return the length from hip to ankle when stretched [m]."""
        return self.thigh + self.shank


def draw_body(height: tuple[float, float], rng: np.random.Generator) -> Body:
    """Return a person of random height [m] within bounds; all betas but the first are random."""
    model, points, directions = _reference_points()
    betas = np.zeros(model.shapes)
    tall = rng.uniform(height[0], height[1])
    betas[1:] = rng.standard_normal(model.shapes - 1)
    build = (-1.0, 0.5)  # of the second beta, mean and spread [1]: wide shoulders, narrow hips
    betas[1] = build[0] + build[1] * betas[1]
    rising = directions[-2, 1] - directions[-1, 1]
    middle = points[-2, 1] - points[-1, 1]
    betas[0] = (tall - middle - rising[1:] @ betas[1:]) / rising[0]
    joints = model.joint_template + model.joint_directions @ betas
    *face, toe, heel, _, lowest = points + directions @ betas
    head = np.array(face)
    hips, shoulders = joints[1:3].mean(axis=0), joints[16:18].mean(axis=0)

    def length(a: int, b: int) -> float:
        return float(np.linalg.norm(joints[a] - joints[b]))

    return Body(
        model=model,
        betas=betas,
        height=tall,
        joints=joints,
        head=head,
        # The model faces z with y up and its left along x.
        face=(head - shoulders)[:, (2, 0, 1)],
        toe=float(toe[2] - joints[10, 2]),
        heel=float(joints[7, 2] - heel[2]),
        ankle_height=float(joints[7, 1] - lowest[1]),
        thigh=length(1, 4),
        shank=length(4, 7),
        hip_half_width=0.5 * length(1, 2),
        trunk=float(np.linalg.norm(shoulders - hips)),
        shoulder_half_width=0.5 * length(16, 17),
        upper_arm=length(16, 18),
        forearm=length(18, 20),
    )


@functools.cache
def _reference_points() -> tuple[BodyModel, Floats, Floats]:
    """Return the open body; head, big toe, heel, crown and sole (9, 3) [m], and these by betas."""
    model = load_open_body()
    named = [VERTEX_OF_POINT[name] for name in (*COCO17[:5], "left_big_toe", "left_heel")]
    upright = model.template[:, 1]
    vertices = [*named, int(upright.argmax()), int(upright.argmin())]
    return model, model.template[vertices], model.shape_directions[vertices]


def level_axes(heading: Floats) -> tuple[Floats, Floats]:
    """Return horizontal unit vectors (frames, 3) forward and to the left."""
    zero = np.zeros_like(heading)
    forward = np.stack([np.cos(heading), np.sin(heading), zero], axis=-1)
    return forward, np.stack([-np.sin(heading), np.cos(heading), zero], axis=-1)


Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""
BIAS: Final = 0.1
"""Weight of a limb's natural bend in its plane, relative to the sine of its actual bend [1]: nearly
straight limbs keep their twist."""

_X, _Z = np.eye(3)[[0, 2]]
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body in motion."""

    body: Body
    rotations: Floats
    """(frames, 24, 3, 3), rotation of every joint, world from model."""
    pelvis: Floats
    """(frames, 3) [m], world: the model's first joint."""

    def joints(self) -> Floats:
        """Return the model's joints (frames, 24, 3) [m], world."""
        rest, parents = self.body.joints, self.body.model.parents
        joints = np.empty((len(self.pelvis), len(rest), 3))
        joints[:, 0] = self.pelvis
        for joint, parent in enumerate(parents[1:], start=1):
            bone = self.rotations[:, parent] @ (rest[joint] - rest[parent])
            joints[:, joint] = joints[:, parent] + bone
        return joints

    def keypoints(self) -> Floats:
        """Return the body's COCO-17 keypoints (frames, 17, 3) [m], world, as `fold_keypoints`."""
        joints = self.joints()
        keypoints = np.empty((len(joints), 17, 3))
        face = self.body.head - self.body.joints[15]
        keypoints[:, :5] = joints[:, None, 15] + face @ self.rotations[:, 15].swapaxes(-1, -2)
        keypoints[:, 5:11] = joints[:, 16:22]
        keypoints[:, 11:] = joints[:, (1, 2, 4, 5, 7, 8)]
        return keypoints

    def parameters(self) -> BodyParameters:
        """Return shape, angles and place of the body, a batch (frames,)."""
        parents = self.body.model.parents[1:]
        local = self.rotations.copy()
        local[:, 1:] = self.rotations[:, parents].swapaxes(-1, -2) @ self.rotations[:, 1:]
        angles = Rigid(local, np.zeros(3)).rotvec
        return BodyParameters(
            betas=self.body.betas,
            global_orient=angles[:, 0],
            body_pose=angles[:, 1:].reshape(len(angles), BODY_POSE),
            transl=self.pelvis - self.body.joints[0],
        )


def solve_body(body: Body, joints: Floats, ground: Ground, courses: Floats) -> PosedBody:
    """Return the body that follows the motion of a skeleton.

    Hips and ankles match the skeleton's as far as the legs reach; knees and arms have its planes
    and directions. Typical human motion completes the rest: the spine bends and twists evenly, the
    neck turns half as far as the head, hands continue forearms, feet are flat where they stand.

    `joints` (frames, 17, 3) [m], world, are COCO-17, of bones about as long as the body's.
    `courses` (frames, 2) [rad], from the x axis towards y, are directions of left and right foot
    when they tread, within what a hip can turn.
    """
    rest = body.joints
    turns = np.empty((len(joints), len(rest), 3, 3))
    across, trunk = joints[:, 11] - joints[:, 12], joints[:, 5:7].sum(1) - joints[:, 11:13].sum(1)
    upward = rest[16:18].sum(axis=0) - rest[1:3].sum(axis=0)
    turns[:, 0] = _rotations(_X, upward, across, trunk)
    turns[:, 9] = _rotations(upward, _X, trunk, joints[:, 5] - joints[:, 6])
    turns[:, 3], turns[:, 6] = (
        _interpolate_rotations(turns[:, 0], turns[:, 9], s) for s in (1 / 3, 2 / 3)
    )
    turns[:, 13] = turns[:, 14] = turns[:, 9]
    turns[:, 15] = _rotations(*_face_vectors(body.head), *_face_vectors(joints))
    turns[:, 12] = _interpolate_rotations(turns[:, 9], turns[:, 15], 0.5)
    pelvis = joints[:, 11:13].mean(axis=1) - turns[:, 0] @ (rest[1:3].mean(axis=0) - rest[0])

    for side in (0, 1):
        upper, fore = (unit(joints[:, k + side] - joints[:, k - 2 + side]) for k in (7, 9))
        hinge = _elbow_axis(body, side, turns[:, 9], upper, fore)
        for joint, along in ((16 + side, upper), (18 + side, fore)):
            bone = rest[joint + 2] - rest[joint]
            turns[:, joint] = _rotations(bone, cross(bone, _Z), along, hinge)
        turns[:, 20 + side] = turns[:, 22 + side] = turns[:, 18 + side]

        hip = pelvis + turns[:, 0] @ (rest[1 + side] - rest[0])
        thigh, shank, hinge = _solve_leg(body, side, hip, joints, turns[:, 0] @ _Z)
        for joint, along in ((1 + side, thigh), (4 + side, shank)):
            turns[:, joint] = _rotations(rest[joint + 3] - rest[joint], _X, along, hinge)
        ankle = hip + thigh + shank
        clear = ankle[:, 2] - ground(ankle[:, 0], ankle[:, 1]) - body.ankle_height
        turns[:, 7 + side], turns[:, 10 + side] = _rotate_foot(
            body, turns[:, 4 + side], shank, clear, courses[:, side]
        )
    return PosedBody(body, turns, pelvis)


def _elbow_axis(body: Body, side: int, chest: Floats, upper: Floats, fore: Floats) -> Floats:
    """Return the axis (frames, 3) about which an elbow bends.

    A straight arm takes the axis of the unposed arm, rotated along the shortest way.
    """
    straight = chest @ unit(body.joints[18 + side] - body.joints[16 + side])
    ahead, both = chest @ _Z, straight + upper
    # Both cancel only in an arm that points straight through the chest.
    share = (ahead * both).sum(-1) / np.maximum(0.5 * (both**2).sum(-1), 0.1)
    return cross(upper, fore + BIAS * (ahead - share[:, None] * both))


def _solve_leg(
    body: Body, side: int, hip: Floats, joints: Floats, forward: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return thigh and shank (frames, 3) [m] from hip to ankle, and the knee's axis."""
    upper, lower = body.thigh, body.shank
    along = joints[:, 15 + side] - hip
    far = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / far
    # Reach ends smoothly and short of a straight leg, whose knee would snap.
    free, spare = 0.965 * body.leg, 0.03 * body.leg
    reach = np.minimum(far, free) + spare * -np.expm1(-np.maximum(far - free, 0.0) / spare)
    reach = np.maximum(reach, abs(upper - lower) + 1e-3)
    down = (upper**2 - lower**2 + reach**2) / (2.0 * reach)
    aside = np.sqrt(upper**2 - down**2)
    front = (joints[:, 13 + side] - hip) / upper + BIAS * forward
    front = unit(front - (front * along).sum(-1, keepdims=True) * along)
    thigh = down * along + aside * front
    return thigh, reach * along - thigh, cross(front, along)


def _rotate_foot(
    body: Body, turned: Floats, shank: Floats, clear: Floats, course: Floats
) -> tuple[Floats, Floats]:
    """Return rotations of foot and toes (frames, 3, 3).

    `turned` (frames, 3, 3) is the rotation of the shank (frames, 3) [m], `clear` (frames,) [m] the
    height of the ankle above that of a flat foot, `course` (frames,) [rad] the direction of the
    foot when it treads.
    """
    levelled = 0.15  # an ankle higher than a standing one by this levels no roll [m]
    # Upward part of the shank's direction [1]: below the first a foot ignores the ground, as
    # of a lying person; above the second the foot is flat on it.
    treading = (0.25, 0.6)
    down = unit(shank)
    pointed = np.radians(10.0)  # of toes of a foot in the air, down from square with the shank
    hanging = np.cos(pointed) * (turned @ _Z) + np.sin(pointed) * down
    treads = _smooth((-down[:, 2] - treading[0]) / (treading[1] - treading[0]))
    free, clear = 4.0 * (1.0 - treads), np.maximum(clear, 0.0)
    ball = float(body.joints[10, 2] - body.joints[7, 2])
    rise = _soft_limit(hanging[:, 2], clear / ball + free, clear / body.heel + free)
    # Toes stay down while the heel rises.
    under = np.maximum(clear + ball * np.minimum(rise, 0.0), 0.0)
    toe_rise = _soft_limit(rise, under / body.toe + free, np.inf)
    level = (treads * (1.0 - _smooth(clear / levelled)))[:, None]
    ahead = _turn_towards(unit(hanging * [1.0, 1.0, 0.0]), course, treads)
    turns = []
    for slope in (rise, toe_rise):
        pointing = np.sqrt(1.0 - slope**2)[:, None] * ahead + slope[:, None] * _UP
        left = (1.0 - level) * (turned @ _X) + level * cross(_UP, ahead)
        turns.append(_rotations(_Z, _X, pointing, left))
    return turns[0], turns[1]


def _turn_towards(ahead: Floats, course: Floats, share: Floats) -> Floats:
    """Return horizontal directions (frames, 3) turned by a share of the way to a course.

    Up to half a right angle the turn is complete but for 2 degrees; it is 67 degrees at most, and
    zero towards a course straight behind: a person who turns about pivots on the foot.
    """
    sine = np.sin(course) * ahead[:, 0] - np.cos(course) * ahead[:, 1]
    angle = share * (sine + sine**3 / 6.0)
    return np.cos(angle)[:, None] * ahead + np.sin(angle)[:, None] * cross(_UP, ahead)


def _soft_limit(value: Floats, below: Floats, above: Floats | float) -> Floats:
    """Return values softly limited to between -below and above."""
    room = np.maximum(np.where(value < 0.0, below, above), 1e-6)
    with np.errstate(invalid="ignore"):
        held: Floats = np.where(np.isinf(room), value, room * np.tanh(value / room))
    return held


def _smooth(value: Floats) -> Floats:
    """Return a smooth step from 0 to 1 while the value goes from 0 to 1."""
    within = np.clip(value, 0.0, 1.0)
    return within**2 * (3.0 - 2.0 * within)


def _face_vectors(head: Floats) -> tuple[Floats, Floats]:
    """Return the vectors from right to left ear, and from the ears to eyes and nose (..., 3)."""
    nose, *eyes, left, right = (head[..., k, :] for k in range(5))
    return left - right, nose + sum(eyes) - 1.5 * (left + right)


def _interpolate_rotations(first: Floats, second: Floats, share: float) -> Floats:
    """Return rotations (frames, 3, 3) between first and second, less than half a turn apart."""
    mixed = (1.0 - share) * first + share * second
    return orthonormal_frame(mixed[..., 0], mixed[..., 1])


def _rotations(bone: Floats, side: Floats, to_bone: Floats, to_side: Floats) -> Floats:
    """Return rotations (frames, 3, 3) of one direction to others, and a second to that side."""
    return orthonormal_frame(to_bone, to_side) @ orthonormal_frame(bone, side).T
