"""Lenses without a pose, of every model, in the files of other tools."""

import json

import cv2
import numpy as np
import pytest
from run_records import calibration

from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.geometry.cameras import Camera, camera_arrays, camera_from_arrays

MATRIX = np.array([[1400.0, 0.0, 970.0], [0.0, 1404.0, 530.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([[-0.31, 0.12, 0.001, -0.002, -0.03]])
SIZES = {"left": (1920, 1080), "right": (1280, 720)}


def write_opencv(file, **further):
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 1 Jan 2024")
    for name, value in further.items():
        storage.write(name, value)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", DISTORTION)
    storage.write("avg_reprojection_error", 0.31)
    storage.release()
    return [file]


def write_npy(folder):
    np.save(folder / "matrix.npy", MATRIX)
    np.save(folder / "dist.npy", DISTORTION)
    return [folder / "matrix.npy", folder / "dist.npy"]


def write_npz(folder):
    np.savez(folder / "lens.npz", mtx=MATRIX, dist=DISTORTION, rvecs=np.zeros((9, 3, 1)))
    return [folder / "lens.npz"]


def write_npz_of(folder, matrix):
    np.savez(folder / "other.npz", mtx=matrix)
    return [folder / "other.npz"]


def write_toml(folder):
    text = f"""[cameras.7]
name = "left"
size = [1920, 1080]
matrix = {MATRIX.tolist()}
distortions = {DISTORTION[0].tolist()}
error = 0.4
"""
    (folder / "config.toml").write_text(text)
    return [folder / "config.toml"]


def write_plain_json(folder):
    lens = {"camera_matrix": MATRIX.tolist(), "dist_coeffs": DISTORTION.tolist(), "rms": 0.3}
    (folder / "lens.json").write_text(json.dumps(lens, indent="\t"))
    return [folder / "lens.json"]


def write_flat_toml(folder):
    text = f"resolution = [1920, 1080]\ncameraMatrix = {MATRIX.tolist()}\n"
    (folder / "lens.toml").write_text(text + f"distCoeffs = {DISTORTION[0].tolist()}\n")
    return [folder / "lens.toml"]


WRITERS = {
    "flat toml": write_flat_toml,
    "xml": lambda folder: write_opencv(folder / "lens.xml"),
    "yml": lambda folder: write_opencv(folder / "lens.yml", image_width=1920, image_height=1080),
    "json": lambda folder: write_opencv(folder / "lens.json"),
    "plain json": write_plain_json,
    "npy": write_npy,
    "npz": write_npz,
    "toml": write_toml,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_kind_of_file_gives_the_same_lens(kind, tmp_path):
    lens = read_lenses(WRITERS[kind](tmp_path), "left", SIZES)["left"]
    assert (lens.focal_px, lens.principal_point_px) == (1402.0, (970.0, 530.0))
    assert lens.distortion == tuple(DISTORTION[0].tolist())
    assert lens.focal_std_px == pytest.approx(14.02)
    assert lens.principal_point_std_px == pytest.approx(9.6)
    assert lens.distortion_std == 0.005


DEEP = 100_000
NESTED = {
    "flow.yml": f"%YAML:1.0\n---\nK: {'[' * DEEP}{']' * DEEP}\n",
    "block.yml": f"%YAML:1.0\n---\nK:\n{'- ' * DEEP}1\n",
    "deep.json": f'{{"opencv-matrix": {"[" * DEEP}{"]" * DEEP}}}',
    "deep.xml": f"<opencv_storage>{'<a>' * DEEP}{'</a>' * DEEP}</opencv_storage>",
    "hidden.yml": f'%YAML:1.0\n---\n# "\nK: {"[" * DEEP}"]"\n',
}


@pytest.mark.parametrize("name", NESTED)
def test_deep_nesting_is_refused_before_a_parser_ends_the_process(name, tmp_path):
    (tmp_path / name).write_text(NESTED[name])
    with pytest.raises(InputError, match=r"32 levels|nesting without end|nested more than 32"):
        read_lenses([tmp_path / name], "left", SIZES)


def test_a_lens_is_scaled_to_images_of_the_same_shape_and_no_others(tmp_path):
    files = write_opencv(tmp_path / "lens.yml", image_width=1920, image_height=1080)
    small = read_lenses(files, "right", SIZES)["right"]
    assert small.focal_px == pytest.approx(1402.0 * 2 / 3)
    # The centre of pixel 970 is 970.5 px from the image's edge.
    assert small.principal_point_px[0] == pytest.approx(970.5 * 2 / 3 - 0.5)
    assert small.distortion == tuple(DISTORTION[0].tolist())
    with pytest.raises(InputError, match=r"expected 1440 x 1080 px.*found 1920 x 1080"):
        read_lenses(files, "right", {"right": (1440, 1080)})


@pytest.mark.parametrize("form", ["multical", "panoptic"])
def test_json_with_several_cameras_gives_their_lenses_by_name(form, tmp_path):
    table = {"K": MATRIX.tolist(), "dist": DISTORTION.tolist(), "image_size": [1920, 1080]}
    cameras = {"left": table, "right": table}
    if form == "panoptic":
        renamed = {"K": table["K"], "distCoef": DISTORTION[0].tolist(), "resolution": [1920, 1080]}
        cameras = [{"name": name, **renamed} for name in cameras]
    (tmp_path / "rig.json").write_text(json.dumps({"cameras": cameras}))
    found = read_lenses([tmp_path / "rig.json"], None, SIZES)
    assert found["left"].focal_px == pytest.approx(1402.0)
    assert found["right"].distortion == tuple(DISTORTION[0].tolist())
    assert [*read_lenses([tmp_path / "rig.json"], "left", SIZES)] == ["left"]


@pytest.mark.parametrize(
    "size",
    [
        {"image_size": {"width": 3840, "height": 2160}},
        {"resolution": "3840x2160"},
        {"img_size": "[3840, 2160]"},
        {"DIM": [3840, 2160]},
        {"cameraResolution": [3840, 2160]},
        {"resolution": "4K UHD 3840x2160@30"},
        {"frame_size": [3840, 2160], "size": 25.0},
    ],
)
def test_a_size_in_the_file_counts_in_any_form(tmp_path, size):
    twice = {"K": np.diag([2.0, 2.0, 1.0]) @ MATRIX, "dist": DISTORTION}
    lens = {key: value.tolist() for key, value in twice.items()}
    (file := tmp_path / "lens.json").write_text(json.dumps({**lens, **size}))
    found = read_lenses([file], "left", SIZES)["left"]
    assert found.focal_px == pytest.approx(1402.0)
    for none in ({}, dict.fromkeys(size, "large"), dict.fromkeys(size)):
        file.write_text(json.dumps({**lens, **none}))
        with pytest.raises(InputError, match=r"no size is stated, found 1940.0, 1060.0, the mid"):
            read_lenses([file], "left", SIZES)


@pytest.mark.parametrize(
    "entry",
    [
        *({"image_shape": [1080, 1920]}, {"frame_shape": "(1080, 1920)"}),
        *({"image_size": [1080, 1920, 3]}, {"image_size": None}, {"calibration_size": [9, 6]}),
        *({"resolution": "full hd"}, {"resolution": "1080p60"}, {"resolution": "1920x1080@30"}),
        *({"camera_size": "APS-C"}, {"camera_dimensions": [23.5, 15.6]}),
    ],
)
def test_entries_that_are_no_size_leave_the_videos_size(tmp_path, entry):
    file = tmp_path / "lens.json"
    dist = [-0.3, 0.1, 0.012, 0.0, 0.0]  # a webcam's p1
    file.write_text(json.dumps({"K": MATRIX.tolist(), "dist": dist, **entry}))
    assert read_lenses([file], "left", SIZES)["left"].distortion == tuple(dist)


@pytest.mark.parametrize("lens", [[0.05, -0.02, 0.03, -0.015, 0.0], [-0.28, 0.09, -0.04, 0, 0]])
def test_five_numbers_in_another_order_are_refused(tmp_path, lens):
    file = tmp_path / "lens.json"
    words = (None, "brown", "brown3t2", "polynomial", "radial_tangential")
    for further, word in zip((0, 3, 7, 9, 0), words, strict=True):
        content = {"K": MATRIX.tolist(), "dist": lens + [0.0] * further, "distortion_model": word}
        file.write_text(json.dumps(content))
        with pytest.raises(InputError, match=r"p1 and p2 up to 0.025"):
            read_lenses([file], "left", SIZES)


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ([0.1, -0.05, -0.04, 0.03, 0.0], {"distortion_model": "plumb_bob"}),
        ([0.05, -0.1, 0.03, -0.03, 0.0], {"distortion_model": "radtan"}),
        ([0.0, -0.18, 0.033, -0.005, 0.18], {}),
    ],
)
def test_large_tangential_terms_count_where_no_other_order_explains_them(tmp_path, lens, said):
    file = tmp_path / "lens.json"
    file.write_text(json.dumps({"K": MATRIX.tolist(), "dist": lens, **said}))
    found = read_lenses([file], "left", SIZES)
    assert found["left"].distortion == tuple(lens)
    write_lens_toml(tmp_path / "lenses.toml", found)
    assert read_lens_toml(tmp_path / "lenses.toml", SIZES) == found
    dist = [*lens[:2], 0.11, *lens[3:]]
    file.write_text(json.dumps({"K": MATRIX.tolist(), "dist": dist, **said}))
    with pytest.raises(InputError, match=r"p1 and p2 up to"):
        read_lenses([file], "left", SIZES)


def test_tabs_and_matrices_without_a_type_are_read_as_opencv_and_ros_do(tmp_path):
    text = (
        "%YAML:1.0\nimage_width: 1920\nimage_height: 1080\ncamera_matrix: !!opencv-matrix\n"
        "   rows: 3\n   cols: 3\n   dt: d\n   data: [1400, 0, 970, 0, 1404, 530, 0, 0, 1]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
        "   data: [ -0.1, 0., 0., 0., 0. ]\n"
        "rectification_matrix:\n   rows: 1\n   cols: 1\n   data: [ 1.0 ]\n"
    )
    for head in ("%YAML:1.0", "%YAML 1.0"):
        (tmp_path / "lens.yml").write_text(text.replace("%YAML:1.0", head))
        lens = read_lenses([tmp_path / "lens.yml"], "left", SIZES)["left"]
        assert (lens.focal_px, lens.distortion) == (1402.0, (-0.1, 0.0, 0.0, 0.0, 0.0))
    text = "K: [1400, 0, 970, 0, 1404, 530, 0, 0, 1]\t\nD: [0, 0, 0, 0]\t# px\n"
    (tmp_path / "ros.yaml").write_text(text)
    assert read_lenses([tmp_path / "ros.yaml"], "left", SIZES)["left"].focal_px == 1402.0


def test_a_lens_of_another_image_size_is_told_by_its_middle_before_its_folds(tmp_path):
    lens = {"K": [[490, 0, 330], [0, 490, 230], [0, 0, 1]], "dist": [-0.36, 0.16, 0, 0, -0.04]}
    (tmp_path / "lens.json").write_text(json.dumps(lens))
    with pytest.raises(InputError, match="the middle of about 661 x 461 px"):
        read_lenses([tmp_path / "lens.json"], "left", SIZES)


LENS = {"camera_matrix": MATRIX.tolist(), "dist": DISTORTION[0].tolist()}
ENTRY = {"K": MATRIX.tolist(), "dist": DISTORTION[0].tolist(), "image_size": [1920, 1080]}


VECTOR = {"intrinsics": [1400.0] * 4, "d": [0.1, 0.1, 0, 0, 0.1], "intrinsic_matrix": ENTRY["K"]}
TABLE = {"rows": 3, "cols": 3, "data": MATRIX.ravel().tolist()}
INLINE = f"dist = {LENS['dist']}\ncamera_matrix = {str(TABLE).replace(':', ' =')}\n".replace(
    "'", ""
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("names.json", {**LENS, "cameras": ["a", "b"]}),
        ("none.yaml", {**LENS, "cameras": []}),
        ("serials.json", {**LENS, "cameras": {"left": {"serial": 1}}}),
        ("order.json", {**ENTRY, "intrinsics": [1.0] * 4, "intrinsic_matrix": [[0]]}),
        ("vector.json", VECTOR),
        ("meta.toml", f"dist = {LENS['dist']}\nK = {ENTRY['K']}\n[meta]\nsize = [1, 1]\n"),
        ("inline.toml", INLINE),
        ("spelt.json", {**LENS, "cameraMatrix": MATRIX.tolist()}),
    ],
)
def test_a_file_with_a_matrix_of_its_own_has_one_lens(name, content, tmp_path):
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / name).write_text(text)
    assert read_lenses([tmp_path / name], "left", SIZES)["left"].focal_px == 1402.0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"cameras": [{"name": "left", **ENTRY}] * 2}, "name of its own, found 'left' a second"),
        ({"cameras": [{"name": "left", **ENTRY}, ENTRY]}, r"cameras\[1\]: expected a lens with a"),
        ({"cameras": {"left": ENTRY, "right": 3}}, r"cameras\[1\]: .* found 3"),
        ({**LENS, "cameraMatrix": np.eye(3).tolist()}, "cameraMatrix: expected the value of"),
        ({"camera_matrix": {"rows": 3, "cols": 3, "data": [[1], [1, 2]]}}, r"data \[\[1\], \[1"),
        ({"camera_matrix": {"rows": 10**30, "cols": 3, "data": [1]}}, "rows x cols numbers"),
        ({"camera_matrix": {"rows": 3, "cols": 3, "data": None}}, "data nothing"),
        ({"dist": [0.0] * 5}, "camera_matrix, mtx or K .capitals and underscores"),
        ({**LENS, "camera_model": "omni"}, "camera_model: expected one of .* found 'omni'"),
        ({**LENS, "model": "fisheye", "fisheye": False}, "one lens model, found model fisheye"),
        ({"cameras": {"cam0": ENTRY, "cam1": ENTRY}}, "camera left, found cam0, cam1.*to left"),
    ],
)
def test_entries_that_contradict_or_lack_a_name_are_refused(content, said, tmp_path):
    (tmp_path / "lens.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=said):
        read_lenses([tmp_path / "lens.json"], "left", SIZES)


@pytest.mark.parametrize(
    ("names", "width", "height"), [("KD", 0, 0), ("kd", 0, 0), ("KD", 320, 180)]
)
def test_the_nine_numbers_and_the_size_of_a_camera_info_are_read(names, width, height, tmp_path):
    half = np.diag([0.5, 0.5, 1.0]) @ MATRIX
    half[:2, 2] += [width, height]  # the images show the corner of a larger sensor
    text = f"height: {540 + height}\nwidth: {960 + width}\n{names[0]}: {half.ravel().tolist()}\n"
    text += f"roi: {{x_offset: {width}, y_offset: {height}, height: 540, width: 960}}\n"
    text += f"{names[1]}: {DISTORTION[0].tolist()}\n---\n"
    (tmp_path / "info.yaml").write_text(text)
    lens = read_lenses([tmp_path / "info.yaml"], "left", SIZES)["left"]
    assert lens.focal_px == pytest.approx(1402.0)
    assert lens.principal_point_px == pytest.approx((970.5, 530.5))


BAD = {
    "two matrices": (
        lambda folder: write_npz(folder) + write_npz_of(folder, 2.0 * MATRIX),
        "left",
        r"other\.npz: mtx: expected the value of mtx",
    ),
    "no camera": (write_npz, None, r"--camera left"),
    "unknown camera": (write_npz, "middle", r"match\.yaml: left, right.*'middle'"),
    "matrix alone": (lambda folder: write_npy(folder)[:1], "left", "distortion coefficients"),
    "distortion alone": (lambda folder: write_npy(folder)[1:], "left", "3 x 3 camera matrix"),
}


@pytest.mark.parametrize("case", BAD)
def test_an_incomplete_lens_is_refused_with_what_it_lacks(case, tmp_path):
    write, camera, said = BAD[case]
    with pytest.raises(InputError, match=said):
        read_lenses(write(tmp_path), camera, SIZES)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("lens.yml", b"matrix: [1, 2", "expected YAML"),
        (
            "lens.xml",
            b'<?xml version="1.0"?><opencv_storage><a>1</a></opencv_storage>',
            "3 x 3 camera matrix",
        ),
        ("lens.npz", b"PK\x03\x04 torn", "npz"),
        ("lens.npy", b"\x93NUMPY", "arrays of numbers"),
        ("lens.txt", b"1400", r"found '\.txt'"),
    ],
)
def test_a_broken_file_is_one_clear_error(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_lenses([tmp_path / name], "left", SIZES)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dist": np.zeros(12) + 0.1}, "more terms"),
        ({"mtx": np.diag([1400.0, 1600.0, 1.0])}, "square pixels"),
        ({"mtx": np.diag([0.001, 0.001, 1.0])}, "focal length"),
        ({"mtx": np.full((3, 3), np.nan)}, "finite numbers"),
        ({"dist": [[-0.9, 0.0, 0.0, 0.0, 0.0]]}, "distortion: expected a lens whose image radii"),
    ],
)
def test_an_impossible_lens_is_refused(changes, said, tmp_path):
    np.savez(tmp_path / "lens.npz", **{"mtx": MATRIX, "dist": DISTORTION, **changes})
    with pytest.raises(InputError, match=said):
        read_lenses([tmp_path / "lens.npz"], "left", SIZES)


LENSES = {
    "fisheye": (-0.05, 0.01, -0.002, 0.0005),
    "rational": (0.4, -0.05, 1e-3, -2e-3, 0.01, 0.7, 0.02, 0.003),
}
SIZE = {"a": (640, 480)}
ROS = {"fisheye": "equidistant", "rational": "rational_polynomial"}


def camera_of(model, **changes):
    values = {
        **{"image_size": (640, 480), "focal_px": (400.0, 402.0), "distortion": LENSES[model]},
        **{"principal_point_px": (319.5, 239.5), "translation": (0.1, 1.2, 4.0)},
    }
    return calibration("a", **{"lens_model": model, **values, **changes})


def opencv(one, points):
    matrix = np.diag([*one.focal_px, 1.0])
    matrix[:2, 2] = one.principal_point_px
    pose = cv2.Rodrigues(np.array(one.rotation))[0], np.array(one.translation)
    project = cv2.fisheye.projectPoints if one.lens_model == "fisheye" else cv2.projectPoints
    return project(points[:, None], *pose, matrix, np.array(one.distortion))[0].reshape(-1, 2)


@pytest.mark.parametrize("model", LENSES)
def test_a_written_calibration_reads_as_the_same_camera_and_has_opencvs_pixels(model, tmp_path):
    one = camera_of(model)
    write_calibration_toml(tmp_path / "calibration.toml", {"a": one})
    read = read_calibration(tmp_path / "calibration.toml")["a"]
    assert (read.lens_model, read.distortion) == (model, one.distortion)
    camera = Camera.from_calibration(read)
    stored = camera_from_arrays(camera_arrays(Camera.stack([camera])))[0]
    assert stored.to_calibration("a").distortion == one.distortion
    points = np.random.default_rng(0).uniform([-3, -1, -1], [3, 5, 1], (100, 3))
    np.testing.assert_allclose(camera.project(points), opencv(one, points), atol=1e-9)


def lens_files(model, folder):
    matrix, numbers = [[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]], LENSES[model]
    fisheye = model == "fisheye"
    storage = cv2.FileStorage(str(folder / "opencv.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("fisheye_model", int(fisheye))
    storage.write("camera_matrix", np.array(matrix))
    storage.write("distortion_coefficients", np.array(numbers)[:, None])
    storage.release()
    (folder / "ros.yaml").write_text(
        f"camera_matrix: {{rows: 3, cols: 3, data: {[each for row in matrix for each in row]}}}\n"
        f"distortion_model: {ROS[model]}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(numbers)}, data: {list(numbers)}}}\n"
    )
    np.savez(folder / "arrays.npz", K=matrix, D=np.array(numbers)[:, None], fisheye=fisheye)
    (folder / "anipose.toml").write_text(
        f'[cam_0]\nname = "a"\nsize = [640, 480]\nmatrix = {matrix}\n'
        f"distortions = {list(numbers)}\nfisheye = {str(fisheye).lower()}\n"
    )
    return sorted(folder.iterdir())


@pytest.mark.parametrize("model", LENSES)
def test_every_lens_file_says_which_model_it_has(model, tmp_path):
    for file in lens_files(model, tmp_path):
        lens = read_lenses([file], "a", SIZE)["a"]
        assert (lens.lens_model, lens.distortion) == (model, LENSES[model]), file
    write_lens_toml(tmp_path / "lenses.toml", {"a": lens})
    assert read_lens_toml(tmp_path / "lenses.toml", SIZE) == {"a": lens}


@pytest.mark.parametrize(
    "said",
    ["model: Fisheye", "camera_model: OPENCV_FISHEYE", "type: fisheye", "projection: equidistant"]
    + ["lens: fisheye", "is_fisheye: True", "calibration_model: kannala brandt"],
)
def test_a_fisheye_is_known_by_every_usual_name(said, tmp_path):
    key, _, word = said.partition(": ")
    numbers = f"[{', '.join(map(str, LENSES['fisheye']))}]"
    matrix = "[[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]"
    (tmp_path / "lens.yaml").write_text(f"K: {matrix}\nD: {numbers}\n{said}\n")
    (tmp_path / "named.json").write_text(
        f'{{"cameras": [{{"name": "a", "resolution": [640, 480], "K": {matrix}, "{key}": "{word}",'
        f' "distCoef": {numbers}, "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 500]}}]}}'
    )
    (tmp_path / "c.toml").write_text(
        f'[a]\nsize = [640, 480]\nmatrix = {matrix}\ndistortions = {numbers}\n{key} = "{word}"\n'
        "rotation = [0, 0, 0]\ntranslation = [0, 0, 5]\n"
    )
    for file in sorted(tmp_path.iterdir()):
        assert read_lenses([file], "a", SIZE)["a"].lens_model == "fisheye", file
    for name in ("named.json", "c.toml"):
        assert read_calibration(tmp_path / name)["a"].lens_model == "fisheye"


@pytest.mark.parametrize(
    ("said", "model"),
    [
        ("projection: [[4, 0, 3, 0], [0, 4, 2, 0], [0, 0, 1, 0]]\nlens_model: Sigma 24mm", "brown"),
        ("projection: rectilinear\ntype: RadialTangential\nlens: 14mm Aspherical", "brown"),
        ("distortion_model: radial_tangential\nmodel: HERO12 wide FOV\nfisheye_views: 1", "brown"),
        ("distortion_type: polynomial\nmodel: OmniVision OV9281\nis_not_fisheye: true", "brown"),
        ("fisheye: true\nmodel: opencv\ndistortion_model: none\nlens_note: radial", "fisheye"),
    ],
)
def test_devices_and_other_things_are_no_lens_models(said, model, tmp_path):
    file = tmp_path / "lens.yaml"
    file.write_text(f"K: [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]\nD: [0, 0, 0, 0]\n{said}\n")
    assert read_lenses([file], "a", SIZE)["a"].lens_model == model


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ("distortion_model: fov\nD: [0.9]", "distortion_model: expected one of .* found 'fov'"),
        ("model: FOV\nD: [0.9]", "model: expected one of .* found 'fov'"),
        ("projection: stereographic\nD: [0.9]", "projection: expected one of"),
        ("D: [-0.05, 0.01, -0.2, 0.05]", "p1 and p2 up to 0.01.*fisheye_model: 1"),
        ("D: [-0.2, 0.05, 0.0, 0.0]\nxi: 1.1", "xi: .* found that of cv2.omnidir"),
        ("fisheye_model: 1\nD: [-0.1, 0.0, 0.0, 0.0, 0.3]", "k1 k2 k3 k4 of a fisheye"),
    ],
)
def test_a_lens_whose_model_is_unknown_or_unsaid_is_refused(lens, said, tmp_path):
    file = tmp_path / "lens.yaml"
    file.write_text(f"K: [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]\n{lens}\n")
    with pytest.raises(InputError, match=said):
        read_lenses([file], "a", SIZE)
