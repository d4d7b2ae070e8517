"""Different cameras that explain the paint of an image, the best first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rows import join_rows
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.candidates import (
    Candidates,
    SeenMarkings,
    explained_share,
    name_triples,
    project_markings,
    refine_candidates,
    score_with_prior,
    stand_on,
    thin_out,
)
from worldpose.static_calibration.from_paint.circles import name_circles
from worldpose.static_calibration.from_paint.paint import PaintMap
from worldpose.static_calibration.line_samples import LineSamples, sample_markings
from worldpose.static_calibration.settings import CameraPrior

MIN_MARGIN: Final = 25.0
"""Minimum margin without a click [1]; below, more rolls and lenses are tried."""
_CLEAR_SHARES: Final = (0.75, 0.6)
"""Both shares; a clear camera that reaches neither of these does not end the search for rolls, and
one that does not reach the first does not end that for lenses [1]."""
FINE: Final = (1.0, 2.0)
"""Spacing of samples [m], and standard deviation of their distance from paint [px], of refined
candidates."""
_MAX_SCORED: Final = 8000
"""Candidates to judge on closer samples [1]."""
ON_PAINT: Final = 4.0
"""Maximum distance of a marking from its paint [px]."""
_POLISHING: Final = (15.0, 8.0, 5.0, 5.0)
"""Distances within which paint attracts a marking of a good camera, with k1 free [px]."""


class RankedCameras(NamedTuple):
    """Different cameras that explain the paint of an image, the best first."""

    paint: PaintMap
    cameras: Candidates
    scores: Floats
    """(k,) log probability ratios to an image without a pitch [1]."""


def rank_under_lenses(
    paints: Iterable[PaintMap],
    pitch: PitchTemplate,
    prior: CameraPrior,
    lens: Camera | None,
    rivals: RankedCameras | None = None,
) -> RankedCameras | None:
    """Return the paint under the lens that explains it best, its cameras and their scores.

    `rivals` are the cameras of another search of the image, which this one may have missed: they
    are refined on this paint and ranked with the others.
    """
    best: RankedCameras | None = None
    samples = sample_markings(pitch, FINE[0])
    for paint in paints:
        focals = np.array([paint.focal / paint.size[0]])
        if lens is None:
            focals = np.geomspace(0.45, 5.0, 13)  # in image widths
        ranked, scores = _rank_cameras(paint, pitch, prior, focals)
        if len(ranked) and (best is None or scores[0] > best[2][0]):
            best = RankedCameras(paint, ranked, scores)
        # Under a wrong lens a camera may be clear though a third of its markings misses the paint.
        if best is not None:
            found, _ = _shares_if_clear(best.paint, samples, best.cameras, best.scores)
            if found >= _CLEAR_SHARES[0]:
                break
    if best is None or rivals is None:
        return best
    paint, focals = best.paint, rivals.cameras.focals * (best.paint.focal / rivals.paint.focal)
    others = replace(rivals.cameras, focals=focals)
    others = refine_candidates(paint, samples, others, _POLISHING, (lens is None, lens is None))
    scores = np.append(best.scores, score_with_prior(paint, samples, others, prior, FINE[1]))
    return RankedCameras(paint, *_rank(paint, samples, join_rows([best.cameras, others]), scores))


def _shares_if_clear(
    paint: PaintMap, samples: LineSamples, ranked: Candidates, scores: Floats
) -> tuple[float, float]:
    """Return the first camera's shares of markings on paint, and of paint on markings [1].

    Both are 0 if another camera explains the paint nearly as well.
    """
    if not len(scores) or scores[0] - runner_up(scores) < MIN_MARGIN:
        return 0.0, 0.0
    seen = project_markings(paint, samples, ranked[:1])
    return share_on_paint(seen), explained_share(paint, seen)


def share_on_paint(seen: SeenMarkings) -> float:
    """Return the share of the first camera's markings that lies on paint [1]."""
    lengths, near = seen.lengths[0], seen.distances[0] < ON_PAINT
    return float((lengths * near).sum() / max(lengths.sum(), 1e-9))


def runner_up(scores: Floats) -> float:
    """Return the score of the best other camera, or that of none [1]."""
    return max(0.0, float(scores[1])) if len(scores) > 1 else 0.0


def _rank_cameras(
    paint: PaintMap, pitch: PitchTemplate, prior: CameraPrior, focals: Floats
) -> tuple[Candidates, Floats]:
    """Return different cameras, the best first, all on the near side, and their scores (k,).

    Focal lengths to try are in image widths [1]; a single one is kept.
    """
    rolls = ((0.0,), (-0.14, -0.07, 0.07, 0.14))  # cameras on masts hang 4 to 8 degrees off
    best, scores = _rank_rolled(paint, pitch, prior, focals, rolls[0])
    samples = sample_markings(pitch, FINE[0])
    shares = _shares_if_clear(paint, samples, best, scores)
    if np.greater_equal(shares, _CLEAR_SHARES).any():
        return best, scores
    rolled, others = _rank_rolled(paint, pitch, prior, focals, rolls[1])
    return _rank(paint, samples, join_rows([best, rolled]), np.append(scores, others))


def _rank_rolled(
    paint: PaintMap,
    pitch: PitchTemplate,
    prior: CameraPrior,
    focals: Floats,
    rolls: Sequence[float],
) -> tuple[Candidates, Floats]:
    """Return different cameras near some rolls, the best first, and their scores (k,)."""
    stages = (25.0, 12.0, 6.0, 5.0)  # distances within which paint attracts a marking [px]
    polished = (10, _POLISHING)  # the best different ones are refined once more
    most = 60
    medium = (2.5, 6.0)
    coarse = (6.0, 8.0)  # spacing of samples [m], deviation from paint [px]; the same for good ones
    found = join_rows([name_triples(paint, pitch, focals, roll) for roll in rolls])
    circles = join_rows([name_circles(paint, pitch, focals, roll) for roll in rolls])
    if not len(found) + len(circles):
        return found, np.zeros(0)
    if len(found) > _MAX_SCORED:
        found = _keep_best(paint, sample_markings(pitch, coarse[0]), found, prior, coarse[1])
    samples = sample_markings(pitch, medium[0])
    # The vote for circles is coarse: bins of 8 to 15 %.
    near = refine_candidates(paint, samples, circles, stages[:1], (len(focals) > 1, False))
    # Apart: circles are refined already, and would crowd out better ones of three lines.
    found, near = (_keep_best(paint, samples, each, prior, medium[1]) for each in (found, near))
    found, near = (thin_out(each[: 10 * most], most) for each in (found, near))
    found = join_rows([found, near])
    samples = sample_markings(pitch, FINE[0])
    for count, radii, bends in ((len(found), stages, False), (*polished, True)):
        free = (len(focals) > 1, bends and len(focals) > 1)
        found = refine_candidates(paint, samples, found[:count], radii, free)
        scores = score_with_prior(paint, samples, found, prior, FINE[1])
        found, scores = _rank(paint, samples, found, scores)
    return found, scores


def _keep_best(
    paint: PaintMap, samples: LineSamples, found: Candidates, prior: CameraPrior, spread: float
) -> Candidates:
    """Return the good candidates, the best first."""
    scores = score_with_prior(paint, samples, found, prior, spread)
    return found[np.argsort(-scores, kind="stable")[:_MAX_SCORED]]


def _rank(
    paint: PaintMap, samples: LineSamples, found: Candidates, scores: Floats
) -> tuple[Candidates, Floats]:
    """Return different cameras on the near side, the best first, and their scores (k,)."""
    order = np.argsort(-scores, kind="stable")
    # Behind a goal refinement moves cameras across the long axis: half a turn makes them equal.
    found, scores = stand_on(found[order], "near"), scores[order]
    different = _distinct(paint, samples, found)
    return found[different], scores[different]


def _distinct(paint: PaintMap, samples: LineSamples, candidates: Candidates) -> Integers:
    """Return indices of the candidates whose markings lie elsewhere than those of all before."""
    seen = project_markings(paint, samples, candidates)
    visible = seen.lengths > 0.0
    kept: list[int] = []
    for index in range(len(candidates)):
        for before in kept:
            either = visible[index] & visible[before]
            moved = np.linalg.norm(seen.pixels[index] - seen.pixels[before], axis=-1)[either]
            shared = np.count_nonzero(either) > 0.8 * np.count_nonzero(visible[before])
            if shared and len(moved) and np.median(moved) < 8.0:
                break
        else:
            kept.append(index)
    return np.array(kept, dtype=np.int64)
