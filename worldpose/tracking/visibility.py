"""Expected visibility of people in cameras, and the rate at which cameras miss them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.geometry import Camera

SEEN_JOINTS: Final = 4
"""Keypoints on a body's image from which on a camera has a detection there [1]."""
BODY_WIDTH: Final = 0.2
"""A ray that passes a joint within this distance is on the body [m]."""
INSIDE: Final = 0.8
"""Share of a body's joints in the image from which a camera should see it [1]."""


FARTHER: Final = 1.25
"""Range of a camera over the largest distance of people it has shown [1]."""


class CameraSight:
    """Expected visibility and misses of cameras, learned from known people.

    Attributes:
        centers: (cameras, 3) [m], world.
        reach: (cameras,) greatest distance of a person that the camera showed [m].
        shown: (cameras,) number of people that the camera should have shown [1].
        missed: (cameras,) of these, people without a detection [1].
    """

    def __init__(self, cameras: Camera) -> None:
        self.centers = np.ascontiguousarray(cameras.center)
        self._cameras = cameras
        count = len(self.centers)
        self.reach = np.zeros(count)
        self.shown, self.missed = np.zeros(count), np.zeros(count)

    def should_see(self, joints: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which cameras (cameras, n) should see bodies (n, 17, 3) [m].

        Most joints must be in the image, and the camera must have shown people at a similar
        distance. NaN joints do not count.
        """
        n, joint_count, _ = joints.shape
        image = self._cameras.project(joints.reshape(-1, 3)).reshape(-1, n, joint_count, 2)
        size = self._cameras.image_size[:, None, None]
        with np.errstate(invalid="ignore"):
            inside = ((image >= 0.0) & (image <= size)).all(axis=-1).sum(axis=-1)
        known = np.isfinite(joints[..., 0]).sum(axis=1)
        return np.asarray((inside >= INSIDE * known) & (known > 0) & self._in_reach(joints))

    def _in_reach(self, joints: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether bodies (n, 17, 3) are within each camera's range (cameras, n)."""
        away = np.linalg.norm(np.nanmean(joints, axis=1) - self.centers[:, None], axis=-1)
        return np.asarray(away <= FARTHER * self.reach[:, None])

    def learn(
        self,
        joints: NDArray[np.float64],
        directions: NDArray[np.float64],
        weights: NDArray[np.float64],
        seen: NDArray[np.bool_],
    ) -> None:
        """Update with the known people of a frame.

        Args:
            joints: (n, 17, 3) [m], world; NaN where unknown, not all of one person.
            directions: (cameras, detections, 17, 3) unit rays, world; NaN where not seen.
            weights: (cameras, detections, 17); 0 where not seen.
            seen: (cameras, n) whether the camera shows the person.
        """
        away = np.linalg.norm(np.nanmean(joints, axis=1) - self.centers[:, None], axis=-1)
        self.reach = np.maximum(self.reach, np.where(seen, away, 0.0).max(axis=1, initial=0.0))
        expected = self.should_see(joints)
        self.shown += expected.sum(axis=1)
        empty = expected & ~seen
        if empty.any():
            empty &= ~bodies_covered(joints, self.centers, directions, weights)
            self.missed += empty.sum(axis=1)

    def misses_score(
        self,
        joints: NDArray[np.float64],
        directions: NDArray[np.float64],
        weights: NDArray[np.float64],
        own: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Return the log probability (n,) that cameras miss bodies which they should see.

        A camera that cannot see the position adds nothing, and neither does one with a detection
        there, which may occlude the body.

        Args:
            joints: (n, 17, 3) [m], world.
            directions: (cameras, detections, 17, 3) unit rays, world; NaN where not seen.
            weights: (cameras, detections, 17); 0 where not seen.
            own: (cameras, n) cameras whose detections the body is from.
        """
        if not len(joints):
            return np.zeros(0)
        empty = self.should_see(joints) & ~own
        if empty.any():
            empty &= ~bodies_covered(joints, self.centers, directions, weights)
        rate = np.log((self.missed + 1.0) / (self.shown + 2.0))
        return np.asarray(np.where(empty, rate[:, None], 0.0).sum(axis=0))


@compiled
def bodies_covered(
    joints: NDArray[np.float64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return in which cameras a detection lies on the image of bodies (cameras, n).

    Args:
        joints: (n, 17, 3) [m], world; NaN where unknown.
        centers: (cameras, 3) [m], world.
        directions: (cameras, detections, 17, 3) unit rays, world; NaN where not seen.
        weights: (cameras, detections, 17); 0 where not seen.
    """
    cameras, detections, count, _ = directions.shape
    covered = np.zeros((cameras, len(joints)), np.bool_)
    for c in range(cameras):
        for body in range(len(joints)):
            for detection in range(detections):
                on = 0
                for k in range(count):
                    if not weights[c, detection, k] > 0.0:
                        continue
                    u, v, w = directions[c, detection, k]
                    for joint in range(len(joints[body])):
                        if math.isnan(joints[body, joint, 0]):
                            continue
                        x = joints[body, joint, 0] - centers[c, 0]
                        y = joints[body, joint, 1] - centers[c, 1]
                        z = joints[body, joint, 2] - centers[c, 2]
                        along = x * u + y * v + z * w
                        if along > 0.0 and x * x + y * y + z * z - along**2 <= BODY_WIDTH**2:
                            on += 1
                            break
                if on >= SEEN_JOINTS:
                    covered[c, body] = True
                    break
    return covered
