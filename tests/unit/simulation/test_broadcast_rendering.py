"""The broadcast camera's pictures are those that a renderer of single pictures makes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from worldpose.body import BodyParameters
from worldpose.errors import InputError
from worldpose.geometry import Camera, Rigid
from worldpose.pitch import PitchTemplate
from worldpose.simulation.broadcast_rendering import film_broadcast, render_broadcast
from worldpose.simulation.casting import dress_people
from worldpose.simulation.filming import open_view, render_frame
from worldpose.simulation.image_formation import Moment
from worldpose.simulation.props import goals
from worldpose.simulation.rendering import RenderingSettings, render_pitch
from worldpose.simulation.stadium import looking
from worldpose.simulation.venues import build_venue

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(light="floodlights", noise=0.0, stand_shadow=0.0)
CENTER = np.array([0.3, -74.0, 15.0])


def turning(focal=(1500.0, 2400.0)):
    poses = [looking(CENTER, np.array([x, 2.0, 0.0]), 0.003) for x in (-6.0, 5.0)]
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
    for frame, picture in enumerate(render_broadcast(cameras, PITCH, None, 3, PLAIN)):
        alone = render_pitch(cameras[frame], PITCH, None, 3, PLAIN)
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
        list(render_broadcast(cameras, PITCH, people, 3, PLAIN)) for people in (None, joints)
    )
    for frame in range(2):
        changed = np.abs(empty[frame].astype(int) - peopled[frame]).sum(axis=-1) > 30
        v, u = np.nonzero(changed)
        middle = cameras[frame].project(np.array([[0.0, 0.0, 1.0]]))[0]
        # Limbs reach as far to one side as to the other, within a fifth of the figure.
        np.testing.assert_allclose([u.mean(), v.mean()], middle, atol=6.0)


def test_the_same_arguments_give_the_same_bytes():
    one, two = (
        next(iter(render_broadcast(turning(), PITCH, None, 4, RenderingSettings())))
        for _ in range(2)
    )
    np.testing.assert_array_equal(one, two)


def test_people_of_a_clip_are_those_of_a_static_camera_with_the_same_lens():
    cameras = turning((2000.0, 2000.0))
    venue = build_venue(PITCH, 3, PLAIN)
    cast = dress_people(np.zeros((1, 10)), ["first"], 3)
    upright = np.array([[np.pi / 2.0, 0.0, 0.0]])
    stands = BodyParameters(np.zeros((1, 10)), upright, np.zeros((1, 69)), np.array([[0, 2, 1.4]]))
    posed = cast.posed(stands)
    moments = [Moment(cast, posed, posed, goals(PITCH))] * 2
    for index, frame in enumerate(film_broadcast(cameras, venue, moments)):
        alone = render_frame(open_view(cameras[index], PITCH, 3, PLAIN), cast, posed)
        assert (frame.person_ids == 0).sum() > 300
        np.testing.assert_array_equal(frame.person_ids, alone.person_ids)
        np.testing.assert_array_equal(frame.boxes, alone.boxes)
        # Grass is looked up between pixels of the panorama: somewhat softer, in the same light.
        apart = np.abs(frame.picture.astype(int) - alone.picture)
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
        list(render_broadcast(walking, PITCH, None, 3, PLAIN))
