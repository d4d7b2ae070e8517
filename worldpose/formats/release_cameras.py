"""Camera files of the WorldPose release, and of the challenge: K, k, R and t over time."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.cameras import CameraCalibration
from worldpose.formats.archives import Member, read_archive, write_archive, wrong
from worldpose.formats.calibration_unit import other_middle
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, nearest_rotation

MEMBERS: Final = {
    "K": Member(("rows", 3, 3), "float"),
    "k": Member(("rows", 5), "float"),
    "R": Member(("rows", 3, 3), "float"),
    "t": Member(("rows", 3), "float"),
}
"""Arrays of a camera file; one row for a static camera, else one per frame."""

LOG = logging.getLogger("worldpose.formats")
RELEASE_SIZE: Final = (1920, 1080)
"""Image size of every released camera [px]; the files do not contain it."""


def write_static_camera(path: Path, calibration: CameraCalibration) -> None:
    """Write a static camera as npz with one row, of names and shapes as in the released files.

    Members, float64: `K` (1, 3, 3) [px], `k` (1, 5) k1 k2 p1 p2 k3, `R` (1, 3, 3) and `t` (1, 3)
    [m] of x_cam = R x_world + t.
    """
    (fx, fy), (cx, cy) = calibration.focal_px, calibration.principal_point_px
    arrays = {
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "k": calibration.distortion,
        "R": calibration.rotation,
        "t": calibration.translation,
    }
    write_archive(
        path, {name: np.array(value, dtype=np.float64)[None] for name, value in arrays.items()}
    )


def write_moving_camera(path: Path, camera: Camera) -> None:
    """Write a moving camera (frames,) in the same layout; NaN where a frame has no camera."""
    write_archive(path, camera_arrays(camera))


def camera_arrays(camera: Camera) -> dict[str, Floats]:
    """Return `MEMBERS` of a moving camera (frames,)."""
    intrinsics = np.zeros((len(camera.focal), 3, 3))
    intrinsics[:, (0, 1), (0, 1)] = camera.focal
    intrinsics[:, :2, 2] = camera.principal_point
    intrinsics[:, 2, 2] = 1.0
    pose = camera.cam_from_world
    distortion = camera.distortion[:, :5]
    return {"K": intrinsics, "k": distortion, "R": pose.rotation, "t": pose.translation}


def read_camera(path: Path, image_size: tuple[int, int] | None = None) -> Camera:
    """Read the camera of a file: a single one if it has one row, else a batch (frames,).

    The batch is NaN where a frame has no camera. `image_size` is width and height [px]; None =
    those of a released camera, or of an image about the principal point where that is off alike
    along both axes. InputError also for a K with skew or without focal length, or an R that is no
    rotation.
    """
    arrays = read_archive(path, MEMBERS)
    k, rotation = arrays["K"], arrays["R"].copy()
    if not len(k):
        raise wrong(f"{path}: K", "one row, or one a frame", "none")
    known = np.all([np.isfinite(a.reshape(len(a), -1)).all(-1) for a in arrays.values()], axis=0)
    shape = np.isclose(k[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0.0, 0.0, 0.0, 0.0, 1.0])
    good = shape.all(-1) & (k[:, [0, 1], [0, 1]] > 0.0).all(-1)
    for row in np.flatnonzero(known):
        if not good[row]:
            raise wrong(
                f"{path}: K[{row}]",
                "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths",
                f"{k[row].tolist()}",
            )
        rotation[row] = nearest_rotation(f"{path}: R[{row}]", rotation[row])
    missing = ~known[:, None]
    if image_size is None:
        middle = np.median(k[known, :2, 2], axis=0) if known.any() else np.zeros(2)
        image_size = RELEASE_SIZE
        if known.any() and (found := other_middle(middle.tolist(), RELEASE_SIZE)):
            around = np.round(2.0 * middle + 1.0)  # (0, 0) is the centre of the first pixel
            image_size = (int(around[0]), int(around[1]))
            LOG.warning("%s: the principal point is %s, which is taken as the size", path, found)
    camera = Camera(
        focal=np.where(missing, np.nan, k[:, [0, 1], [0, 1]]),
        principal_point=k[:, :2, 2],
        distortion=arrays["k"],
        cam_from_world=Rigid(rotation, arrays["t"]),
        image_size=np.array(image_size, dtype=np.int64),
    )
    return camera if len(k) > 1 else camera[0]


_ROW_MEMBERS: Final = MEMBERS | {
    "R": Member(("poses", 3, 3), "float"),
    "t": Member(("poses", 3), "float"),
    "Rt": Member(("poses", 3, 4), "float", required=False),
}
"""Arrays of a camera file; the challenge has R and t of the first frame only, and its 2025
edition repeats them as Rt."""


@dataclass(frozen=True, eq=False)
class CameraRows:
    """Raw arrays of a camera file: one row for a static camera, else one per frame."""

    intrinsics: NDArray[np.float64]
    """(rows, 3, 3), K [px]."""
    distortion: NDArray[np.float64]
    """(rows, 5) k1 k2 p1 p2 k3."""
    rotation: NDArray[np.float64]
    """(rows, 3, 3), R in x_cam = R x_world + t; NaN if the file has none."""
    translation: NDArray[np.float64]
    """(rows, 3) [m], t; NaN if the file has none."""

    def camera(self) -> Camera:
        """Return the camera (rows,), with the image size derived from the principal point."""
        middle = self.intrinsics[:, :2, 2]
        usual = np.where(np.all(np.isfinite(middle), axis=-1)[:, None], middle, 0.5)
        return Camera(
            focal=self.intrinsics[:, (0, 1), (0, 1)],
            principal_point=middle,
            distortion=self.distortion,
            cam_from_world=Rigid(self.rotation, self.translation),
            image_size=np.maximum(np.round(2.0 * usual), 1.0).astype(np.int64),
        )

    def lens(self) -> Camera:
        """Return the camera (rows,) at the origin, for any pose."""
        count = len(self.intrinsics)
        rotation, translation = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
        return CameraRows(self.intrinsics, self.distortion, rotation, translation).camera()


def read_kit_camera(path: Path, image_size: tuple[int, int]) -> Camera:
    """Return the camera (frames,) of a challenge's file, whose pose is NaN where it has none.

    R and t are those of every frame or of the first alone; `image_size` is width and height [px].
    InputError as `read_camera`, and for unequal focal lengths, or distortion beyond k1 and k2.
    """
    arrays = read_archive(path, _ROW_MEMBERS)
    intrinsics, distortion, poses = arrays["K"], arrays["k"], len(arrays["R"])
    if poses not in (1, len(intrinsics)):
        raise wrong(f"{path}: R", f"1 or {len(intrinsics)} frames, as K has", f"{poses}")
    if len(distortion) != len(intrinsics):
        raise wrong(f"{path}: k", f"{len(intrinsics)} frames, as K has", f"{len(distortion)}")
    (fx, skew, _), (low, fy, _) = np.moveaxis(intrinsics[:, :2], 0, -1)
    usual = (fx > 0.0) & (np.abs(fy - fx) <= 1e-3 * np.abs(fx)) & (skew == 0.0) & (low == 0.0)
    usual &= np.isfinite(intrinsics).all((-1, -2))
    brown = np.isfinite(distortion).all(-1) & (distortion[:, 2:] == 0.0).all(-1)
    for name, good, expected in (
        ("K", usual, "finite, without skew, with equal focal lengths above 0"),
        ("k", brown, "finite k1 and k2, then three zeros"),
    ):
        if not good.all():
            row = int(np.argmin(good))
            raise wrong(f"{path}: {name}[{row}]", expected, f"{arrays[name][row].tolist()}")
    rotation, translation = np.full((len(fx), 3, 3), np.nan), np.full((len(fx), 3), np.nan)
    rotation[:poses], translation[:poses] = arrays["R"], arrays["t"]
    known = np.isfinite(rotation).all((-1, -2)) & np.isfinite(translation).all(-1)
    if not known[0]:
        raise wrong(f"{path}: R[0], t[0]", "the pose of the first frame", "NaN")
    for row in np.flatnonzero(known).tolist():
        rotation[row] = nearest_rotation(f"{path}: R[{row}]", rotation[row])
    rotation[~known], translation[~known] = np.nan, np.nan
    return Camera(
        focal=intrinsics[:, (0, 1), (0, 1)],
        principal_point=intrinsics[:, :2, 2],
        distortion=distortion,
        cam_from_world=Rigid(rotation, translation),
        image_size=np.array(image_size, dtype=np.int64),
    )


def read_camera_rows(path: Path) -> CameraRows:
    """Read the rows of a camera file without validation; `read_camera` refuses invalid cameras."""
    arrays = read_archive(path, _ROW_MEMBERS)
    count, poses = len(arrays["K"]), len(arrays["R"])
    rotation, translation = arrays["R"], arrays["t"]
    if count != poses:
        kept = min(count, poses)
        rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        rotation[:kept], translation[:kept] = arrays["R"][:kept], arrays["t"][:kept]
    return CameraRows(arrays["K"], arrays["k"], rotation, translation)
