"""Metrics of one clip, summed over its chunks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.records import Record
from worldpose.triangulation.solve import SolvedJoints

LEAST: Final = 1e-7
WIDTH: Final = 0.005
"""Relative width of a histogram bin: the accuracy of the median."""


class TriangulationReport(Record):
    """Agreement between the views of one clip."""

    joints: int
    """Joints found [1]."""
    undetermined: int
    """Joints that are missing although a camera saw them [1]."""
    observations: int
    """Keypoints of tracked people [1]."""
    rejected_share: tuple[float | None, ...]
    """Share of outliers among each camera's keypoints of joints found; None without any."""
    exchanged_share: tuple[float | None, ...]
    """Share of each camera's views of people with a corrected left-right swap of at least one part;
    None without any."""
    mean_views: float | None
    """Mean number of inlier views of the joints found."""
    reprojection_error_px: float | None
    """Median over joints [px]."""
    standard_deviation_m: float | None
    """Median over joints of the root of the covariance's trace [m]."""
    noise_factor: float | None
    """Median over joints of the learned noise of a confident keypoint over the stated one [1]; None
    without joints."""
    misplacement_m: tuple[float | None, ...]
    """Displacement of people by each camera's calibration, root mean square per axis at the median
    person [m]; None without people or with offsets disabled."""


class SmoothingReport(Record):
    """Effect of smoothing on the joints of one clip."""

    filled: int
    """Joints filled in [1]."""
    filled_share: float | None
    """Share of filled joints in all joints; None without any."""
    acceleration_m_s2: float
    """Median over joints of the prior's acceleration [m/s^2]."""
    repeated: float
    """Frames of observations whose errors count as one [1]: errors are correlated in time."""
    moved_m: float | None
    """Median distance between smoothed and triangulated joints [m]."""


@dataclass(frozen=True, eq=False)
class Histogram:
    """Histogram of non-negative numbers with bins half a percent wide; chunks of a clip add up.

    Attributes:
        counts: (CLASSES,) int64; the first includes numbers below `LEAST`.
    """

    counts: NDArray[np.int64]

    @classmethod
    def of(cls, values: NDArray[np.floating]) -> Self:
        """Return the histogram of values of any shape, without NaN."""
        place = np.log(np.maximum(values, LEAST) / LEAST) / math.log1p(WIDTH)
        classes = 5000  # Bins from `LEAST` to 7000.
        place = np.clip(place, 0, classes - 1).astype(np.int64)
        return cls(np.bincount(place.ravel(), minlength=classes))

    def __add__(self, other: Self) -> Self:
        return type(self)(self.counts + other.counts)

    @property
    def median(self) -> float | None:
        """Middle of the median's bin; None without values, 0 below `LEAST`."""
        below = self.counts.cumsum()
        if not below[-1]:
            return None
        place = int(np.searchsorted(below, 0.5 * below[-1]))
        return LEAST * math.exp((place + 0.5) * math.log1p(WIDTH)) if place else 0.0


@dataclass(frozen=True, eq=False)
class Agreement:
    """Counts and histograms behind a triangulation report.

    Attributes:
        found: joints; undetermined: joints seen but not found.
        seen: observations.
        views: inlier views, summed over all joints.
        used: (cameras,) observations of joints found.
        agreed: (cameras,) number of inliers among these.
        people: (cameras,) views of people.
        exchanged: (cameras,) number of these with a corrected left-right swap.
        error: reprojection errors [px].
        deviation: roots of traces [m].
        misplaced: expected displacements by calibration errors, by camera [m].
    """

    found: int
    undetermined: int
    seen: int
    views: int
    used: NDArray[np.int64]
    agreed: NDArray[np.int64]
    people: NDArray[np.int64]
    exchanged: NDArray[np.int64]
    error: Histogram
    deviation: Histogram
    misplaced: tuple[Histogram, ...]

    def __add__(self, other: Self) -> Self:
        sums = {name: value + getattr(other, name) for name, value in vars(self).items()}
        pairs = zip(self.misplaced, other.misplaced, strict=True)
        return type(self)(**{**sums, "misplaced": tuple(a + b for a, b in pairs)})

    def report(self, noise_factor: float) -> TriangulationReport:
        """Return the metrics."""
        return TriangulationReport(
            joints=self.found,
            undetermined=self.undetermined,
            observations=self.seen,
            rejected_share=_shares(self.used - self.agreed, self.used),
            exchanged_share=_shares(self.exchanged, self.people),
            mean_views=self.views / self.found if self.found else None,
            reprojection_error_px=self.error.median,
            standard_deviation_m=self.deviation.median,
            noise_factor=noise_factor if self.found else None,
            misplacement_m=tuple(each.median for each in self.misplaced),
        )


def count_agreement(
    solved: SolvedJoints,
    covariance: Floats,
    index: NDArray[np.integer],
    exchanged: NDArray[np.bool_],
    misplaced: tuple[Histogram, ...],
) -> Agreement:
    """Return the agreement between the views of some frames."""
    views, seen = solved.views, solved.seen
    found = views > 0
    used = seen & found[:, None]
    trace = np.einsum("...ii", covariance)[found]
    return Agreement(
        found=int(found.sum()),
        undetermined=int((seen.any(axis=1) & ~found).sum()),
        seen=int(np.count_nonzero(seen)),
        views=int(views[found].sum(dtype=np.int64)),
        used=_by_camera(used),
        agreed=_by_camera(solved.inliers),
        error=Histogram.of(solved.reprojection_error[found]),
        deviation=Histogram.of(np.sqrt(trace)),
        people=_by_camera(np.asarray(index >= 0)),
        exchanged=_by_camera(np.asarray(exchanged.any(axis=-1))),
        misplaced=misplaced,
    )


def _by_camera(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of true entries of (frames, cameras, ...), by camera."""
    return np.array([np.count_nonzero(there[:, c]) for c in range(there.shape[1])], np.int64)


@dataclass(frozen=True, eq=False)
class Changes:
    """Joints after smoothing, those `filled` among them, and their distances `moved` by it [m]."""

    there: int
    filled: int
    moved: Histogram

    def __add__(self, other: Self) -> Self:
        return type(self)(
            self.there + other.there, self.filled + other.filled, self.moved + other.moved
        )

    def report(self, acceleration: Floats, repeated: float) -> SmoothingReport:
        """Return the metrics for a motion model."""
        return SmoothingReport(
            filled=self.filled,
            filled_share=self.filled / self.there if self.there else None,
            acceleration_m_s2=float(np.median(acceleration)),
            repeated=repeated,
            moved_m=self.moved.median,
        )


def _shares(part: NDArray[np.int64], whole: NDArray[np.int64]) -> tuple[float | None, ...]:
    """Return part over whole; None where the whole is 0."""
    each = zip(part.tolist(), whole.tolist(), strict=True)
    return tuple(some / number if number else None for some, number in each)
