"""Cameras in the form of the WorldPose release: K, k, R, t over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.cameras import CameraCalibration
from worldpose.release.archives import write_archive


def write_static_camera(path: Path, calibration: CameraCalibration) -> None:
    """Write a camera that never moves as npz with one row.

    Members, float64: `K` (1, 3, 3) [px], `k` (1, 5) k1 k2 p1 p2 k3, `R` (1, 3, 3) and `t` (1, 3)
    [m] of x_cam = R x_world + t.

    Note:
        X3: the names and shapes are those of the released files, which have one row a frame.
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
