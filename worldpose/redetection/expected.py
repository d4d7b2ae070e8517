"""Bodies projected into one camera's frames: positions, sizes and occlusions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_BONES, COCO17_TORSO
from worldpose.filtering import BodyViews

AROUND: Final = (0.12, 0.20, 0.12, 0.10)
"""Margins of a person beyond the joints: left, up to the top of the head, right, and down to the
soles [m]."""
BEHIND: Final = 0.2
"""A body occludes joints that are farther away than it by more than this [m]."""


def _capsules() -> tuple[NDArray[np.int64], Floats]:
    """Return pairs of joints at the ends of a body's solid parts, and their radii [m]."""
    left_shoulder, right_shoulder, left_hip, right_hip = COCO17_TORSO
    trunk = set(COCO17_TORSO)
    ends = [
        *COCO17_BONES,
        (left_shoulder, right_hip),
        (right_shoulder, left_hip),
        (3, 4),
    ]
    radius = [0.12 if a < 5 and b < 5 else 0.11 if {a, b} <= trunk else 0.06 for a, b in ends]
    return np.array(ends), np.array(radius)


_ENDS, _RADIUS = _capsules()


@dataclass(frozen=True, eq=False)
class Expected:
    """Bodies in view of one camera, (frames, persons, 17) each; NaN without a body.

    Attributes:
        image: (..., 2) expected detections of joints [px].
        variance: of `image` per axis [px^2], from the uncertainty of the bodies.
        scale: pixels per metre there [px/m].
        depth: along the camera's optical axis [m].
    """

    image: Floats
    variance: Floats
    scale: Floats
    depth: Floats

    @classmethod
    def of(cls, views: BodyViews, beside: Floats, focal: float) -> Expected:
        """Return the expected image of the bodies in the only camera of `views`.

        Args:
            views: bodies in the frames of one camera.
            beside: (frames, persons, 17, 2) [px] expected offset of keypoints from the joints.
            focal: of the camera [px].
        """
        scale = views.scale[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(scale > 0.0, focal / scale, np.nan)
        return cls(views.image[:, 0] + np.nan_to_num(beside), views.variance[:, 0], scale, depth)

    @property
    def boxes(self) -> Floats:
        """Return bodies' boxes (frames, persons, 4) [px]: x0, y0, x1, y1; NaN if incomplete."""
        left, up, right, down = (side * self.scale for side in AROUND)
        x, y = self.image[..., 0], self.image[..., 1]
        sides = [(x - left).min(-1), (y - up).min(-1), (x + right).max(-1), (y + down).max(-1)]
        return np.stack(sides, axis=-1)

    @property
    def unsure(self) -> Floats:
        """Return median standard deviations of joints across the view (frames, persons) [m]."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.median(np.sqrt(self.variance) / self.scale, axis=-1))

    def hidden(self, frame: int) -> NDArray[np.bool_]:
        """Return which joints (persons, 17) of a frame another person's body occludes."""
        image, scale, depth = self.image[frame], self.scale[frame], self.depth[frame]
        begin, end = image[:, _ENDS[:, 0]], image[:, _ENDS[:, 1]]
        along = end - begin
        radius = _RADIUS * scale[:, _ENDS].mean(-1)
        near = depth[:, _ENDS].mean(-1)
        off = image[:, :, None, None] - begin  # (persons, joints, others, capsules, 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            part = (off * along).sum(-1) / np.square(along).sum(-1)
            away = off - np.clip(np.nan_to_num(part), 0.0, 1.0)[..., None] * along
            covered = np.square(away).sum(-1) < radius**2
            covered &= near + BEHIND < depth[:, :, None, None]
        persons = np.arange(len(image))
        covered[persons, :, persons] = False
        return np.asarray(covered.any(axis=(2, 3)))
