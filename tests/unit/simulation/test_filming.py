"""Frames with people against OpenCV's projection of their bodies."""

import cv2
import numpy as np
import pytest

from worldpose.body import BodyParameters, load_open_body
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.casting import dress_people
from worldpose.simulation.filming import open_view, render_frame
from worldpose.simulation.image_formation import clusters
from worldpose.simulation.looks import RenderingSettings
from worldpose.simulation.mannequins import open_mannequin, pose_people, shape_people
from worldpose.simulation.stadium import looking

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(noise=0.0, stand_shadow=0.0)
ARMS_DOWN = 1.2


def people(places, turn=0.0):
    """Bodies that stand at places (n, 2) with their arms down, facing -y."""
    pose = np.zeros((len(places), 23, 3))
    pose[:, 15, 2], pose[:, 16, 2] = -ARMS_DOWN, ARMS_DOWN
    places = np.asarray(places, dtype=float)
    height = PITCH.height(places[:, 0], places[:, 1]) + 1.2
    return BodyParameters(
        np.zeros((len(places), 10)),
        np.array([np.pi / 2.0, 0.0, 0.0]),
        pose.reshape(len(places), 69),
        np.column_stack([places, height]),
    )


def camera(place=(-30.0, -60.0, 18.0), aim=(-30.0, -10.0, 0.0), k1=-0.2):
    return Camera(
        focal=np.array([1100.0, 1100.0]),
        principal_point=np.array([242.0, 131.0]),
        distortion=np.array([k1, 0.05, 0.002, -0.001, 0.01]),
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


PLACES = [(-30.0, -10.0), (-36.0, -6.0), (-24.0, -12.0)]


@pytest.fixture(scope="module")
def view():
    return open_view(camera(), PITCH, 3, PLAIN)


@pytest.fixture(scope="module")
def cast():
    return dress_people(np.zeros((3, 10)), ["first", "second", "official"], 3)


def test_boxes_are_opencvs_and_masks_are_under_the_mid_hips(view, cast):
    poses = people(PLACES)
    surfaces = cast.posed(poses)
    frame = render_frame(view, cast, surfaces)
    joints = load_open_body().joints(poses)
    for person in range(3):
        pixels = cv_pixels(view.camera, surfaces.vertices[person].astype(np.float64))
        expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
        # Single precision of 60 m and of 480 px.
        np.testing.assert_allclose(frame.boxes[person], expected, atol=2e-3)
        hip = cv_pixels(view.camera, joints[person, 1:3].mean(axis=0)[None])[0]
        u, v = np.rint(hip).astype(int)
        assert frame.person_ids[v, u] == person
        rows, columns = np.nonzero(frame.person_ids == person)
        # What fills half a pixel reaches its border within a pixel.
        found = [columns.min(), rows.min(), columns.max(), rows.max()]
        np.testing.assert_allclose(found, expected, atol=1.5)
    np.testing.assert_array_equal(frame.visible, 1.0)


def test_mannequins_have_the_bodys_vertices_under_their_clothes():
    poses = people(PLACES)
    mannequin = open_mannequin()
    body = mannequin.body.vertices(poses)[:, mannequin.kept]
    posed = pose_people(mannequin, shape_people(mannequin, poses.betas), poses).vertices
    # Clothes stand off by 5 cm at most, and some skin is bare. Joints blend four bones, not six.
    away = np.linalg.norm(posed - body, axis=-1)
    assert away.max() < 0.06
    assert np.median(away[:, mannequin.clothed[:, 0] > 0.5]) < 1e-3


def test_the_nearer_person_hides_the_farther(view, cast):
    middle = view.camera.center
    nearer = np.array([-30.0, -10.0])
    behind = middle[:2] + 1.03 * (nearer - middle[:2])
    places = [tuple(behind), tuple(nearer), PLACES[2]]
    frame = render_frame(view, cast, cast.posed(people(places)))
    assert frame.visible[1] == 1.0
    # 1.6 m behind, seen from 18 m above: head and shoulders show.
    assert 0.1 < frame.visible[0] < 0.6
    exchanged = render_frame(view, cast, cast.posed(people([places[1], places[0], places[2]])))
    np.testing.assert_array_equal(
        np.where(frame.person_ids == 0, 1, np.where(frame.person_ids == 1, 0, frame.person_ids)),
        exchanged.person_ids,
    )


def test_people_throw_shadows_and_leave_the_rest_alone(view, cast):
    frame = render_frame(view, cast, cast.posed(people(PLACES)))
    nobody = render_frame(view, cast, cast.posed(people([(-30.0, -300.0)] * 3)))
    assert (nobody.person_ids == -1).all()
    assert np.isnan(nobody.boxes).all()
    darker = nobody.picture.astype(int).sum(-1) - frame.picture.astype(int).sum(-1)
    shadow = (darker > 60) & (frame.person_ids == -1)
    # A person of 35 px throws one of about as many pixels as he fills.
    assert 0.3 < shadow.sum() / (frame.person_ids >= 0).sum() < 3.0
    changed = darker != 0
    assert changed.mean() < 0.1


def test_the_same_arguments_give_the_same_bytes_and_frames_differ_in_noise(cast):
    noisy = open_view(camera(), PITCH, 3, PLAIN.model_copy(update={"noise": 2.0}))
    opened = cast.posed(people(PLACES))
    closed = cast.posed(people(np.array(PLACES) + 0.05))
    one, two = (render_frame(noisy, cast, opened, closed) for _ in range(2))
    assert one.picture.tobytes() == two.picture.tobytes()
    assert one.person_ids.tobytes() == two.person_ids.tobytes()
    other = render_frame(noisy, cast, opened, closed, frame=1)
    assert one.person_ids.tobytes() == other.person_ids.tobytes()
    assert 0.0 < np.abs(one.picture.astype(int) - other.picture).mean() < 5.0


def test_missing_people_are_left_out(view, cast):
    poses = people(PLACES)
    transl = poses.transl.copy()
    transl[1] = np.nan
    gone = BodyParameters(poses.betas, poses.global_orient, poses.body_pose, transl)
    frame = render_frame(view, cast, cast.posed(gone))
    assert np.isnan(frame.boxes[1]).all()
    assert frame.visible.tolist() == [1.0, 0.0, 1.0]
    assert set(np.unique(frame.person_ids)) == {-1, 0, 2}


def test_fog_draws_everything_towards_its_grey(cast):
    foggy = open_view(camera(), PITCH, 3, PLAIN.model_copy(update={"fog": 0.05}))
    frame = render_frame(foggy, cast, cast.posed(people(PLACES)))
    # At 50 m 8 % of the contrast is left.
    spread = frame.picture[frame.person_ids >= 0].astype(float).std(axis=0)
    assert spread.max() < 12.0


def test_teams_wear_different_kits_and_everybody_the_same_in_every_order():
    first = dress_people(np.zeros((4, 10)), ["first", "second", "first", "second"], 8)
    middle = first.pictures[:, 1, 40:60, 60:90].astype(float)
    apart = np.abs(middle[0] - middle[1]).mean()
    assert apart > 40.0
    again = dress_people(np.zeros((2, 10)), ["first", "second"], 8)
    np.testing.assert_array_equal(again.pictures, first.pictures[:2])


def test_clusters_share_no_pixel_and_grow_until_they_do_not():
    spans = [(0, 0, 4, 4), (10, 0, 14, 4), None, (3, 3, 8, 8), (7, 0, 11, 9)]
    assert clusters(spans) == [((0, 0, 14, 9), [0, 1, 3, 4])]
    assert clusters([(0, 0, 4, 4), (4, 0, 8, 4)]) == [((0, 0, 4, 4), [0]), ((4, 0, 8, 4), [1])]
