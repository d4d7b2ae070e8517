"""Rational and fisheye lenses at every door: what files say, and what the pixels then are."""

import cv2
import numpy as np
import pytest

from data_contracts.cameras import COEFFICIENTS, CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.geometry.cameras import Camera, camera_arrays, camera_from_arrays
from worldpose.geometry.lens_fit import fit_brown_lens

LENSES = {
    "fisheye": (-0.05, 0.01, -0.002, 0.0005),
    "rational": (0.4, -0.05, 1e-3, -2e-3, 0.01, 0.7, 0.02, 0.003),
}
SIZE = {"a": (640, 480)}
ROS = {"fisheye": "equidistant", "rational": "rational_polynomial"}


def camera_of(model, **changes):
    values = {
        "id": "a",
        "image_size": (640, 480),
        "focal_px": (400.0, 402.0),
        "principal_point_px": (319.5, 239.5),
        "distortion": LENSES[model],
        "lens_model": model,
        "rotation": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
        "translation": (0.1, 1.2, 4.0),
    }
    return CameraCalibration(**{**values, **changes})


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
    """Files of several programs with the lens of a model."""
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
    ["model: Fisheye", "camera_model: OPENCV_FISHEYE", "type: fisheye", "projection: equidistant"],
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
    ("lens", "said"),
    [
        ("distortion_model: fov\nD: [0.9]", "distortion_model: expected one of .* found 'fov'"),
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


def test_records_refuse_coefficients_of_another_model():
    for model, names in COEFFICIENTS.items():
        with pytest.raises(ValueError, match="found 3 numbers"):
            camera_of("fisheye", lens_model=model, distortion=(0.0,) * 3)
        assert camera_of("fisheye", lens_model=model, distortion=(0.0,) * len(names))


@pytest.mark.parametrize("model", LENSES)
def test_browns_nearest_lens_states_its_largest_error(model):
    camera = Camera.from_calibration(camera_of(model, focal_px=(700.0, 700.0)))
    near, error = fit_brown_lens(camera)
    rng = np.random.default_rng(0)
    rays = camera.unproject(rng.uniform([0, 0], [639, 479], (500, 2)))
    points = rays.origins + 5.0 * rays.directions
    off = np.linalg.norm(near.project(points) - camera.project(points), axis=1)
    assert 0.2 * error < off.max() <= 1.01 * error < 0.1
