import re
import tomllib

import cv2
import numpy as np
import pytest
from calibration_writers import matrix

from worldpose.errors import InputError
from worldpose.formats.calibration_files import LeftOut
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml

ANIPOSE = """
[cam_0]
name = "left"
size = [1032, 776]
matrix = [[1063.5, 0.0, 511.7], [0.0, 1071.8, 350.1], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.02, 0.001, -0.002, 0.003]
rotation = [1.5, -0.6, 0.7]
translation = [-0.5, 0.9, 2.6]

[metadata]
adjusted = false
error = 0.0
"""

POSE2SIM = """
[cam_01]
name = "cam_01"
size = [ 1088.0, 1920.0]
matrix = [ [ 1681.2, 0.0, 532.9], [ 0.0, 1681.0, 948.1], [ 0.0, 0.0, 1.0]]
distortions = [ -0.1, 0.02, 9.5e-06, 1.1e-05]
rotation = [ 1.6, 1.0, -0.4]
translation = [ 0.3, 0.9, 2.8]
fisheye = false
"""

CALISCOPE = """
[cameras.3]
cam_id = 3
size = [1280, 720]
rotation_count = 0
error = 0.3
matrix = [[900.0, 0.0, 640.0], [0.0, 901.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [[-0.1, 0.02, 0.0, 0.0, 0.0]]
translation = [[0.1], [0.2], [3.0]]
rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
grid_count = 20
fisheye = false
"""

# Stands 10 m up at (1, 2), looks straight down; its image's right is world x, its up is world y.
QUALISYS = """<?xml version='1.0' encoding='UTF-8'?>
<calibration created="2024-01-01 10:00:00" type="regular"><!-- wand <!> -->
<cameras>
<camera active="1" serial="26580" model="Miqus Video" viewrotation="0">
<fov_video left="0" top="0" right="1919" bottom="1079"/>
<transform x="1000" y="2000" z="10000" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0"
 r31="0" r32="0" r33="1"/>
<intrinsic focallength="9.2" sensorMinU="0" sensorMaxU="122879" sensorMinV="0" sensorMaxV="69119"
 focalLengthU="64000" focalLengthV="70400" centerPointU="61440" centerPointV="34560" skew="0.000"
 radialDistortion1="-0.05" radialDistortion2="0.14" radialDistortion3="0.01"
 tangentalDistortion1="0.0006" tangentalDistortion2="-0.0004"/>
</camera>
<camera active="0" serial="1"/>
</cameras></calibration>
"""


@pytest.fixture
def read(tmp_path):
    def read_text(text, name="calibration.toml"):
        path = tmp_path / name
        path.write_text(text)
        return read_calibration(path)

    return read_text


@pytest.fixture
def refusal(read):
    def caught(text, name="calibration.toml"):
        with pytest.raises(InputError) as error:
            read(text, name)
        return error.value

    return caught


def test_anipose_camera_is_called_by_its_name(read):
    cameras = read(ANIPOSE)
    assert list(cameras) == ["left"]
    camera = cameras["left"]
    assert (camera.image_size, camera.focal_px) == ((1032, 776), (1063.5, 1071.8))
    assert camera.principal_point_px == (511.7, 350.1)
    assert camera.distortion == (-0.1, 0.02, 0.001, -0.002, 0.003)
    assert camera.translation == (-0.5, 0.9, 2.6)
    expected, _ = cv2.Rodrigues(np.array([1.5, -0.6, 0.7]))
    # Two ways to the same matrix of entries up to 1, in float64.
    np.testing.assert_allclose(camera.rotation, expected, rtol=0, atol=1e-15)
    assert read(ANIPOSE.replace("0.003]", "0.003, 0.0, 0, 0.0]")) == cameras
    camera = read(POSE2SIM)["cam_01"]  # four coefficients, and sizes with a point
    assert camera.image_size == (1088, 1920)
    assert camera.distortion == (-0.1, 0.02, 9.5e-06, 1.1e-05, 0.0)


def test_caliscope_camera_is_called_by_its_number_and_may_give_a_matrix(read):
    settings = "camera_count = 1\nCreationDate = 2023-02-11T13:53:13Z\n[charuco]\ncolumns = 4\n"
    assert read(settings + CALISCOPE) == read(CALISCOPE)
    cameras = read(CALISCOPE)
    assert list(cameras) == ["cam_3"]
    camera = cameras["cam_3"]
    assert camera.rotation == ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    assert camera.distortion == (-0.1, 0.02, 0.0, 0.0, 0.0)
    assert camera.translation == (0.1, 0.2, 3.0)


def test_half_a_pose_is_none(tmp_path):
    half = CALISCOPE.replace("cameras.3", "cameras.4").replace("[[0.1], [0.2], [3.0]]", "[]")
    (tmp_path / "c.toml").write_text(CALISCOPE + half)
    assert [*read_calibration(tmp_path / "c.toml", left_out=(left_out := LeftOut()))] == ["cam_3"]
    assert left_out == {"cam_4": "it has no translation"}


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("[-0.5, 0.9, 2.6]", "[-0.5, nan, 2.6]", "cam_0.translation", "finite"),
        ("[-0.5, 0.9, 2.6]", "[0.9, 2.6]", "cam_0.translation", "shape (3,)"),
        ("translation = [-0.5, 0.9, 2.6]", "", "cam_0.translation", "a value"),
        ("[1.5, -0.6, 0.7]", "[[1,0,0],[0,1,0],[0,0,1.1]]", "cam_0: rotation", "orthonormal"),
        ("[1.5, -0.6, 0.7]", "[[1,0,0],[0,1,0],[0,0,-1]]", "cam_0: rotation", "mirror"),
        ("1063.5", "-1063.5", "cam_0: focal length", "positive"),
        ("1063.5, 0.0", "1063.5, 2.0", "cam_0.matrix", "[fx, 0, cx]"),
        ("[1032, 776]", "[1032, 0]", "cam_0: size", "whole pixels"),
        ("0.003]", "0.003, 0.1, 0, 0, 0, 0, 0, 1]", "cam_0.distortions", "more terms"),
        ("[-0.1, 0.02, 0.001, -0.002, 0.003]", "[0.1, 0.2]", "cam_0.distortions", "k1 k2 p1 p2"),
        ('"left"', '"../left"', "cam_0: name", "letters"),
        ("[metadata]", "fisheye = true\n[metadata]", "cam_0.distortions", "k1 k2 k3 k4"),
        ("1063.5", "6.2", "cam_0: focal length", "in pixels"),
        ("511.7", "1e6", "cam_0: principal point", "in pixels"),
        ("[1.5, -0.6, 0.7]", "[90.0, 10.0, -45.0]", "cam_0.rotation", "degrees"),
        ("[-0.5, 0.9, 2.6]", "[1e8, 0.9, 2.6]", "cam_0: translation", "metres"),
        ("[1032, 776]", "[1000000, 776]", "cam_0: size", "pixels"),
    ],
)
def test_wrong_entry_is_refused_with_its_key(refusal, old, new, place, words):
    assert old in ANIPOSE
    error = refusal(ANIPOSE.replace(old, new, 1))
    assert error.where.endswith(f"calibration.toml: {place}")
    assert words in str(error)


def test_no_camera_two_of_one_name_and_other_kinds_of_file_are_refused(refusal):
    assert refusal("[metadata]\nerror = 0.0\n").expected == "at least one camera"
    twice = ANIPOSE + ANIPOSE.replace("[cam_0]", "[cam_1]").split("[metadata]")[0]
    assert "'left' a second time" in refusal(twice).found
    assert "a camchain of Kalibr" in refusal("a: 1", "calibration.yaml").expected
    assert "FileStorage" in refusal("K: !!opencv-matrix", "calibration.yaml").found
    assert refusal('{"unit": "mm"}', "calibration.json").found == "nothing; there are unit"
    assert "'.ini'" in refusal("", "calibration.ini").found


def test_a_size_that_is_no_whole_number_is_that_of_the_video(tmp_path):
    """Programs that do not know the size write twice the principal point."""
    path = tmp_path / "calibration.toml"
    size = re.search(r"size = \[(\d+)[.\d]*, (\d+)[.\d]*\]", ANIPOSE)
    path.write_text(ANIPOSE.replace(size[0], f"size = [{int(size[1]) - 6.21}, {size[2]}.758]"))
    with pytest.raises(InputError, match=r"size: expected whole pixels .* --videos takes theirs"):
        read_calibration(path)
    shown = (int(size[1]), int(size[2]))
    assert read_calibration(path, {"left": shown})["left"].image_size == shown


def test_written_cameras_come_back(tmp_path, make_camera):
    angles = (0.7, 1.4, 0.0, 1e-9, np.pi - 1e-9, np.pi)
    cameras = {f"cam{i}": make_camera(f"cam{i}", angle) for i, angle in enumerate(angles)}
    write_calibration_toml(tmp_path / "c.toml", cameras)
    back = read_calibration(tmp_path / "c.toml")
    tables = tomllib.loads((tmp_path / "c.toml").read_text())
    assert list(tables) == [*(f"cam_{i}" for i in range(6)), "metadata"]
    assert list(back) == list(cameras)
    for name, camera in cameras.items():
        exact = back[name].model_copy(update={"rotation": camera.rotation})
        assert exact == camera
        # The rotation went through a Rodrigues vector: a few roundings of numbers up to pi.
        np.testing.assert_allclose(back[name].rotation, camera.rotation, rtol=0, atol=2e-15)


def test_qualisys_camera_projects_as_it_stands(read):
    camera = read(QUALISYS, "rig.qca.txt")["26580"]
    assert camera.image_size == (1920, 1080)
    assert camera.focal_px == (1000.0, 1100.0)  # 64000 / 64, 70400 / 64
    assert camera.principal_point_px == (960.0, 540.0)
    assert camera.distortion == (-0.05, 0.14, 0.0006, -0.0004, 0.01)
    rotation, t = np.array(camera.rotation), np.array(camera.translation)
    np.testing.assert_array_equal(-rotation.T @ t, [1.0, 2.0, 10.0])  # whole numbers throughout

    def pixel(point):
        return cv2.projectPoints(
            np.array([point]), cv2.Rodrigues(rotation)[0], t, matrix(camera), None
        )[0].ravel()

    # 1 m at 10 m distance is a tenth of the focal length; world y is up in the image.
    np.testing.assert_allclose(pixel([1.0, 2.0, 0.0]), [960, 540], atol=1e-9)
    np.testing.assert_allclose(pixel([2.0, 2.0, 0.0]), [1060, 540], atol=1e-9)
    np.testing.assert_allclose(pixel([1.0, 3.0, 0.0]), [960, 430], atol=1e-9)


def test_qualisys_numbers_may_have_decimal_commas(read):
    commas = re.sub(r'"(-?\d+)[.](\d+)"', r'"\1,\2"', QUALISYS.replace('x="1000"', 'x="1,0E+3"'))
    assert commas != QUALISYS
    assert read(commas, "rig.qca.txt") == read(QUALISYS, "rig.qca.txt")


@pytest.mark.parametrize("word", ['calibrated="false"', 'calibrated="0"', 'active="False"'])
def test_qualisys_cameras_that_are_off_are_left_out_by_name(tmp_path, word):
    begin, one, end = re.split(r"(<camera active=\"1\".*?</camera>)", QUALISYS, flags=re.S)
    two = re.sub('active="1"', word, one).replace("26580", "7")
    hybrid = one.replace("26580", "8").replace("Video", "Hybrid").replace("1000", "3000")
    (tmp_path / "rig.qca.txt").write_text(begin + one + two + hybrid + end)
    left_out = LeftOut()
    assert [*read_calibration(tmp_path / "rig.qca.txt", left_out=left_out)] == ["26580", "8"]
    assert left_out.keys() == {"7", "1"}


def test_qualisys_video_that_shows_a_part_of_the_sensor_moves_the_centre(read):
    part = QUALISYS.replace('left="0" top="0"', 'left="320" top="40"')
    camera = read(part, "rig.qca.txt")["26580"]
    assert camera.image_size == (1600, 1040)
    assert camera.principal_point_px == (640.0, 500.0)


def test_qualisys_files_of_older_versions_have_pixels_and_the_whole_sensor(read):
    whole = QUALISYS.replace('<fov_video left="0" top="0" right="1919" bottom="1079"/>', "")
    pixels = whole
    for parts, px in (("122879", "1920"), ("69119", "1080"), ("64000", "1000"), ("70400", "1100")):
        pixels = pixels.replace(f'"{parts}"', f'"{px}"')
    pixels = pixels.replace('"61440"', '"960"').replace('"34560"', '"540"')
    expected = read(QUALISYS, "rig.qca.txt")
    assert read(whole, "rig.qca.txt") == expected
    assert read(pixels, "rig.qca.txt") == expected


def test_poses_of_pairs_beside_the_cameras_are_no_cameras(read):
    pair = "\n[stereo_1_2]\nrotation = [0.1, 0.2, 0.3]\ntranslation = [1.0, 0.0, 0.0]\n"
    assert read(ANIPOSE + pair) == read(ANIPOSE)


def test_a_posed_camera_with_a_misspelt_lens_is_refused(refusal):
    bad = "\n[cam_09]\nK = [1.0]\nrotation = [0.1, 0.2, 0.3]\ntranslation = [1.0, 0.0, 0.0]\n"
    assert refusal(ANIPOSE + bad).where.endswith("cam_09.matrix")


def test_poses_that_are_all_null_are_told_to_be_lenses(refusal):
    without = CALISCOPE.replace("[[0.1], [0.2], [3.0]]", '"null"')
    without = without.replace("[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]", '"null"')
    assert "a lens alone" in refusal(without).found


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('x="1000"', 'x="east"', "camera[0].transform.x"),
        ('r33="1"', 'r33="-1"', "camera[0]: rotation"),
        ('skew="0.000"', 'skew="1.5"', "camera[0].intrinsic.skew"),
        ('<camera active="1"', '<camera active="0"', "rig.qca.txt"),
        ("</calibration>", "", "rig.qca.txt"),
        ("<calibration", "<!DOCTYPE a [<!ENTITY b 'c'>]><calibration", "rig.qca.txt"),
    ],
)
def test_wrong_qualisys_entry_is_refused_with_its_place(refusal, old, new, place):
    assert old in QUALISYS
    assert refusal(QUALISYS.replace(old, new, 1), "rig.qca.txt").where.endswith(place)


def test_entities_are_refused_in_any_encoding(tmp_path):
    path = tmp_path / "rig.xml"
    text = "<?xml version='1.0' encoding='UTF-16'?><!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>"
    path.write_bytes(text.encode("utf-16"))
    with pytest.raises(InputError, match="a document type"):
        read_calibration(path)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (3.0, -40.0, 6.0)])
def test_cameras_in_one_place_are_told_to_be_lenses(tmp_path, make_camera, place):
    cameras = {}
    for n, (name, turn) in enumerate({"a": np.eye(3), "b": np.eye(3)[[1, 2, 0]]}.items()):
        pose = {
            "rotation": tuple(map(tuple, turn.tolist())),
            "translation": tuple((-turn @ place).tolist()),
        }
        cameras[name] = make_camera(name, 0.1 + n).model_copy(update=pose)
    write_calibration_toml(tmp_path / "c.toml", cameras)
    with pytest.raises(InputError, match=r"found all cameras in one place: .* import --lens"):
        read_calibration(tmp_path / "c.toml")
