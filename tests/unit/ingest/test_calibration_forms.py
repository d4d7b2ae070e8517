"""Calibrations of other programs: known cameras written in each form, and bad files of each."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from calibration_writers import (
    LENS,
    SIZE,
    STANDING,
    WRITERS,
    attributes,
    center_of,
    project,
    rig,
    write_biocv,
    write_easymocap,
    write_kalibr,
    write_opencap,
    write_openpose,
    write_vicon,
)
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from worldpose.errors import InputError
from worldpose.formats.calibration_files import LeftOut
from worldpose.formats.calibration_forms import FORMS, read_calibration, read_cameras
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.lens_files import read_lenses
from worldpose.triangulation.world import place_cameras, read_stated_world


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


@pytest.mark.parametrize("form", WRITERS)
def test_known_cameras_are_read_back(tmp_path, form):
    known = rig(lens=(0.0,) * 5 if form == "Vicon" else LENS)
    path = WRITERS[form](tmp_path, known)
    assert_same(read_calibration(path), known)
    # A folder with one calibration stands for it.
    folder = path if path.is_dir() else path.parent
    (folder / "Config.toml").write_text("[project]\n")
    (folder / "notes.md").write_text("# notes\n")
    assert list(read_cameras(folder)) == [one.id for one in known]


@pytest.mark.parametrize("form", ["OpenCap", "EasyMocap", "bioCV", "OpenPose", "Kalibr"])
def test_large_tangential_terms_of_programs_with_one_order_come_back_and_go_out(tmp_path, form):
    writers = {**WRITERS, "OpenPose": write_openpose, "Kalibr": write_kalibr}
    lens = (0.1, -0.05, -0.02, 0.027, 0.0)
    path = writers[form](tmp_path, rig(lens=lens))
    read = read_calibration(path, dict.fromkeys(("a1", "b2", "c3"), SIZE))
    assert [one.distortion for one in read.values()] == [pytest.approx(lens)] * 3
    write_calibration_toml(tmp_path / "c.toml", read)
    assert [one.distortion for one in read_calibration(tmp_path / "c.toml").values()] == [
        one.distortion for one in read.values()
    ]


def test_a_camchain_counts_from_its_first_camera(tmp_path):
    known = rig(lens=(*LENS[:4], 0.0))
    path = write_kalibr(tmp_path, known)
    found = read_calibration(path)
    assert list(found) == ["cam0", "cam1", "cam2"]
    turn, shift = np.array(known[0].rotation), np.array(known[0].translation)
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 3)) + [0.0, 0.0, 1.0]
    for one, other in zip(known, found.values(), strict=True):
        np.testing.assert_allclose(
            project(other, points @ turn.T + shift), project(one, points), atol=1e-6
        )
    sizes = dict.fromkeys(found, SIZE)
    lenses = read_lenses([path], None, sizes)
    np.testing.assert_allclose(lenses["cam2"].distortion, (*LENS[:4], 0.0))
    # As OpenVINS and VINS have it: with OpenCV's head, rows in one list, and the IMU's place.
    chain = yaml.safe_load(path.read_text()) | {"T_imu_body": [1.0, 0.0]}
    for name in ("cam1", "cam2"):
        chain[name]["T_cn_cnm1"] = np.ravel(chain[name]["T_cn_cnm1"]).tolist()
    path.write_text(f"%YAML:1.0\n\n{yaml.safe_dump(chain)}")
    assert list(read_calibration(path)) == [*read_lenses([path], None, sizes)] == [*found]
    (tmp_path / "one").mkdir()
    with pytest.raises(InputError, match=r"found one camera, at the origin: .* import --lens"):
        read_calibration(write_kalibr(tmp_path / "one", known[:1]))
    path.write_text(path.read_text().replace("pinhole", "omni"))
    with pytest.raises(InputError, match="found omni with radtan"):
        read_calibration(path)


def test_a_camchain_counts_by_the_numbers_of_its_cameras(tmp_path):
    lines = []
    for name in (f"cam{n}" for n in (0, 1, 10, 11, *range(2, 10))):
        lines += [f"{name}:", "  camera_model: pinhole", "  intrinsics: [900, 900, 639.5, 359.5]"]
        lines += ["  distortion_model: none", "  resolution: [1280, 720]"]
        if name != "cam0":
            step = f"[[1, 0, 0, -{name[3:]}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
            lines += [f"  T_cn_cnm1: {step}"]
    path = tmp_path / "camchain.yaml"
    path.write_text("\n".join(lines) + "\n")
    found = {name: one.center[0] for name, one in read_cameras(path).items()}
    assert found == {f"cam{n}": n * (n + 1) / 2 for n in range(12)}
    path.write_text("\n".join(lines[5:]) + "\n")
    with pytest.raises(InputError, match=r"cam1\.T_cn_cnm1: expected none in the first camera"):
        read_cameras(path)
    assert len(read_lenses([path], None, dict.fromkeys(found, (1280, 720)))) == 11


def test_cameras_of_panoptic_with_skew_pixels_or_without_a_pose_are_left_out(tmp_path):
    path = WRITERS["Panoptic"](tmp_path, rig())
    content = json.loads(path.read_text())
    content["cameras"][1]["K"][0][1] = 0.403304
    content["cameras"][2] |= {"R": None, "t": None}
    path.write_text(json.dumps(content))
    left_out = LeftOut()
    assert list(read_calibration(path, left_out=left_out)) == ["a1"]
    assert "skew" in left_out["b2"]
    assert "no pose" in left_out["c3"]


@pytest.mark.parametrize("zeros", [(1, 2), (0, 2), (0,)], ids=["others", "reference", "alone"])
@pytest.mark.parametrize("form", ["TOML", "Panoptic"])
def test_cameras_of_one_pose_have_none(tmp_path, form, zeros):
    zero = {"rotation": tuple(map(tuple, np.eye(3).tolist())), "translation": (0.0,) * 3}
    known = [one.model_copy(update=zero if n in zeros else {}) for n, one in enumerate(rig())]
    write_calibration_toml(path := tmp_path / "c.toml", {one.id: one for one in known})
    if form == "Panoptic":
        content = json.loads((path := WRITERS[form](tmp_path, known)).read_text())
        for number in zeros:  # in the axes of the file
            content["cameras"][number] |= {"R": np.eye(3).tolist(), "t": [0, 0, 0]}
        path.write_text(json.dumps(content))
    lost = [known[number].id for number in zeros if len(zeros) > 1]
    found = read_calibration(path, left_out=(left_out := LeftOut()))
    assert [*found] == [one.id for one in known if one.id not in lost]
    assert [*left_out] == lost
    if lost:
        assert left_out[lost[0]].endswith(f"but one for {', '.join(lost)}")
        with pytest.raises(InputError, match=rf"{', '.join(lost)}: expected poses, .* the same"):
            read_calibration(path)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0)])
def test_a_list_of_cameras_as_panoptics_may_have_another_unit(tmp_path, unit, metres):
    known = rig(lens=(0.0,) * 5)
    path = WRITERS["Panoptic"](tmp_path, known)
    content = json.loads(path.read_text())
    for one in content["cameras"]:
        one["t"] = (np.array(one["t"]) * 0.01 / metres).tolist()
    path.write_text(json.dumps(content))
    cameras = read_calibration(path, any_unit=True)
    placed, _ = place_cameras(path, cameras, {}, 25.0, read_stated_world(unit, None))
    assert_same(placed, known)


def test_openposes_cameras_take_the_size_of_the_videos(tmp_path):
    known = rig()
    folder = write_openpose(tmp_path, known)
    sizes = dict.fromkeys(["a1", "b2", "c3"], SIZE)
    assert_same(read_calibration(folder, sizes), known)
    assert_same(read_calibration(folder / "b2.xml", sizes), known)
    with pytest.raises(InputError, match="OpenPose's files lack"):
        read_calibration(folder)
    (tmp_path / "easymocap").mkdir()
    assert_same(
        read_calibration(write_easymocap(tmp_path / "easymocap", known, sizes=False), sizes), known
    )


@pytest.mark.parametrize("part", [0.5, 1 / 3, 2 / 3, 1.5])
def test_videos_of_another_size_do_not_stand_for_a_size_that_is_not_stated(tmp_path, part):
    (tmp_path / "openpose").mkdir()
    folders = write_easymocap(tmp_path, rig(), sizes=False), tmp_path / "openpose"
    write_openpose(folders[1], rig())
    shown = dict.fromkeys(["a1", "b2", "c3"], tuple(round(part * side) for side in SIZE))
    for folder in folders:
        with pytest.raises(InputError, match=r"principal point: .*, the middle of about 1942 x"):
            read_calibration(next(folder.rglob("a1.xml"), folder), shown)


def test_a_stated_size_that_the_principal_point_contradicts_is_named(tmp_path):
    path, left_out = WRITERS["multical"](tmp_path, rig()), LeftOut()
    path.write_text(path.read_text().replace("[1920, 1080]", "[960, 540]"))
    read_calibration(path, left_out=left_out)
    assert (
        "a1 is 970.5, 530.2, the middle of about 1942 x 1062 px; is its size" in left_out.notes[0]
    )


def test_multicals_poses_may_be_counted_step_by_step(tmp_path):
    known = rig()
    path = WRITERS["multical"](tmp_path, known)
    content = json.loads(path.read_text())
    turns, moves = (
        [np.array(one[key]) for one in content["camera_poses"].values()] for key in "RT"
    )
    steps = {}
    for n, name in enumerate(("b2_to_a1", "c3_to_b2")):
        turn = turns[n + 1] @ turns[n].T
        steps[name] = {"R": turn.tolist(), "T": (moves[n + 1] - turn @ moves[n]).tolist()}
    steps["r9_to_r8"] = steps["b2_to_a1"]  # of cameras that the file does not list
    for first in ({"a1": content["camera_poses"]["a1"]}, {}):
        path.write_text(json.dumps({**content, "camera_poses": {**first, **steps}}))
        found = read_calibration(path)
        turn, move = (turns[0], moves[0]) if not first else (np.eye(3), np.zeros(3))
        for one in known:
            center = turn @ center_of(one) + move
            np.testing.assert_allclose(center_of(found[one.id]), center, atol=1e-9)
    steps["b2_to_c3"] = steps.pop("b2_to_a1")
    steps["a1"] = content["camera_poses"]["a1"]
    path.write_text(json.dumps({**content, "camera_poses": steps}))
    with pytest.raises(InputError, match="poses counted from one of the cameras"):
        read_calibration(path)


def test_opencaps_lens_without_a_pose_and_its_relative_path(tmp_path, monkeypatch):
    known = rig()
    file = next(write_opencap(tmp_path, known, STANDING).glob("a1/*.pickle"))
    lens = read_lenses([file], "a1", {"a1": SIZE})["a1"]
    assert (lens.focal_px, lens.image_size) == (pytest.approx(1500.0), SIZE)
    monkeypatch.chdir(file.parent)
    assert list(read_calibration(Path(file.name))) == ["a1"]


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
    found = read_calibration(write_vicon(tmp_path, known, radial), left_out=(told := LeftOut()))
    assert len(told.notes) == 3
    assert "coefficients follow Vicon's lens within 0.0" in told.notes[0]
    for one in known:
        expected = distort_by_vicon(one, middle, terms)
        inside = np.all((expected > 0) & (expected < SIZE), axis=-1)
        assert inside.sum() > 20
        error = np.abs(project(found[one.id]) - expected)[inside].max()
        flat = np.abs(project(one) - expected)[inside].max()
        assert error < 0.1 < 3.0 < flat


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
        'VICON_RADIAL="0 0"/></KeyFrames></Camera><Camera DEVICEID="7"/></Cameras>'
    )
    found = read_calibration(tmp_path / "c.xcp", left_out=(left_out := LeftOut()))["51433950"]
    assert left_out == {"7": "it records markers"}
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
        '</Camera><Camera Serial="M1"/></Cameras></Calibration></calibrationProfile>'
    )
    found = read_calibration(tmp_path / "c.mcal", left_out=(left_out := LeftOut()))["C11764"]
    assert left_out == {"M1": "it records markers"}
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


def test_unknown_files_and_empty_folders_name_all_forms(tmp_path):
    (tmp_path / "old.cal").write_bytes(b"\x00\x01")
    for path, found, todo in (
        (tmp_path, "found none; there are old.cal", "Export the calibration"),
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
        ('FOCAL_LENGTH="[^"]*"', 'FOCAL_LENGTH="8.5"', "focal length: expected positive pixels"),
        ('ORIENTATION="[^"]*"', 'ORIENTATION="1 1 0 0"', "a quaternion of length 1, found 1.41"),
        ('PIXEL_ASPECT_RATIO="1"', 'PIXEL_ASPECT_RATIO="1.1"', "expected 1: square pixels"),
        ('SKEW="0"', 'SKEW="2"', "SKEW: expected 0: square pixels"),
        ("Vicon3Parameter", "Vicon5Parameter", "expected Vicon3Parameter"),
        ('Vicon3Parameter [^"]*', "Vicon3Parameter 960 540 1", "RADIAL2: expected 5 numbers"),
        ('0 0 0"', '-4e-7 0 0"', "found one that folds the image"),
        ('0 0 0"', '1e-8 1e-12 9e-18"', r"follow within 0.1 px, found"),
        ("<KeyFrame .*?/>", "", "none: the camera is not calibrated"),
        (r"(<KeyFrame .*?/>)", r"\1\1", "of a camera that does not move, found 2"),
        ("</Cameras>", "", "expected XML of Qualisys, Vicon or OptiTrack"),
    ],
    "OptiTrack": [
        ("<IntrinsicStandardCameraModel[^>]*>", "", "found Motive's own model alone"),
        ('(CameraModel [^>]*) k3="[^"]*"', r"\1", "k3: expected a number"),
        ("<Extrinsic[^>]*/>", "", "expected <Extrinsic>, found nothing"),
        (' X="[^"]*"', ' X="5000"', "positions in metres, found .* Divide"),
        ('OrientMatrix8="[^"]*"', 'OrientMatrix8="0.1"', "rotation: expected a rotation"),
    ],
    "FreeMoCap": [
        ("= true", "= false", "expected true: .* --lens.* locate-cameras"),
        ("translation = .*", "", "cam_0.translation: .* nothing; there are name, size"),
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
        ({"distortion": np.append(np.zeros(11), 0.1)}, "a lens model with more terms"),
        ({"imageSize": np.array([1920.0, 1080.0])}, "found width 1080 and height 1920, which"),
        ({"rotation": np.diag([-1.0, 1.0, 1.0])}, "found a mirror image"),
        (
            {
                "rotation": Rotation.from_euler("y", 50, degrees=True).as_matrix()[[1, 0, 2]]
                * [[1], [-1], [1]]
            },
            "board that stands or lies",
        ),
        ({"translation": np.full(3, 1e-3)}, "positions in millimetres"),
    ],
)
def test_a_bad_opencap_file_is_refused(tmp_path, changes, message):
    folder = write_opencap(tmp_path, rig(), STANDING, **changes)
    with pytest.raises(InputError, match=message):
        read_calibration(folder)


@pytest.mark.parametrize(
    ("form", "factor", "message"),
    [
        *((form, 1e-3, r"in millimetres, .* Multiply") for form in ("Vicon", "OpenCap", "bioCV")),
        *((form, 1e3, r"in metres, found .* Divide") for form in ("EasyMocap", "OptiTrack")),
    ],
)
def test_a_file_in_another_unit_of_length_is_refused(tmp_path, form, factor, message):
    cameras = [
        one.model_copy(update={"translation": tuple(factor * np.array(one.translation))})
        for one in rig(lens=(0.0,) * 5)
    ]
    with pytest.raises(InputError, match=message):
        read_calibration(WRITERS[form](tmp_path, cameras))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("intri.yml", "K_a1: ", "K_zz: ", "intri.yml: K_a1: expected a matrix, found nothing"),
        ("intri.yml", "W_a1: .*", "", "Add the width and height .* W_a1: 1920"),
        ("intri.yml", "names:", "cameras:", "names: expected a list of cameras"),
        ("extri.yml", "T_a1: ", "T_zz: ", "extri.yml: T_a1: expected a matrix, found nothing"),
        ("extri.yml", "(T_a1: [^%]*?)rows: 3", r"\1rows: 2", "extri.yml"),
        ("extri.yml", "%YAML", "\x00\x01", "extri.yml: expected"),
    ],
)
def test_a_bad_easymocap_file_is_refused(tmp_path, file, old, new, message):
    write_easymocap(tmp_path, rig())
    spoil_text(tmp_path / file, old, new)
    with pytest.raises(InputError, match=message):
        read_calibration(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected 32 numbers: .* found 0"),
        (" ".join(["1"] * 32), "L: expected a last row 0 0 0 1"),
        ("\x00" * 100, "expected 32 numbers, found"),
    ],
)
def test_a_bad_biocv_file_is_refused(tmp_path, text, message):
    (tmp_path / "01.mp4.calib").write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        read_calibration(tmp_path)
    assert "01.mp4.calib" in str(refused.value)
    write_biocv(tmp_path, rig()[:1])
    (tmp_path / "a1.calib").rename(tmp_path / "01.mp4.calib")
    assert list(read_calibration(tmp_path / "01.mp4.calib")) == ["01"]
