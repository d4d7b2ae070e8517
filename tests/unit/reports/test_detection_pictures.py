"""Detections before and after, and paint with distances to it, show what they say."""

import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.clips import (
    LEFT_OUT,
    USED,
    ImageDetections,
    ReconstructedPeople,
    plot_detections,
)
from worldpose.reports.drawing import PALETTE, markings
from worldpose.reports.static_cameras import (
    NEAR_PAINT_PX,
    detect_paint,
    distance_to,
    marking_distances,
    plot_paint,
)


@pytest.fixture
def camera():
    """South of the pitch, 12 m up, looking north and down a little."""
    tilt = np.radians(14.0)
    down = np.array([0.0, -np.sin(tilt), -np.cos(tilt)])
    ahead = np.array([0.0, np.cos(tilt), -np.sin(tilt)])
    rotation = np.stack([[1.0, 0.0, 0.0], down, ahead])
    return Camera(
        focal=np.full(2, 900.0),
        principal_point=np.array([479.5, 269.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -rotation @ np.array([0.0, -50.0, 12.0])),
        image_size=np.array([960, 540]),
    )


def person_at(x):
    joints = np.zeros((17, 3))
    joints[:, 0] = x + np.linspace(-0.2, 0.2, 17)
    joints[:, 2] = np.linspace(1.8, 0.1, 17)
    return joints


def pixels_of(png, color):
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return np.argwhere((np.abs(image.astype(int) - wanted) < 12).all(-1)), image.shape


def drawn(camera, used, joints, keypoints):
    boxes = np.stack([np.r_[k.min(0) - 3, k.max(0) + 3] for k in keypoints])
    return plot_detections(
        camera,
        ImageDetections(boxes, keypoints, np.array(used)),
        ReconstructedPeople(joints, np.arange(len(joints)), np.ones(len(joints), dtype=bool)),
        pitch=PitchSpec(),
    )


def test_detections_are_on_the_left_by_use_and_people_on_the_right(camera):
    joints = np.stack([person_at(-2.0), person_at(2.0)])
    keypoints = camera.project(joints)
    png = drawn(camera, [0], joints, keypoints)
    (used, shape), (left_out, _) = (pixels_of(png, color) for color in (USED, LEFT_OUT))
    middle = shape[1] / 2
    assert len(used)
    assert (used[:, 1] < middle).all()
    before = left_out[left_out[:, 1] < middle]
    # Orange is also the second person's colour, on the right.
    assert len(before)
    assert np.median(before[:, 1]) > np.median(used[:, 1])
    first, _ = pixels_of(png, PALETTE[0])
    assert (first[:, 1] > middle).all()


def test_nobody_detected_and_nobody_found_is_still_a_picture(camera):
    gone = np.full((1, 17, 3), np.nan)
    png = plot_detections(
        camera,
        ImageDetections(
            np.full((2, 4), np.nan), np.full((2, 17, 2), np.nan), np.empty(0, dtype=int)
        ),
        ReconstructedPeople(gone, np.array([4]), np.zeros(1, dtype=bool)),
    )
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None


def painted(camera):
    """An image of grass with the markings as the camera has them, 5 px wide."""
    still = np.full((540, 960, 3), (40, 110, 45), dtype=np.uint8)
    for line in markings(PitchSpec()):
        pixels = camera.project(line)
        ahead = np.isfinite(pixels).all(-1) & (np.abs(pixels) < 5000).all(-1)
        if ahead.all():
            cv2.polylines(still, [np.rint(pixels).astype(np.int32)], False, (235, 240, 235), 5)
    return still


def test_paint_is_found_and_the_camera_puts_markings_on_it(camera):
    still = painted(camera)
    paint = detect_paint(still)
    truly = (still > 200).all(-1)
    assert (paint & truly).sum() > 0.9 * paint.sum()
    _, share = plot_paint(camera, still, PitchSpec())
    assert share > 0.95
    # Turned by 6 px, lines of 5 px are beside themselves but near.
    beside = Camera(
        focal=camera.focal,
        principal_point=camera.principal_point + np.array([6.0, 6.0]),
        distortion=camera.distortion,
        cam_from_world=camera.cam_from_world,
        image_size=camera.image_size,
    )
    off = marking_distances(beside, PitchSpec(), distance_to(paint))
    assert 1.5 < np.median(off) < NEAR_PAINT_PX


def test_a_wide_bright_stripe_and_specks_are_no_paint():
    still = np.full((200, 300, 3), 60, dtype=np.uint8)
    still[:, 100:160] = 230
    still[20:25, 20:25] = 230
    assert not detect_paint(still).any()
    assert np.isinf(distance_to(detect_paint(still))).all()
