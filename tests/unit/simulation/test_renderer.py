import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.settings import RenderingSettings

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(light="floodlights", noise=0.0, stripes=0.0)
# A camera of a quarter of the usual size, which renders in a twentieth of the time.
VIEW = look_at_camera(
    *((-30.0, -60.0, 22.0), (-35.0, 0.0, 0.0), 560.0, (480, 270)),
    middle=(242.0, 131.0),
    lens=(-0.1, 0.02, 0.0, 0.0, 0.0),
    roll=0.01,
)


def cv_pixels(points):
    matrix = np.diag([*VIEW.focal, 1.0])
    matrix[:2, 2] = VIEW.principal_point
    pose = VIEW.cam_from_world
    lens = np.array(VIEW.distortion)
    return cv2.projectPoints(points, pose.rotvec, pose.translation, matrix, lens)[0].reshape(-1, 2)


def paint_middle(pixel, normal, fresh, bare):
    """Return the offset [px] of the paint's centre from a pixel, along the normal."""
    t = np.arange(-4.0, 4.01, 0.25)
    at = pixel + t[:, None] * normal
    added = (fresh[..., 1] - bare[..., 1]).astype(np.float32)
    x, y = at.T.astype(np.float32)
    profile = cv2.remap(added, x[None], y[None], cv2.INTER_LINEAR)[0]
    return float((t * profile).sum() / profile.sum())


@pytest.mark.parametrize("surveyed", [False, True])
def test_paint_lies_where_opencv_projects_the_template(surveyed):
    points = {
        "penalty_area_left_near_front": (-36.05, -20.1, -0.03),
        "center_mark": (0.0, 0.0, 0.3),
    }
    pitch = PitchTemplate.from_spec(PitchSpec(points=points)) if surveyed else PITCH
    fresh = render_pitch(VIEW, pitch, None, 0, PLAIN).astype(int)
    bare = render_pitch(VIEW, pitch, None, 0, PLAIN.model_copy(update={"paint": 0.0})).astype(int)
    middles = []
    for name in ("penalty_area_left_front", "penalty_area_left_near", "halfway_line"):
        samples = pitch.sample_lines(0.05)
        line = samples.points_world[samples.marking == samples.names.index(name)]
        pixels = cv_pixels(line)
        for index in range(60, len(line) - 60, 10):
            along = pixels[index + 1] - pixels[index - 1]
            normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
            near = np.abs(line[index] - [-36.0, 0.0, 0.0])[1]
            inside = (pixels[index] > 8).all() and (pixels[index] < VIEW.image_size - 9).all()
            if inside and not (name.endswith("front") and near < 10.0):
                middles.append(paint_middle(pixels[index], normal, fresh, bare))
    assert len(middles) > 50
    # Grey levels and straight interpolation; worn paint moves single places of lines that are a
    # pixel wide here.
    assert abs(np.mean(middles)) < 0.015
    assert np.percentile(np.abs(middles), 95) < 0.15
