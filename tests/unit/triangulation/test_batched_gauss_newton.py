import cv2
import numpy as np
import pytest

from worldpose.triangulation import batched_gauss_newton
from worldpose.triangulation.batched_gauss_newton import LANES, ROWS, STATE
from worldpose.triangulation.observations import Observations, Rig, gather, linearize

POINT = np.array([0.7, -1.1, 1.3])
NOISE = (2.0, 0.0)


def tiles_of(camera, image, confidence=None):
    """Tiles whose every lane sees pixels (cameras, 2)."""
    count = len(image)
    keypoints = np.broadcast_to(image[None, :, None, None], (1, count, 1, LANES, 2)).copy()
    precision = np.ones((1, count, 1, LANES))
    if confidence is not None:
        precision *= np.array(confidence)[:, None, None]
    rig = Rig.from_cameras(camera)
    tiles = np.empty((count, ROWS * LANES))
    index = np.zeros((1, count, 1), np.int64)
    gather(Observations.from_rig(rig, keypoints, precision, index), 0, tiles)
    for tile, one in zip(tiles, rig.cameras, strict=True):
        linearize(tile, one[None], 0)
    return rig, tiles


def state_at(point):
    state = np.zeros(STATE * LANES)
    state[: 3 * LANES] = np.repeat(point, LANES)
    state[batched_gauss_newton.SHARPNESS : batched_gauss_newton.SHARPNESS + LANES] = 0.0
    return state


@pytest.fixture
def views(ring):
    """Four views of `POINT`, each some pixels off."""
    camera = ring(4)
    off = np.array([[3, 1], [-2, 4], [1, 1], [0, -3]])
    return camera, camera.project(POINT[None])[:, 0] + off


def test_errors_are_cv2_pixel_errors_over_the_variance(views):
    camera, image = views
    confidence = [1.0, 0.5, 0.8, 0.3]
    rig, tiles = tiles_of(camera, image, confidence)
    state = state_at(POINT)
    for n in range(4):
        tiles[n, batched_gauss_newton.USED : batched_gauss_newton.USED + LANES] = 1.0
        batched_gauss_newton.accumulate(tiles[n], rig.depths[n], NOISE, state)
        matrix = np.diag([*camera.focal[n], 1.0])
        matrix[:2, 2] = camera.principal_point[n]
        pose = camera.cam_from_world[n]
        rotation = cv2.Rodrigues(pose.rotation)[0]
        pixel, _ = cv2.projectPoints(
            POINT[None], rotation, pose.translation, matrix, camera.distortion[n]
        )
        squared = ((pixel.ravel() - image[n]) ** 2).sum()
        # The lens is linearised over 5 px: less than 1 % of a squared length.
        found = tiles[n, batched_gauss_newton.SQUARED : batched_gauss_newton.SQUARED + LANES]
        np.testing.assert_allclose(found, squared * confidence[n] / 4.0, rtol=0.01)


def test_normal_equations_are_the_gradient_of_half_the_weighted_cost(views):
    camera, image = views
    rig, tiles = tiles_of(camera, image)
    tiles[:, batched_gauss_newton.USED : batched_gauss_newton.USED + LANES] = 1.0

    def cost_and_right(point):
        state = state_at(point)
        batched_gauss_newton.clear(state)
        for tile, depth in zip(tiles, rig.depths, strict=True):
            batched_gauss_newton.accumulate(tile, depth, NOISE, state)
        return 0.5 * tiles[:, batched_gauss_newton.SQUARED].sum(), state[
            batched_gauss_newton.RIGHT :: LANES
        ][:3]

    _, right = cost_and_right(POINT)
    step = 1e-5
    for axis in range(3):
        ahead, _ = cost_and_right(POINT + step * np.eye(3)[axis])
        behind, _ = cost_and_right(POINT - step * np.eye(3)[axis])
        # Central differences of a cost of about 10 with third derivatives of order 1e3.
        assert right[axis] == pytest.approx(-(ahead - behind) / (2 * step), rel=1e-5, abs=1e-3)
