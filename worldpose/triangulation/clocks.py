"""Clock offsets of the cameras: estimated from moving people, and corrected in their detections.

Frame t of a camera with clock offset d shows the time t + d: its rays miss a person by the person's
motion in d frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, ClipArray, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import Record
from worldpose.compiled import compile_kernel, map_in_threads
from worldpose.geometry import camera_model
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import geman_mcclure_weight
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.residuals import Observations, Rig
from worldpose.triangulation.samples import choose_intervals, have_views
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import solve_joints

GATES: Final = (10.0, 10.0, 5.0, 3.5, 3.5, 3.5, 3.5)
"""Deviations accepted in each pass: clocks three frames apart put a runner's rays half a metre
apart."""
SETTLED: Final = 0.005
"""Change that ends the passes [frame]."""


class ClockReport(Record):
    """Clock offsets as metrics, one value per camera."""

    clock_late_frames: tuple[float | None, ...]
    """None where too little moves."""
    clock_error_frames: tuple[float | None, ...]
    """Standard error."""


@dataclass(frozen=True, eq=False)
class CameraClocks:
    """Clock offsets of the cameras.

    Attributes:
        late: (cameras,) [frame]: frame t shows the time t + late of the cameras' mean clock; NaN
            where `determined` is false.
        standard_error: (cameras,) [frame]; several frames without motion.
        determined: (cameras,) bool, standard error below the settings' `max_clock_error_frames`.
    """

    late: Floats
    standard_error: Floats
    determined: NDArray[np.bool_]

    @property
    def report(self) -> ClockReport:
        """The metrics of the clock offsets."""
        late = zip(self.late.tolist(), self.determined.tolist(), strict=True)
        return ClockReport(
            clock_late_frames=tuple(value if known else None for value, known in late),
            clock_error_frames=tuple(self.standard_error.tolist()),
        )


def estimate_clocks(
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
) -> CameraClocks:
    """Return the clock offset of each camera relative to the cameras' mean.

    Each pass triangulates people, regresses each camera's residuals on the people's image velocity,
    with the joints free to follow, and shifts the camera's observations in time by the estimate. At
    convergence no residual correlates with velocity, so noise of the velocity has no effect.
    """
    rig = Rig.from_cameras(cameras)
    count = len(rig.cameras)
    unknown = 10.0  # Standard deviation of an undetermined offset [frame].
    late, error = np.zeros(count), np.full(count, unknown)
    # Length of an interval [s]; errors within an interval count as one.
    parts = choose_intervals(have_views(detections, 2), max(3, round(1.0 * fps)))
    # By person, which takes a fraction of the memory of all detections.
    seen = [shift_in_time(detections[part], late) for part in parts]
    for gate in GATES if parts else ():
        loose = settings.model_copy(update={"max_deviation": gate})

        def sum_up(
            part: KeypointDetections, late: Floats = late, loose: TriangulationSettings = loose
        ) -> PersonSums:
            return sum_equations(MovingJoints.find(rig, shift_in_time(part, late), fps, loose))

        sums = PersonSums.join(list(map_in_threads(sum_up, seen)))
        # A common offset moves people along their path and changes no residual.
        inverse = np.linalg.inv(sums.information.sum(axis=0) + np.eye(count) / unknown**2)
        step = inverse @ sums.score.sum(axis=0)
        error = np.minimum(_standard_error(sums, step, inverse, unknown), unknown)
        known = error < settings.max_clock_error_frames
        late = np.where(known, late + step, 0.0)
        if known.any():
            late = np.where(known, late - late[known].mean(), 0.0)
        if np.abs(step[known] - step[known].mean() if known.any() else 0.0).max() < SETTLED:
            break
    determined = error < settings.max_clock_error_frames
    return CameraClocks(np.where(determined, late, np.nan), error, determined)


def _standard_error(sums: PersonSums, step: Floats, inverse: Floats, unknown: float) -> Floats:
    """Return the standard error (cameras,) [frame] of a step of summed equations, or `unknown`."""
    information = sums.information
    # Cameras without information are not part of the mean.
    telling = np.diagonal(information.sum(axis=0)) > 1.0 / unknown**2
    centered = inverse - telling @ inverse / max(1, telling.sum())
    # Intervals of a person are independent, frames are not: the error is the scatter of interval
    # scores. Each interval has influenced the solution, hence the division (jackknife).
    own = np.diagonal(information, axis1=1, axis2=2)
    share = np.minimum(own / np.maximum(own.sum(axis=0), 1e-12), 0.5)
    left = ((sums.score - information @ step) / (1.0 - share)) @ centered.T
    stated = np.einsum("cd,de,ce->c", centered, information.sum(axis=0), centered)
    alike = sums.common_score()
    variance = np.maximum((left**2).sum(axis=0), stated) + centered**2 @ alike**2
    return np.where(telling, np.sqrt(variance), unknown)


@dataclass(frozen=True, eq=False)
class PersonSums:
    """Normal equations of each person in some intervals, with the joints free to follow.

    Attributes:
        information: (persons, unknowns, unknowns) [1/frame^2], camera by camera.
        score: (persons, unknowns) [1/frame]; the offsets grow by the solution of the sum.
        shared: (3, cameras), for a shift of people along their path: sum of weight x image motion x
            image scale [1/(frame m)], of weighted squared residuals [1], and of weight x squared
            image scale [1/m^2].
    """

    information: Floats
    score: Floats
    shared: Floats

    @classmethod
    def join(cls, parts: Sequence[PersonSums]) -> PersonSums:
        """Return the sums of all intervals."""
        return cls(
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.score for part in parts]),
            np.sum([part.shared for part in parts], axis=0),
        )

    def common_score(self) -> Floats:
        """Return the score (cameras,) of an error that all people in a camera have in common."""
        # Share of a detector's error along the motion that all people in a camera have in
        # common [1]: the detector shifts bodies seen from one side, and no number of
        # people averages that out. Simulated matches and penalty boxes showed 0.027 and
        # 0.021.
        alike = 0.025
        along, misses, scale = self.shared
        usual = np.divide(misses, 2.0 * scale, out=np.zeros_like(scale), where=scale > 0.0)
        return np.asarray(alike * along * np.sqrt(usual))


@dataclass(frozen=True, eq=False)
class MovingJoints:
    """Triangulated joints of an interval of frames, and what each camera of a rig sees of them.

    Attributes:
        at: (n, 3) [m], world.
        velocity: (n, 3) [m/frame].
        person: (n,).
        frame: (n,).
    """

    at: Floats
    velocity: Floats
    person: Integers
    frame: Integers
    _known: NDArray[np.bool_]
    _pixels: AnyFloats
    _precision: Floats
    rig: Rig
    _settings: TriangulationSettings

    @classmethod
    def find(
        cls, rig: Rig, people: KeypointDetections, fps: float, settings: TriangulationSettings
    ) -> MovingJoints:
        """Return the joints with a velocity, of detections by person on the common clock."""
        joints = triangulate_views(rig, people, settings)
        # Half the time over which velocity is computed is 0.06 s.
        half = max(1, round(0.06 * fps))
        rows = np.arange(half, len(joints) - half)
        return cls.at_rows(rig, people[rows], joints, rows, half, settings)

    @classmethod
    def at_rows(
        cls,
        rig: Rig,
        people: KeypointDetections,
        joints: Floats,
        rows: Integers,
        half: int,
        settings: TriangulationSettings,
    ) -> MovingJoints:
        """Return the joints at some rows, of detections by person at these; `half` as for `find`.

        Joints are (frames, persons, joints, 3), and there are `half` more before and after rows.
        """
        pixels = people.keypoints
        precision = NoiseModel.nominal(pixels.shape[-2]).precision(people.confidence)
        at = joints[rows]
        velocity = (joints[rows + half] - joints[rows - half]) / (2.0 * half)
        known = np.asarray(np.isfinite(at + velocity).all(axis=-1))
        frame, person, _ = np.nonzero(known)
        return cls(
            at[known], velocity[known], person, rows[frame], known, pixels, precision, rig, settings
        )

    def look(self, camera: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return what a camera sees, all 0 where it does not see the joint.

        Derivatives (n, 2, 21) of pixels by points and cameras, misses (n, 2) [px], their weights
        (n,) [1/px^2] and scales (n,) [px/m].
        """
        n, row = len(self.at), self.rig.cameras[camera]
        image, jacobian = np.empty((1, n, 2)), np.empty((1, n, 2, camera_model.DERIVATIVES))
        given, status = np.ascontiguousarray(self.at[None]), np.empty((1, n), np.uint8)
        camera_model.project_with_jacobians(row[None], given, image, jacobian, status)
        miss = self._pixels[:, camera][self._known] - image[0]
        depth = self.at @ self.rig.depths[camera, :3] + self.rig.depths[camera, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            size = row[0] / depth
            variance = self._settings.pixel_noise_px**2 + (size * self._settings.joint_noise_m) ** 2
            weight = self._precision[:, camera][self._known] / variance
            squared = weight * (miss**2).sum(axis=-1)
            weight = weight * geman_mcclure_weight(squared, self._settings.max_deviation)
        usable = np.isfinite(weight * squared)
        return (
            np.where(usable[:, None, None], jacobian[0], 0.0),
            np.where(usable[:, None], miss, 0.0),
            np.where(usable, weight, 0.0),
            np.where(usable, size, 0.0),
        )


def triangulate_views(
    rig: Rig, seen: KeypointDetections, settings: TriangulationSettings
) -> Floats:
    """Return joints (frames, persons, 17, 3) [m] by the stated noise."""
    precision = NoiseModel.nominal(seen.confidence.shape[-1]).precision(seen.confidence)
    observations = Observations.of(rig, seen.keypoints, precision, seen.detection_index)
    return solve_joints(observations, settings).joints


def sum_equations(moving: MovingJoints, *, with_cameras: bool = False) -> PersonSums:
    """Return the normal equations of each person from the residuals of an interval of frames.

    The unknowns of a camera are its clock offset [frame] and, if `with_cameras`, its rotation [rad]
    and the logarithm of its focal length.
    """
    rig, count, width = moving.rig, len(moving.rig.cameras), 5 if with_cameras else 1
    place, shared = np.full((len(moving.at), count), -1), np.zeros((3, count))
    views: list[tuple[Floats, ...]] = []
    for camera in range(count):
        derivatives, miss, weight, scale = moving.look(camera)
        seen = np.flatnonzero(weight)
        place[seen, camera] = sum(len(view[0]) for view in views) + np.arange(len(seen))
        derivatives, miss, weight = derivatives[seen], miss[seen], weight[seen]
        by_point, scale = derivatives[..., :3], scale[seen]
        columns = np.einsum("nij,nj->ni", by_point, moving.velocity[seen])[..., None]
        motion = np.linalg.norm(columns[..., 0], axis=-1)
        if with_cameras:
            focal = (derivatives[..., 9:11] * rig.cameras[camera, :2]).sum(axis=-1, keepdims=True)
            columns = np.concatenate([columns, derivatives[..., 3:6], focal], axis=-1)
        shared[0, camera] = (weight * motion * scale).sum()
        shared[1, camera] = (weight * (miss**2).sum(axis=-1)).sum()
        shared[2, camera] = (weight * scale**2).sum()
        views.append((by_point, columns, miss, weight))
    people, group = np.unique(moving.person, return_inverse=True)
    information = np.zeros((len(people), count, width, count, width))
    score = np.zeros((len(people), count, width))
    by_point, columns, miss, weight = (np.concatenate(each) for each in zip(*views, strict=True))
    _eliminate_points(place, group, by_point, columns, miss, weight, information, score)
    size = (len(people), count * width)
    return PersonSums(information.reshape(*size, size[1]), score.reshape(size), shared)


@compile_kernel
def _eliminate_points(
    place: Integers,
    group: Integers,
    by_point: Floats,
    columns: Floats,
    miss: Floats,
    weight: Floats,
    information: Floats,
    score: Floats,
) -> None:
    """Add normal equations of cameras by group, with each point free to follow.

    With P, C the derivatives by point and camera, m the miss, w the weight, in views c and d: H_cd
    = [c = d] w C^T C - X_c V^-1 X_d^T and g_c = w C^T m - X_c V^-1 (sum w P^T m), where X = w C^T P
    and V = sum w P^T P.

    `place` (n, cameras) is a point's row, -1 = none, in `by_point` (rows, 2, 3), `columns` (rows,
    2, k), `miss` (rows, 2) [px] and `weight` (rows,) [1/px^2]; `group` is (n,). Added to are
    `information` (groups, cameras, k, cameras, k) and `score` (groups, cameras, k).
    """
    cameras, width = place.shape[1], columns.shape[2]
    mixed, follows = np.empty((cameras, width, 3)), np.empty((cameras, width, 3))
    for i in range(len(place)):
        held, right, g = 1e-9 * np.eye(3), np.zeros(3), group[i]
        seen = np.flatnonzero(place[i] >= 0)
        for c in seen:
            k = place[i, c]
            for row in range(2):
                for a in range(3):
                    pull = weight[k] * by_point[k, row, a]
                    right[a] += pull * miss[k, row]
                    for b in range(3):
                        held[a, b] += pull * by_point[k, row, b]
        inverse = np.linalg.inv(held)
        for c in seen:
            k = place[i, c]
            for a in range(width):
                first, second = weight[k] * columns[k, 0, a], weight[k] * columns[k, 1, a]
                for b in range(3):
                    mixed[c, a, b] = first * by_point[k, 0, b] + second * by_point[k, 1, b]
                score[g, c, a] += first * miss[k, 0] + second * miss[k, 1]
                for b in range(width):
                    own = first * columns[k, 0, b] + second * columns[k, 1, b]
                    information[g, c, a, c, b] += own
                for b in range(3):
                    follows[c, a, b] = (
                        mixed[c, a, 0] * inverse[0, b]
                        + mixed[c, a, 1] * inverse[1, b]
                        + mixed[c, a, 2] * inverse[2, b]
                    )
                    score[g, c, a] -= follows[c, a, b] * right[b]
        for c in seen:
            for a in range(width):
                x, y, z = follows[c, a]
                for d in seen:
                    for b in range(width):
                        information[g, c, a, d, b] -= (
                            x * mixed[d, b, 0] + y * mixed[d, b, 1] + z * mixed[d, b, 2]
                        )


def read_frames(
    detections: KeypointDetections[ClipArray], frames: slice | Integers, late: Floats | None
) -> KeypointDetections:
    """Return the detections of some frames of a clip, on the common clock.

    Frames are a range or single ones. Clock offsets `late` (cameras,) [frame] are corrected; None =
    no correction.
    """
    offsets = np.zeros(1) if late is None else np.nan_to_num(late)
    reach = math.ceil(float(np.abs(offsets).max(initial=0.0)))
    if not reach:
        return detections[frames]
    if isinstance(frames, slice):
        start = max(0, frames.start - reach)
        shifted = shift_in_time(detections[start : frames.stop + reach], offsets)
        return shifted[frames.start - start : frames.stop - start]
    each = [read_frames(detections, slice(frame, frame + 1), late) for frame in frames.tolist()]
    if not each:
        return read_frames(detections, slice(0, 0), late)
    found = KeypointDetections.from_keypoints(
        np.concatenate([one.keypoints for one in each]),
        np.concatenate([one.confidence for one in each]),
        np.concatenate([one.detection_index for one in each]),
    )
    if not detections.points:
        return found
    extra = [(one.extra_keypoints, one.extra_confidence) for one in each]
    return found.add_points(detections.points, *map(np.concatenate, zip(*extra, strict=True)))


def shift_in_time(detections: KeypointDetections, late: Floats) -> KeypointDetections:
    """Return the uncorrected detections shifted to the common clock, one per person and camera.

    Keypoints, also those besides COCO-17, are interpolated linearly between two frames and are
    missing unless both have them: (frames, cameras, persons, joints, 2), with confidence and the
    matching index. Offsets `late` are (cameras,) or (cameras, frames) [frame]; NaN or 0 leaves a
    camera as it is.
    """
    frames, _, persons = detections.detection_index.shape
    row, camera_row, _ = np.ogrid[:frames, : detections.detection_index.shape[1], :persons]
    place = row, camera_row, np.maximum(detections.detection_index, 0)
    there = (detections.detection_index >= 0)[..., None]
    pixels = detections.keypoints[place].astype(np.float64, copy=False)
    weights = detections.confidence[place].astype(np.float64, copy=False)
    joints = weights.shape[-1]
    if detections.extra_keypoints is not None and detections.extra_confidence is not None:
        pixels = np.concatenate([pixels, detections.extra_keypoints[place]], axis=-2)
        weights = np.concatenate([weights, detections.extra_confidence[place]], axis=-1)
    weights = np.where(there & np.isfinite(pixels).all(axis=-1), weights, np.nan)
    for camera in np.flatnonzero(np.nan_to_num(late).reshape(len(late), -1).any(axis=1)):
        time = np.arange(frames) - late[camera]
        before = np.floor(time).astype(np.int64)
        share = time - before
        # A whole number of frames needs one frame only.
        after = np.where(share > 0.0, before + 1, before)
        outside = (before < 0) | (after >= frames)
        before, after = np.clip(before, 0, frames - 1), np.clip(after, 0, frames - 1)
        for array, spread in ((pixels, 3), (weights, 2)):
            part = share.reshape(-1, *(1,) * spread)
            of = array[:, camera]
            moved = (1.0 - part) * of[before] + part * of[after]
            moved[outside] = np.nan
            array[:, camera] = moved
    seen = np.isfinite(weights[..., :joints]).any(axis=-1)
    index = np.where(seen, np.arange(persons), -1).astype(np.int16)
    found = KeypointDetections.from_keypoints(pixels[..., :joints, :], weights[..., :joints], index)
    if not detections.points:
        return found
    return found.add_points(detections.points, pixels[..., joints:, :], weights[..., joints:])


def move_to_match_time(pixels: Floats, index: NDArray[np.integer], late: Floats) -> Floats:
    """Return keypoints (frames, cameras, detections, points, 2) [px] of people at the match frames.

    A keypoint moves along the line to the same person's in a neighbouring frame: x(f) = x + share
    (x' - x), where the camera's frames show the match times f + late and f' + late'. The neighbour
    on the other side of f counts, or else the one on the same side; without any, x stays.

    `index` (frames, cameras, persons) is each person's detection, -1 = not seen; `late` (frames,
    cameras) is how much later than its match frame each frame is [frame].
    """
    moved, frames = pixels.copy(), len(index)
    frame = np.arange(frames)[:, None]
    for c in np.flatnonzero((late != 0.0).any(axis=0)):
        slot, off = index[:, c], late[:, c, None]
        own = np.where((slot >= 0)[..., None, None], pixels[frame, c, np.maximum(slot, 0)], np.nan)
        found, shares = [], []
        for side in (-1, 1):
            there = np.clip(frame + side, 0, frames - 1)[:, 0]
            step = (there - frame[:, 0])[:, None] + off[there] - off
            # The same image again tells no motion.
            share = np.where(np.abs(step) > 1e-6, -off / np.where(step == 0.0, 1.0, step), np.nan)
            found.append(own + share[..., None, None] * (own[there] - own))
            shares.append(share)
        is_before = (shares[0] >= 0.0)[..., None, None]
        best = np.where(is_before, found[0], found[1])
        best = np.where(np.isfinite(best), best, np.where(is_before, found[1], found[0]))
        row, column = np.nonzero(slot >= 0)
        known = np.where(np.isfinite(best), best, own)
        moved[row, c, slot[row, column]] = known[row, column]
    return moved
