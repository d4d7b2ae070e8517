"""Known cameras, and writers of them in the terms of each calibration program."""

import json
import pickle

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from data_contracts.cameras import CameraCalibration

SIZE = (1920, 1080)
LENS = (-0.11, 0.03, 0.0007, -0.0004, -0.002)
POINTS = np.random.default_rng(7).uniform([-1.5, -1.5, 0.0], [1.5, 1.5, 2.0], (60, 3))
"""Where people are, in metres, z up."""


def camera(name, center, lens=LENS):
    """Return a level-headed camera that looks at the middle of the scene, z up, metres."""
    forward = np.array([0.0, 0.0, 1.0]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    tilt = Rotation.from_rotvec([0.0, 0.0, 0.03]).as_matrix()
    rotation = tilt @ np.array([right, np.cross(forward, right), forward])
    return CameraCalibration(
        id=name,
        image_size=SIZE,
        focal_px=(1500.0, 1500.0),
        principal_point_px=(970.5, 530.25),
        distortion=lens,
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple((-rotation @ center).tolist()),
    )


def rig(names=("a1", "b2", "c3"), lens=LENS):
    centers = np.array([[4.0, 1.0, 1.6], [-3.0, 3.5, 2.0], [0.5, -5.0, 1.2]])
    return [camera(name, center, lens) for name, center in zip(names, centers, strict=True)]


def matrix(one):
    (fx, fy), (cx, cy) = one.focal_px, one.principal_point_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(one, points=POINTS):
    turn, _ = cv2.Rodrigues(np.array(one.rotation))
    shift = np.array(one.translation)
    pixels, _ = cv2.projectPoints(points, turn, shift, matrix(one), np.array(one.distortion))
    return pixels[:, 0]


def center_of(one):
    return -np.array(one.rotation).T @ np.array(one.translation)


def write_vicon(folder, cameras, radial=None, frames=1):
    parts = []
    for one in cameras:
        turn = " ".join(map(repr, Rotation.from_matrix(one.rotation).as_quat().tolist()))
        place = " ".join(map(repr, (1000.0 * center_of(one)).tolist()))
        middle = "{!r} {!r}".format(*one.principal_point_px)
        lens = radial if radial is not None else f"Vicon3Parameter {middle} 0 0 0"
        frame = (
            f'<KeyFrame FOCAL_LENGTH="{one.focal_px[0]!r}" FRAME="0" IMAGE_ERROR="0.1" '
            f'ORIENTATION="{turn}" PIXEL_ASPECT_RATIO_CORRECTION="1" POSITION="{place}" '
            f'PRINCIPAL_POINT="{middle}" VICON_RADIAL2="{lens}" WORLD_ERROR="0.4"/>'
        )
        parts.append(
            f'<Camera DEVICEID="{one.id}" DISPLAY_TYPE="VideoInputDevice:Blackfly" ISDV="1" '
            f'PIXEL_ASPECT_RATIO="1" SENSOR_SIZE="{SIZE[0]} {SIZE[1]}" SKEW="0" SYSTEM="DV">'
            f"<KeyFrames>{frame * frames}</KeyFrames></Camera>"
        )
    parts.append('<Camera DEVICEID="99" DISPLAY_TYPE="Vero v2.2" ISDV="0" SYSTEM=""/>')
    text = '<?xml version="1.0" encoding="UTF-8"?>\n<Cameras VERSION="2.0">%s</Cameras>'
    (folder / "Calib.xcp").write_text(text % "\n".join(parts))
    return folder / "Calib.xcp"


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From our world to one with y up: x' = A x."""


def write_optitrack(folder, cameras, mode='VideoType="6"', encoding="utf-16"):
    parts = []
    for one in cameras:
        # Columns are the camera's axes in the world with y up: right, up, backward.
        to_world = Y_UP @ np.array(one.rotation).T @ np.diag([1.0, -1.0, -1.0])
        place = dict(zip("XYZ", (Y_UP @ center_of(one)).tolist(), strict=True))
        turn = {f"OrientMatrix{i}": v for i, v in enumerate(to_world.ravel().tolist())}
        k1, k2, p1, p2, k3 = one.distortion
        lens = {
            "LensCenterX": one.principal_point_px[0],
            "LensCenterY": one.principal_point_px[1],
            "HorizontalFocalLength": one.focal_px[0],
            "VerticalFocalLength": one.focal_px[1],
            **{"k1": k1, "k2": k2, "k3": k3, "TangentialX": p1, "TangentialY": p2},
        }
        parts.append(
            f'<Camera Serial="{one.id}"><Properties CameraID="1" {mode}/>'
            f'<Attributes ImagerPixelWidth="{SIZE[0]}" ImagerPixelHeight="{SIZE[1]}"/>'
            f"<Intrinsic {attributes(lens)}/><IntrinsicStandardCameraModel {attributes(lens)}/>"
            f"<Extrinsic {attributes(place | turn)}/></Camera>"
        )
    marker = '<Camera Serial="M1"><Properties CameraID="9" VideoType="2"/></Camera>'
    text = (
        f'<?xml version="1.0" encoding="{encoding.upper()}"?><calibrationProfile version="1">'
        f"<Calibration><Cameras>{''.join(parts)}{marker}</Cameras></Calibration>"
        "</calibrationProfile>"
    )
    (folder / "Cal.mcal").write_bytes(text.encode(encoding))
    return folder / "Cal.mcal"


def attributes(values):
    return " ".join(f'{key}="{value!r}"' for key, value in values.items())


def write_opencap(folder, cameras, board=None, **changes):
    """Write OpenCap's pickles of cameras in a world that `board` turns into the board's."""
    board = np.eye(3) if board is None else board
    for one in cameras:
        rotation = np.array(one.rotation) @ board.T
        content = {
            "distortion": np.array([one.distortion]),
            "intrinsicMat": matrix(one),
            "imageSize": np.array([[float(SIZE[1])], [float(SIZE[0])]]),
            "rotation": rotation,
            "translation": 1000.0 * np.array(one.translation)[:, None],
            "rotation_EulerAngles": cv2.Rodrigues(rotation)[0],
        } | changes
        place = folder / "Videos" / one.id
        place.mkdir(parents=True, exist_ok=True)
        kept = {key: value for key, value in content.items() if value is not None}
        (place / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps(kept))
    return folder / "Videos"


STANDING = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""From our world to that of a standing board, and back: x' = A x."""


def write_easymocap(folder, cameras, *, sizes=True, pose="R"):
    lenses = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    poses = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (lenses, poses):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for one in cameras:
            storage.write("", one.id)
        storage.endWriteStruct()
    for one in cameras:
        lenses.write(f"K_{one.id}", matrix(one))
        lenses.write(f"dist_{one.id}", np.array([one.distortion]))
        if sizes:
            lenses.write(f"H_{one.id}", SIZE[1])
            lenses.write(f"W_{one.id}", SIZE[0])
        if "R" in pose:
            poses.write(f"R_{one.id}", cv2.Rodrigues(np.array(one.rotation))[0])
        poses.write(f"Rot_{one.id}", np.array(one.rotation))
        poses.write(f"T_{one.id}", np.array(one.translation)[:, None])
    lenses.release()
    poses.release()
    return folder


def write_biocv(folder, cameras):
    for one in cameras:
        pose = np.eye(4)
        pose[:3, :3] = one.rotation
        pose[:3, 3] = 1000.0 * np.array(one.translation)
        lines = ["{}\n{}".format(*SIZE), *rows(matrix(one)), "", *rows(pose), ""]
        lines.append(" ".join(map(repr, one.distortion)))
        (folder / f"{one.id}.calib").write_text("\n".join(lines) + "\n")
    return folder


def rows(array):
    return [" ".join(map(repr, row)) + " " for row in array.tolist()]


def write_freemocap(folder, cameras, metadata="groundplane_calibration = true"):
    tables = []
    for index, one in enumerate(cameras):
        turn = cv2.Rodrigues(np.array(one.rotation))[0].ravel().tolist()
        tables.append(
            f'[cam_{index}]\nname = "{one.id}"\nsize = {list(SIZE)}\n'
            f"matrix = {matrix(one).tolist()}\ndistortions = {list(one.distortion)}\n"
            f"rotation = {turn}\n"
            f"translation = {(1000.0 * np.array(one.translation)).tolist()}\n"
            f"world_position = {(1000.0 * center_of(one)).tolist()}\n"
        )
    tables.append(f"[metadata]\ncharuco_square_size = 58.0\n{metadata}\n")
    (folder / "calibration.toml").write_text("\n".join(tables))
    return folder / "calibration.toml"


def write_panoptic(folder, cameras):
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # of y down to z up
    tables = [
        {
            "name": one.id,
            "type": "hd",
            "resolution": list(SIZE),
            "K": matrix(one).tolist(),
            "distCoef": list(one.distortion),
            "R": (np.array(one.rotation) @ axes).tolist(),
            "t": [[100.0 * value] for value in one.translation],
        }
        for one in cameras
    ]
    path = folder / "calibration_160224.json"
    path.write_text(json.dumps({"calibDataSource": "160224", "cameras": tables}))
    return path


def write_multical(folder, cameras):
    lenses = {
        one.id: {
            "model": "standard",
            "image_size": list(SIZE),
            "K": matrix(one).tolist(),
            "dist": [list(one.distortion)],
        }
        for one in cameras
    }
    poses = {one.id: {"R": one.rotation, "T": one.translation} for one in cameras}
    path = folder / "calibration.json"
    path.write_text(json.dumps({"cameras": lenses, "camera_poses": poses, "image_sets": {}}))
    return path


def write_plain(folder, cameras, shift="t"):
    tables = {
        one.id: {"K": matrix(one).tolist(), "R": one.rotation, shift: one.translation}
        | {"dist": one.distortion, "image_size": SIZE}
        for one in cameras
    }
    path = folder / "calibration.json"
    path.write_text(json.dumps(tables))
    return path


def write_kalibr(folder, cameras, model="radtan"):
    """Write a camchain, whose world is that of the first camera."""
    lines, before = [], None
    for index, one in enumerate(cameras):
        (fx, fy), (cx, cy) = one.focal_px, one.principal_point_px
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = one.rotation, one.translation
        lines += [f"cam{index}:", "  camera_model: pinhole", f"  intrinsics: {[fx, fy, cx, cy]}"]
        lines += [f"  distortion_model: {model}", f"  distortion_coeffs: {[*one.distortion[:4]]}"]
        lines += [f"  resolution: {list(SIZE)}", f"  rostopic: /{one.id}/image"]
        if before is not None:
            step = (pose @ np.linalg.inv(before)).tolist()
            lines += ["  T_cn_cnm1:", *(f"  - {row}" for row in step)]
        before = pose
    (folder / "camchain.yaml").write_text("\n".join(lines) + "\n")
    return folder / "camchain.yaml"


def write_openpose(folder, cameras):
    for one in cameras:
        file = cv2.FileStorage(str(folder / f"{one.id}.xml"), cv2.FILE_STORAGE_WRITE)
        file.write("CameraMatrix", np.c_[np.array(one.rotation), np.array(one.translation)])
        file.write("Intrinsics", matrix(one))
        file.write("Distortion", np.array([*one.distortion, 0.0, 0.0, 0.0])[:, None])
        file.release()
    return folder


WRITERS = {
    "Vicon": write_vicon,
    "OptiTrack": write_optitrack,
    "OpenCap": lambda folder, cameras: write_opencap(folder, cameras, STANDING),
    "EasyMocap": write_easymocap,
    "bioCV": write_biocv,
    "FreeMoCap": write_freemocap,
    "Panoptic": write_panoptic,
    "multical": write_multical,
    "K R t": write_plain,
    "K R T": lambda folder, cameras: write_plain(folder, cameras, "T"),
}
