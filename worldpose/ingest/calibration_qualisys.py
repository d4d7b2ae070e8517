"""Reader of calibrated cameras from Qualisys XML (`.qca.txt`)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration
from worldpose.ingest.given_cameras import (
    NUMBER_LIMIT,
    calibration_error,
    cameras_by_name,
    given_camera,
)
from worldpose.ingest.text_files import SETTINGS_BYTES, require_file


def read_calibration_qualisys(path: Path) -> dict[str, CameraCalibration]:
    """Return the active cameras of a Qualisys calibration by serial, in file order.

    Raises:
        InputError: with file, camera and attribute: unreadable, missing, no finite number, no
            rotation, no camera, or two cameras of one serial.
    """
    size = require_file(path)
    if size > SETTINGS_BYTES:
        raise calibration_error(str(path), f"at most {SETTINGS_BYTES} bytes", f"{size} bytes")
    try:
        root = ET.fromstring(path.read_bytes(), ET.XMLParser(target=_PlainTree()))
    except (ET.ParseError, ValueError, LookupError, OSError) as error:
        raise calibration_error(str(path), "Qualisys XML", str(error)) from error
    cameras = []
    for index, element in enumerate(root.iterfind("cameras/camera")):
        where = f"{path}: camera[{index}]"
        if element.get("active", "1") != "0":
            cameras.append((where, _qualisys_camera(where, element)))
    return cameras_by_name(path, cameras)


class _PlainTree(ET.TreeBuilder):
    """A tree builder that rejects entities, which could expand a small file without limit."""

    def doctype(self, name: str, pubid: str, system: str) -> None:
        raise ValueError(f"a DOCTYPE ({name}), which no calibration has")


def _qualisys_camera(where: str, element: ET.Element) -> CameraCalibration:
    """Return one `<camera>` of a Qualisys calibration, with its `serial` as name.

    `<transform>`: x y z is the camera centre C [mm]; r11..r33 is A, row by row, whose rows are the
    camera's axes in the world: x right, y up, z backward. So R = diag(1, -1, -1) A, t = -R C.

    `<intrinsic>`: focal length and centre point are in 1/64 px of the sensor; `<fov_video>` (px,
    both ends included) is the part of the sensor in the video. The radial and tangential (in the
    file: tangental) coefficients act on the normalised image plane and have no unit, so that they
    need no conversion: only lengths on the sensor are in 1/64 px. (Pose2Sim's reader divides them
    by 64 as well, which nearly removes the distortion.) `viewrotation` rotates only the view in
    QTM; the function ignores it.
    """
    parts = {}
    for tag in ("transform", "intrinsic", "fov_video"):
        part = element.find(tag)
        if part is None:
            raise calibration_error(where, f"<{tag}>", "nothing")
        parts[tag] = part

    def read(tag: str, *keys: str) -> NDArray[np.float64]:
        values = []
        for key in keys:
            text = parts[tag].get(key)
            try:
                values.append(float(text if text is not None else "nothing"))
            except ValueError as error:
                raise calibration_error(f"{where}.{tag}.{key}", "a number", repr(text)) from error
            if not abs(values[-1]) <= NUMBER_LIMIT:
                raise calibration_error(
                    f"{where}.{tag}.{key}", f"up to {NUMBER_LIMIT:g}", repr(text)
                )
        return np.array(values)

    left, top, right, bottom = read("fov_video", "left", "top", "right", "bottom")
    skew = parts["intrinsic"].get("skew", "0")
    if skew.strip("0.+-") != "":
        raise calibration_error(f"{where}.intrinsic.skew", "0", repr(skew))
    axes = read("transform", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3)
    center = read("transform", "x", "y", "z") / 1000.0
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes
    k1, k2, k3 = read("intrinsic", "radialDistortion1", "radialDistortion2", "radialDistortion3")
    p1, p2 = read("intrinsic", "tangentalDistortion1", "tangentalDistortion2")
    return given_camera(
        where,
        element.get("serial", ""),
        size=np.array([right - left + 1, bottom - top + 1]),
        focal=read("intrinsic", "focalLengthU", "focalLengthV") / 64.0,
        principal_point=read("intrinsic", "centerPointU", "centerPointV") / 64.0 - [left, top],
        distortion=np.array([k1, k2, p1, p2, k3]),
        rotation=rotation,
        translation=-rotation @ center,
    )
