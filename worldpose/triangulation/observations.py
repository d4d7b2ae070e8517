"""Observations of a clip as tiles: gathered by person, undistorted, linearised."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import is_finite
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel, distort, distort_brown, load_camera, undistort
from worldpose.geometry.rays import RayStatus
from worldpose.triangulation.batched_gauss_newton import (
    EXTRA,
    LANES,
    PRECISION,
    SCALE,
    SQUARED,
    A,
    B,
)

_BROWN = int(LensModel.BROWN)
_OK = int(RayStatus.OK)


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras in the memory layout of the kernels.

    Attributes:
        cameras: (cameras, WIDTH) rows as in `worldpose.geometry.camera_model`.
        depths: (cameras, 4), depth of (x, y, z, 1) [m]; 1 where a camera is missing.
        centers: (cameras, 3) [m], world.
    """

    cameras: Floats
    depths: Floats
    centers: Floats

    @classmethod
    def from_cameras(cls, cameras: Camera) -> Rig:
        """Return the rig of a batch (cameras,)."""
        pose = cameras.cam_from_world
        rows = cameras.numbers
        depths = np.concatenate([pose.rotation[:, 2], pose.translation[:, 2:]], axis=-1)
        # 0 x NaN is NaN: a camera of weight 0 needs a finite depth nevertheless.
        missing = [not is_finite(rows, c) for c in range(len(rows))]
        depths[missing] = [0.0, 0.0, 0.0, 1.0]
        return cls(rows, depths, np.ascontiguousarray(cameras.center))


def no_shift() -> Floats:
    """Return the empty shift, which moves no observation."""
    return np.zeros((0, 0, 0, 3))


class Observations(NamedTuple):
    """Weighted observations of tracked people by all cameras, as solvers and kernels take them.

    Attributes:
        keypoints: (frames, cameras, detections, joints, 2) [px].
        precision: (frames, cameras, detections, joints), inverse of the factor on the stated
            variance; 0 or NaN = no observation.
        detection_index: (frames, cameras, persons), index of the detection; -1 = not seen.
        shift: (frames, cameras, persons, 3), subtracted from pixels [px], and additional variance
            [px^2]; no frames = no shift.
        cameras: (cameras, WIDTH) rows as in `Rig`.
        depths: (cameras, 4) rows as in `Rig`.
        centers: (cameras, 3) centers as in `Rig`.
    """

    keypoints: AnyFloats
    precision: Floats
    detection_index: NDArray[np.integer]
    shift: Floats
    cameras: Floats
    depths: Floats
    centers: Floats

    @classmethod
    def from_rig(
        cls,
        rig: Rig,
        keypoints: AnyFloats,
        precision: Floats,
        index: NDArray[np.integer],
        shift: Floats | None = None,
    ) -> Observations:
        """Return the observations of a rig; arguments as the attributes, by default unshifted.

        Arrays are contiguous and have one type: numba compiles a kernel again for every other.
        """
        return cls(
            keypoints=keypoints,
            precision=np.ascontiguousarray(precision),
            detection_index=np.ascontiguousarray(index, dtype=np.int64),
            shift=no_shift() if shift is None else shift,
            cameras=rig.cameras,
            depths=rig.depths,
            centers=rig.centers,
        )


@dataclass(frozen=True, eq=False)
class PersonTrack:
    """Observations of one person over an interval of frames.

    Attributes:
        pixels: (joints, cameras, frames, 2) [px], offsets subtracted.
        precision: (joints, cameras, frames) precision as in `Observations`.
        joints: (frames, joints, 3) [m], triangulated; NaN where unknown.
    """

    pixels: Floats
    precision: Floats
    joints: Floats


def observe_person(
    detections: KeypointDetections,
    precision: Floats,
    offsets: Floats,
    joints: Floats,
    person: int,
    frames: slice = slice(None),
) -> PersonTrack:
    """Return one person's observations.

    Args:
        detections: detections of all people.
        precision: (frames, cameras, detections, joints) precision of the keypoints.
        offsets: (frames, cameras, persons, 2) [px] to subtract.
        joints: (frames, persons, joints, 3) [m], triangulated.
        person: index of the person.
        frames: frames to include.
    """
    index = detections.detection_index[frames, :, person]
    # Whole rows of joints: `take_along_axis` would index every number, at ten times the time.
    row, camera = np.ogrid[: index.shape[0], : index.shape[1]]
    place = row, camera, np.maximum(index, 0)
    pixels = detections.keypoints[frames][place] - offsets[frames, :, person, None]
    weights = precision[frames][place]
    weights = np.where((index >= 0)[..., None], weights, np.nan)
    return PersonTrack(
        pixels=np.ascontiguousarray(pixels.transpose(2, 1, 0, 3)),
        precision=np.ascontiguousarray(weights.transpose(2, 1, 0)),
        joints=joints[frames, person],
    )


@compile_kernel
def gather(observations: Observations, first: int, tiles: Floats) -> None:
    """Write pixels, precision and additional variance of 64 joints.

    Args:
        observations: observations of all joints.
        first: the first joint, counted over frames, persons, joints.
        tiles: (cameras, ROWS x LANES); pixels go to the first rows of `A` and `B`.
    """
    keypoints, precision = observations.keypoints, observations.precision
    index, shift, cameras = observations.detection_index, observations.shift, observations.cameras
    frames, count, persons = index.shape
    joints = precision.shape[3]
    last = min(LANES, frames * persons * joints - first)
    for camera in range(count):
        tile = tiles[camera]
        tile[PRECISION : PRECISION + 2 * LANES] = 0.0
        j = 0
        while j < last:
            # Consecutive joints of one person.
            joint, which = (first + j) % joints, (first + j) // joints
            run = min(joints - joint, last - j)
            frame, person = which // persons, which % persons
            detection = index[frame, camera, person]
            if detection >= 0:
                pixels = keypoints[frame, camera, detection, joint : joint + run]
                weights = precision[frame, camera, detection, joint : joint + run]
                into = tile[j:]
                for k in range(run):
                    into[A + k], into[B + k] = pixels[k, 0], pixels[k, 1]
                    into[PRECISION + k] = weights[k]
                if len(shift):
                    for k in range(run):
                        into[A + k] -= shift[frame, camera, person, 0]
                        into[B + k] -= shift[frame, camera, person, 1]
                        into[EXTRA + k] = shift[frame, camera, person, 2]
            j += run
        u, v = cameras[camera, 2], cameras[camera, 3]
        for j in range(LANES):
            a, b, g = tile[A + j], tile[B + j], tile[PRECISION + j]
            there = (g > 0.0) & (g < math.inf) & (abs(a) + abs(b) < math.inf)
            tile[A + j] = a if there else u
            tile[B + j] = b if there else v
            tile[PRECISION + j] = g if there else 0.0


@compile_kernel
def linearize(tile: Floats, cameras: Floats, camera: int) -> None:
    """Turn the pixels of one of the cameras into equations.

    Observations are dropped where the lens model has no inverse, and for a missing camera.
    """
    if not is_finite(cameras, camera):
        tile[:] = 0.0
        return
    c, is_brown = cameras[camera], cameras[camera, 25] == _BROWN
    over_u, over_v = 1.0 / c[0], 1.0 / c[1]
    for j in range(LANES):
        xd, yd = (tile[A + j] - c[2]) * over_u, (tile[B + j] - c[3]) * over_v
        square = xd * xd + yd * yd
        over = 1.0 / (1.0 + square * (c[4] + square * c[5]))
        x, y = xd * over, yd * over
        # Newton steps that invert most of Brown's lenses to rounding; others are inverted below.
        for _ in range(2):
            fx, fy, dxx, dxy, dyy = distort_brown(x, y, c[4], c[5], c[6], c[7], c[8])
            over = 1.0 / (dxx * dyy - dxy * dxy)
            fx, fy = fx - xd, fy - yd
            x -= (dyy * fx - dxy * fy) * over
            y -= (dxx * fy - dxy * fx) * over
        fx, fy, dxx, dxy, dyy = distort_brown(x, y, c[4], c[5], c[6], c[7], c[8])
        misfit = max(abs(fx - xd), abs(fy - yd))
        # Largest accepted misfit of an inverse on the plane z = 1.
        inside = misfit <= 1e-13 and x * x + y * y < c[21] * c[21]
        # Mark the joints that need the scalar inverse.
        tile[SQUARED + j] = 0.0 if inside else 1.0
        tile[A + LANES + j], tile[B + LANES + j] = x, y
        tile[A + 2 * LANES + j], tile[A + 3 * LANES + j], tile[B + 2 * LANES + j] = dxx, dxy, dyy
    for j in range(LANES):
        if tile[SQUARED + j] > 0.0 or not is_brown:
            numbers = load_camera(cameras, camera)
            x, y, status = undistort(
                numbers, (tile[A + j] - c[2]) / c[0], (tile[B + j] - c[3]) / c[1]
            )
            if status != _OK:
                x = y = tile[PRECISION + j] = 0.0
            _, _, dxx, dxy, dyy = distort(numbers, x, y)
            tile[A + LANES + j], tile[B + LANES + j] = x, y
            tile[A + 2 * LANES + j], tile[A + 3 * LANES + j] = dxx, dxy
            tile[B + 2 * LANES + j] = dyy
    for j in range(LANES):
        x, y = tile[A + LANES + j], tile[B + LANES + j]
        dxx, dxy = tile[A + 2 * LANES + j], tile[A + 3 * LANES + j]
        dyy = tile[B + 2 * LANES + j]
        m00, m01, m10, m11 = c[0] * dxx, c[0] * dxy, c[1] * dxy, c[1] * dyy
        tile[SCALE + j] = abs(m00 * m11 - m01 * m10)
        there = 1.0 if tile[PRECISION + j] > 0.0 else 0.0
        m00, m01, m10, m11 = there * m00, there * m01, there * m10, there * m11
        for k in range(4):
            # Row k of the rotation is at 9 + 3 k, the translation at 18.
            p = c[9 + k] if k < 3 else c[18]
            q = c[12 + k] if k < 3 else c[19]
            r = c[15 + k] if k < 3 else c[20]
            p, q = p - x * r, q - y * r
            tile[A + k * LANES + j] = m00 * p + m01 * q
            tile[B + k * LANES + j] = m10 * p + m11 * q
