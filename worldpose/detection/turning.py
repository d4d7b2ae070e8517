"""Images of cameras that are mounted on their side or upside down, turned upright for the nets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid


@dataclass(frozen=True)
class QuarterTurn:
    """A turn of images of a width, height [px] by quarters, after which people stand upright.

    They are counterclockwise, as in np.rot90: 1 to 3.
    """

    quarters: int
    size: tuple[int, int]

    @classmethod
    def of(cls, camera: Camera) -> QuarterTurn | None:
        """Return the turn of a single camera's images; None if they are upright, or unclear.

        The z axis of the world points up.
        """
        right, down = camera.cam_from_world.rotation[:2, 2]
        # A camera that looks straight down has no upright image.
        if np.hypot(right, down) < 0.5:
            return None
        quarters = round(float(np.degrees(np.arctan2(right, -down))) / 90.0) % 4
        width, height = camera.image_size.tolist()
        return cls(quarters, (width, height)) if quarters else None

    def image(self, image: Image | None) -> Image | None:
        """Return the turned image (height, width, 3)."""
        return None if image is None else np.ascontiguousarray(np.rot90(image, self.quarters))

    def points(self, points: ArrayLike, *, back: bool = False) -> Floats:
        """Return points (..., 2) [px] in turned images, or of these in the camera's."""
        x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
        right, low = self.size[0] - 1.0, self.size[1] - 1.0
        if back and self.quarters % 2:
            right, low = low, right
        quarters = -self.quarters % 4 if back else self.quarters
        turned = {1: (y, right - x), 2: (right - x, low - y), 3: (low - y, x)}[quarters]
        return np.stack(turned, axis=-1)

    def boxes(self, boxes: ArrayLike, *, back: bool = False) -> Floats:
        """Return boxes (..., 4) x0, y0, x1, y1 as `points` does."""
        given = np.asarray(boxes, dtype=np.float64)
        ends = self.points(given.reshape(*given.shape[:-1], 2, 2), back=back)
        return np.concatenate([ends.min(axis=-2), ends.max(axis=-2)], axis=-1)

    def people(self, given: Mapping[int, People]) -> dict[int, People]:
        """Return given people by frame in turned images."""
        return {n: People(self.boxes(one.boxes), one.scores) for n, one in given.items()}

    def camera(self, camera: Camera) -> Camera:
        """Return the single camera of turned images."""
        for _ in range(self.quarters):
            axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
            pose, lens = camera.cam_from_world, camera.distortion.copy()
            lens[2:4] = -lens[3], lens[2]  # tangential terms
            x, y = camera.principal_point
            camera = replace(
                camera,
                cam_from_world=Rigid(axes @ pose.rotation, axes @ pose.translation),
                focal=camera.focal[::-1].copy(),
                principal_point=np.array([y, camera.image_size[0] - 1.0 - x]),
                distortion=lens,
                image_size=camera.image_size[::-1].copy(),
            )
        return camera

    def turn_back(self, found: KeypointDetections) -> KeypointDetections:
        """Return people of turned images in the pixels of the camera's."""
        arrays = dict(found.arrays())
        for name in {"keypoints", "extra_keypoints"} & arrays.keys():
            arrays[name] = self.points(arrays[name], back=True).astype(np.float32)
        arrays["boxes"] = self.boxes(found.boxes, back=True).astype(np.float32)
        return found.with_arrays(arrays, found.frame)
