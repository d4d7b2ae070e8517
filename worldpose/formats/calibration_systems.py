"""Readers of the calibrations of motion capture systems: Qualisys, Vicon and OptiTrack (XML)."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import COEFFICIENTS, CameraCalibration
from worldpose.errors import InputError, say_failure
from worldpose.formats.calibration_files import (
    NUMBER_LIMIT,
    LeftOut,
    Optics,
    build_camera,
    calibration_error,
    index_by_name,
)
from worldpose.formats.calibration_unit import MILLIMETRE
from worldpose.formats.files import SETTINGS_BYTES, parse_xml, require_file
from worldpose.parsing import decimal_point

LENS_ERROR_PX: Final = 0.1
"""Maximum error of OpenCV's coefficients fitted to Vicon's lens, within the image [px]: a tenth of
the error with which a detector finds a joint."""


BACKWARD: Final = np.diag([1.0, -1.0, -1.0])
"""(3, 3) from camera axes x right, y up, z backward to OpenCV's."""


def read_calibration_xml(
    path: Path, left_out: LeftOut | None = None
) -> dict[str, CameraCalibration]:
    """Return the cameras of a calibration of Qualisys, Vicon or OptiTrack, in file order.

    The root element tells the system: `calibration`, `Cameras` or `calibrationProfile`. Parameters
    that Qualisys' server states (`QTM_Parameters_Ver_...`) contain the first. `left_out` receives
    cameras that are not calibrated; None = all must be.
    """
    require_file(path, 16 * SETTINGS_BYTES)
    try:
        root = parse_xml(path.read_bytes())
    except (ValueError, OSError) as error:
        raise calibration_error(
            str(path), "XML of Qualisys, Vicon or OptiTrack", say_failure(error)
        ) from error
    if root.tag.startswith("QTM_Parameters"):
        root = _child(str(path), root, "calibration")
    readers = {
        "calibration": _read_qualisys,
        "Cameras": _read_vicon,
        "calibrationProfile": _read_optitrack,
    }
    if root.tag not in readers:
        expected = (
            "<calibration> of Qualisys, <Cameras> of Vicon, or <calibrationProfile> of OptiTrack"
        )
        todo = "Export the calibration of the system again."
        raise InputError(f"{path}: <{root.tag:.40}>", expected, f"<{root.tag:.40}>", todo)
    return readers[root.tag](path, root, left_out)


def _child(where: str, element: ET.Element, tag: str) -> ET.Element:
    part = element.find(tag)
    if part is None:
        raise calibration_error(where, f"<{tag}>", "nothing")
    return part


def _numbers(where: str, element: ET.Element, keys: Sequence[str]) -> NDArray[np.float64]:
    """Return attributes of one number each."""
    return np.concatenate([_parse(f"{where}.{key}", element.get(key), 1) for key in keys])


def _parse(where: str, text: str | None, count: int) -> NDArray[np.float64]:
    """Return the numbers of an attribute, separated by spaces."""
    if text is None:
        raise calibration_error(where, "a number" if count == 1 else f"{count} numbers", "nothing")
    try:
        # Some systems write decimal commas.
        values = np.array([float(decimal_point(each)) for each in text.split()])
    except ValueError as error:
        raise calibration_error(where, "numbers", f"{text!r:.60}") from error
    if len(values) != count:
        raise calibration_error(where, f"{count} numbers", f"{text!r:.60}")
    if not np.all(np.abs(values) <= NUMBER_LIMIT):  # also NaN
        raise calibration_error(where, f"finite numbers up to {NUMBER_LIMIT:g}", f"{text!r:.60}")
    return values


def _read_qualisys(
    path: Path, root: ET.Element, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return the active cameras by serial; the video cameras alone if some are called so."""
    every = [
        (f"{path}: camera[{index}]", element)
        for index, element in enumerate(root.iterfind("cameras/camera"))
    ]
    # Those that the file calls inactive are left out in any case.
    off = ("0", "false")
    active = [each for each in every if each[1].get("active", "1").lower() not in off]
    if left_out is not None and active:
        gone = [each for each in every if each not in active]
        left_out.update({element.get("serial", where): "it is inactive" for where, element in gone})
    has_video = any(re.search("video|hybrid", each.get("model", "").lower()) for _, each in active)
    has_fov = any(element.find("fov_video") is not None for _, element in active)
    lacks = [_qualisys_lack(element, has_video, has_fov) for _, element in active]
    if left_out is not None and not all(lacks):
        for (where, element), why in zip(active, lacks, strict=True):
            if why:
                left_out[element.get("serial", where)] = why
        active = [each for each, why in zip(active, lacks, strict=True) if not why]
    cameras = [(where, _read_qualisys_camera(where, element)) for where, element in active]
    return index_by_name(path, cameras)


def _qualisys_lack(element: ET.Element, has_video: bool, has_fov: bool) -> str:
    """Return why a camera makes no calibrated video; empty if it does."""
    model = element.get("model", "")
    if has_video and not re.search("video|hybrid", model.lower()):
        return f"it records markers ({model})"
    if has_fov and element.find("fov_video") is None:
        return "it makes no video (no fov_video)"
    if element.get("calibrated", "1").lower() in ("0", "false"):
        return "it is not calibrated (calibrated is false)"
    place = element.find("transform")
    axes = [] if place is None else [place.get(f"r{i}{j}", "") for i in "123" for j in "123"]
    if all(re.fullmatch(r"-?0*[.,]?0*", text) for text in axes):
        return "it is not calibrated (its rotation is zero)"
    return ""


def _read_qualisys_camera(where: str, element: ET.Element) -> CameraCalibration:
    """Return one `<camera>` of a Qualisys calibration, with its `serial` as name.

    `<transform>`: x y z is the camera centre C [mm]; r11..r33 is A, row by row, whose rows are the
    camera's axes in the world: x right, y up, z backward. So R = diag(1, -1, -1) A, t = -R C.

    `<intrinsic>`: focal length and centre point are in 1/64 px of the sensor, or in px where the
    sensor (`sensorMaxU`) is; `<fov_video>` (px, both ends included) is the part of the sensor in
    the video, the whole one in files without it. The radial and tangential (in the file: tangental)
    coefficients act on the normalised image plane and have no unit. (Pose2Sim's reader divides them
    by 64, which nearly removes the distortion.) `viewrotation` rotates only the view in QTM; the
    function ignores it.
    """
    parts = {tag: _child(where, element, tag) for tag in ("transform", "intrinsic")}
    fov = element.find("fov_video")
    parts |= {} if fov is None else {"fov_video": fov}

    def read(tag: str, keys: Sequence[str]) -> NDArray[np.float64]:
        return _numbers(f"{where}.{tag}", parts[tag], keys)

    largest_px = 16384  # more are no pixels of a sensor, but parts of them
    unit = 1.0 / 64.0
    if fov is None or parts["intrinsic"].get("sensorMaxU") is not None:
        last = read("intrinsic", ("sensorMaxU", "sensorMaxV"))
        unit = unit if last.max() > largest_px else 1.0
        last = 2.0 * np.ceil(0.5 * unit * last) - 1.0  # sensors have even sides
    if fov is None:
        left, top, right, bottom = 0.0, 0.0, *last
    else:
        left, top, right, bottom = read("fov_video", ("left", "top", "right", "bottom"))
    skew = parts["intrinsic"].get("skew", "0")
    if _parse(f"{where}.intrinsic.skew", skew, 1)[0] != 0.0:
        raise calibration_error(f"{where}.intrinsic.skew", "0", repr(skew))
    axes = read("transform", [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(3, 3)
    center = MILLIMETRE * read("transform", "xyz")
    rotation = BACKWARD @ axes
    k1, k2, k3 = read("intrinsic", [f"radialDistortion{i}" for i in (1, 2, 3)])
    p1, p2 = read("intrinsic", ("tangentalDistortion1", "tangentalDistortion2"))
    return build_camera(
        where,
        element.get("serial", ""),
        Optics(
            np.array([right - left + 1, bottom - top + 1]),
            unit * read("intrinsic", ("focalLengthU", "focalLengthV")),
            unit * read("intrinsic", ("centerPointU", "centerPointV")) - [left, top],
            np.array([k1, k2, p1, p2, k3]),
        ),
        rotation=rotation,
        translation=-rotation @ center,
    )


def _read_vicon(
    path: Path, root: ET.Element, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return the video cameras of an XCP file by device id; those for markers make no video."""
    elements: list[tuple[str, ET.Element]] = []
    others: dict[str, str] = {}
    for index, element in enumerate(root.iterfind("Camera")):
        where = f"{path}: Camera[{index}]"
        kind = f"{element.get('DISPLAY_TYPE', '')} {element.get('TYPE', '')}".lower()
        is_digital = element.get("SYSTEM") == "DV" or element.get("ISDV", "0") not in ("", "0")
        if is_digital or "video" in kind or "vue" in kind:
            elements.append((where, element))
        else:
            others[element.get("DEVICEID", where)] = element.get("DISPLAY_TYPE", "?")
    posed = [each for each in elements if each[1].find("KeyFrames/KeyFrame") is not None]
    if left_out is not None and posed:
        names = {element.get("DEVICEID", where) for where, element in elements}
        names -= {element.get("DEVICEID", where) for where, element in posed}
        left_out.update(dict.fromkeys(others, "it records markers"))
        left_out.update(dict.fromkeys(sorted(names), "it is not calibrated (no KeyFrame)"))
        elements = posed
    if others and not elements:
        expected = "a video camera (SYSTEM DV, ISDV, VideoInputDevice or Vue)"
        todo = "Calibrate the video cameras with the others, and export again."
        found = f"cameras for markers alone: {', '.join(sorted(set(others.values()))):.80}"
        raise InputError(str(path), expected, found, todo)
    cameras = [(where, _read_vicon_camera(where, element, left_out)) for where, element in elements]
    return index_by_name(path, cameras)


def _read_vicon_camera(
    where: str, element: ET.Element, left_out: LeftOut | None
) -> CameraCalibration:
    """Return one `<Camera>` of an XCP file, in pixels of its sensor.

    The one `<KeyFrame>` of a static camera has the centre C (POSITION [mm]) and a quaternion
    (ORIENTATION, x y z w) of the rotation from the world to OpenCV's camera axes; z is up. The
    lens: see `_vicon_optics`. Format: Vicon's "About calibration data (XCP) files".
    """
    name = element.get("DEVICEID", "")
    frames = element.findall("KeyFrames/KeyFrame")
    where = f"{where} {name}".rstrip()
    if len(frames) != 1:
        found = str(len(frames)) if frames else "none: the camera is not calibrated"
        todo = "Calibrate the camera, or take it out of the file."
        raise InputError(
            f"{where}.KeyFrames", "one KeyFrame, of a camera that does not move", found, todo
        )
    (frame,) = frames
    for holder, key, only in (
        (element, "PIXEL_ASPECT_RATIO", 1.0),
        (frame, "PIXEL_ASPECT_RATIO_CORRECTION", 1.0),
        (element, "SKEW", 0.0),
    ):
        given = holder.get(key)
        if given is not None and float(_parse(f"{where}.{key}", given, 1)[0]) != only:
            raise calibration_error(f"{where}.{key}", f"{only:g}: square pixels", repr(given))
    size = _parse(f"{where}.SENSOR_SIZE", element.get("SENSOR_SIZE"), 2)
    (focal,) = _parse(f"{where}.FOCAL_LENGTH", frame.get("FOCAL_LENGTH"), 1)
    middle = _parse(f"{where}.PRINCIPAL_POINT", frame.get("PRINCIPAL_POINT"), 2)
    turn = _parse(f"{where}.ORIENTATION", frame.get("ORIENTATION"), 4)
    center = MILLIMETRE * _parse(f"{where}.POSITION", frame.get("POSITION"), 3)
    norm = float(np.linalg.norm(turn))
    if abs(norm - 1.0) > 1e-3:
        raise calibration_error(f"{where}.ORIENTATION", "a quaternion of length 1", f"{norm:g}")
    from scipy.spatial.transform import Rotation  # late: it takes 0.1 s, and few files need it

    rotation = Rotation.from_quat(turn).as_matrix()
    optics, error = _vicon_optics(where, frame, size, focal, middle)
    if left_out is not None and error > 0.0:
        how = f"{optics.lens_model} coefficients follow Vicon's lens within {error:.2g} px"
        left_out.notes.append(f"camera {name}: {how}")
    return build_camera(where, name, optics, rotation=rotation, translation=-rotation @ center)


def _vicon_optics(
    where: str,
    frame: ET.Element,
    size: NDArray[np.float64],
    focal: float,
    middle: NDArray[np.float64],
) -> tuple[Optics, float]:
    """Return the optics with a lens of OpenCV's models that follows Vicon's, and its error [px].

    Vicon's model goes from the pixel in the image to that without distortion: the offset d from the
    center of distortion is scaled by 1 + w1 d^2 + w2 d^4 + w3 d^6 [px]. `VICON_RADIAL2` is
    "Vicon3Parameter" with that center and w1, w2, w3; `VICON_RADIAL` is w1, w2, about the principal
    point. OpenCV's model goes the other way, on the plane at distance 1. InputError for a model
    that folds the image, or that OpenCV's coefficients do not follow within `LENS_ERROR_PX`.
    """
    text = frame.get("VICON_RADIAL2")
    if text is not None:
        model, _, rest = text.strip().partition(" ")
        if model != "Vicon3Parameter":
            expected = "Vicon3Parameter, the center, and three coefficients"
            todo = "Calibrate with the three-parameter lens model."
            raise InputError(f"{where}.VICON_RADIAL2", expected, f"{text!r:.60}", todo)
        numbers = _parse(f"{where}.VICON_RADIAL2", rest, 5)
        about, terms = numbers[:2], numbers[2:]
    else:
        about = middle
        terms = np.append(_parse(f"{where}.VICON_RADIAL", frame.get("VICON_RADIAL"), 2), 0.0)
    if not np.any(terms) or not np.all(size >= 1) or focal <= 0.0:
        # `build_camera` refuses an impossible size and focal length.
        return Optics(size, np.full(2, focal), middle, np.zeros(5)), 0.0
    across = np.stack(
        np.meshgrid(*(np.linspace(-0.5, length - 0.5, 41) for length in size)), axis=-1
    ).reshape(-1, 2)
    offset = across - about
    square = np.sum(offset**2, axis=-1, keepdims=True)
    powers = np.concatenate([np.ones_like(square), square, square**2, square**3], axis=-1)
    ideal = about + offset * (powers @ np.append(1.0, terms))[:, None]
    slope = powers @ (np.append(1.0, terms) * [1.0, 3.0, 5.0, 7.0])
    if slope.min() > 0.0:
        from worldpose.geometry.cameras import Camera  # late: few files need the kernels
        from worldpose.geometry.lens_fit import INTRINSICS, fit_lens
        from worldpose.geometry.lens_models import LensModel
        from worldpose.geometry.rigid import Rigid

        at = Rigid.identity()
        lens = Camera(np.full(2, focal), middle, np.zeros(8), at, size.astype(np.int64))
        for kind, names in (
            (LensModel.BROWN, COEFFICIENTS["brown"]),
            (LensModel.RATIONAL, COEFFICIENTS["rational"]),
            (LensModel.RATIONAL, (*INTRINSICS, *COEFFICIENTS["rational"])),
        ):
            fit = fit_lens(lens, (ideal - middle) / focal, across, kind, names)
            if fit.error_px <= LENS_ERROR_PX:
                lens = fit.camera
                place = lens.principal_point
                optics = Optics(size, lens.focal, place, lens.coefficients, kind.label)
                return optics, fit.error_px
    raise InputError(
        f"{where}.VICON_RADIAL2" if text is not None else f"{where}.VICON_RADIAL",
        expected=f"a lens that k1 to k6, p1 and p2 follow within {LENS_ERROR_PX:g} px",
        found="one that folds the image" if slope.min() <= 0.0 else f"{fit.error_px:.2g} px",
        todo="Correct the videos for distortion in Vicon's program, and set the coefficients to 0.",
    )


def _read_optitrack(
    path: Path, root: ET.Element, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return the cameras of a Motive calibration that film, by serial; all if none does.

    Colour cameras (serial C...) and those in grayscale or MJPEG mode film (VideoType 1 or 6); the
    others record markers.
    """
    filming, every = [], []
    for index, element in enumerate(root.iterfind("Calibration/Cameras/Camera")):
        properties = element.find("Properties")
        mode = {} if properties is None else properties.attrib
        if mode.get("Enabled", "1") == "0":
            continue
        every.append((f"{path}: Camera[{index}]", element))
        if element.get("Serial", "").startswith("C") or mode.get("VideoType") in ("1", "6"):
            filming.append(every[-1])
    chosen = filming or every
    if left_out is not None:
        others = [element.get("Serial", where) for where, element in every]
        filmed = {element.get("Serial", where) for where, element in chosen}
        left_out.update({name: "it records markers" for name in others if name not in filmed})
    return index_by_name(
        path, [(where, _read_optitrack_camera(where, element)) for where, element in chosen]
    )


def _read_optitrack_camera(where: str, element: ET.Element) -> CameraCalibration:
    """Return one `<Camera>` of a Motive calibration (.mcal of Motive 3.2 or later).

    `<Extrinsic>`: X Y Z is the centre C [m]; OrientMatrix0..8 is A, row by row, from the camera's
    axes (x right, y up, z backward) to the world, whose y is up. `<IntrinsicStandardCameraModel>`
    has OpenCV's coefficients in pixels; Motive's own `<Intrinsic>` has another model. The world is
    turned to z up: x stays, y is minus the file's z.
    """
    name = element.get("Serial", "")
    where = f"{where} {name}".rstrip()
    image = _child(where, element, "Attributes")
    lens = element.find("IntrinsicStandardCameraModel")
    if lens is None:
        raise InputError(
            f"{where}.IntrinsicStandardCameraModel",
            expected="the lens in OpenCV's model",
            found="Motive's own model alone"
            if element.find("Intrinsic") is not None
            else "no lens",
            todo="Export the calibration (.mcal) from Motive 3.2 or later.",
        )
    place = _child(where, element, "Extrinsic")
    optics, pose = f"{where}.IntrinsicStandardCameraModel", f"{where}.Extrinsic"
    k1, k2, k3 = _numbers(optics, lens, ("k1", "k2", "k3"))
    p1, p2 = _numbers(optics, lens, ("TangentialX", "TangentialY"))
    axes = _numbers(pose, place, [f"OrientMatrix{index}" for index in range(9)]).reshape(3, 3)
    # (3, 3) from a world with y up to one with z up: x stays, y becomes minus z.
    y_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotation = BACKWARD @ axes.T @ y_up.T
    return build_camera(
        where,
        name,
        Optics(
            _numbers(f"{where}.Attributes", image, ("ImagerPixelWidth", "ImagerPixelHeight")),
            _numbers(optics, lens, ("HorizontalFocalLength", "VerticalFocalLength")),
            _numbers(optics, lens, ("LensCenterX", "LensCenterY")),
            np.array([k1, k2, p1, p2, k3]),
        ),
        rotation=rotation,
        translation=-rotation @ (y_up @ _numbers(pose, place, "XYZ")),
    )
