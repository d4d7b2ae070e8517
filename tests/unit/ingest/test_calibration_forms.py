"""Calibrations of other programs: known cameras written in each form, and bad files of each."""

import json
import os
import pickle
import re
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.calibration_forms import FORMS, read_calibration, read_cameras

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
    """Return OpenCV's pixels of world points [m]."""
    turn, _ = cv2.Rodrigues(np.array(one.rotation))
    shift = np.array(one.translation)
    pixels, _ = cv2.projectPoints(points, turn, shift, matrix(one), np.array(one.distortion))
    return pixels[:, 0]


def center_of(one):
    return -np.array(one.rotation).T @ np.array(one.translation)


def assert_same(found, known):
    assert list(found) == [one.id for one in known]
    for one in known:
        other = found[one.id]
        assert other.image_size == one.image_size
        np.testing.assert_allclose(other.focal_px, one.focal_px, rtol=0, atol=1e-6)
        np.testing.assert_allclose(other.principal_point_px, one.principal_point_px, atol=1e-6)
        np.testing.assert_allclose(other.distortion, one.distortion, rtol=0, atol=1e-6)
        np.testing.assert_allclose(other.rotation, one.rotation, rtol=0, atol=1e-6)
        np.testing.assert_allclose(other.translation, one.translation, rtol=0, atol=1e-6)
        # 1e-6 of a radian is 0.0015 px.
        np.testing.assert_allclose(project(other), project(one), atol=0.005)


# Writers of known cameras, each in the terms of its program.


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


WRITERS = {
    "Vicon": write_vicon,
    "OptiTrack": write_optitrack,
    "OpenCap": lambda folder, cameras: write_opencap(folder, cameras, STANDING),
    "EasyMocap": write_easymocap,
    "bioCV": write_biocv,
    "FreeMoCap": write_freemocap,
}


@pytest.mark.parametrize("form", WRITERS)
def test_known_cameras_are_read_back(tmp_path, form):
    known = rig(lens=(0.0,) * 5 if form == "Vicon" else LENS)
    assert_same(read_calibration(WRITERS[form](tmp_path, known)), known)


@pytest.mark.parametrize("form", WRITERS)
def test_a_folder_with_one_calibration_stands_for_it(tmp_path, form):
    known = rig(lens=(0.0,) * 5 if form == "Vicon" else LENS)
    path = WRITERS[form](tmp_path, known)
    folder = path if path.is_dir() else path.parent
    (folder / "Config.toml").write_text("[project]\n")
    (folder / "notes.md").write_text("# notes\n")
    assert_same(read_calibration(folder), known)
    assert list(read_cameras(folder)) == [one.id for one in known]


@pytest.mark.parametrize(
    "board",
    [
        STANDING,
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
        np.diag([1.0, -1.0, -1.0]),
    ],
    ids=["standing", "on its head", "lying"],
)
def test_opencaps_board_may_stand_or_lie(tmp_path, board):
    known = rig()
    assert_same(read_calibration(write_opencap(tmp_path, known, board)), known)


def distort_by_vicon(one, middle, terms):
    """Return the pixels that Vicon's model gives world points, by bisection of its polynomial."""
    flat = one.model_copy(update={"distortion": (0.0,) * 5})
    offsets = project(flat) - middle
    pixels = []
    for offset in offsets:
        wanted = np.linalg.norm(offset)
        length = brentq(
            lambda r, wanted=wanted: r * np.polyval([*terms[::-1], 1.0], r * r) - wanted,
            0.0,
            2.0 * wanted + 1.0,
            xtol=1e-10,
        )
        pixels.append(middle + offset * length / wanted)
    return np.array(pixels)


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_vicons_lens_goes_the_other_way(tmp_path, shift):
    known = rig(lens=(0.0,) * 5)
    # 4 % at the corner of the image, as of a wide lens.
    terms = np.array([3.1e-8, 2.0e-15, -1.0e-22])
    middle = np.array(known[0].principal_point_px) + shift
    radial = "Vicon3Parameter " + " ".join(map(repr, [*middle.tolist(), *terms.tolist()]))
    found = read_calibration(write_vicon(tmp_path, known, radial))
    for one in known:
        expected = distort_by_vicon(one, middle, terms)
        inside = np.all((expected > 0) & (expected < SIZE), axis=-1)
        assert inside.sum() > 20
        error = np.abs(project(found[one.id]) - expected)[inside].max()
        flat = np.abs(project(one) - expected)[inside].max()
        assert error < 0.1 < 3.0 < flat


def test_vicons_older_lens_has_two_terms_about_the_principal_point(tmp_path):
    known = rig(lens=(0.0,) * 5)
    path = write_vicon(tmp_path, known)
    path.write_text(re.sub(r'VICON_RADIAL2="[^"]*"', 'VICON_RADIAL="3e-8 1e-15"', path.read_text()))
    found = read_calibration(path)[known[0].id]
    expected = distort_by_vicon(known[0], np.array(known[0].principal_point_px), [3e-8, 1e-15, 0])
    inside = np.all((expected > 0) & (expected < SIZE), axis=-1)
    np.testing.assert_allclose(project(found)[inside], expected[inside], atol=0.1)


def test_a_vicon_camera_looks_where_a_real_one_looks(tmp_path):
    """A file of Nexus 2.16 from a laboratory, which its owner made public.

    The camera is 6.5 m from the origin at a height of 1.8 m, and the scene is around the origin:
    the camera must look at it, with its image's bottom towards the floor.
    """
    (tmp_path / "c.xcp").write_text(
        '<Cameras><Camera DEVICEID="51433950" ISDV="1" PIXEL_ASPECT_RATIO="1" SYSTEM="DV" '
        'SENSOR_SIZE="1920 1200"><KeyFrames><KeyFrame FOCAL_LENGTH="2020.2893760912" '
        'ORIENTATION="0.0212356595799633 0.774555124454236 -0.632128503215528 0.00519243357047355" '
        'POSITION="-28.8969712138325 6497.81893431526 1828.97203757617" PRINCIPAL_POINT="960 600" '
        'VICON_RADIAL="0 0"/></KeyFrames></Camera></Cameras>'
    )
    found = read_calibration(tmp_path / "c.xcp")["51433950"]
    low, high = project(found, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.all((low > 0) & (low < [1920, 1200]))
    assert low[1] > high[1] + 200


def test_an_optitrack_camera_looks_where_a_real_one_looks(tmp_path):
    """Extrinsics of a colour camera of Motive 3 that were published with their projection."""
    place = {"X": -0.268640, "Y": 2.655145, "Z": -3.509723}
    turn = [-0.995356, -0.046982, 0.084021, 0.000355, 0.871016, 0.491255]
    turn += [-0.096264, 0.489003, -0.866954]
    lens = {
        **{"LensCenterX": 960.596, "LensCenterY": 538.614, "k1": 0.136385, "k2": -0.125546},
        **{"HorizontalFocalLength": 1247.841, "VerticalFocalLength": 1247.755, "k3": 0.000035},
        **{"TangentialX": 0.000259, "TangentialY": -0.000259},
    }
    place |= {f"OrientMatrix{index}": value for index, value in enumerate(turn)}
    (tmp_path / "c.mcal").write_text(
        '<calibrationProfile><Calibration><Cameras><Camera Serial="C11764">'
        '<Attributes ImagerPixelWidth="1920" ImagerPixelHeight="1080"/>'
        f"<IntrinsicStandardCameraModel {attributes(lens)}/><Extrinsic {attributes(place)}/>"
        "</Camera></Cameras></Calibration></calibrationProfile>"
    )
    found = read_calibration(tmp_path / "c.mcal")["C11764"]
    # The same point by the published recipe: y up, rows as they stand, a negative focal length.
    world = np.array([0.2, 1.1, 0.3])  # y up
    x, y, z = np.array(turn).reshape(3, 3).T @ (world - [place[axis] for axis in "XYZ"])
    flat = found.model_copy(update={"distortion": (0.0,) * 5})
    pixel = project(flat, np.array([[0.2, -0.3, 1.1]]))[0]
    np.testing.assert_allclose(
        pixel, [960.596 - 1247.841 * x / z, 538.614 + 1247.755 * y / z], atol=0.01
    )
    np.testing.assert_allclose(center_of(found), [-0.268640, 3.509723, 2.655145], atol=1e-4)
    assert np.all((pixel > 0) & (pixel < SIZE))


def test_cameras_that_record_markers_are_left_out(tmp_path):
    known = rig(("C1", "C2", "C3"))
    found = read_calibration(write_optitrack(tmp_path, known, mode='VideoType="2"'))
    assert_same(found, known)
    path = write_vicon(tmp_path, rig(lens=(0.0,) * 5))
    text = path.read_text().replace('ISDV="1"', 'ISDV="0"').replace('SYSTEM="DV"', 'SYSTEM=""')
    path.write_text(text.replace("VideoInputDevice:Blackfly", "Vantage"))
    with pytest.raises(InputError, match=r"expected a video camera .* found .*Vantage, Vero"):
        read_calibration(path)


def test_a_pickle_runs_nothing(tmp_path):
    class Attack:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    path = tmp_path / "Cam0.pickle"
    path.write_bytes(pickle.dumps({"rotation": Attack()}))
    with pytest.raises(InputError, match=r"mkdir, which is not allowed. .*Nothing in this file"):
        read_calibration(path)
    assert not (tmp_path / "ran").exists()


def test_a_folder_with_several_calibrations_asks_for_one(tmp_path):
    write_vicon(tmp_path, rig())
    write_biocv(tmp_path, rig())
    write_easymocap(tmp_path, rig())
    with pytest.raises(InputError) as refused:
        read_calibration(tmp_path)
    listed = "Calib.xcp (Vicon); extri.yml and 1 more (EasyMocap); a1.calib and 2 more (bioCV)"
    assert listed in str(refused.value)
    assert "Give the file that is meant" in str(refused.value)
    assert_same(read_calibration(tmp_path / "intri.yml"), rig())


def test_unknown_files_and_empty_folders_name_all_forms(tmp_path):
    (tmp_path / "old.cal").write_bytes(b"\x00\x01")
    for path, found, todo in (
        (tmp_path, "found none", "Export the calibration"),
        (tmp_path / "old.cal", "ends in '.cal'", "Motive 3.2 or later"),
    ):
        with pytest.raises(InputError) as refused:
            read_calibration(path)
        assert found in str(refused.value) and todo in str(refused.value)
        for form in FORMS:
            assert form.name in str(refused.value) and form.endings[0] in str(refused.value)


def spoil_text(path, old, new):
    encoding = "utf-16" if path.suffix == ".mcal" else "utf-8"
    text = path.read_bytes().decode(encoding)
    spoilt = re.sub(old, new, text, count=1)
    assert spoilt != text, old
    path.write_bytes(spoilt.encode(encoding))


BAD_TEXT = {
    "Vicon": [
        (' FOCAL_LENGTH="[^"]*"', "", r"Camera\[0\] a1.FOCAL_LENGTH: expected a number"),
        ('FOCAL_LENGTH="[^"]*"', 'FOCAL_LENGTH="nan"', "FOCAL_LENGTH: expected finite"),
        ('FOCAL_LENGTH="[^"]*"', 'FOCAL_LENGTH="8.5"', "focal length: expected positive pixels"),
        ('FOCAL_LENGTH="[^"]*"', 'FOCAL_LENGTH="-1500"', "focal length: expected positive pixels"),
        (' POSITION="[^"]*"', ' POSITION="1 2"', "POSITION: expected 3 numbers"),
        (' POSITION="[^"]*"', ' POSITION="1 2 x"', "POSITION: expected numbers"),
        ('ORIENTATION="[^"]*"', 'ORIENTATION="1 1 0 0"', "a quaternion of length 1, found 1.41"),
        ('SENSOR_SIZE="[^"]*"', 'SENSOR_SIZE="1920"', "SENSOR_SIZE: expected 2 numbers"),
        ('PIXEL_ASPECT_RATIO="1"', 'PIXEL_ASPECT_RATIO="1.1"', "expected 1: square pixels"),
        ('SKEW="0"', 'SKEW="2"', "SKEW: expected 0: square pixels"),
        ("Vicon3Parameter", "Vicon5Parameter", "expected Vicon3Parameter"),
        ('Vicon3Parameter [^"]*', "Vicon3Parameter 960 540 1", "RADIAL2: expected 5 numbers"),
        ('0 0 0"', '-4e-7 0 0"', "found one that folds the image"),
        ('0 0 0"', '1e-8 1e-12 9e-18"', r"follow within 0.1 px, found"),
        ("<KeyFrame .*?/>", "", "none: the camera is not calibrated"),
        (r"(<KeyFrame .*?/>)", r"\1\1", "of a camera that does not move, found 2"),
        ('DEVICEID="b2"', 'DEVICEID="a1"', "a name of its own, found 'a1' a second time"),
        ('DEVICEID="b2"', 'DEVICEID="b/2"', "name: expected up to 64 letters"),
        ("</Cameras>", "", "expected XML of Qualisys, Vicon or OptiTrack"),
        ("<Cameras", "<Camera", "mismatched"),
    ],
    "OptiTrack": [
        ("<IntrinsicStandardCameraModel[^>]*>", "", "found Motive's own model alone"),
        ('(CameraModel [^>]*) k3="[^"]*"', r"\1", "k3: expected a number"),
        ("<Extrinsic[^>]*/>", "", "expected <Extrinsic>, found nothing"),
        ("<Attributes[^>]*/>", "", "expected <Attributes>, found nothing"),
        (' X="[^"]*"', ' X="inf"', "Extrinsic.X: expected finite numbers"),
        (' X="[^"]*"', ' X="5000"', "positions in metres, found .* Divide"),
        ('OrientMatrix8="[^"]*"', 'OrientMatrix8="0.1"', "rotation: expected a rotation"),
        ('(CameraModel .*?HorizontalFocalLength)="[^"]*"', r'\1="6"', "focal length: expected"),
        ("calibrationProfile", "settings", "mismatched"),
        ('Serial="b2"', 'Serial=""', "name: expected up to 64 letters"),
    ],
    "FreeMoCap": [
        ("= true", "= false", "expected true: .* --lens.* locate-cameras"),
        ("translation = .*", "", "cam_0.translation: expected a value, found nothing"),
        ("translation = .*", "translation = [1.0, 2.0]", r"expected numbers of shape \(3,\)"),
        ("translation = .*", "translation = [nan, 2.0, 1.0]", "expected finite numbers"),
        ("rotation = .*", "rotation = [90.0, 0.0, 0.0]", "in radians"),
    ],
}


@pytest.mark.parametrize(
    ("form", "old", "new", "message"),
    [(form, *case) for form, cases in BAD_TEXT.items() for case in cases],
)
def test_a_bad_entry_is_refused_with_its_place(tmp_path, form, old, new, message):
    path = WRITERS[form](tmp_path, rig())
    spoil_text(path, old, new)
    with pytest.raises(InputError, match=message) as refused:
        read_calibration(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": None}, r"pickle: rotation: expected the pose .* found a lens alone"),
        ({"intrinsicMat": None}, r"pickle.intrinsicMat: expected a value"),
        ({"intrinsicMat": np.eye(2)}, r"intrinsicMat: expected numbers of shape \(3, 3\)"),
        ({"intrinsicMat": np.full((3, 3), np.nan)}, "intrinsicMat: expected finite numbers"),
        ({"intrinsicMat": "a camera"}, "intrinsicMat: expected numbers"),
        ({"distortion": np.zeros(7)}, "distortion: expected 4 or 5"),
        ({"distortion": np.array([0, 0, 0, 0, 0, 0.1, 0, 0])}, "a lens model with more terms"),
        ({"imageSize": np.array([1080.0])}, r"imageSize: expected numbers of shape \(2,\)"),
        ({"imageSize": np.array([1920.0, 1080.0])}, "imageSize: expected height, then width"),
        ({"rotation": np.eye(4)}, "rotation: expected numbers of shape"),
        ({"rotation": 2.0 * np.array(rig()[0].rotation) @ STANDING}, "rotation: expected a rota"),
        ({"rotation": np.diag([-1.0, 1.0, 1.0])}, "found a mirror image"),
        (
            {
                "rotation": Rotation.from_euler("y", 50, degrees=True).as_matrix()[[1, 0, 2]]
                * [[1], [-1], [1]]
            },
            "board that stands or lies",
        ),
        ({"translation": np.array([1.0, 2.0])}, r"translation: expected numbers of shape \(3,\)"),
        ({"translation": np.zeros(3)}, "positions in millimetres"),
    ],
)
def test_a_bad_opencap_file_is_refused(tmp_path, changes, message):
    folder = write_opencap(tmp_path, rig(), STANDING, **changes)
    with pytest.raises(InputError, match=message):
        read_calibration(folder)


def test_a_millimetre_file_in_metres_is_refused(tmp_path):
    near = [
        one.model_copy(update={"translation": tuple(0.001 * np.array(one.translation))})
        for one in rig(lens=(0.0,) * 5)
    ]
    for form in ("Vicon", "OpenCap", "bioCV", "FreeMoCap"):
        folder = tmp_path / form
        folder.mkdir()
        with pytest.raises(InputError, match=r"in millimetres, found .* Multiply") as refused:
            read_calibration(WRITERS[form](folder, near))
        assert str(folder) in str(refused.value)


def test_a_metre_file_in_millimetres_is_refused(tmp_path):
    far = [
        one.model_copy(update={"translation": tuple(1000.0 * np.array(one.translation))})
        for one in rig()
    ]
    for form in ("EasyMocap", "OptiTrack"):
        folder = tmp_path / form
        folder.mkdir()
        with pytest.raises(InputError, match=r"positions in metres, found .* Divide"):
            read_calibration(WRITERS[form](folder, far))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("intri.yml", "K_a1: ", "K_zz: ", "intri.yml: K_a1: expected a matrix, found nothing"),
        ("intri.yml", "dist_a1: ", "dist_zz: ", "dist_a1: expected a matrix"),
        ("intri.yml", "W_a1: .*", "", "Add its width and height .* W_a1: 1920"),
        ("intri.yml", "W_a1: .*", "W_a1: 2.5", "size: expected whole pixels"),
        ("intri.yml", "names:", "cameras:", "names: expected a list of cameras"),
        ("intri.yml", "data: \\[ 1500.", "data: [ 1e12", "intri.yml: a1.K_a1: expected finite"),
        ("extri.yml", "T_a1: ", "T_zz: ", "extri.yml: T_a1: expected a matrix, found nothing"),
        ("extri.yml", "(T_a1: [^%]*?)rows: 3", r"\1rows: 2", "extri.yml"),
        ("extri.yml", "data: \\[", "data: [ .Inf, ", "extri.yml"),
        ("extri.yml", "%YAML", "\x00\x01", "extri.yml: expected"),
    ],
)
def test_a_bad_easymocap_file_is_refused(tmp_path, file, old, new, message):
    write_easymocap(tmp_path, rig())
    spoil_text(tmp_path / file, old, new)
    with pytest.raises(InputError, match=message):
        read_calibration(tmp_path)


def test_easymocaps_lenses_need_their_poses(tmp_path):
    write_easymocap(tmp_path, rig())
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(InputError, match=r"one extri.yml of poses, found intri.yml"):
        read_calibration(tmp_path / "intri.yml")


def test_easymocap_may_have_rotation_matrices_alone(tmp_path):
    assert_same(read_calibration(write_easymocap(tmp_path, rig(), pose="ot")), rig())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected 32 numbers: .* found 0"),
        ("1920\n1080\n", "expected 32 numbers: .* found 2"),
        (" ".join(["1"] * 32), "L: expected a last row 0 0 0 1"),
        ("a camera", "expected 32 numbers, found"),
        ("\x00" * 100, "expected 32 numbers, found"),
        (" ".join(["nan"] * 23 + ["0", "0", "0", "1"] + ["0"] * 5), "K: expected finite numbers"),
    ],
)
def test_a_bad_biocv_file_is_refused(tmp_path, text, message):
    (tmp_path / "01.mp4.calib").write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        read_calibration(tmp_path)
    assert "01.mp4.calib" in str(refused.value)


def test_biocvs_cameras_are_called_by_their_videos(tmp_path):
    (one, *_) = rig()
    write_biocv(tmp_path, [one])
    (tmp_path / "a1.calib").rename(tmp_path / "01.mp4.calib")
    assert list(read_calibration(tmp_path / "01.mp4.calib")) == ["01"]


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("content", [b"", b"\x00\x80\xff" * 100, b"{}", b"[1, 2]"])
def test_an_empty_or_binary_file_is_refused_once(tmp_path, form, content, capfd):
    path = WRITERS[form](tmp_path, rig())
    spoilt = path if path.is_file() else next(f for f in sorted(path.rglob("*")) if f.is_file())
    spoilt.write_bytes(content)
    with pytest.raises(InputError) as refused:
        read_calibration(path)
    assert str(spoilt) in str(refused.value)
    assert "Traceback" not in capfd.readouterr().err


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(WRITERS)), st.floats(0, 1), st.integers(0, 30), st.binary(max_size=6))
@example("EasyMocap", 0.75, 0, b"\x80")  # a name that is no text
def test_a_spoilt_file_is_read_or_refused(tmp_path_factory, form, share, length, insert):
    folder = Path(tmp_path_factory.mktemp("spoilt"))
    path = WRITERS[form](folder, rig())
    spoilt = path if path.is_file() else next(f for f in sorted(path.rglob("*")) if f.is_file())
    content = spoilt.read_bytes()
    start = int(share * len(content))
    spoilt.write_bytes(content[:start] + insert + content[start + length :])
    try:
        assert read_calibration(path)
    except InputError as error:
        assert str(folder) in error.where


POSE2SIM = """
import json, sys
import cv2, numpy
from pathlib import Path
from Pose2Sim import calibration

folder = Path(sys.argv[1])
found = {
    "Vicon": calibration.calib_vicon_fun(str(folder / "Vicon" / "calibration" / "Calib.xcp")),
    "OpenCap": calibration.calib_opencap_fun(sorted((folder / "OpenCap").glob("*.pickle"))),
    "EasyMocap": calibration.calib_easymocap_fun(
        [str(folder / "EasyMocap" / name) for name in ("extri.yml", "intri.yml")]
    ),
    "bioCV": calibration.calib_biocv_fun(sorted((folder / "bioCV").glob("*.calib"))),
}
found = {
    form: [[numpy.array(part, float).tolist() for part in camera] for camera in zip(*parts[3:])]
    for form, parts in found.items()
}
(folder / "found.json").write_text(json.dumps(found))
"""


@pytest.mark.skipif(
    "WORLDPOSE_POSE2SIM_PYTHON" not in os.environ,
    reason="WORLDPOSE_POSE2SIM_PYTHON names no Python with Pose2Sim",
)
def test_pose2sim_converts_to_the_same_cameras(tmp_path):
    ours = {}
    for form in ("Vicon", "OpenCap", "EasyMocap", "bioCV"):
        folder = tmp_path / form / ("calibration" if form == "Vicon" else "")
        folder.mkdir(parents=True)
        # Pose2Sim has another meaning of Vicon's lens, the same without distortion.
        ours[form] = rig(lens=(0.0,) * 5 if form == "Vicon" else (*LENS[:4], 0.0))
        path = WRITERS[form](folder, ours[form])
        for file in path.glob("*/*.pickle"):  # Pose2Sim has them side by side
            file.rename(folder / f"{file.parent.name}.pickle")
        ours[form] = list(read_calibration(path if form == "Vicon" else folder).values())
    (tmp_path / "Vicon" / "videos").mkdir()
    for one in ours["Vicon"]:  # it takes the image size from them
        name = str(tmp_path / "Vicon" / "videos" / f"{one.id}.avi")
        film = cv2.VideoWriter(name, cv2.VideoWriter_fourcc(*"MJPG"), 25.0, SIZE)
        film.write(np.zeros((*SIZE[::-1], 3), np.uint8))
        film.release()
    command = [os.environ["WORLDPOSE_POSE2SIM_PYTHON"], "-c", POSE2SIM, str(tmp_path)]
    subprocess.run(command, check=True, cwd=tmp_path)
    found = json.loads((tmp_path / "found.json").read_text())
    for form, cameras in ours.items():
        for one, (lens, optics, turn, place) in zip(cameras, found[form], strict=True):
            np.testing.assert_allclose(lens[:4], one.distortion[:4], rtol=0, atol=1e-6)
            np.testing.assert_allclose(optics, matrix(one), rtol=0, atol=1e-4)  # single precision
            np.testing.assert_allclose(
                cv2.Rodrigues(np.array(turn))[0], one.rotation, rtol=0, atol=1e-6
            )
            np.testing.assert_allclose(place, one.translation, rtol=0, atol=1e-6)


def test_the_documents_and_the_help_name_every_form():
    root = Path(__file__).parents[3]
    page = (root / "docs/reference/formats.md").read_text().partition("## Calibrations")[2]
    table = [
        line.split("|")[1:3] for line in page.partition("\n## ")[0].splitlines() if "|" in line
    ]
    assert [name.strip() for name, _ in table[2:]] == [form.name for form in FORMS]
    for (_, files), form in zip(table[2:], FORMS, strict=True):
        assert form.endings[0] in files
    source = (root / "flows/cli/matches.py").read_text()
    for form in FORMS:
        for program in form.name.split(", "):
            assert program in source.partition("--fps")[0]
