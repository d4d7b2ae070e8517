"""Pose coordinates that keypoints determine: joint limits, pose prior and initial poses.

COCO's 17 points leave many of a body's 69 angles undetermined: the bend of single spine joints,
hands and feet. 30 coordinates remain: bend of the whole spine and of the whole neck, hips, knees,
shoulders and elbows. The other angles follow from them (spine and neck share evenly) or from the
ground (feet). Where a detector gives points of the feet, 8 more coordinates bend ankles and toes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_TORSO
from worldpose.body.keypoints import JOINT_NAMES
from worldpose.body.model import BODY_POSE, BodyModel
from worldpose.compiled import compile_kernel
from worldpose.geometry.rigid import Rigid, cross, orthonormal_frame, unit
from worldpose.parsing import read_npz_members

COORDINATES: Final = (
    *(("spine1", "spine2", "spine3"), ("neck", "head"), ("left_hip",), ("right_hip",)),
    *(("left_knee",), ("right_knee",)),
    *(("left_shoulder",), ("right_shoulder",), ("left_elbow",), ("right_elbow",)),
)
"""Joints that share a rotation evenly; three coordinates each."""
SIZE: Final = 3 * len(COORDINATES)

_LIMITS: Final = {
    # Ranges of motion that only contortionists exceed [rad]: lowest, highest by axis. The body's
    # unposed arms point sideways, so a shoulder's third angle hangs the arm.
    "spine": ((-0.6, 1.6), (-1.0, 1.0), (-0.7, 0.7)),
    "neck": ((-1.2, 1.0), (-1.5, 1.5), (-0.8, 0.8)),
    "hip": ((-2.4, 0.8), (-1.0, 1.0), (-0.8, 1.2)),
    "knee": ((-0.05, 2.7), (-0.4, 0.4), (-0.3, 0.3)),
    "shoulder": ((-2.0, 2.0), (-2.0, 1.2), (-2.0, 1.8)),
    "elbow": ((-0.5, 0.5), (-2.7, 0.1), (-0.5, 0.5)),
    # The first angle of a foot points it down.
    "ankle": ((-0.7, 1.0), (-0.5, 0.5), (-0.5, 0.5)),
    "foot": ((-1.0, 0.3),),
}
"""Limits of the middle and the left side; the right side mirrors the second and third angle."""


FOOT_JOINTS: Final = ("left_ankle", "right_ankle", "left_foot", "right_foot")
"""Joints of further coordinates: three of each ankle, and the bend of the toes of each foot."""
FOOT_SIZE: Final = 8


def _limits() -> tuple[Floats, Floats]:
    bounds = []
    for name in (*(joints[0] for joints in COORDINATES), *FOOT_JOINTS):
        kind = next(kind for kind in _LIMITS if kind in name)
        own = np.array(_LIMITS[kind])
        if name.startswith("right"):
            own[1:] = -own[1:, ::-1]
        bounds.append(own)
    low, high = np.concatenate(bounds).T
    return low, high


MIN_ANGLES, MAX_ANGLES = _limits()
"""(38,) [rad], of the coordinates and then of those of the feet."""


def _spread() -> Floats:
    matrix = np.zeros((BODY_POSE, SIZE))
    for index, joints in enumerate(COORDINATES):
        for joint in joints:
            row = 3 * (JOINT_NAMES.index(joint) - 1)
            matrix[row : row + 3, 3 * index : 3 * index + 3] = np.eye(3) / len(joints)
    return matrix


SPREAD: Final = _spread()
"""(69, 30): matrix from coordinates to `body_pose` [1]; feet and hands are straight."""


def _foot_spread() -> Floats:
    matrix = np.zeros((BODY_POSE, FOOT_SIZE))
    column = 0
    for joint in FOOT_JOINTS:
        axes = 3 if "ankle" in joint else 1
        row = 3 * (JOINT_NAMES.index(joint) - 1)
        matrix[row : row + axes, column : column + axes] = np.eye(axes)
        column += axes
    return matrix


SPREADS: Final = {SIZE: SPREAD, SIZE + FOOT_SIZE: np.hstack([SPREAD, _foot_spread()])}
"""The matrix to `body_pose` by the number of coordinates, without and with those of the feet."""
GATHER: Final = (SPREAD.T > 0.0).astype(np.float64)
"""(30, 69): matrix from `body_pose` to coordinates; shared rotations are summed."""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Pose prior: a normal distribution of the coordinates."""

    mean: Floats
    """(30,) [rad]."""
    precision: Floats
    """(30, 30) [1/rad^2]."""

    def add_feet(self) -> PosePrior:
        """Return the prior of 38 coordinates, of ankles and toes too."""
        size = len(self.mean) + FOOT_SIZE
        precision = np.zeros((size, size))
        precision[:-FOOT_SIZE, :-FOOT_SIZE] = self.precision
        # Standard deviations of these coordinates [rad], about a foot at a right angle to the
        # shank: the range of motion of walking and running.
        precision[-FOOT_SIZE:, -FOOT_SIZE:] = np.diag(
            1.0 / np.array((0.4, 0.2, 0.2, 0.4, 0.2, 0.2, 0.3, 0.3)) ** 2
        )
        return PosePrior(np.concatenate([self.mean, np.zeros(FOOT_SIZE)]), precision)


@functools.cache
def load_pose_prior() -> PosePrior:
    """Return the prior from this project's own simulated football, symmetric left to right.

    0.15 rad, 0.1 rad in knees and elbows, is added in quadrature to every standard deviation:
    simulated people are stiffer than real people.
    """
    file = read_npz_members(Path(__file__).parent / "pose_prior.npz", ("mean", "covariance"))
    mean, covariance = file["mean"], file["covariance"]
    widening = np.full(SIZE, 0.15)
    widening[12:18] = 0.1
    widening[24:30] = 0.1
    return PosePrior(mean, np.linalg.inv(covariance + np.diag(widening**2)))


_LIMBS: Final = (
    # COCO's joints, the body's joints, slices of their coordinates, and the hinge of the second.
    ((5, 7, 9), (16, 18, 20), (slice(18, 21), slice(24, 27)), "elbow"),
    ((6, 8, 10), (17, 19, 21), (slice(21, 24), slice(27, 30)), "elbow"),
    ((11, 13, 15), (1, 4, 7), (slice(6, 9), slice(12, 15)), "knee"),
    ((12, 14, 16), (2, 5, 8), (slice(9, 12), slice(15, 18)), "knee"),
)


def interpolate_gaps(joints: Floats) -> Floats:
    """Return joints (frames, joints, 3) without gaps: linear, constant beyond; NaN if not seen."""
    full = joints.copy()
    frames = np.arange(len(joints))
    for joint in range(joints.shape[1]):
        seen = np.isfinite(joints[:, joint, 0])
        if seen.any() and not seen.all():
            for axis in range(3):
                full[:, joint, axis] = np.interp(frames, frames[seen], joints[seen, joint, axis])
    return full


def nearest_known(known: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each of `frames` the nearest of the frames `known` (rising, not empty)."""
    after = np.searchsorted(known, frames).clip(max=len(known) - 1)
    before = (after - 1).clip(min=0)
    is_before = np.abs(frames - known[before]) <= np.abs(known[after] - frames)
    return known[np.where(is_before, before, after)]


def nearest_matrices(matrices: Floats) -> Floats:
    """Return matrices (frames, 3, 3) with those of the nearest frame where they are NaN."""
    known = np.flatnonzero(np.isfinite(matrices).all(axis=(-1, -2)))
    if not len(known):
        return np.zeros_like(matrices)
    nearest: Floats = matrices[nearest_known(known, np.arange(len(matrices)))]
    return nearest


def align_root(rest: Floats, torso: Floats) -> tuple[Floats, Floats]:
    """Return orientation (frames, 3, 3) and position of `rest`'s mean (frames, 3) [m].

    `rest` (4, 3) [m] are shoulders and hips of the unposed body; NaN of `torso` (frames, 4, 3) [m],
    world, do not count.
    """
    seen = np.asarray(np.isfinite(torso[..., 0]))
    weight = seen / np.maximum(seen.sum(-1, keepdims=True), 1)
    known = np.where(seen[..., None], torso, 0.0)
    target_mean = np.einsum("fp,fpc->fc", weight, known)
    rest_mean = weight @ rest
    centred = np.where(seen[..., None], torso - target_mean[:, None], 0.0)
    spread = np.einsum("fpa,fpb->fab", centred, rest - rest_mean[:, None])
    u, _, vt = np.linalg.svd(spread)
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turns = u @ vt
    sure = np.flatnonzero(seen.sum(-1) >= 3)
    if len(sure):
        turns = turns[nearest_known(sure, np.arange(len(torso)))]
    else:
        turns = np.broadcast_to(
            Rigid.from_rotvec([np.pi / 2, 0.0, 0.0], np.zeros(3)).rotation, turns.shape
        )
    place = target_mean + np.einsum("fab,fb->fa", turns, rest.mean(axis=0) - rest_mean)
    return turns, place


def start_poses(
    model: BodyModel, betas: Floats, joints: Floats, prior: PosePrior
) -> tuple[Floats, Floats, Floats]:
    """Return `transl` (frames, 3), `global_orient` (frames, 3) and coordinates of the prior.

    Betas are (shapes,), joints (frames, 17, 3) [m], world, without gaps; one never seen is NaN. The
    prior has the pose of limbs that no frame shows, and the bending direction of straight ones.
    """
    rest = model.joint_template + model.joint_directions @ betas
    torso = rest[[16, 17, 1, 2]]
    turns, place = align_root(torso, joints[:, COCO17_TORSO])
    # Without torso joints, the person is at the mean of the other joints.
    shown = np.asarray(np.isfinite(joints[..., 0]))
    center = np.where(shown[..., None], joints, 0.0).sum(1) / np.maximum(shown.sum(1), 1)[:, None]
    some = np.asarray(shown[:, COCO17_TORSO].any(-1))
    place = np.where(some[:, None], place, center)
    middle = joints[:, 11:13].mean(axis=1)
    from_torso = place + turns @ (rest[1:3].mean(axis=0) - torso.mean(axis=0))
    middle = np.where(np.isfinite(middle), middle, from_torso)
    pelvis = middle - turns @ (rest[1:3].mean(axis=0) - rest[0])
    coordinates = np.broadcast_to(prior.mean, (len(joints), len(prior.mean))).copy()
    for ends, bones, places, hinge in _LIMBS:
        upper, lower = (joints[:, ends[k + 1]] - joints[:, ends[k]] for k in (0, 1))
        if not (np.isfinite(upper).all() and np.isfinite(lower).all()):
            continue
        first, second = (rest[bones[k + 1]] - rest[bones[k]] for k in (0, 1))
        axis = (
            np.array((1.0, 0.0, 0.0))
            if hinge == "knee"
            else unit(cross(first, np.array((0.0, 0.0, 1.0))))
        )
        usual = Rigid.from_rotvec(prior.mean[places[0]], np.zeros(3)).rotation @ axis
        # The bend of the limb determines the hinge, with a weight that grows with the bend.
        across = cross(unit(upper), unit(lower)) + 0.1 * (turns @ usual)
        outer = turns
        for bone, along, own in ((first, upper, places[0]), (second, lower, places[1])):
            turned = orthonormal_frame(along, across) @ orthonormal_frame(bone, axis).T
            local = np.swapaxes(outer, -1, -2) @ turned
            coordinates[:, own] = Rigid(local, np.zeros(3)).rotvec
            outer = turned
    orient = Rigid(turns, np.zeros(3)).rotvec
    return pelvis - rest[0], orient, coordinates


def level_feet(rotations: Floats, clear: Floats) -> Floats:
    """Return rotations of feet relative to their shanks (frames, 3, 3): flat where they stand.

    Shanks have rotations (frames, 3, 3), world; `clear` (frames,) [m] is the height of the ankle
    above that of a flat foot.
    """
    forward = rotations[..., 2].copy()
    forward[..., 2] = 0.0
    length = np.linalg.norm(forward, axis=-1, keepdims=True)
    forward /= np.maximum(length, 1e-9)
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    flat = np.stack([np.cross(up, forward), up, forward], axis=-1)
    upright = np.clip((rotations[:, 2, 1] - 0.25) / 0.35, 0.0, 1.0)
    share = upright * np.clip(1.0 - clear / 0.15, 0.0, 1.0) * (length[:, 0] > 0.1)
    mixed = share[:, None, None] * flat + (1.0 - share)[:, None, None] * rotations
    u, _, vt = np.linalg.svd(mixed)
    turned: Floats = rotations.swapaxes(-1, -2) @ u @ vt
    return turned


def _spread_terms(spread: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    angle, coordinate = np.nonzero(spread)
    return angle, coordinate, spread[angle, coordinate]


SPREAD_TERMS: Final = {size: _spread_terms(spread) for size, spread in SPREADS.items()}
"""Angle, coordinate and factor of every nonzero entry of `SPREADS`."""


def differentiate_points(pose: Floats, size: int) -> Floats:
    """Return derivatives (frames, points, 3, 6 + size) of points by the unknowns.

    `pose` (frames, points, 3, 72) are those by the angles of all joints, `size` counts its
    coordinates.
    """
    angle, coordinate, factor = SPREAD_TERMS[size]
    return _gather_angles(pose, 3 + angle, 6 + coordinate, factor, 6 + size)


@compile_kernel
def _gather_angles(
    pose: Floats,
    angle: NDArray[np.int64],
    unknown: NDArray[np.int64],
    factor: Floats,
    unknowns: int,
) -> Floats:
    """Return derivatives by the unknowns: sums of those by angles, with factors, (terms,) each."""
    frames, points = pose.shape[:2]
    rows = np.zeros((frames, points, 3, unknowns))
    for t in range(frames):
        for p in range(points):
            for a in range(3):
                rows[t, p, a, a] = 1.0
                for c in range(3):
                    rows[t, p, a, 3 + c] = pose[t, p, a, c]
                for i in range(len(angle)):
                    rows[t, p, a, unknown[i]] += factor[i] * pose[t, p, a, angle[i]]
    return rows
