"""A wide still of a stadium with its lens, pose and people; skipped where it is absent.

WORLDPOSE_TEST_DATA names a folder with `sskit`: the folder `example` of Spiideo/sskit.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from real_data import GIVEN, needs

from data_contracts.cameras import COEFFICIENTS, LensCalibration
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_fit import fit_lens
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.proposal import calibrate_proposal, propose_camera

DATA = GIVEN / "sskit"
pytestmark = needs("sskit")
SIZE = np.array([3840, 2160])
# Their x is across the pitch, their y along it, towards what is left in the world of this project.
WORLD = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def lens():
    """The fisheye that follows the polynomial of the angle by the radius."""
    stated = json.loads((DATA / "lens.json").read_text())
    edges = [np.linspace(-0.5, length - 0.5, 41) for length in SIZE]
    pixels = np.stack(np.meshgrid(*edges), axis=-1).reshape(-1, 2)
    offset = (pixels - 0.5 * (SIZE - 1)) / SIZE[0]
    radius = np.linalg.norm(offset, axis=1)
    angle = -np.radians(
        np.polynomial.polynomial.polyval(radius * stated["sensor_width"], stated["dist_poly"])
    )
    plane = offset * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None]
    start = Camera(np.full(2, 2600.0), 0.5 * (SIZE - 1), np.zeros(8), Rigid.identity(), SIZE)
    free = ("fx", "fy", *COEFFICIENTS["fisheye"])
    fit = fit_lens(start, plane, pixels, LensModel.FISHEYE, free)
    rays = np.insert(plane, 2, 1.0, axis=1)
    return fit.camera, np.linalg.norm(fit.camera.project(rays) - pixels, axis=1), radius


def test_the_fisheye_follows_the_real_lens_within_half_a_pixel(lens):
    _, off, radius = lens
    assert np.sqrt((off**2).mean()) < 0.2
    # The polynomial is 0.04 degrees at radius 0, where no lens has a jump.
    assert off[radius > 0.08].max() < 0.5


@pytest.mark.slow
def test_calibration_without_clicks_places_feet_or_is_refused(lens):
    camera = lens[0]
    pose = -np.load(DATA / "camera_matrix.npy")[:3]
    turn, shift = Rigid(pose[:, :3] @ WORLD.T, pose[:, 3]).rotation, pose[:, 3]
    u, _, v = np.linalg.svd(turn)
    true = replace(camera, cam_from_world=Rigid(u @ v, shift))
    things = json.loads((DATA / "objects.json").read_text()).values()
    people = [
        np.array(one["smpl_matrix_world"])[:3, 3] for one in things if one["class"] == "human"
    ]
    feet = np.array(people) @ WORLD.T
    given = LensCalibration(
        id="wide",
        image_size=tuple(SIZE.tolist()),
        focal_px=float(camera.focal.mean()),
        principal_point_px=tuple(camera.principal_point.tolist()),
        distortion=tuple(camera.coefficients.tolist()),
        lens_model="fisheye",
        focal_std_px=5.0,
        principal_point_std_px=3.0,
        distortion_std=0.002,
    )
    picture = cv2.cvtColor(cv2.imread(str(DATA / "rgb.jpg")), cv2.COLOR_BGR2RGB)
    pitch = PitchTemplate.from_spec(PitchSpec(length=101.64, width=65.86))
    try:
        proposal = propose_camera(picture, pitch, side="near", lens=given)
        found = calibrate_proposal(pitch, proposal, picture, lens=given)
    except InputError as error:
        assert "expected one camera that explains the paint" in str(error)
        return
    rays = found.estimate.camera.unproject(true.project(feet))
    hit = rays.origins - (rays.origins[:, 2] / rays.directions[:, 2])[:, None] * rays.directions
    assert np.median(np.linalg.norm(hit - feet, axis=1)) < 0.3
