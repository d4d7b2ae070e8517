"""Errors of a pitch template: its survey or paint, and an unmeasured size and crown.

A pitch without a survey has its markings where the Laws of the Game put them, within the accuracy
of the painter, on a surface whose crown is a matter of local practice. The fit of a clip estimates
all three with priors, so that the camera's covariance includes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.broadcast_calibration.evidence import PointEvidence
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.pitch.laws import places_by_size
from worldpose.pitch.template import PitchTemplate, surface_shape

SIZES: Final = ("length", "width", "crown", "end_fall")
"""Entries of pitch.json that a clip's fit estimates."""


@dataclass(frozen=True, eq=False)
class PitchErrors:
    """Standard deviations of a pitch template.

    Attributes:
        surveyed: (points,) mask of the template's points whose place is surveyed.
        survey_m: standard deviation of a surveyed point, each axis [m].
        most_paint_m: largest standard deviation of any other point in the fit, each axis [m].
        shown_m: the one that the clip's residuals show [m].
        size_m: (4,) standard deviations of length, width, crown, end fall [m]; 0 = known.
        by_size: (points, 2) change of x by the length, and of y by the width [1].
        size: length, width of the pitch [m].
    """

    surveyed: Flags
    survey_m: float
    most_paint_m: float
    shown_m: float
    size_m: Floats
    by_size: Floats
    size: tuple[float, float]

    @classmethod
    def of(cls, pitch: PitchTemplate, settings: BroadcastCalibrationSettings) -> PitchErrors:
        """Return the prior errors of a template."""
        size = (pitch.length, pitch.width)
        paint_m = max(settings.paint_error_m, settings.survey_error_m)
        _, change = places_by_size(pitch.spec, size, list(pitch.points))
        spread = {
            "length": settings.pitch_size_std_m,
            "width": settings.pitch_size_std_m,
            "crown": settings.crown_std_m,
            "end_fall": settings.end_fall_std_m,
        }
        return cls(
            surveyed=np.array([name in pitch.surveyed for name in pitch.points]),
            survey_m=settings.survey_error_m,
            most_paint_m=paint_m,
            shown_m=paint_m,
            size_m=np.array(
                [each if name in pitch.assumed else 0.0 for name, each in spread.items()]
            ),
            by_size=change,
            size=size,
        )

    @property
    def paint_m(self) -> float:
        """Standard deviation of a point without survey in the fit, each axis [m]."""
        return min(self.shown_m, self.most_paint_m)

    @property
    def point_m(self) -> Floats:
        """Standard deviations (points,) of each point, each axis [m]."""
        return np.where(self.surveyed, self.survey_m, self.paint_m)

    def apply(self, points: PointEvidence, ends: Integers, shares: Floats) -> PointEvidence:
        """Return evidence with the errors of the points (n, 2) that define its places, -1 = none.

        The shares (n, 2) are displacements of the places by these points [m/m].
        """
        return replace(
            points,
            ends=ends,
            shares=np.where(ends >= 0, self.point_m[ends] * shares, 0.0),
            by_size=self.displacement_by_size(ends, shares, points.world),
        )

    def displacement_by_size(self, ends: Integers, shares: Floats, world: Floats) -> Floats:
        """Return displacements (n, 2, 3) [m] of places per standard deviation of the pitch's size.

        The first row is by length, width and crown, the second by the end fall. The places (n, 3)
        [m] are defined by points (n, 2), -1 = none, with shares (n, 2) [m/m].
        """
        weight = np.where(ends >= 0, shares, 0.0)
        moved = np.zeros((len(world), 2, 3))
        moved[:, 0, :2] = (weight[..., None] * self.by_size[ends]).sum(axis=1) * self.size_m[:2]
        moved[:, :, 2] = surface_shape(world[:, 0], world[:, 1], self.size) * self.size_m[2:]
        return moved

    def rescale(self, points: PointEvidence, before: PitchErrors) -> PointEvidence:
        """Return evidence of other errors of the same pitch with the spreads of these."""
        # A survey has one deviation, which may be 0.
        ratio = np.where(self.surveyed, 1.0, self.paint_m / before.paint_m)
        ratio = np.append(ratio, 1.0)  # -1 = none
        return replace(points, shares=points.shares * ratio[points.ends])

    def learn_paint(self, offsets: Floats, variance: Floats, points: Integers) -> PitchErrors:
        """Return the errors with the spread of the paint that a fit shows.

        MacKay's fixed point: the sum of squared offsets over the number of coordinates that the
        evidence determines. The offsets (n, 3) of the points (n,) are in standard deviations, as is
        their posterior variance (n, 3). One view cannot tell markings off their places from a
        misfit of its lens or surface: in the fit, the spread stays below `most_paint_m`.
        """
        prior = 6.0  # coordinates that the prior spread of the paint is worth
        chosen = ~self.surveyed[points]
        if not chosen.any():
            return self
        squares = float((offsets[chosen] ** 2).sum())
        determined = float((1.0 - variance[chosen]).sum())
        factor = (prior + squares) / (prior + determined)
        return replace(self, shown_m=max(self.paint_m * float(np.sqrt(factor)), self.survey_m))


@dataclass(frozen=True, eq=False)
class PitchFit:
    """The pitch and the noise that a clip's fit shows.

    Attributes:
        points: places (3,) [m], world, of the template's points without survey that the clip's
            markings rest on.
        size: (4,) length, width, crown, end fall [m].
        size_std: (4,) standard deviations of `size` [m]; 0 = given.
        paint_m: spread of markings without survey about the rules, each axis [m]; 0 = all surveyed.
        line_noise: deviation of a line's sample over its assumed one [1].
        click_noise: the same ratio for clicks [1].
    """

    points: Mapping[str, Floats]
    size: Floats
    size_std: Floats
    paint_m: float
    line_noise: float
    click_noise: float

    @property
    def surface(self) -> Floats:
        """(2,) estimated or given crown and end fall [m]."""
        return self.size[2:]

    @property
    def keys(self) -> dict[str, float | dict[str, list[float]]] | None:
        """Estimated sizes and points, by their keys in pitch.json; None if all is given."""
        if not (self.size_std.any() or self.points):
            return None
        points = {name: place.tolist() for name, place in self.points.items()}
        sizes = dict(zip(SIZES, self.size.tolist(), strict=True))
        return {**sizes, "crown": max(sizes["crown"], 0.0), "points": points}

    @property
    def describe(self) -> tuple[str, ...]:
        """Sentences for the report."""
        said = [
            f"the {name.replace('_', ' ')} of the pitch is {value:.2f} m "
            f"with a standard deviation of {std:.2f} m"
            for name, value, std in zip(SIZES, self.size, self.size_std, strict=True)
            if std > 0.0
        ]
        if self.paint_m > 0.0:
            said.append(f"markings differ from the rules by {self.paint_m:.3f} m per axis")
        said.append(
            f"samples of lines err by {self.line_noise:.2f} and clicks by {self.click_noise:.2f} "
            "of their assumed deviation"
        )
        return tuple(said)
