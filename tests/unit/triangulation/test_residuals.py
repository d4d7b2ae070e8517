import numpy as np
import pytest

from worldpose.triangulation.residuals import (
    LANES,
    Buffers,
    Observations,
    Rig,
    add_data,
    clear,
    read_tile,
)

POINT = np.array([0.7, -1.1, 1.3])
NOISE = (2.0, 0.0)


def buffers_of(camera, image):
    """Buffers in which every lane sees pixels (cameras, 2), and its joint is at `POINT`."""
    count = len(image)
    keypoints = np.broadcast_to(image[None, :, None, None], (1, count, 1, LANES, 2)).copy()
    precision = np.ones((1, count, 1, LANES))
    rig, buffers = Rig.from_cameras(camera), Buffers.of(count)
    index = np.zeros((1, count, 1), np.int64)
    read_tile(Observations.of(rig, keypoints, precision, index), 0, buffers.tiles)
    buffers.tiles["used"] = 1.0
    buffers.state["point"] = POINT[:, None]
    return rig, buffers


@pytest.fixture
def views(ring):
    """Four views of `POINT`, each some pixels off."""
    camera = ring(4)
    off = np.array([[3, 1], [-2, 4], [1, 1], [0, -3]])
    return camera, camera.project(POINT[None])[:, 0] + off


def test_normal_equations_are_the_gradient_of_half_the_weighted_cost(views):
    camera, image = views
    rig, buffers = buffers_of(camera, image)
    state = buffers.state[0]

    def cost_and_right(point):
        state["point"][:] = point[:, None]
        clear(state)
        for tile, depth in zip(buffers.tiles, rig.depths, strict=True):
            add_data(tile, depth, NOISE, state)
        return 0.5 * buffers.tiles["squared"][:, 0].sum(), state["right"][:, 0].copy()

    _, right = cost_and_right(POINT)
    step = 1e-5
    for axis in range(3):
        ahead, _ = cost_and_right(POINT + step * np.eye(3)[axis])
        behind, _ = cost_and_right(POINT - step * np.eye(3)[axis])
        # Central differences of a cost of about 10 with third derivatives of order 1e3.
        assert right[axis] == pytest.approx(-(ahead - behind) / (2 * step), rel=1e-5, abs=1e-3)
