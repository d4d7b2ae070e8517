"""Writer of calibrated cameras as TOML of Anipose, Pose2Sim and `calibration_files`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from data_contracts.cameras import CameraCalibration, LensCalibration


def order_entry(lens: CameraCalibration | LensCalibration) -> list[str]:
    """Return the TOML line that says the order of coefficients; none if readers do not doubt it."""
    # p1 and p2 up to here [1] are of OpenCV's order without saying so.
    if lens.lens_model == "fisheye" or max(map(abs, lens.distortion[2:4])) <= 0.01:
        return []
    return ['distortion_model = "plumb_bob"']


def write_calibration_toml(path: Path, calibrations: Mapping[str, CameraCalibration]) -> None:
    """Write cameras in the form that Anipose, Pose2Sim and `read_calibration` read.

    Numbers keep all digits. A rotation becomes a Rodrigues vector, the only form that all of them
    read, with rounding errors of 1e-15 on reading.
    """
    from scipy.spatial.transform import Rotation  # late: it takes 0.1 s

    lines = []
    for index, (name, camera) in enumerate(calibrations.items()):
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_point_px
        rotvec = Rotation.from_matrix(np.array(camera.rotation)).as_rotvec()
        lines += [
            f"[cam_{index}]",
            f'name = "{name}"',
            f"size = {list(camera.image_size)}",
            f"matrix = {[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]}",
            f"distortions = {list(camera.distortion)}",
            f"rotation = {rotvec.tolist()}",
            f"translation = {list(camera.translation)}",
            f"fisheye = {str(camera.lens_model == 'fisheye').lower()}",
            *order_entry(camera),
            "",
        ]
    lines += ["[metadata]", "adjusted = false", "error = 0.0", ""]
    path.write_text("\n".join(lines), encoding="utf-8")
