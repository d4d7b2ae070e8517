"""Measured bars of painted lines, and their residuals at nearby cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.static_calibration.line_samples import LineSamples
from worldpose.static_calibration.parameters import project_with_jacobian

_STRIDE: Final = 0.1
"""Step along a marking for finite differences of its projection [m]."""


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars in the image, each with its marking sample.

    Attributes:
        samples: (n,) marking samples.
        pixels: (n, 2) positions of the bars [px].
        noise: (n,) across the marking, standard deviation [px].
        by_paint: (n, 7) derivatives of the marking by the paint's unknowns.
        unknowns: (n, 7) numbers of these, see `SeenLines`.
    """

    samples: LineSamples
    pixels: Floats
    noise: Floats
    by_paint: Floats
    unknowns: NDArray[np.int64]

    @cached_property
    def _paint(self) -> Floats:
        """Orthonormal basis of the paint's unknowns, in residuals and priors."""
        numbers, index = np.unique(self.unknowns, return_inverse=True)
        count = len(self.noise)
        columns = np.zeros((count + len(numbers), len(numbers)))
        np.add.at(columns, (np.arange(count)[:, None], index), self.by_paint / self.noise[:, None])
        columns[count:] = np.eye(len(numbers))
        return np.linalg.qr(columns)[0]

    def whitened(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) of markings against bars, and derivatives (m, 12).

        Residuals are distances to the nearest point: a marking that slides along itself fits as
        well as before. Residuals and derivatives are projected off the paint's unknowns and their
        priors, so that m is larger than the number of bars.
        """
        before, after = (camera.project(self.samples.beside(way)) for way in (-_STRIDE, _STRIDE))
        middle, jacobian = project_with_jacobian(camera, self.samples.points_world)
        along, bend = 0.5 * (after - before), after + before - 2.0 * middle
        away = self.pixels - middle
        way = (away * along).sum(-1) / (along**2).sum(-1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        off = ((0.5 * way[:, None] ** 2 * bend - away) * normal).sum(-1)
        moves = np.einsum("ni,nij->nj", normal, jacobian)
        both = np.zeros((len(self._paint), 1 + moves.shape[1]))
        both[: len(off), 0], both[: len(off), 1:] = off, moves
        both[: len(off)] /= self.noise[:, None]
        both -= self._paint @ (self._paint.T @ both)
        return both[:, 0], both[:, 1:]
