"""Evidence of a moving camera: pixels of known world points, and followed points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.normal_equations import Points

ENDS = 2
"""Maximum template points that define a place: the ends of its line, or the center of its arc, or
itself."""
CLICK, MARKING, PLAYER = 0, 1, 2
"""Kinds of `PointEvidence`: clicked points and drawn markings, painted lines, players' joints."""


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Pixels of known world points, without their noise.

    Attributes:
        frame: (n,) index of the frame, rising.
        world: (n, 3) [m], world.
        image: (n, 2) [px].
        kind: CLICK, MARKING or PLAYER.
        source: (n,) index of the marking or person, -1 for clicks.
        ends: (n, 2) indices of the template's points that define the world point, -1 = none;
            None = no survey error.
        shares: (n, 2) [m] displacement of the world point per standard deviation of the survey
            error of `ends`; None without `ends`.
        by_size: (n, 2, 3) [m] displacement of the world point along x, y, z per standard deviation
            of the pitch's length, width and crown, and along z per that of its end fall; None = all
            four are known.
    """

    frame: Integers
    world: Floats
    image: Floats
    kind: int
    source: Integers
    ends: Integers | None = None
    shares: Floats | None = None
    by_size: Floats | None = None


@dataclass(frozen=True, eq=False)
class PointEvidence:
    """Pixels of known world points, per frame.

    Attributes:
        frame: (n,) index of the frame, rising.
        world: (n, 3) [m], world.
        image: (n, 2) [px].
        whitening: (n, 2, 2) [1/px] converts a pixel error to standard deviations; a place along a
            line has one row, the other is zero.
        weight: (n,) factor on the loss [1].
        loss: (n,) scale of the Geman-McClure loss [standard deviations]; infinite = squares.
        kind: (n,) CLICK, MARKING or PLAYER.
        source: (n,) index of the marking or person, -1 for clicks.
        ends: (n, 2) indices of the template's points that define the place; -1 = none.
        shares: (n, 2) [m] displacement of the place per standard deviation of these points' survey
            error.
        by_size: (n, 2, 3) [m] displacement of the place per standard deviation of the pitch's size,
            as in `ObservedPoints`.
    """

    frame: Integers
    world: Floats
    image: Floats
    whitening: Floats
    weight: Floats
    loss: Floats
    kind: Integers
    source: Integers
    ends: Integers
    shares: Floats
    by_size: Floats

    @classmethod
    def none(cls) -> PointEvidence:
        """Return no evidence."""
        empty, index = np.empty(0), np.empty(0, dtype=np.int64)
        return cls(
            index,
            np.empty((0, 3)),
            np.empty((0, 2)),
            np.empty((0, 2, 2)),
            empty,
            empty,
            index,
            index,
            np.empty((0, ENDS), dtype=np.int64),
            np.empty((0, ENDS)),
            np.empty((0, 2, 3)),
        )

    @classmethod
    def across_lines(
        cls,
        observed: ObservedPoints,
        normals: Floats,
        deviation: Floats,
        weight: float,
        loss: float,
    ) -> PointEvidence:
        """Return evidence that constrains places only across a line.

        Args:
            observed: pixels and places.
            normals: (n, 2) unit vectors across the line.
            deviation: (n,) standard deviation [px].
            weight: factor on the loss [1].
            loss: scale of the loss [standard deviations].
        """
        whitening = np.zeros((len(observed.frame), 2, 2))
        whitening[:, 0] = normals / deviation[:, None]
        return cls._whiten(observed, whitening, weight, loss)

    @classmethod
    def at_points(
        cls, observed: ObservedPoints, deviation: Floats, weight: float, loss: float
    ) -> PointEvidence:
        """Return evidence with equal noise in both image directions.

        Args:
            observed: pixels and places.
            deviation: (n,) standard deviation, each axis [px].
            weight: factor on the loss [1].
            loss: scale of the loss [standard deviations].
        """
        return cls._whiten(observed, np.eye(2) / deviation[:, None, None], weight, loss)

    @classmethod
    def _whiten(
        cls, observed: ObservedPoints, whitening: Floats, weight: float, loss: float
    ) -> PointEvidence:
        count = len(observed.frame)
        ones = np.ones(count)
        ends, shares = observed.ends, observed.shares
        if ends is None or shares is None:
            ends, shares = np.full((count, ENDS), -1), np.zeros((count, ENDS))
        return cls(
            frame=observed.frame,
            world=observed.world,
            image=observed.image,
            whitening=whitening,
            weight=weight * ones,
            loss=loss * ones,
            kind=np.full(count, observed.kind),
            source=observed.source,
            ends=ends,
            shares=shares,
            by_size=np.zeros((count, 2, 3)) if observed.by_size is None else observed.by_size,
        )

    def arrays(self, ends: Integers, size_row: int = -1) -> Points:
        """Return the arrays for compiled kernels.

        Args:
            ends: (n, 2) rows of the paint errors that define a point; -1 = none.
            size_row: first row that holds the pitch's size; -1 = known.
        """
        return Points(
            self.world,
            self.image,
            self.whitening,
            self.weight,
            self.loss,
            ends,
            self.shares,
            self.by_size,
            size_row,
        )

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: Integers | NDArray[np.bool_]) -> PointEvidence:
        return PointEvidence(*(getattr(self, name)[index] for name in _POINT_PARTS))

    def in_frame(self, frame: int) -> PointEvidence:
        """Return evidence of a single frame with another frame index."""
        return replace(self, frame=np.full(len(self), frame))


@dataclass(frozen=True, eq=False)
class FlowEvidence:
    """Static points, followed from one frame to the next (M6).

    Attributes:
        frame: (n,) index of the first frame, rising.
        start: (n, 2) [px] in the first frame.
        end: (n, 2) [px] in the next frame.
        deviation: (n,) standard deviation of their difference, each axis [px].
    """

    frame: Integers
    start: Floats
    end: Floats
    deviation: Floats

    @classmethod
    def none(cls) -> FlowEvidence:
        """Return no evidence."""
        pixels = np.empty((0, 2))
        return cls(np.empty(0, dtype=np.int64), pixels, pixels, np.empty(0))

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: Integers | NDArray[np.bool_]) -> FlowEvidence:
        return FlowEvidence(*(getattr(self, name)[index] for name in _FLOW_PARTS))


_POINT_PARTS = (
    *("frame", "world", "image", "whitening", "weight", "loss", "kind", "source", "ends", "shares"),
    "by_size",
)
_FLOW_PARTS = ("frame", "start", "end", "deviation")


def spread_noise(points: PointEvidence, lasting: float) -> PointEvidence:
    """Return evidence in which `lasting` samples of lines count as one; losses stay in pixels."""
    root = np.where(points.kind == MARKING, np.sqrt(lasting), 1.0)
    return replace(
        points, whitening=points.whitening / root[:, None, None], loss=points.loss / root
    )


def join_evidence(parts: Sequence[PointEvidence]) -> PointEvidence:
    """Return the concatenated evidence, sorted by frame."""
    arrays = {
        name: np.concatenate([getattr(part, name) for part in [PointEvidence.none(), *parts]])
        for name in _POINT_PARTS
    }
    order = np.argsort(arrays["frame"], kind="stable")
    return PointEvidence(**{name: array[order] for name, array in arrays.items()})


def bounds(frame: Integers, frames: int) -> Integers:
    """Return the first entry of each frame, and the end of the last (frames + 1,)."""
    return np.searchsorted(frame, np.arange(frames + 1)).astype(np.int64)
