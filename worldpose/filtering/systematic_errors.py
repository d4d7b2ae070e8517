"""Systematic errors of keypoints: bias by viewing direction, and clock offsets.

Both are learned from all people of a clip together. The next iteration subtracts them from each
keypoint; they contain no error of a single person.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.filtering.clock_offsets import ClockEquations
from worldpose.filtering.judging import Suspects, body_residuals, judge_detections, learn_from
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.view_bias import ViewBias, find_azimuths, learn_view_bias
from worldpose.filtering.views import BodyViews
from worldpose.geometry import Camera

LASTING: Final = 0.3
"""Correlation time of a detector's error, to a factor e [s]."""
ROUNDS: Final = 2
"""Passes of judging and learning: the second judges with the result of the first."""
TURNS: Final = 3
"""Alternations between view bias and clock offsets within a pass."""


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Systematic errors of a clip's detector and clocks.

    Attributes:
        view_bias: by viewing direction.
        late: (cameras,) clock offset of each camera relative to the cameras' mean [frame]; positive
            = the camera shows a later time.
    """

    view_bias: ViewBias
    late: Floats

    @classmethod
    def none(cls, cameras: int) -> SystematicErrors:
        """Return zero errors."""
        return cls(ViewBias.none(), np.zeros(cameras))

    def shift(self, motion: BodyMotion, views: BodyViews) -> Floats:
        """Return the systematic error of keypoints (frames, cameras, persons, 17, 2) [px].

        NaN where a body, or its motion, is unknown.
        """
        sides = self.view_bias.shift(motion.azimuth, _scale(views))
        return np.asarray(sides + self.late[:, None, None, None] * motion.way)

    def late_in_offsets(self, offsets: Floats, motion: BodyMotion) -> Floats:
        """Return the part of the clock offsets that people's offsets contain (cameras,) [frame].

        People's offsets belong to joints triangulated without clock offsets, so a camera seems to
        see people displaced along their motion.

        Args:
            offsets: (frames, cameras, persons, 2) [px], as of `Suspects`.
            motion: of the bodies.
        """
        way = np.nan_to_num(motion.way.mean(axis=-2))
        along = (np.nan_to_num(offsets) * way).sum(axis=(0, 2, 3))
        held = along / np.maximum((way**2).sum(axis=(0, 2, 3)), 1e-12)
        return np.asarray(np.clip(held, np.minimum(self.late, 0.0), np.maximum(self.late, 0.0)))


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Azimuth and image motion of bodies in all images."""

    azimuth: Floats
    """(frames, cameras, persons) of the camera, seen from the body [rad]."""
    way: Floats
    """(frames, cameras, persons, 17, 2) motion of joints per frame [px]."""


def watch_motion(cameras: Camera, joints: Floats, step: Floats) -> BodyMotion:
    """Return azimuth and image motion of bodies in all images.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world.
        step: (frames, persons, 17, 3) [m], their motion per frame.
    """
    ends = [
        cameras.project((joints + part * step).reshape(len(joints), 1, -1, 3))
        for part in (-0.5, 0.5)
    ]
    shape = (len(joints), cameras.batch_shape[0], *joints.shape[1:3], 2)
    return BodyMotion(find_azimuths(cameras, joints), (ends[1] - ends[0]).reshape(shape))


def learn_systematic_errors(
    cameras: Camera,
    joints: Floats,
    views: BodyViews,
    motion: BodyMotion,
    suspects: Suspects,
    settings: FilteringSettings,
    fps: float,
) -> SystematicErrors:
    """Return the systematic errors of keypoints that fit their bodies.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world, of the bodies, as the detector sees them.
        views: projections of the bodies in all images.
        motion: of the bodies.
        suspects: detections in these frames.
        settings: limits of the consistency check.
        fps: of these frames [1/s].
    """
    systematic = SystematicErrors.none(cameras.batch_shape[0])
    repeated = max(1.0, 2.0 * LASTING * fps)
    for _ in range(ROUNDS):
        corrected = suspects.without(systematic.shift(motion, views))
        spread = learn_from(views, corrected)
        judged = judge_detections(views, corrected, spread, settings)
        residuals = body_residuals(views, suspects, judged, spread, repeated)
        at = residuals.frame, residuals.camera, residuals.person
        azimuth, way, scale = motion.azimuth[at], motion.way[at], _scale(views)[at]
        clocks = ClockEquations.of(cameras, joints, way, residuals)
        for _ in range(TURNS):
            late = systematic.late[residuals.camera, None, None]
            bias = learn_view_bias(residuals.less(late * np.nan_to_num(way)), azimuth, scale)
            sides = np.nan_to_num(bias.shift(azimuth, scale))
            systematic = SystematicErrors(bias, clocks.learn_lateness(residuals.less(sides)))
    return systematic


def _scale(views: BodyViews) -> Floats:
    """Return the image scale at a body's hips (frames, cameras, persons) [px/m]."""
    return np.asarray(views.scale[..., (11, 12)].mean(axis=-1))
