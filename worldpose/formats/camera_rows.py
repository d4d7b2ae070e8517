"""Raw arrays of camera files of any origin, without validation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.formats.archives import Member, read_archive
from worldpose.geometry import Camera, Rigid

MEMBERS: Final = {
    "K": Member(("rows", 3, 3), "float"),
    "k": Member(("rows", 5), "float"),
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
        still = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
        return CameraRows(self.intrinsics, self.distortion, *still).camera()


def read_camera_rows(path: Path) -> CameraRows:
    """Read the rows of a camera file without validation; `read_camera` refuses invalid cameras.

    Raises:
        InputError: names file and member: absent, members missing or unknown, wrong shapes.
    """
    arrays = read_archive(path, MEMBERS)
    count, poses = len(arrays["K"]), len(arrays["R"])
    rotation, translation = arrays["R"], arrays["t"]
    if count != poses:
        kept = min(count, poses)
        rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        rotation[:kept], translation[:kept] = arrays["R"][:kept], arrays["t"][:kept]
    return CameraRows(arrays["K"], arrays["k"], rotation, translation)
