"""Painted lines as they were found in a picture, for cameras near the one that found them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras import Camera
from worldpose.static_calibration.line_samples import LineSamples
from worldpose.static_calibration.parameters import project_with_jacobian

Floats = NDArray[np.float64]

_STRIDE: Final = 0.1
"""Along a marking, its course in the picture is told from [m]."""


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars in the picture, each with the sample of a marking that it is.

    Attributes:
        samples: (n,) where they were looked for.
        pixels: (n, 2) where they are [px].
        noise: (n,) across the marking, standard deviation [px].
        by_paint: (n, 7) how the marking moves with what is not known of the paint.
        unknowns: (n, 7) numbers of these, see `SeenLines`.
    """

    samples: LineSamples
    pixels: Floats
    noise: Floats
    by_paint: Floats
    unknowns: NDArray[np.int64]

    @cached_property
    def _paint(self) -> Floats:
        """Orthonormal columns that span what the paint's unknowns do to residuals and priors."""
        numbers, index = np.unique(self.unknowns, return_inverse=True)
        count = len(self.noise)
        columns = np.zeros((count + len(numbers), len(numbers)))
        np.add.at(columns, (np.arange(count)[:, None], index), self.by_paint / self.noise[:, None])
        columns[count:] = np.eye(len(numbers))
        return np.linalg.qr(columns)[0]

    def whitened(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return how far markings lie beside their bars (m,), and how they move by a step (m, 12).

        Beside the nearest point: a marking that slides along itself fits as well as before. Both
        are independent and in standard deviations, the paint's unknowns and their priors taken off;
        so there are more of them than bars.
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
