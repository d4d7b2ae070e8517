"""The page plays the results, to half a centimetre."""

import base64
import json
import re

import numpy as np
import pytest

from worldpose.formats import JointTracks
from worldpose.geometry import Camera, Rigid
from worldpose.reports import Scene
from worldpose.reports.html_page import MISSING, NUMBERS, UNIT, scene_html


def shown(scene):
    data = re.search(r'<script type="application/json">(.*?)</script>', scene_html(scene), re.S)
    content = json.loads(data[1])
    raw = np.frombuffer(base64.b64decode(content["joints"]), "<i2")
    joints = raw.reshape(content["frames"], content["persons"], 17, 3)
    return content, np.where(joints == MISSING, np.nan, joints * UNIT)


def walkers(frames, persons=2, first=7):
    rng = np.random.default_rng(1)
    joints = rng.uniform(-60.0, 60.0, (frames, persons, 17, 3))
    return JointTracks(np.arange(first, first + frames), np.arange(persons), joints)


def test_joints_are_those_of_the_tracks_and_gaps_stay_gaps():
    tracks = walkers(5)
    tracks.joints[2, 1] = np.nan
    tracks.joints[3, 0, 9, 1] = np.nan
    content, joints = shown(Scene("a clip", tracks, 25.0, {}))
    assert (content["first"], content["every"], content["fps"]) == (7, 1, 25.0)
    np.testing.assert_allclose(joints[0], tracks.joints[0], atol=0.5 * UNIT + 1e-12)
    assert np.isnan(joints[2, 1]).all()
    # A joint without one coordinate is no joint.
    assert np.isnan(joints[3, 0, 9]).all()
    assert np.isfinite(joints[3, 0, 8]).all()


def test_what_is_too_far_away_is_missing_and_not_wrapped_around():
    tracks = walkers(1, 1)
    tracks.joints[0, 0, 0, 0] = 200.0
    _, joints = shown(Scene("a clip", tracks, 25.0, {}))
    assert np.isnan(joints[0, 0, 0]).all()


@pytest.mark.parametrize(
    ("frames", "persons", "fps", "every"), [(100, 2, 50.0, 2), (6000, 22, 50.0, 5)]
)
def test_frames_are_left_out_until_it_is_small_enough(frames, persons, fps, every):
    joints = np.zeros((frames, persons, 17, 3))
    tracks = JointTracks(np.arange(frames), np.arange(persons), joints)
    content, found = shown(Scene("a clip", tracks, fps, {}))
    assert content["every"] == every
    assert len(found) == -(-frames // every)
    assert found.size <= NUMBERS


def test_the_broadcast_camera_of_a_frame_is_that_of_the_frame():
    tracks = walkers(4)
    focal = np.array([[1000.0, 1000.0], [2000.0, 2000.0], [3000.0, 3000.0], [np.nan, np.nan]])
    moving = Camera(
        focal=focal,
        principal_point=np.full((4, 2), 500.0),
        distortion=np.zeros((4, 5)),
        cam_from_world=Rigid(np.tile(np.eye(3), (4, 1, 1)), np.arange(12.0).reshape(4, 3)),
        image_size=np.array([1920, 1080]),
    )
    content, _ = shown(Scene("a clip", tracks, 50.0, {}, moving))
    rows = np.frombuffer(base64.b64decode(content["broadcast"]), "<f4").reshape(2, 15)
    np.testing.assert_array_equal(rows[1, 9:], [6.0, 7.0, 8.0, 3000.0, 1920.0, 1080.0])


def test_names_cannot_leave_the_data():
    tracks = walkers(1)
    camera = Camera(
        focal=np.ones(2),
        principal_point=np.zeros(2),
        distortion=np.zeros(5),
        cam_from_world=Rigid(np.eye(3), np.zeros(3)),
        image_size=np.array([10, 10]),
    )
    text = scene_html(Scene('"><b>', tracks, 25.0, {"</script><b>": camera}))
    assert text.count("</script>") == 1
    assert "<b>" not in text.replace(r"<\/script><b>", "")
