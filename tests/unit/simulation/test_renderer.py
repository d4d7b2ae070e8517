import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.cast import dress_people
from worldpose.simulation.image_formation import Moment
from worldpose.simulation.renderer import film_broadcast, open_view, render_frame, render_pitch
from worldpose.simulation.scene import look_at
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import build_venue

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(light="floodlights", noise=0.0, stripes=0.0)


def camera(place=(-30.0, -60.0, 22.0), aim=(-35.0, 0.0, 0.0), k1=-0.1):
    """A camera of a quarter of the usual size, which renders in a twentieth of the time."""
    return Camera(
        focal=np.array([560.0, 560.0]),
        principal_point=np.array([242.0, 131.0]),
        distortion=np.array([k1, 0.02, 0.0, 0.0, 0.0]),
        cam_from_world=look_at(np.array(place), np.array(aim), 0.01),
        image_size=np.array([480, 270]),
    )


def cv_pixels(view, points):
    fx, fy = view.focal
    cx, cy = view.principal_point
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    pose = view.cam_from_world
    pixels, _ = cv2.projectPoints(
        points, pose.rotvec, pose.translation, matrix, np.array(view.distortion)
    )
    return pixels.reshape(-1, 2)


def standing(x, y):
    """Return an upright body (1,) in T-pose at a place of the pitch, its pelvis at 1.2 m."""
    place = np.array([[x, y, 1.2 + float(PITCH.height(x, y))]])
    upright = np.array([[np.pi / 2.0, 0.0, 0.0]])
    return BodyParameters(np.zeros((1, 10)), upright, np.zeros((1, 69)), place)


def paint_middle(pixel, normal, fresh, bare):
    """Return the offset [px] of the paint's centre from a pixel, along the normal."""
    t = np.arange(-4.0, 4.01, 0.25)
    at = pixel + t[:, None] * normal
    added = (fresh[..., 1].astype(np.float32) - bare[..., 1].astype(np.float32))[None]
    profile = cv2.remap(
        added[0], at[None, :, 0].astype(np.float32), at[None, :, 1].astype(np.float32), 1
    )[0]
    return float((t * profile).sum() / profile.sum())


@pytest.mark.parametrize("surveyed", [False, True])
def test_paint_lies_where_opencv_projects_the_template(surveyed):
    points = {
        "penalty_area_left_near_front": (-36.05, -20.1, -0.03),
        "center_mark": (0.0, 0.0, 0.3),
    }
    pitch = PitchTemplate.from_spec(PitchSpec(points=points)) if surveyed else PITCH
    view = camera()
    fresh = render_pitch(view, pitch, None, 0, PLAIN).astype(int)
    bare = render_pitch(view, pitch, None, 0, PLAIN.model_copy(update={"paint": 0.0})).astype(int)
    middles = []
    for name in ("penalty_area_left_front", "penalty_area_left_near", "halfway_line"):
        samples = pitch.sample_lines(0.05)
        line = samples.points_world[samples.marking == samples.names.index(name)]
        pixels = cv_pixels(view, line)
        for index in range(60, len(line) - 60, 10):
            along = pixels[index + 1] - pixels[index - 1]
            normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
            near = np.abs(line[index] - [-36.0, 0.0, 0.0])[1]
            inside = (pixels[index] > 8).all() and (pixels[index] < view.image_size - 9).all()
            if inside and not (name.endswith("front") and near < 10.0):
                middles.append(paint_middle(pixels[index], normal, fresh, bare))
    assert len(middles) > 50
    # Grey levels and straight interpolation; worn paint moves single places of lines that are a
    # pixel wide here.
    assert abs(np.mean(middles)) < 0.015
    assert np.percentile(np.abs(middles), 95) < 0.15


def test_people_are_drawn_where_they_project_and_throw_shadows():
    view, people = camera(), standing(-36.0, -5.0)
    joints = fold_keypoints(load_open_body(), SKELETONS["coco17"])(people)[0]
    empty = render_pitch(view, PITCH, None, 0, PLAIN).astype(int)
    changed = np.abs(render_pitch(view, PITCH, people, 0, PLAIN) - empty).max(axis=-1) > 5
    rows, columns = np.nonzero(changed)
    body = cv_pixels(view, joints)
    assert changed[tuple(np.rint(body[[5, 6, 11, 12]].mean(0)).astype(int)[::-1])]
    assert rows.min() == pytest.approx(body[:, 1].min(), abs=4)  # hair, 0.14 m above the eyes
    # Shadows of four lights reach beyond the hands on both sides.
    assert columns.min() < body[:, 0].min() - 3
    assert columns.max() > body[:, 0].max() + 3


NOISELESS = RenderingSettings(light="floodlights", noise=0.0, stand_shadow=0.0)
CENTER = np.array([0.3, -74.0, 15.0])


def turning(focal=(1500.0, 2400.0)):
    poses = [look_at(CENTER, np.array([x, 2.0, 0.0]), 0.003) for x in (-6.0, 5.0)]
    return Camera(
        focal=np.repeat(np.array(focal)[:, None], 2, axis=1),
        principal_point=np.array([478.0, 255.0]),
        distortion=np.array([0.4, 1.4, 0.0, 0.0, 0.0]),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.array([960, 540]),
    )


def test_people_of_a_clip_are_those_of_a_static_camera_with_the_same_lens():
    cameras = turning((2000.0, 2000.0))
    venue = build_venue(PITCH, 3, NOISELESS)
    cast = dress_people(np.zeros((1, 10)), ["first"], 3)
    posed = cast.pose(standing(0.0, 2.0))
    moments = [Moment(cast, posed, posed)] * 2
    for index, frame in enumerate(film_broadcast(cameras, venue, moments)):
        alone = render_frame(open_view(cameras[index], PITCH, 3, NOISELESS), cast, posed)
        assert (frame.person_ids == 0).sum() > 300
        np.testing.assert_array_equal(frame.person_ids, alone.person_ids)
        np.testing.assert_array_equal(frame.boxes, alone.boxes)
        # Grass is looked up between pixels of the panorama: somewhat softer, in the same light.
        apart = np.abs(frame.image.astype(int) - alone.image)
        assert np.percentile(apart, 90) <= 3.0
