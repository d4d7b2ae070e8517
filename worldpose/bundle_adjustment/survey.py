"""What a survey's errors do to all cameras at once.

Cameras calibrated on the same painted lines share the errors of the survey of these lines. Each
camera's covariance has them in it; but averaging over sixteen cameras does not lessen them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.clip import Clip
from worldpose.static_calibration.line_samples import sample_markings, see_lines, thinned
from worldpose.static_calibration.line_settings import LineRefinementSettings

Floats = NDArray[np.float64]

_SPACING: Final = 0.25
"""Of samples along painted lines [m]."""
_LINE_WIDTH: Final = LineRefinementSettings().line_width
_APART: Final = 8.0
"""Least distance of two independent samples in a picture [px]: as far as a bar across a line is
wide."""
_MOST: Final = 700
"""Samples of a picture, about [1]."""
_NOISE: Final = 0.1
"""Of a sample across its line, standard deviation [px]. With it, and the true errors of a survey,
the response foretells how far all cameras put everybody beside himself to 0.6 of 6 mm on simulated
matches; 0.3 foretells two thirds of it, 0.03 the same."""
_SHIFT: Final = LineRefinementSettings().line_shift
"""Of a whole line in one picture, standard deviation [px]; no other camera shares it."""


def survey_response(clip: Clip, survey_error: float) -> Floats:
    """Return how calibrated cameras (cameras, 12, unknowns) move with the survey's errors.

    A calibration that knows about unknowns s of unit variance errs by
    C H (K + 1)^-1 s, where C is its covariance, and H and K are the blocks of its normal equations
    that lines give for camera and unknowns, and for the unknowns alone. Unknowns are the places of
    the template's points, which cameras share, and a shift of each marking in the picture, which
    is a camera's own. The lines are those that the camera sees; clicks err by far more than the
    survey, and are left out.

    Args:
        clip: cameras, their covariance, the pitch and who was calibrated on its lines.
        survey_error: of the template's points, each axis, standard deviation [m].

    Returns:
        Zero for cameras that do not rest on lines; no unknowns without a pitch, else three for
        each point of the template.
    """
    count = len(clip.covariance)
    if clip.pitch is None or clip.on_lines is None or not clip.on_lines.any():
        return np.zeros((count, clip.covariance.shape[1], 0))
    samples = sample_markings(clip.pitch, _SPACING)
    response = np.zeros((count, clip.covariance.shape[1], 3 * len(clip.pitch.points)))
    for c in np.flatnonzero(clip.on_lines).tolist():
        seen = see_lines(clip.cameras[c], samples, _LINE_WIDTH, survey_error, _SHIFT)
        seen = seen[thinned(seen, samples, _APART, _MOST)]
        unknowns, column = np.unique(seen.unknowns, return_inverse=True)
        by_paint = np.zeros((len(seen.places), len(unknowns)))
        np.add.at(by_paint, (np.arange(len(by_paint))[:, None], column), seen.by_paint / _NOISE)
        known = by_paint.T @ by_paint + np.eye(len(unknowns))
        met = by_paint.T @ seen.by_camera / _NOISE
        moved = clip.covariance[c] @ np.linalg.solve(known, met).T
        response[c][:, unknowns[unknowns >= 0]] = moved[:, unknowns >= 0]
        response[c] /= max(1.0, _share(clip.covariance[c], response[c]))
    return response


def with_shared_errors(covariance: Floats, information: Floats, response: Floats) -> Floats:
    """Return the covariance (cameras, 12, 12) of each camera when calibrations err together.

    The adjustment takes them for independent, which says what it weighs; how far it errs is
    another question (the sandwich of White 1980).

    Args:
        covariance: (12 cameras, 12 cameras) of the adjustment as if they were.
        information: (cameras, 12, 12) that calibrations entered with.
        response: (cameras, 12, unknowns) of each calibration to unknowns that all share.
    """
    count, size = information.shape[:2]
    blocks = covariance.reshape(count, size, count, size)
    own = blocks[np.arange(count), :, np.arange(count)]
    pull = np.einsum("cij,cjk->cik", information, response)
    moved = np.einsum("cidj,djk->cdik", blocks, pull)
    together = moved.sum(axis=1)
    # What a camera's own part adds to itself is in the covariance already.
    alone = np.einsum("cdik,cdjk->cij", moved, moved)
    return np.asarray(own + together @ together.swapaxes(1, 2) - alone)


def _share(covariance: Floats, response: Floats) -> float:
    """The largest share of a camera's standard deviation that a response explains."""
    free = np.diag(covariance) > 0.0
    size = np.sqrt(np.diag(covariance)[free])
    factor = np.linalg.cholesky(covariance[np.ix_(free, free)] / np.outer(size, size))
    return float(np.linalg.norm(np.linalg.solve(factor, response[free] / size[:, None]), ord=2))
