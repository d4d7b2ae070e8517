"""Monocular SMPL estimates: file formats, poses in the world, and terms in the objective.

4DHumans (HMR2) and HybrIK estimate a body in each image crop: useful joint rotations, at a guessed
depth and size. Only the rotations and the image position are used. Every file is an npz of arrays;
the methods' own array names are supported.

With enough cameras on a person the fit without monocular poses is much more accurate, and their
distance from it is their error. Its mean square, over all people, is their variance elsewhere. So
an inaccurate method gets almost no weight, and an accurate one helps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from worldpose.body.model import JOINTS
from worldpose.body_fitting.pose_space import GATHER, SIZE, interpolate_gaps, nearest_known
from worldpose.errors import InputError
from worldpose.formats.archives import read_npz
from worldpose.formats.files import require_file
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, shortest_rotation


@dataclass(frozen=True, eq=False)
class MonocularEstimates:
    """Bodies in the images of one camera, one row each."""

    frame: NDArray[np.int64]
    """(rows,)"""
    rotations: Floats
    """(rows, 24, 3, 3): of the pelvis, from the body to a camera (x right, y down, z forward) that
    looks at `center` if `cropped`, else along the optical axis; of the others, relative to the
    parent."""
    center: Floats
    """(rows, 2) [px], center of the body's box, or its position in the image."""
    cropped: bool


def read_monocular(path: Path) -> MonocularEstimates:
    """Return the bodies of an npz file of 4DHumans, HybrIK, or another SMPL estimator.

    Rotations are axis-angle vectors or matrices, in one array (`pred_thetas`, `poses`, ...) or two
    (`global_orient` and `body_pose`). The position of a body comes from its crop (`box_center`,
    `bbox`: weak perspective, whose scale and offset are not needed) or from its position in front
    of the camera (`transl` with `focal_length` and `img_size`: full perspective). Boxes are
    centers, or x0 y0 x1 y1 and anything after them, or VIBE's `bboxes` with `frame_ids`: center,
    width and height. `frame` gives the rows' frames; without it each row is a frame of its own.
    `numpy.savez` also saves the arrays of a pickle this way. InputError without rotations or
    positions.
    """
    require_file(path)
    # Maximum size of the arrays of one file [byte]: 1.5 million bodies as matrices.
    return parse_monocular(read_npz(path, 1 << 30), path)


def parse_monocular(arrays: Mapping[str, NDArray[Any]], where: Path) -> MonocularEstimates:
    """Return the bodies of arrays as of `read_monocular`; InputError, with `where`, for others."""
    # Names of all 24 rotations in one array.
    names_of_all = ("pred_thetas", "pred_theta_mats", "poses", "pose", "thetas")
    whole = _first_present(arrays, names_of_all)
    names_of_root = ("global_orient", "pred_global_orient")
    # Names of the pelvis' rotation and of the 23 others.
    names_of_rest = ("body_pose", "pred_body_pose")
    if whole is None:
        root, rest = _first_present(arrays, names_of_root), _first_present(arrays, names_of_rest)
        if root is None or rest is None:
            expected = f"{' or '.join(names_of_all)}; or {names_of_root[0]} and {names_of_rest[0]}"
            raise _format_error(where, expected, ", ".join(arrays) or "nothing")
        parts = [
            _rotation_matrices(root, where, names_of_root[0], 1),
            _rotation_matrices(rest, where, names_of_rest[0], JOINTS - 1),
        ]
        if len(parts[0]) != len(parts[1]):
            raise _format_error(
                where, "as many root rotations as bodies", f"{len(parts[0])} and {len(parts[1])}"
            )
        rotations = np.concatenate(parts, axis=1)
    else:
        rotations = _rotation_matrices(whole, where, "rotations", JOINTS)
    rows = len(rotations)
    frame = _first_present(arrays, ("frame", "frames", "frame_ids"))
    try:
        frame = np.arange(rows) if frame is None else frame.ravel().astype(np.float64)
    except ValueError:  # text that is no number
        frame = np.full(rows, np.nan)
    if (frame != np.rint(frame)).any() or np.isinf(frame).any():
        raise _format_error(where, "whole frame numbers", f"others among {len(frame)}")
    # Crops have centers or boxes; whole images positions in front of the camera [m].
    crop = _first_present(arrays, ("box_center", "bbox", "bboxes"))
    place = _first_present(arrays, ("transl", "pred_cam_t_full", "cam_t", "trans"))
    if crop is not None:
        is_vibe = "frame_ids" in arrays and crop is arrays.get("bboxes")
        center = _box_centers(np.asarray(crop, dtype=np.float64), where, is_vibe)
    elif place is not None and "focal_length" in arrays and "img_size" in arrays:
        focal = np.broadcast_to(np.asarray(arrays["focal_length"]).reshape(-1, 1), (rows, 1))
        size = np.broadcast_to(np.asarray(arrays["img_size"]).reshape(-1, 2), (rows, 2))
        place = np.asarray(place, dtype=np.float64).reshape(rows, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            center = focal * place[:, :2] / place[:, 2:] + 0.5 * (size - 1.0)
    else:
        expected = "a crop (box_center or bbox), or transl with focal_length and img_size"
        raise _format_error(where, expected, ", ".join(arrays))
    if len(frame) != rows or center.shape != (rows, 2):
        raise _format_error(
            where, f"{rows} frames and positions", f"{len(frame)} and {center.shape}"
        )
    return MonocularEstimates(frame.astype(np.int64), rotations, center, crop is not None)


def _first_present(
    arrays: Mapping[str, NDArray[Any]], names: tuple[str, ...]
) -> NDArray[Any] | None:
    return next((arrays[name] for name in names if name in arrays), None)


def _box_centers(boxes: Floats, where: Path, is_vibe: bool) -> Floats:
    """Return centers (rows, 2) [px] of centers or boxes; VIBE has center, width and height."""
    width = boxes.shape[1] if boxes.ndim == 2 else 0
    if width == 2 or (width == 4 and is_vibe):
        return boxes[:, :2]
    if width < 4 or (boxes[:, 2:4] < boxes[:, :2]).any():  # NaN: no box
        expected = "centers, or boxes x0 y0 x1 y1 (score, class, ...), x1 >= x0 and y1 >= y0"
        raise _format_error(where, expected, f"shape {boxes.shape} or other corners")
    return 0.5 * (boxes[:, :2] + boxes[:, 2:4])


def _rotation_matrices(given: NDArray[Any], where: Path, name: str, joints: int) -> Floats:
    """Return matrices (rows, joints, 3, 3) of axis-angle vectors or matrices of any shape."""
    values = np.asarray(given, dtype=np.float64)
    rows, numbers = values.shape[:1], int(np.prod(values.shape[1:]))
    if values.ndim > 1 and numbers == 9 * joints:
        matrices: Floats = values.reshape((*rows, joints, 3, 3))
        return matrices
    if values.ndim > 1 and numbers == 3 * joints:
        return Rigid.from_rotvec(values.reshape((*rows, joints, 3)), np.zeros(3)).rotation
    expected = f"{name} of {joints} joints, axis-angle vectors or matrices, for each row"
    raise _format_error(where, expected, f"shape {values.shape}")


def _format_error(where: Path, expected: str, found: str) -> InputError:
    return InputError(
        str(where),
        expected=expected,
        found=found,
        todo="Save the method's arrays with numpy.savez, one row for each body and image.",
    )


@dataclass(frozen=True, eq=False)
class MonocularPoses:
    """Poses of people, estimated from images of one camera."""

    orient: Floats
    """(frames, persons, 3, 3), world from body; NaN without an estimate."""
    angles: Floats
    """(frames, persons, 30) [rad], of `pose_space`; NaN without an estimate."""
    height: Floats
    """(frames, persons), of the person in the image [px]; NaN without an estimate."""

    def __getitem__(self, frames: slice) -> MonocularPoses:
        """Return the poses in some frames."""
        return MonocularPoses(self.orient[frames], self.angles[frames], self.height[frames])


def join_poses(poses: Sequence[MonocularPoses]) -> MonocularPoses | None:
    """Return the poses of several cameras: a person's in a frame by the one that shows most of it.

    A person twice as tall in the image has four times the pixels.
    """
    if not poses:
        return None
    heights = np.stack([np.nan_to_num(each.height, nan=-1.0) for each in poses])
    best = heights.argmax(axis=0)[None]
    orient, angles, height = (
        np.take_along_axis(stack, best.reshape(best.shape + (1,) * (stack.ndim - 3)), axis=0)[0]
        for stack in (
            np.stack([getattr(each, name) for each in poses])
            for name in ("orient", "angles", "height")
        )
    )
    return MonocularPoses(orient, angles, height)


def place_monocular_poses(
    estimates: MonocularEstimates, camera: Camera, frame: NDArray[np.int64], joints: Floats
) -> MonocularPoses:
    """Return the estimates of tracked people, in the world.

    A method that sees a crop treats its center as straight ahead; the calibrated camera has a ray
    there, and rotating the optical axis onto it rotates the body, by 10 degrees near the border of
    a broadcast image. The assignment minimizes the distances to the middle of the projected joints,
    frame by frame.

    The camera is a batch (frames,) with numbers (frames,); gaps of joints (frames, persons, 17, 3)
    [m], world, are interpolated.
    """
    frames, persons = joints.shape[:2]
    orient = np.full((frames, persons, 3, 3), np.nan)
    angles = np.full((frames, persons, GATHER.shape[0]), np.nan)
    if not persons:
        return MonocularPoses(orient, angles, np.full((frames, persons), np.nan))
    full = np.stack([interpolate_gaps(joints[:, person]) for person in range(persons)], axis=1)
    image = camera.project(full.reshape(frames, -1, 3)).reshape(frames, persons, -1, 2)
    known = np.isfinite(image)
    low = np.where(known, image, np.inf).min(axis=2, initial=np.inf)
    high = np.where(known, image, -np.inf).max(axis=2, initial=-np.inf)
    with np.errstate(invalid="ignore"):  # without a camera, inf - inf
        middle, height = 0.5 * (low + high), high[..., 1] - low[..., 1]
    gate = 0.35  # Maximum image distance between an estimate and its person [person height].
    for place in np.flatnonzero(np.isin(frame, estimates.frame)):
        rows = np.flatnonzero(estimates.frame == frame[place])
        with np.errstate(invalid="ignore", divide="ignore"):
            away = np.linalg.norm(estimates.center[rows, None] - middle[place], axis=-1)
            away = away / height[place]
        away = np.where(np.isfinite(away), away, np.inf)
        row, person = linear_sum_assignment(np.minimum(away, gate))
        near = away[row, person] < gate
        row, person = rows[row[near]], person[near]
        at = camera[int(place)]
        turned = estimates.rotations[row, 0]
        if estimates.cropped:
            ahead = np.insert(at.normalize(estimates.center[row]), 2, 1.0, axis=-1)
            ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
            turned = shortest_rotation(np.array([0.0, 0.0, 1.0]), ahead) @ turned
        orient[place, person] = at.cam_from_world.rotation.T @ turned
        bend = Rigid(estimates.rotations[row, 1:], np.zeros(3)).rotvec
        angles[place, person] = bend.reshape(len(row), GATHER.shape[1]) @ GATHER.T
    bad = ~(np.isfinite(orient).all((-1, -2)) & np.isfinite(angles).all(-1))
    orient[bad], angles[bad] = np.nan, np.nan
    return MonocularPoses(orient, angles, np.where(bad, np.nan, height))


PRIOR_SPREAD: Final = 0.25
"""Prior standard deviation of an angle [rad]: 80 mm on a limb of 0.3 m."""

CORRELATION_S: Final = 0.5
"""Correlation time of monocular pose errors [s]: images hardly change."""


@dataclass(frozen=True, eq=False)
class MonocularPrior:
    """Monocular poses of one track, with precision."""

    orient: Floats
    """(frames, 3, 3), world from body."""
    angles: Floats
    """(frames, 30) [rad]."""
    used: NDArray[np.bool_]
    """(frames,), frames that count; poses of others may be NaN."""
    precision: Floats
    """(33, 33) [1/rad^2]: of rotations of the body about the world's axes, and angles."""
    correlated_frames: float
    """Frames with correlated errors, which count as one [1]."""
    left: Floats | float = 1.0
    """(frames,) share of the variance left after correction by known frames (`carry_errors`)
    [1]."""

    def normal_equations(self, orient: Floats, angles: Floats) -> tuple[Floats, Floats, float]:
        """Return matrices (frames, 33, 33), gradient (frames, 33) and cost for a pose.

        It has orientations (frames, 3) and angles (frames, 30) [rad].
        """
        away = deviations(self.orient, self.angles, orient, angles)
        away = np.where(self.used[:, None], away, 0.0)
        surer = 1.0 / np.broadcast_to(self.left, len(away))
        weighted = away @ self.precision * surer[:, None]
        square = (weighted * away).sum(-1)
        # Deviation, root mean square over the angles, at which an estimate has half its weight
        # [standard deviations]: backs mistaken for fronts.
        tail = 2.5**2 * len(self.precision)
        weight = self.used / (1.0 + square / tail) / self.correlated_frames
        by_pose = np.broadcast_to(np.eye(3 + SIZE), (len(away), 3 + SIZE, 3 + SIZE)).copy()
        by_pose[:, :3, :3] = np.linalg.solve(left_jacobian(away[:, :3]), left_jacobian(orient))
        held = by_pose.swapaxes(-1, -2) * weight[:, None, None]
        cost = 0.5 * tail * float(np.log1p(square / tail).sum()) / self.correlated_frames
        matrix = (held * surer[:, None, None]) @ self.precision @ by_pose
        return matrix, (held @ weighted[..., None])[..., 0], cost


def learn_precision(
    monocular: MonocularPoses,
    orient: Floats,
    angles: Floats,
    sure: NDArray[np.bool_],
    correlated_frames: float,
) -> Floats:
    """Return the precision (33, 33) [1/rad^2] of a monocular pose of one clip.

    Orientations (frames, persons, 3) and angles (frames, persons, 30) [rad] are of bodies fitted
    without monocular poses; those that are `sure` (frames, persons) are much more accurate. So many
    `correlated_frames` count as one.
    """
    there = sure & np.isfinite(monocular.angles[..., 0]) & np.isfinite(angles[..., 0])
    away = deviations(
        monocular.orient[there], monocular.angles[there], orient[there], angles[there]
    )
    prior_weight = 5.0  # Weight of that prior in independent estimates [1].
    square = prior_weight * PRIOR_SPREAD**2 + (away**2).sum(axis=0) / correlated_frames
    return np.diag((prior_weight + len(away) / correlated_frames) / square).astype(np.float64)


def carry_errors(
    known: Floats, known_angles: Floats, off: Floats, used: NDArray[np.bool_], lasting: float
) -> tuple[Floats, Floats, Floats]:
    """Return estimates of one person minus their expected errors.

    The errors of a method for a person in an interval with few cameras mostly exist just before and
    after it too, where the fit reveals them (simple kriging).

    `known` (frames, 3, 3), world from body, and `known_angles` (frames, 30) [rad] are returned
    corrected where `used` (frames,), with the share (frames,) of the variance that is left. `off`
    (frames, 33) [rad] is from estimates to more accurate fits, NaN without one; errors last for
    `lasting` frames, to a factor e.
    """
    # Share of an estimate's variance that is independent from frame to frame [1].
    independent_share = 0.3
    turn, angles, left = known.copy(), known_angles.copy(), np.ones(len(off))
    there = np.flatnonzero(np.isfinite(off).all(axis=-1))
    asked = np.flatnonzero(used)
    # Range of known errors in correlation times [1]: farther ones explain a fiftieth of the
    # variance.
    reach = 2.0 * lasting
    for block in np.unique(asked // reach):
        at = asked[asked // reach == block]
        near = there[(there >= at[0] - reach) & (there <= at[-1] + reach)]
        if not len(near):
            continue
        apart = [np.abs(rows[:, None] - near) / lasting for rows in (near, at)]
        alike = [(1.0 - independent_share) * np.exp(-away) for away in apart]
        share = np.linalg.solve(alike[0] + independent_share * np.eye(len(near)), alike[1].T).T
        expected = share @ off[near]
        turn[at] = Rigid.from_rotvec(expected[:, :3], np.zeros(3)).rotation @ turn[at]
        angles[at] += expected[:, 3:]
        left[at] = 1.0 - (share * alike[1]).sum(axis=-1)
    return turn, angles, left


def deviations(known: Floats, known_angles: Floats, orient: Floats, angles: Floats) -> Floats:
    """Return rotations about the world's axes and angles (frames, 33) [rad] from known poses."""
    turned = Rigid.from_rotvec(orient, np.zeros(3)).rotation @ known.swapaxes(-1, -2)
    safe = np.where(np.isfinite(turned), turned, np.eye(3))
    return np.concatenate([Rigid(safe, np.zeros(3)).rotvec, angles - known_angles], axis=-1)


def left_jacobian(vectors: Floats) -> Floats:
    """Return the left Jacobians (frames, 3, 3) of axis-angle vectors (frames, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    axis = vectors / np.maximum(angle[..., 0], 1e-12)
    cross = np.zeros((len(vectors), 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, b, a], cross[:, a, b] = axis[:, c], -axis[:, c]
    first = np.sinc(angle / np.pi)
    half = 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    outer = axis[:, :, None] * axis[:, None, :]
    jacobian: Floats = first * np.eye(3) + (1.0 - first) * outer + half * cross
    return jacobian


def monocular_priors(
    poses: tuple[Floats, Floats],
    joint_seen: NDArray[np.bool_],
    covariance: Floats,
    estimates: MonocularPoses,
    spans: Mapping[int, slice],
    fps: float,
) -> dict[int, MonocularPrior]:
    """Return monocular poses of persons for frames with few well-determined joints.

    Poses are orientations (frames, persons, 3) and angles (frames, persons, 69) [rad] of bodies
    fitted without monocular poses. `joint_seen` (frames, persons, 17) are triangulated, with a
    covariance (frames, persons, 17, 3, 3) [m^2]; `spans` are the frames of each person.
    """
    variance = np.trace(covariance[:, :, 5:], axis1=-2, axis2=-1) / 3.0
    # Joints are well determined if their median standard deviation per axis is below this [m]: 16
    # cameras leave 0.02 to 0.03, two 0.04 to 0.1.
    sure = np.median(np.where(joint_seen[:, :, 5:], variance, np.inf), axis=-1) < 0.035**2
    correlated_frames = 1.0 + CORRELATION_S * fps
    fitted, body_pose = poses
    angles = body_pose @ GATHER.T
    precision = learn_precision(estimates, fitted, angles, sure, correlated_frames)
    there = np.isfinite(estimates.angles[..., 0])
    guided = {}
    for person, span in spans.items():
        used = (there & ~sure)[span, person]
        if not used.any():
            continue
        orient, bend = estimates.orient[span, person], estimates.angles[span, person]
        off = deviations(orient, bend, fitted[span, person], angles[span, person])
        off[~(there & sure)[span, person]] = np.nan
        orient, bend, left = carry_errors(orient, bend, off, used, CORRELATION_S * fps)
        guided[person] = MonocularPrior(orient, bend, used, precision, correlated_frames, left)
    return guided


def smooth_poses(
    poses: MonocularPoses,
    person: int,
    at: NDArray[np.int64],
    frames: NDArray[np.int64],
    reach: float,
) -> tuple[Floats, Floats]:
    """Return robust means of a person's orientations (frames, 3) and angles (frames, 30) [rad]."""
    orient = np.empty((len(frames), 3, 3))
    angles = np.empty((len(frames), SIZE))
    width = np.maximum(reach, np.abs(frames - nearest_known(at, frames)))
    first = np.searchsorted(at, frames - width)
    last = np.searchsorted(at, frames + width, side="right")
    for row in range(len(frames)):
        near = at[first[row] : last[row]]
        turns = poses.orient[near, person]
        weight = np.ones(len(near))
        for _ in range(3):
            u, _, vt = np.linalg.svd(np.einsum("n,nab->ab", weight, turns))
            u[:, -1] *= np.linalg.det(u @ vt)
            mean = u @ vt
            off = np.linalg.norm(Rigid(turns @ mean.T, np.zeros(3)).rotvec, axis=-1)
            weight = 1.0 / (1.0 + (off / PRIOR_SPREAD) ** 2)
        orient[row], angles[row] = mean, np.median(poses.angles[near, person], axis=0)
    return Rigid(orient, np.zeros(3)).rotvec, angles
