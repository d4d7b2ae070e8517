from dataclasses import replace

import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.body import BodyParameters
from worldpose.errors import InputError
from worldpose.geometry import Camera, Rigid
from worldpose.pitch import PitchTemplate
from worldpose.simulation import RigSettings
from worldpose.simulation.cast import dress_people, goals
from worldpose.simulation.image_formation import Moment
from worldpose.simulation.matches import open_view, render_frame
from worldpose.simulation.renderer import (
    RenderingSettings,
    film_broadcast,
    render_broadcast,
    render_pitch,
)
from worldpose.simulation.scene import look_at, place_camera
from worldpose.simulation.surroundings import BOARD_HEIGHT, BOARD_SETBACK, scenery
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
    """Return the joints (17, 3) [m] of an upright person at a pitch position."""
    up = [1.6, 1.63, 1.63, 1.6, 1.6, 1.4, 1.4, 1.1, 1.1, 0.85, 0.85, 0.9, 0.9, 0.5, 0.5, 0.08, 0.08]
    side = [0.0, 0.03, -0.03, 0.07, -0.07, 0.18, -0.18, 0.2, -0.2, 0.2, -0.2] + [0.1, -0.1] * 3
    joints = np.stack([np.full(17, x) + side, np.full(17, y), np.array(up)], axis=-1)
    return joints + [0.0, 0.0, float(PITCH.height(x, y))]


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


def test_same_seed_gives_the_same_bytes():
    view, people = camera(), standing(-30.0, -5.0)[None]
    first = render_pitch(view, PITCH, people, 3)
    assert first.tobytes() == render_pitch(view, PITCH, people, 3).tobytes()
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


def test_pictures_are_those_of_the_single_renderer():
    cameras = turning()
    for frame, picture in enumerate(render_broadcast(cameras, PITCH, None, 3, NOISELESS)):
        alone = render_pitch(cameras[frame], PITCH, None, 3, NOISELESS)
        one, two = (each[..., 1].astype(np.float32) for each in (picture, alone))
        shift, response = cv2.phaseCorrelate(one, two)
        # A lens inverted on a grid and looked up between pixels: hundredths of a pixel.
        assert np.abs(shift).max() < 0.03
        assert response > 0.9
        assert np.percentile(np.abs(one - two), 90) <= 3.0


def test_people_are_drawn_where_they_are():
    cameras = turning((2000.0, 2000.0))
    joints = np.full((2, 1, 17, 3), np.nan)
    joints[:] = np.array([0.0, 0.0, 1.0]) + np.linspace(-0.3, 0.3, 17)[:, None] * [1.0, 0.0, 1.0]
    empty, peopled = (
        list(render_broadcast(cameras, PITCH, people, 3, NOISELESS)) for people in (None, joints)
    )
    for frame in range(2):
        changed = np.abs(empty[frame].astype(int) - peopled[frame]).sum(axis=-1) > 30
        v, u = np.nonzero(changed)
        middle = cameras[frame].project(np.array([[0.0, 0.0, 1.0]]))[0]
        # Limbs reach as far to one side as to the other, within a fifth of the person.
        np.testing.assert_allclose([u.mean(), v.mean()], middle, atol=6.0)


def test_the_same_arguments_give_the_same_bytes():
    one, two = (
        next(iter(render_broadcast(turning(), PITCH, None, 4, RenderingSettings())))
        for _ in range(2)
    )
    np.testing.assert_array_equal(one, two)


def test_people_of_a_clip_are_those_of_a_static_camera_with_the_same_lens():
    cameras = turning((2000.0, 2000.0))
    venue = build_venue(PITCH, 3, NOISELESS)
    cast = dress_people(np.zeros((1, 10)), ["first"], 3)
    upright = np.array([[np.pi / 2.0, 0.0, 0.0]])
    stands = BodyParameters(np.zeros((1, 10)), upright, np.zeros((1, 69)), np.array([[0, 2, 1.4]]))
    posed = cast.pose(stands)
    moments = [Moment(cast, posed, posed, goals(PITCH))] * 2
    for index, frame in enumerate(film_broadcast(cameras, venue, moments)):
        alone = render_frame(open_view(cameras[index], PITCH, 3, NOISELESS), cast, posed)
        assert (frame.person_ids == 0).sum() > 300
        np.testing.assert_array_equal(frame.person_ids, alone.person_ids)
        np.testing.assert_array_equal(frame.boxes, alone.boxes)
        # Grass is looked up between pixels of the panorama: somewhat softer, in the same light.
        apart = np.abs(frame.image.astype(int) - alone.image)
        assert np.percentile(apart, 90) <= 3.0


def test_a_camera_that_walks_is_refused():
    cameras = turning()
    walking = replace(
        cameras,
        cam_from_world=Rigid(
            cameras.cam_from_world.rotation,
            cameras.cam_from_world.translation + np.array([[0.0] * 3, [0.1, 0.0, 0.0]]),
        ),
    )
    with pytest.raises(InputError, match="one center"):
        list(render_broadcast(walking, PITCH, None, 3, NOISELESS))


RIG = RigSettings()
UP = np.array([0.0, 0.0, 1.0])
TARGET = np.array([-20.0, 14.0, -0.03])


def ring(count):
    return [
        place_camera(RIG, i, TARGET, PitchSpec(), np.random.default_rng(i)) for i in range(count)
    ]


def test_cameras_stand_off_the_pitch_where_the_settings_say():
    for camera in ring(12):
        x, y, z = camera.center
        beyond = max(abs(x) - 52.5, abs(y) - 34.0)
        # Along a slanted way of 6 m and more behind the line, at most 1.5 m more or a third less.
        assert beyond > 3.0
        assert beyond < 30.0
        assert 10.0 <= z - TARGET[2] <= 20.0
        assert camera.image_size.tolist() == [1920, 1080]
        assert camera.distortion[2:].tolist() == [0.0, 0.0, 0.0]


def test_cameras_surround_the_target():
    azimuths = sorted(np.arctan2(*(camera.center - TARGET)[1::-1]) for camera in ring(6))
    gaps = np.diff([*azimuths, azimuths[0] + 2 * np.pi])
    # Golden steps leave gaps of at most 0.236 turns among six, and cameras stand 0.02 off.
    assert gaps.max() <= 2 * np.pi * (0.237 + 0.04)


def test_the_target_is_near_the_middle_of_the_picture_and_upright():
    for camera in ring(12):
        foot, head = camera.project(TARGET + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.8]]))
        # 1.5 m off the target is 96 px, or 136 px along the diagonal; nearer ones see more.
        assert np.abs(0.5 * (foot + head) - [960, 540]).max() < 150
        assert head[1] < foot[1]
        assert abs(head[0] - foot[0]) < 0.05 * (foot[1] - head[1])


def test_a_standard_person_at_the_target_is_as_tall_as_asked():
    for camera in ring(12):
        foot, head = camera.project(TARGET + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.8]]))
        # The aim is up to 2 m nearer or farther than the target, of at least 30 m: 7 %.
        assert foot[1] - head[1] == pytest.approx(115.0, rel=0.07)


def test_people_in_the_area_are_80_to_200_px_tall():
    corners = TARGET + np.array([[x, y, 0.0] for x in (-10, 10) for y in (-7, 7)])
    for camera in ring(12):
        for height, least, most in ((1.7, 75.0, 190.0), (1.95, 80.0, 215.0)):
            feet, heads = camera.project(corners), camera.project(corners + height * UP)
            tall = np.linalg.norm(heads - feet, axis=-1)
            assert least < tall.min()
            assert tall.max() < most


def test_lenses_are_one_to_one_in_the_whole_picture():
    u, v = np.meshgrid(np.linspace(0, 1919, 9), np.linspace(0, 1079, 9))
    for camera in ring(12):
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
        rays = camera.unproject(pixels)
        # Unprojection converges to 1e-9 px or better (worldpose.geometry).
        np.testing.assert_allclose(
            camera.project(rays.origins + 40.0 * rays.directions), pixels, atol=1e-6
        )


HALF = np.array([52.5, 34.0]) + BOARD_SETBACK
BEND = 0.2 / 34.0**2


def look(start, at):
    """Return colour and distance [m] of the surface seen from `start` in the direction of `at`."""
    way = np.array(at, dtype=float) - start
    *color, steps = scenery(np.array(start, dtype=float), *way, HALF, np.array([0.0, BEND]), 3)
    return color, steps * np.linalg.norm(way)


@pytest.mark.parametrize("height", [17.0, 25.0])
def test_a_main_camera_built_into_its_stand_or_above_it_sees_the_far_stand(height):
    start = [0.0, -75.0, height]  # the near stand is 18.2 m high there
    color, distance = look(start, [0.0, 60.0, 9.9])
    assert min(color) >= 0.0
    # Rows rise 0.55 m per metre from 42 m behind the middle: 9.9 m high 60 m behind it.
    assert distance == pytest.approx(np.linalg.norm([135.0, height - 9.9]), abs=1e-6)


def test_a_ray_down_to_the_pitch_ends_on_grass():
    color, _ = look([0.0, -75.0, 17.0], [10.0, 5.0, -BEND * 25.0])
    assert color[0] == -1.0


def test_a_board_hides_the_ground_behind_it():
    start = [0.0, 0.0, 10.0]
    _, distance = look(start, [HALF[0], 0.0, 0.5 * BOARD_HEIGHT])
    assert distance == pytest.approx(np.hypot(HALF[0], 10.0 - 0.5 * BOARD_HEIGHT), abs=1e-6)
