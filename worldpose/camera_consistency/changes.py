"""Changes of a camera within a clip: the moment from which its images depart otherwise.

For the normal equations (M_b, r_b) of each bin b of one camera, less the solution of the clip, a
change d of some unknowns that begins with weight w_b (a step, or a ramp over the clip) lowers the
sum of squares by

    g^T K^-1 g,  g = sum_b w_b r_b,  K = sum_b w_b^2 M_b - P M^-1 P,  P = sum_b w_b M_b,

with what stays constant fitted, too. It is a change if this gain is far beyond the noise of the
bins and large enough to matter. Noise of detectors lasts: its variance is that of blocks of bins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from data_contracts.arrays import Floats
from worldpose.camera_consistency.health import UNKNOWNS, CameraHealth

Kind = Literal["clock", "view"]


@dataclass(frozen=True)
class Change:
    """A change of a camera within a clip.

    Attributes:
        camera: index.
        kind: its clock or its view changed.
        is_sudden: from one frame on; else over the whole clip.
        row: row of the first frame after a sudden change.
        size: change of the clock [frame], over the whole clip if gradual; of the view, usual
            displacement of people in the image [px].
        gain: decrease of the sum of squares, in variances of the noise [1].
    """

    camera: int
    kind: Kind
    is_sudden: bool
    row: int
    size: float
    gain: float


def find_changes(
    health: CameraHealth, fps: float, kinds: Sequence[Kind] = ("clock", "view")
) -> list[Change]:
    """Return sudden and gradual changes of some kinds, the clearest first.

    Where a camera changes, the people that it helps to place move with it, so that other cameras
    seem to change at the same time; and a step seems a drift, too.
    """
    cameras = range(health.matrix.shape[1])
    found = [each for c in cameras for kind in kinds for each in _find(health, c, kind, fps)]
    return sorted(found, key=lambda change: -change.gain)


def _find(health: CameraHealth, c: int, kind: Kind, fps: float) -> Iterator[Change]:
    min_gain = 30.0
    # Of the clock [frame]; of the view [px], 2 cm at people. The camera's own share in the people
    # hides up to a half of a change.
    total_scale, terms, _ = health.sums[:, c].sum(axis=0)
    scale = total_scale / max(1.0, terms)
    min_size = 0.25 if kind == "clock" else max(1.5, 0.02 * scale)
    matrix, right = health.matrix[:, c], health.right[:, c]
    total = matrix.sum(axis=0)
    if len(matrix) < 8 or not _is_solvable(total):
        return
    right = right - matrix @ np.linalg.solve(total, right.sum(axis=0))
    changing = [4] if kind == "clock" else [0, 1, 2, 3]
    bins, second = len(matrix), max(1, round(fps / health.length))
    margin = max(2, round(0.6 * second))  # on either side of a step
    ramp = np.arange(bins) / (bins - 1.0)
    steps = (np.arange(bins) >= np.arange(margin, bins - margin)[:, None]).astype(np.float64)
    for is_sudden, weights in ((False, ramp[None]), (True, steps)):
        gains, by = _gains(matrix, right, total, weights, changing)
        if not len(gains):
            continue
        place = int(np.argmax(gains))
        change = np.zeros(UNKNOWNS)
        change[changing] = by[place]
        left = right - weights[place, :, None] * (matrix @ change)
        gain = float(gains[place]) / _noise(matrix, left, second)
        size = (
            float(by[place, 0])
            if kind == "clock"
            else _displacement(gains[place], weights[place], matrix)
        )
        if gain < min_gain or abs(size) < min_size:
            continue
        start = place + margin
        near = slice(max(0, start - 3 * second), start + 3 * second)
        if is_sudden and not _is_sharp(matrix[near], right[near], start - near.start, changing):
            continue
        yield Change(c, kind, is_sudden, start * health.length if is_sudden else 0, size, gain)
    if kind == "view":
        size, gain = _sway(matrix, right, second)
        if gain > min_gain and size > 2.0 * min_size:
            yield Change(c, kind, is_sudden=False, row=0, size=size, gain=gain)


def _sway(matrix: Floats, right: Floats, second: int) -> tuple[float, float]:
    """Return the usual displacement [px] and gain of a view that is another in each second."""
    left, sizes, gains = right.copy(), [0.0], [0.0]
    for start in range(0, len(matrix) - second + 1, second):
        part = slice(start, start + second)
        held, pull = matrix[part].sum(axis=0), right[part].sum(axis=0)
        if _is_solvable(held):
            change = np.linalg.solve(held, pull)
            left[part] = right[part] - matrix[part] @ change
            gains.append(float(pull @ change))
            sizes.append(np.sqrt(2.0 * gains[-1] / (held[0, 0] + held[1, 1])))
    return float(np.median(sizes)), float(np.median(gains)) / _noise(matrix, left, 1)


def _is_sharp(matrix: Floats, right: Floats, place: int, changing: list[int]) -> bool:
    """Return whether a step stands out in the seconds around it.

    People who walk to another place meet other errors of the calibration: a slow change.
    """
    total = matrix.sum(axis=0)
    if not _is_solvable(total):
        return False
    right = right - matrix @ np.linalg.solve(total, right.sum(axis=0))
    step = (np.arange(len(matrix)) >= place).astype(np.float64)
    (gain,), by = _gains(matrix, right, total, step[None], changing)
    change = np.zeros(UNKNOWNS)
    change[changing] = by[0]
    left = right - step[:, None] * (matrix @ change)
    return bool(gain > 12.0 * _noise(matrix, left, 1))


def _gains(
    matrix: Floats, right: Floats, total: Floats, weights: Floats, changing: list[int]
) -> tuple[Floats, Floats]:
    """Return the gains (n,) and changes (n, k) of weights (n, bins)."""
    part = np.einsum("nb,bij->nij", weights, matrix)
    own = np.einsum("nb,bij->nij", weights**2, matrix) - part @ np.linalg.solve(total, part)
    block = own[:, changing][:, :, changing]
    block = block + 1e-6 * total[changing][:, changing] * np.eye(len(changing))
    force = (weights @ right)[:, changing, None]
    by = np.linalg.solve(block, force)
    return np.asarray((force * by).sum(axis=(1, 2))), by[..., 0]


def _noise(matrix: Floats, right: Floats, length: int) -> float:
    """Return the variance of blocks of bins about their neighbours [1], at least 1."""
    blocks = len(matrix) // length
    held = matrix[: blocks * length].reshape(blocks, length, *matrix.shape[1:]).sum(axis=1)
    pull = right[: blocks * length].reshape(blocks, length, -1).sum(axis=1)
    values = []
    for one in range(1, blocks - 1):
        near = held[one - 1] + held[one + 1]
        if _is_solvable(near) and _is_solvable(held[one]):
            left = pull[one] - held[one] @ np.linalg.solve(near, pull[one - 1] + pull[one + 1])
            spread = held[one] + held[one] @ np.linalg.solve(near, held[one])
            values.append(float(left @ np.linalg.solve(spread, left)) / len(left))
    return max(1.0, float(np.median(values))) if values else 1.0


def measure_step(
    health: CameraHealth, found: Change, weights: Floats
) -> tuple[Floats, float, float]:
    """Return the change (5,) with weights (bins,), the standard deviation of its size, and a rest.

    The rest is the offset of a changed clock where the weights are 0 [frame].
    """
    matrix, right = health.matrix[:, found.camera], health.right[:, found.camera]
    changing = [4] if found.kind == "clock" else [0, 1, 2, 3]
    total, change = matrix.sum(axis=0), np.zeros(UNKNOWNS)
    if not _is_solvable(total):
        return change, np.inf, 0.0
    usual = np.linalg.solve(total, right.sum(axis=0))
    left = right - matrix @ usual
    _, by = _gains(matrix, left, total, weights[None], changing)
    change[changing] = by[0]
    part = np.einsum("b,bij->ij", weights, matrix)
    constant = usual - np.linalg.solve(total, part @ change)
    left = right - matrix @ constant - weights[:, None] * (matrix @ change)
    own = np.einsum("b,bij->ij", weights**2, matrix) - part @ np.linalg.solve(total, part)
    covariance = np.linalg.pinv(own[np.ix_(changing, changing)]) * _noise(matrix, left, 1)
    variance = np.diagonal(covariance)[: 2 if len(changing) > 1 else 1]
    std = float(np.sqrt(max(0.0, variance.sum())))
    return change, std, float(constant[4]) if found.kind == "clock" else 0.0


def _is_solvable(matrix: Floats) -> bool:
    size = np.sqrt(np.diagonal(matrix))
    if not (size > 0.0).all():
        return False
    return bool(np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > 1e-6)


def _displacement(gain: float, weights: Floats, matrix: Floats) -> float:
    """Return the usual displacement [px] of people by a change of the view with this gain."""
    shift = 0.5 * (matrix[:, 0, 0] + matrix[:, 1, 1])
    spread = (weights**2 * shift).sum() - (weights * shift).sum() ** 2 / shift.sum()
    return float(np.sqrt(gain / max(spread, 1e-12)))
