"""Rendered pictures against OpenCV's projection of what is painted."""

import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.rendering import RenderingSettings, render_pitch
from worldpose.simulation.stadium import looking

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(light="floodlights", noise=0.0, stripes=0.0)


def camera(place=(-30.0, -60.0, 22.0), aim=(-35.0, 0.0, 0.0), k1=-0.1):
    """A camera of a quarter of the usual size, which renders in a twentieth of the time."""
    return Camera(
        focal=np.array([560.0, 560.0]),
        principal_point=np.array([242.0, 131.0]),
        distortion=np.array([k1, 0.02, 0.0, 0.0, 0.0]),
        cam_from_world=looking(np.array(place), np.array(aim), 0.01),
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
    """Somebody upright at a place of the pitch (17, 3)."""
    up = [1.6, 1.63, 1.63, 1.6, 1.6, 1.4, 1.4, 1.1, 1.1, 0.85, 0.85, 0.9, 0.9, 0.5, 0.5, 0.08, 0.08]
    side = [0.0, 0.03, -0.03, 0.07, -0.07, 0.18, -0.18, 0.2, -0.2, 0.2, -0.2] + [0.1, -0.1] * 3
    joints = np.stack([np.full(17, x) + side, np.full(17, y), np.array(up)], axis=-1)
    return joints + [0.0, 0.0, float(PITCH.height(x, y))]


def paint_middle(pixel, normal, fresh, bare):
    """Where the paint's middle lies along a normal through a pixel, from what paint added."""
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


def test_paint_has_its_width():
    view = camera(aim=(-36.0, -20.0, 0.0))
    fresh = render_pitch(view, PITCH, None, 0, PLAIN)[..., 1].astype(float)
    bare = render_pitch(view, PITCH, None, 0, PLAIN.model_copy(update={"paint": 0.0}))[..., 1]
    ends = np.array([[-36.0, -12.0], [-36.0, -14.0]])
    edges = np.array([[x + s * 0.06, y] for x, y in ends for s in (-1.0, 1.0)])
    world = np.column_stack([edges, PITCH.height(edges[:, 0], edges[:, 1])])
    a, b, c, d = cv_pixels(view, world)
    covered = 0.5 * abs(np.cross(np.append(d - a, 0.0), np.append(c - b, 0.0))[2])
    low, high = np.floor(min(a[1], c[1])), np.ceil(max(a[1], c[1]))
    rows = np.arange(int(low) - 1, int(high) + 2)
    top, bottom = min(a[1], c[1]), max(a[1], c[1])
    share = np.clip(np.minimum(rows + 0.5, bottom) - np.maximum(rows - 0.5, top), 0.0, 1.0)
    left, right = int(min(a[0], b[0], c[0], d[0])) - 3, int(max(a[0], b[0], c[0], d[0])) + 4
    added = (fresh - bare)[rows, left:right].sum(axis=1)
    # Paint adds 0.91 - 0.475 of full brightness where it hides 0.88 of the grass on average.
    assert (added * share).sum() / (0.88 * 0.435 * 255.0) == pytest.approx(covered, rel=0.12)


def test_same_seed_gives_the_same_bytes_and_frames_differ_in_noise_alone():
    view, people = camera(), standing(-30.0, -5.0)[None]
    first = render_pitch(view, PITCH, people, 3)
    assert first.tobytes() == render_pitch(view, PITCH, people, 3).tobytes()
    other = render_pitch(view, PITCH, people, 3, frame=1).astype(int) - first
    assert 0.0 < np.abs(other).mean() < 5.0  # noise of 2 levels, twice
    assert (render_pitch(view, PITCH, people, 4) != first).mean() > 0.5


def test_people_are_drawn_where_they_project_and_throw_shadows():
    view, joints = camera(), standing(-36.0, -5.0)[None]
    empty = render_pitch(view, PITCH, None, 0, PLAIN).astype(int)
    changed = np.abs(render_pitch(view, PITCH, joints, 0, PLAIN) - empty).max(axis=-1) > 5
    rows, columns = np.nonzero(changed)
    body = cv_pixels(view, joints[0])
    assert changed[tuple(np.rint(body[[5, 6, 11, 12]].mean(0)).astype(int)[::-1])]
    assert rows.min() == pytest.approx(body[:, 1].min(), abs=4)  # hair, 0.14 m above the eyes
    # Shadows of four lights reach beyond the arms on both sides.
    assert columns.min() < body[:, 0].min() - 3
    assert columns.max() > body[:, 0].max() + 3


def test_people_with_missing_joints_or_behind_the_camera_are_left_out():
    view = camera()
    empty = render_pitch(view, PITCH, None, 0, PLAIN)
    nobody = np.full((1, 17, 3), np.nan)
    behind = standing(-30.0, -100.0)[None]
    for people in (nobody, behind, np.empty((0, 17, 3))):
        assert (render_pitch(view, PITCH, people, 0, PLAIN) == empty).all()


def test_stand_and_sky_fill_a_picture_without_pitch():
    view = camera(place=(0.0, -60.0, 20.0), aim=(0.0, 40.0, 40.0))
    picture = render_pitch(view, PITCH, None, 0)
    green = picture[..., 1].astype(int) - picture[..., 0] > 25
    assert green.mean() < 0.01


def test_batch_of_cameras_and_other_joints_are_refused():
    with pytest.raises(InputError, match="single camera"):
        render_pitch(Camera.stack([camera(), camera()]), PITCH, None, 0)
    with pytest.raises(InputError, match="persons, 17, 3"):
        render_pitch(camera(), PITCH, np.zeros((2, 15, 3)), 0)
