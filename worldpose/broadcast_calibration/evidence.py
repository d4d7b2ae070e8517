"""Evidence of a moving camera: pixels of known world points, and followed points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.geometry.rows import Index, join_rows, take_rows

ENDS = 2
"""Maximum template points that define a place: the ends of its line, or the center of its arc, or
itself."""
CLICK, MARKING, PLAYER = 0, 1, 2
"""Kinds of `PointEvidence`: clicked points and drawn markings, painted lines, players' joints."""


class PointArrays(NamedTuple):
    """`PointEvidence` as compiled kernels take it."""

    frame: Integers
    world: Floats
    image: Floats
    whitening: Floats
    loss: Floats
    ends: Integers
    """(n, 2) rows of the paint errors that define a point; -1 = none."""
    shares: Floats
    by_size: Floats
    size_row: int
    """First of two rows of the paint errors that hold the pitch's size; -1 = the size is known."""


@dataclass(frozen=True, eq=False)
class PointEvidence:
    """Pixels of known world points, per frame.

    Attributes:
        frame: (n,) index of the frame, rising.
        world: (n, 3) [m], world.
        image: (n, 2) [px].
        whitening: (n, 2, 2) [1/px] converts a pixel error to standard deviations; a place along a
            line has one row, the other is zero.
        loss: (n,) scale of the Geman-McClure loss [standard deviations]; infinite = squares.
        kind: (n,) CLICK, MARKING or PLAYER.
        source: (n,) index of the marking or person, -1 for clicks.
        ends: (n, 2) indices of the template's points that define the place; -1 = none.
        shares: (n, 2) [m] displacement of the place per standard deviation of these points' survey
            error.
        by_size: (n, 2, 3) [m] displacement of the place along x, y, z per standard deviation of the
            pitch's length, width and crown, and along z per that of its end fall.
    """

    frame: Integers
    world: Floats
    image: Floats
    whitening: Floats
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
            index,
            index,
            np.empty((0, ENDS), dtype=np.int64),
            np.empty((0, ENDS)),
            np.empty((0, 2, 3)),
        )

    @classmethod
    def observe(
        cls,
        kind: int,
        frame: Integers,
        world: Floats,
        image: Floats,
        whitening: Floats,
        *,
        source: Integers | None = None,
        loss: float,
    ) -> PointEvidence:
        """Return evidence of places without survey error and with a known size of the pitch.

        Arguments are as the attributes, the loss one for all; `whitening` is of `whiten_across` or
        `whiten_points`, and `source` None is that of clicks.
        """
        count = len(frame)
        return cls(
            frame=frame,
            world=world,
            image=image,
            whitening=whitening,
            loss=loss * np.ones(count),
            kind=np.full(count, kind),
            source=np.full(count, -1) if source is None else source,
            ends=np.full((count, ENDS), -1),
            shares=np.zeros((count, ENDS)),
            by_size=np.zeros((count, 2, 3)),
        )

    def arrays(self, ends: Integers, size_row: int = -1) -> PointArrays:
        """Return the arrays for compiled kernels.

        Points are defined by rows (n, 2) of the paint errors, -1 = none, and from `size_row` on by
        the size of the pitch, -1 = known.
        """
        return PointArrays(
            self.frame,
            self.world,
            self.image,
            self.whitening,
            self.loss,
            ends,
            self.shares,
            self.by_size,
            size_row,
        )

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: Index) -> PointEvidence:
        return take_rows(self, index)

    def in_frame(self, frame: int) -> PointEvidence:
        """Return evidence of a single frame with another frame index."""
        return replace(self, frame=np.full(len(self), frame))


@dataclass(frozen=True, eq=False)
class FlowEvidence:
    """Static points, followed from one frame to the next.

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

    def __getitem__(self, index: Index) -> FlowEvidence:
        return take_rows(self, index)


def whiten_across(normals: Floats, deviation: Floats) -> Floats:
    """Return the whitening (n, 2, 2) [1/px] of places that count only across lines.

    Lines have unit normals (n, 2); the standard deviation (n,) is across them [px].
    """
    whitening = np.zeros((len(normals), 2, 2))
    whitening[:, 0] = normals / deviation[:, None]
    return whitening


def whiten_points(deviation: Floats) -> Floats:
    """Return the whitening (n, 2, 2) [1/px] of a standard deviation (n,) [px] along each axis."""
    return np.asarray(np.eye(2) / deviation[:, None, None])


def spread_noise(points: PointEvidence, lasting: float) -> PointEvidence:
    """Return evidence in which `lasting` samples of lines count as one; losses stay in pixels."""
    root = np.where(points.kind == MARKING, np.sqrt(lasting), 1.0)
    return replace(
        points, whitening=points.whitening / root[:, None, None], loss=points.loss / root
    )


def join_evidence(parts: Sequence[PointEvidence]) -> PointEvidence:
    """Return the concatenated evidence, sorted by frame."""
    joined = join_rows([PointEvidence.none(), *parts])
    return joined[np.argsort(joined.frame, kind="stable")]


def bounds(frame: Integers, frames: int) -> Integers:
    """Return the first entry of each frame, and the end of the last (frames + 1,)."""
    return np.searchsorted(frame, np.arange(frames + 1)).astype(np.int64)
