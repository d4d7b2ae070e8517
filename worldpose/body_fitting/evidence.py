"""Triangulated joints of one person as least-squares terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_SIGMAS
from worldpose.body_fitting.settings import BodyFittingSettings

DIFFICULTY: Final = np.array(COCO17_SIGMAS) / 0.08
"""Spread of each joint relative to an average one: COCO's sigmas over their mean of 0.08."""

LEAST: Final = 1e-6
"""Added to singular information [1/m^2]: one line leaves a direction undetermined."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Joints of one person with their information."""

    joints: Floats
    """(frames, 17, 3) [m]; NaN where unknown."""
    information: Floats
    """(frames, 17, 3, 3) [1/m^2], inverse covariance; 0 where unknown."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """(frames, 17), joints with any information."""
        return np.asarray(self.information.any(axis=(-1, -2)))

    @classmethod
    def of(
        cls, joints: Floats, covariance: Floats, fps: float, settings: BodyFittingSettings
    ) -> Evidence:
        """Return the evidence of joints whose errors last for `noise_time`.

        Args:
            joints: (frames, 17, 3) [m], world.
            covariance: (frames, 17, 3, 3) [m^2], as triangulation states it.
            fps: [1/s].
            settings: scale and correlation time of the noise.
        """
        seen = np.asarray(np.isfinite(joints).all(-1) & np.isfinite(covariance).all((-1, -2)))
        stated = np.where(seen[..., None, None], covariance, np.eye(3))
        spread = settings.noise_scale**2 * DIFFICULTY[:, None, None] ** 2 * stated
        spread = spread + settings.joint_floor**2 * np.eye(3)
        # Correlated frames count as one observation.
        spread *= 1.0 + settings.noise_time * fps
        information: Floats = (np.linalg.inv(spread) * seen[..., None, None]).astype(np.float64)
        return cls(np.where(seen[..., None], joints, np.nan), information)

    def with_lines(
        self, points: Floats, across: Floats, fps: float, settings: BodyFittingSettings
    ) -> Evidence:
        """Return the evidence with lines of sight added.

        Args:
            points: (frames, 17, 3) [m], world, on the lines; NaN without.
            across: (frames, 17, 3, 3) [1], projections across the lines; 0 without.
            fps: [1/s].
            settings: standard deviation of a joint from its line.
        """
        seen = np.asarray(np.isfinite(points).all(-1))
        spread = (settings.sight_spread * DIFFICULTY) ** 2 + settings.joint_floor**2
        spread *= 1.0 + settings.noise_time * fps
        line = np.where(seen[..., None, None], across / spread[:, None, None], 0.0)
        information = self.information + line
        # From the point on the line towards the known joint; a lone line does not pull along
        # itself.
        away = np.where(np.isfinite(self.joints), self.joints, points) - points
        pulled = self.information @ np.nan_to_num(away)[..., None]
        moved = np.linalg.solve(information + LEAST * np.eye(3), pulled)[..., 0]
        return Evidence(np.where(seen[..., None], points + moved, self.joints), information)
