"""Evidence, weights and priors of a clip's fit; `residuals` has the objective."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.broadcast_calibration.evidence import (
    PLAYER,
    FlowEvidence,
    PointArrays,
    PointEvidence,
)
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE
from worldpose.broadcast_calibration.priors import Prior


class TermWeights(NamedTuple):
    """Weights of the terms [1]."""

    field: float = 1.0
    """lambda_4."""
    player: float = 1.0
    """lambda_5, over the correlation time of a person's errors in frames."""
    flow: float = 1.0
    """lambda_flow."""


@dataclass(frozen=True, eq=False)
class ClipProblem:
    """Evidence, smoothness and priors of a clip's fit.

    Attributes:
        points: clicks, lines and players.
        flow: followed points.
        prior: prior of center and lenses.
        weights: weights of the terms.
        smoothness: (4,) standard deviation of second differences of rotation and log focal length;
            infinite = free.
        lens_walk: (frames - 1,) standard deviation of changes of the distortion [deviations of its
            prior]; None = free.
        flow_loss: scale of the loss of followed points [standard deviations].
        free_frame: (7,) mask of a frame's free parameters.
        free_clip: (5,) mask of the clip's free parameters.
        known: (frames, 7) mask of fixed parameters in single frames, such as the first frame's
            rotation.
    """

    points: PointEvidence
    flow: FlowEvidence
    prior: Prior
    weights: TermWeights = field(default_factory=TermWeights)
    smoothness: Floats = field(default_factory=lambda: np.full(4, np.inf))
    lens_walk: Floats | None = None
    flow_loss: float = np.inf
    free_frame: Flags = field(default_factory=lambda: np.ones(FRAME_SIZE, np.bool_))
    free_clip: Flags = field(default_factory=lambda: np.ones(CLIP_SIZE, np.bool_))
    known: Flags | None = None

    def fixed_mask(self, frames: int) -> Flags:
        """Return the mask of every frame's fixed parameters (frames, 7)."""
        held = np.broadcast_to(~self.free_frame, (frames, FRAME_SIZE))
        return held if self.known is None else held | self.known

    @cached_property
    def painted(self) -> Integers:
        """Indices of the template points with estimated paint errors, rising (m,)."""
        found = np.unique(self.points.ends)
        return np.asarray(found[found >= 0])

    @cached_property
    def size_row(self) -> int:
        """First of the two last rows of the paint errors, of the pitch's size; -1 if known."""
        return len(self.painted) if self.points.by_size.any() else -1

    @property
    def paint_count(self) -> int:
        """Rows of the paint errors: template points, and the pitch's size."""
        return len(self.painted) + 2 * (self.size_row >= 0)

    def of_size(self, rows: Floats) -> Floats:
        """Return length, width, crown and end fall (4,) of paint errors (paint_count, 3)."""
        if self.size_row < 0:
            return np.zeros(4)
        return np.asarray(rows[self.size_row :].ravel()[np.array([0, 1, 2, 5])])

    @cached_property
    def ends(self) -> Integers:
        """Indices into `painted` of the points that define each evidence (n, 2); -1 = none."""
        number = np.searchsorted(self.painted, self.points.ends)
        return np.asarray(np.where(self.points.ends >= 0, number, -1))

    @cached_property
    def field_points(self) -> PointArrays:
        """Clicks and lines."""
        some = self.points.kind != PLAYER
        return self.points[some].arrays(self.ends[some], self.size_row)

    @cached_property
    def player_points(self) -> PointArrays:
        """Players' keypoints, which no error of the pitch moves."""
        some = self.points.kind == PLAYER
        return self.points[some].arrays(self.ends[some])
