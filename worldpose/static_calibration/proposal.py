"""Cameras and markings proposed from an image alone, without a click (C2).

Straight segments of paint are the evidence. A triple of them, two along one axis of the pitch and
one along the other, with names from the template and a level camera, determines a camera. Every
plausible assignment gives a candidate; the paint that it explains, and the markings that it
predicts and the image lacks, decide. The best candidates are refined on the nearest paint.

The pitch looks the same after half a turn. The side on which the camera stands decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.cameras import LensCalibration
from data_contracts.match import Side
from data_contracts.static_calibration import ClickedMarkings, DrawnMarking
from worldpose.errors import InputError
from worldpose.geometry import Camera, Rigid
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.line_samples import LineSamples, sample_markings
from worldpose.static_calibration.paint_segments import ORIENTATIONS, PaintMap, find_paint
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings

_FOCALS: Final = np.geomspace(0.45, 5.0, 13)
"""Focal lengths to try, in image widths [1]."""
_TILTS: Final = np.radians(np.geomspace(3.0, 45.0, 16))
"""Tilts below the horizon to try [rad]."""
_ROLLS: Final = ((0.0,), (-0.14, -0.07, 0.07, 0.14))
"""Rolls to try, and those to try as well while the proposal is not clear [rad]: cameras on masts
hang 4 to 8 degrees off the level."""
_CLEAR: Final = 25.0
"""Minimum margin of a clear proposal [1]."""
MIN_MARGIN: Final = 25.0
"""Minimum margin of a proposal to be used without a click [1]."""
MIN_FOUND: Final = 0.6
"""Minimum share of its markings on paint [1]."""
MIN_EXPLAINED: Final = 0.4
"""Minimum share of the straight paint on its markings [1]: a small part of the pitch may fit any
two lines."""
_AGREES: Final = 0.01
"""Maximum median displacement of markings by the calibration, in image widths [1]."""
_LENS_STD: Final = (0.1, 0.02, 0.03)
"""Standard deviations of a proposed lens: focal length, of itself [1]; principal point, in image
widths [1]; displacement of the image corner [1]."""
_TO_CLICK: Final = "Click four or more named points of this camera, such as corners of areas."
_LEVEL: Final = np.radians(5.0)
"""Deviation of two segments from a right angle, or from parallels, on the pitch [rad]."""
_SEGMENTS: Final = 12
"""Maximum segments to name, those with the most paint [1]."""
_BEYOND: Final = (0.15, 1.5)
"""Reach of a segment beyond its marking: share of its length [1], and [m]."""
_HEIGHTS: Final = (1.8, 80.0)
"""Heights of cameras above the pitch [m]."""
_FARTHEST: Final = 200.0
"""Distance of a camera from the centre spot in plan [m]."""
_INSIDE: Final = 1.0
"""Distance of a camera from the outer lines inside of the pitch [m]."""
_FOUND: Final = 0.7
"""Probability that a visible marking is found at one place [1]: players, shadows and wear hide
the rest."""
_BY_CHANCE: Final = 0.05
"""Probability that paint is near a place without a marking [1]."""
_INDEPENDENT: Final = 1.0 / 32.0
"""Length of a marking that counts as one observation, in image widths [1]: what hides paint has
this size."""
_COARSE: Final = (6.0, 8.0)
_SAMPLED: Final = (2.5, 6.0)
_FINE: Final = (1.0, 2.0)
"""Spacing of samples [m], and standard deviation of their distance from paint [px]: for all
candidates, for good ones, and for refined ones."""
_GOOD: Final = 8000
"""Candidates to judge on closer samples [1]."""
_REFINED: Final = 60
"""Candidates to refine [1]."""
_RADII: Final = (25.0, 12.0, 6.0, 5.0)
"""Distances within which paint attracts a marking, one stage after another [px]."""
_POLISHED: Final = (10, (15.0, 8.0, 5.0, 5.0))
"""Best different candidates to refine once more [1], with k1 free from the start, and distances of
the stages [px]."""
_ITERATIONS: Final = 4
"""Steps of each stage [1]."""
_SAME: Final = 8.0
"""Median displacement of the markings below which two cameras are the same proposal [px]."""
_ROLL_STD: Final = 0.015
"""Standard deviation of the roll while candidates are refined [rad]."""
_BEND_STD: Final = (0.005, 0.02)
"""Standard deviation of the displacement of the image corner by k1 while candidates are refined,
relative to the corner's distance from the middle [1], in images that look straight and in others:
less than of an unknown lens, so that a wrong name does not bend the image."""
_DRAWN: Final = 40
"""Maximum pixels to draw along a marking [1]."""
_ON_PAINT: Final = 4.0
"""Maximum distance of a marking from its paint [px]."""


@dataclass(frozen=True)
class MarkingSupport:
    """How much of one marking the image shows.

    Attributes:
        name: line or arc of the template.
        visible_px: length of the marking in the straight copy of the image [px].
        found: share of it on paint [1].
    """

    name: str
    visible_px: float
    found: float


@dataclass(frozen=True, eq=False)
class Proposal:
    """A camera found without a click, and the evidence for it.

    Attributes:
        camera: pose, focal length and k1; no covariance: a calibration from `drawn` has one.
        drawn: pixels on the paint of every marking that was found.
        markings: what was expected and found, the longest first.
        score: log probability ratio to an image without a pitch [1].
        margin: score above the best other camera [1].
        found: share of the expected markings on paint, by length [1].
        explained: share of the segments' length on a marking [1].
    """

    camera: Camera
    drawn: ClickedMarkings
    markings: tuple[MarkingSupport, ...]
    score: float
    margin: float
    found: float
    explained: float

    @property
    def is_clear(self) -> bool:
        """Whether the proposal may be used without a click."""
        enough = self.found >= MIN_FOUND and self.explained >= MIN_EXPLAINED
        return self.margin >= MIN_MARGIN and enough


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Cameras with square pixels and the principal point in the middle of the working image.

    Attributes:
        rotations: (k, 3, 3) world to camera.
        centers: (k, 3) [m], world.
        focals: (k,) [px].
        radial: (k,) k1 [1].
    """

    rotations: Floats
    centers: Floats
    focals: Floats
    radial: Floats

    def __len__(self) -> int:
        return len(self.focals)

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> _Candidates:
        return _Candidates(
            self.rotations[index], self.centers[index], self.focals[index], self.radial[index]
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    """Samples of markings in the images of candidates.

    Attributes:
        pixels: (k, n, 2) [px] from the middle of the image.
        normals: (k, n) angles across the projected markings [rad].
        lengths: (k, n) length of marking per sample [px]; 0 outside of the image.
        distances: (k, n) to paint of this direction [px]; infinite outside of the pitch's area.
        nearest: (k, n) this paint's index in `PaintMap.points`.
    """

    pixels: Floats
    normals: Floats
    lengths: Floats
    distances: Floats
    nearest: NDArray[np.int32]


def propose_camera(
    picture: Image,
    pitch: PitchTemplate,
    *,
    side: Side,
    prior: CameraPrior | None = None,
    lens: LensCalibration | None = None,
    where: str = "image",
) -> Proposal:
    """Return the camera that explains the paint of an image best.

    Args:
        picture: (height, width, 3) RGB.
        pitch: the stadium's template.
        side: where the camera stands.
        prior: heights, distances, focal lengths; the defaults if None.
        lens: a lens that was calibrated before.
        where: file or camera, for messages.

    Raises:
        InputError: there is no grass, or too little paint for a camera.

    Note:
        The homography of line correspondences follows Hartley and Zisserman 2004, chapter 8; the
        search over names is exhaustive.
    """
    known = prior or CameraPrior()
    height, width = picture.shape[:2]
    given = None if lens is None else _lens_camera(lens, (width, height))
    found = _rank_under_lenses(find_paint(picture, given, where), pitch, known, given)
    if found is None:
        raise InputError(
            where,
            expected="at least three straight markings, one of them across the others",
            found="paint that fits no camera",
            todo=_TO_CLICK,
        )
    paint, ranked, scores = found
    samples, best = sample_markings(pitch, _FINE[0]), _stand_on(ranked[:1], side)
    seen = _look(paint, samples, best)
    markings, drawn = _support(paint, samples, seen)
    lengths = seen.lengths[0]
    on_paint = (lengths * (seen.distances[0] < _ON_PAINT)).sum() / max(lengths.sum(), 1e-9)
    return Proposal(
        _to_camera(best, paint),
        drawn,
        markings,
        float(scores[0]),
        float(scores[0] - max(0.0, *scores[1:2])),
        float(on_paint),
        _explained(paint, seen),
    )


def calibrate_without_clicks(
    pitch: PitchTemplate,
    picture: Image,
    *,
    side: Side,
    settings: StaticCalibrationSettings | None = None,
    where: str = "image",
    lens: LensCalibration | None = None,
) -> StaticCalibration:
    """Return the camera of an image, its covariance and its report, from the image alone.

    The markings of a clear proposal are calibrated as if they had been drawn. The calibration has
    to agree with the proposal.

    Args:
        pitch: the stadium's template.
        picture: (height, width, 3) RGB.
        side: where the camera stands.
        settings: noise, prior and thresholds; the defaults if None.
        where: file or camera, for messages.
        lens: a lens that was calibrated before; None = not known.

    Raises:
        InputError: the image shows too little, other cameras explain it nearly as well, or the
            calibration disagrees with the proposal; the message says what to click.
    """
    stated = settings or StaticCalibrationSettings()
    proposal = propose_camera(picture, pitch, side=side, prior=stated.prior, lens=lens, where=where)
    if not proposal.is_clear:
        raise _unclear(proposal, where)
    height, width = picture.shape[:2]
    bent = bool(proposal.camera.distortion.any())
    calibration = calibrate_camera(
        pitch,
        proposal.drawn,
        (width, height),
        picture=picture,
        settings=stated,
        where=where,
        lens=lens,
    )
    places = pitch.sample_lines(_FINE[0]).points_world
    pixels, others = (
        camera.project(places) for camera in (proposal.camera, calibration.estimate.camera)
    )
    inside = ((pixels >= 0.0) & (pixels <= [width - 1.0, height - 1.0])).all(axis=1)
    moved = float(np.median(np.linalg.norm(pixels - others, axis=1)[inside]))
    if not moved < _AGREES * width:
        raise InputError(
            where,
            expected="the calibration close to the proposal of the image",
            found=f"markings {moved:.0f} px apart (median)",
            todo=_TO_CLICK,
        )
    decision = (
        f"markings proposed from the image: {proposal.found:.0%} of their length on paint, "
        f"{proposal.margin:.0f} above other cameras"
    )
    report = calibration.report
    report = replace(report, decisions=(decision, *report.decisions))
    return replace(calibration, report=report)


def _unclear(proposal: Proposal, where: str) -> InputError:
    lacking = [each.name for each in proposal.markings if each.found < 0.5]
    return InputError(
        where,
        expected=f"one camera that explains the paint (margin {MIN_MARGIN:g}, "
        f"{MIN_FOUND:.0%} of the markings on paint, {MIN_EXPLAINED:.0%} of the paint on markings)",
        found=f"margin {proposal.margin:.0f}, {proposal.found:.0%} and {proposal.explained:.0%}; "
        f"not found: {', '.join(lacking[:4]) or 'nothing, but other cameras fit as well'}",
        todo=_TO_CLICK,
    )


def _proposed_lens(camera: Camera) -> LensCalibration:
    """Return a proposal's lens as a prior."""
    width, height = (int(length) for length in camera.image_size)
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    return LensCalibration(
        id="proposed",
        image_size=(width, height),
        focal_px=float(camera.focal[0]),
        principal_point_px=(0.5 * (width - 1), 0.5 * (height - 1)),
        distortion=(k1, k2, p1, p2, k3),
        focal_std_px=_LENS_STD[0] * float(camera.focal[0]),
        principal_point_std_px=_LENS_STD[1] * width,
        distortion_std=_LENS_STD[2],
    )


def _rank_under_lenses(
    paints: Iterable[PaintMap], pitch: PitchTemplate, prior: CameraPrior, lens: Camera | None
) -> tuple[PaintMap, _Candidates, Floats] | None:
    """Return the paint under the lens that explains it best, its cameras and their scores."""
    best: tuple[PaintMap, _Candidates, Floats] | None = None
    for paint in paints:
        focals = _FOCALS if lens is None else np.array([paint.focal / paint.size[0]])
        ranked, scores = rank_cameras(paint, pitch, prior, focals)
        if len(ranked) and (best is None or scores[0] > best[2][0]):
            best = (paint, ranked, scores)
        if best is not None and best[2][0] - max(0.0, *best[2][1:2]) > _CLEAR:
            break
    return best


def rank_cameras(
    paint: PaintMap, pitch: PitchTemplate, prior: CameraPrior, focals: Floats = _FOCALS
) -> tuple[_Candidates, Floats]:
    """Return different cameras, the best first, all on the near side, and their scores (k,).

    Args:
        paint: paint of the image.
        pitch: the template.
        prior: heights, distances, focal lengths.
        focals: focal lengths to try, in image widths [1]; a single one is kept.
    """
    best, scores = _rank_rolled(paint, pitch, prior, focals, _ROLLS[0])
    if len(scores) and scores[0] - max(0.0, *scores[1:2]) > _CLEAR:
        return best, scores
    rolled, others = _rank_rolled(paint, pitch, prior, focals, _ROLLS[1])
    return _order(
        paint, sample_markings(pitch, _FINE[0]), _join(best, rolled), np.append(scores, others)
    )


def _rank_rolled(
    paint: PaintMap,
    pitch: PitchTemplate,
    prior: CameraPrior,
    focals: Floats,
    rolls: Sequence[float],
) -> tuple[_Candidates, Floats]:
    """Return different cameras near some rolls, the best first, and their scores (k,)."""
    found = _join(*(_name_triples(paint, pitch, focals, roll) for roll in rolls))
    if not len(found):
        return found, np.zeros(0)
    for (spacing, spread), count in ((_COARSE, _GOOD), (_SAMPLED, 10 * _REFINED)):
        if len(found) > count or spacing == _SAMPLED[0]:
            samples = sample_markings(pitch, spacing)
            scores = _score(paint, samples, found, spread) + _log_prior(found, prior, paint.size)
            found = found[np.argsort(-scores, kind="stable")[:count]]
    samples = sample_markings(pitch, _FINE[0])
    found = _thin_out(found)
    for count, radii, bends in ((len(found), _RADII, False), (*_POLISHED, True)):
        free = (len(focals) > 1, bends and len(focals) > 1)
        found = _refine(paint, samples, found[:count], radii, free)
        scores = _score(paint, samples, found, _FINE[1]) + _log_prior(found, prior, paint.size)
        found, scores = _order(paint, samples, found, scores)
    return found, scores


def _order(
    paint: PaintMap, samples: LineSamples, found: _Candidates, scores: Floats
) -> tuple[_Candidates, Floats]:
    """Return different cameras, the best first, and their scores (k,)."""
    order = np.argsort(-scores, kind="stable")
    found, scores = found[order], scores[order]
    different = _different(paint, samples, found)
    return found[different], scores[different]


def _join(*parts: _Candidates) -> _Candidates:
    """Return all candidates in one record."""
    return _Candidates(
        np.concatenate([part.rotations for part in parts]),
        np.concatenate([part.centers for part in parts]),
        np.concatenate([part.focals for part in parts]),
        np.concatenate([part.radial for part in parts]),
    )


def _straight_lines(pitch: PitchTemplate) -> tuple[Floats, Floats]:
    """Return painted lines along x (n, 3) as y, first and last x, and along y (m, 3) [m]."""
    along: tuple[list[list[float]], list[list[float]]] = ([], [])
    for line in pitch.lines.values():
        start, end = pitch.points[line.start], pitch.points[line.end]
        reach = np.abs(end - start)[:2]
        for axis in (0, 1):
            if reach[1 - axis] < 0.02 * reach[axis]:
                first, last = sorted((start[axis], end[axis]))
                place = 0.5 * (start[1 - axis] + end[1 - axis])
                along[axis].append([float(place), float(first), float(last)])
    return np.array(along[0]).reshape(-1, 3), np.array(along[1]).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Triples:
    """Segments a, b along one axis, c along the other, in the ground frame of a level camera.

    The ground frame has its origin below the camera, at a height of 1; first axis to the right,
    second axis forward.

    Attributes:
        focals: (k,) [px].
        tilts: (k,) [rad].
        along: (k, 2) unit vector of a and b.
        offsets: (k, 2) of a and b across it [1].
        reach: (k, 2, 2) ends of a and b along it, rising [1].
        offset: (k,) of c along it [1].
        across: (k, 2) ends of c across it, rising [1].
    """

    focals: Floats
    tilts: Floats
    along: Floats
    offsets: Floats
    reach: Floats
    offset: Floats
    across: Floats


def _name_triples(
    paint: PaintMap, pitch: PitchTemplate, focals: Floats, roll: float
) -> _Candidates:
    """Return the cameras with a roll of all triples of segments under all names that fit them."""
    x_lines, y_lines = _straight_lines(pitch)
    half = 0.5 * np.array([pitch.length, pitch.width]) - _INSIDE
    found: list[Floats] = []
    for triples in _ground_triples(paint, focals, roll):
        for axis, (pair, third) in enumerate(((x_lines, y_lines), (y_lines, x_lines))):
            # The normal of a line along x points to y; that of a line along y, to -x.
            sign = 1.0 if axis == 0 else -1.0
            for first, second in permutations(pair, 2):
                gap = triples.offsets[:, 0] - triples.offsets[:, 1]
                with np.errstate(divide="ignore", invalid="ignore"):
                    height = sign * (first[0] - second[0]) / gap
                tall = (height > _HEIGHTS[0]) & (height < _HEIGHTS[1])
                for other in third:
                    kept = np.flatnonzero(tall)
                    up = height[kept]
                    beside = sign * first[0] - up * triples.offsets[kept, 0]
                    ahead = other[0] - up * triples.offset[kept]
                    place = (ahead, beside) if axis == 0 else (-beside, ahead)
                    fits = np.hypot(*place) < _FARTHEST
                    fits &= (np.abs(place[0]) > half[0]) | (np.abs(place[1]) > half[1])
                    for index, line in enumerate((first, second)):
                        ends = triples.reach[kept, index] * up[:, None] + ahead[:, None]
                        fits &= _within(ends, line[1:])
                    ends = triples.across[kept] * up[:, None] + beside[:, None]
                    fits &= _within(ends, other[1:] if axis == 0 else -other[:0:-1])
                    kept, up = kept[fits], up[fits]
                    if not len(kept):
                        continue
                    along = triples.along[kept]
                    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
                    axes = (along, normal) if axis == 0 else (-normal, along)
                    found.append(
                        np.column_stack(
                            [
                                triples.focals[kept],
                                triples.tilts[kept],
                                up,
                                *axes,
                                place[0][fits],
                                place[1][fits],
                            ]
                        )
                    )
    level = _level_cameras(np.concatenate([np.empty((0, 9)), *found]))
    return replace(level, rotations=_about_axis(roll) @ level.rotations)


def _about_axis(roll: float) -> Floats:
    """Return the turn (3, 3) of a camera about its axis."""
    cosine, sine = np.cos(roll), np.sin(roll)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _within(ends: Floats, line: Floats) -> NDArray[np.bool_]:
    """Return whether segments with ends (k, 2) lie on a marking from line[0] to line[1]."""
    beyond = _BEYOND[0] * (ends[:, 1] - ends[:, 0]) + _BEYOND[1]
    return np.asarray((ends[:, 0] > line[0] - beyond) & (ends[:, 1] < line[1] + beyond))


def _level_cameras(rows: Floats) -> _Candidates:
    """Return cameras on the near side of rows (k, 9).

    Args:
        rows: focal length, tilt, height, right and forward component of the pitch's x and y axis,
            x, y.
    """
    turn = np.where(rows[:, 8:] > 0.0, -1.0, 1.0)
    focals, tilts, up = rows[:, :3].T
    zero = np.zeros(len(rows))
    right = np.stack([*(turn * rows[:, [3, 5]]).T, zero], axis=-1)
    forward = np.stack([*(turn * rows[:, [4, 6]]).T, zero], axis=-1)
    down = np.array([0.0, 0.0, -1.0])
    cosine, sine = np.cos(tilts)[:, None], np.sin(tilts)[:, None]
    rotations = np.stack(
        [right, down * cosine - forward * sine, forward * cosine + down * sine], axis=1
    )
    centers = np.stack([*(turn * rows[:, 7:]).T, up], axis=-1)
    return _Candidates(rotations, centers, focals, zero)


def _ground_triples(paint: PaintMap, focals: Floats, roll: float) -> Iterator[_Triples]:
    """Yield triples at all focal lengths and tilts, one segment's direction after another's."""
    width, height = paint.size
    middle = 0.5 * np.array([width - 1, height - 1])
    ends = (paint.segments[:_SEGMENTS] - middle) @ _about_axis(roll)[:2, :2]
    if len(ends) < 3:
        return
    focal, tilt = (part.ravel() for part in np.meshgrid(focals * width, _TILTS, indexing="ij"))
    cosine, sine = np.cos(tilt)[:, None, None], np.sin(tilt)[:, None, None]
    away = focal[:, None, None]
    depth = ends[None, ..., 1] * cosine + away * sine
    with np.errstate(divide="ignore", invalid="ignore"):
        right = ends[None, ..., 0] / depth
        forward = (away * cosine - ends[None, ..., 1] * sine) / depth
    below: NDArray[np.bool_] = np.asarray((depth > 1e-3 * away).all(axis=-1))
    ground = np.stack([right, forward], axis=-1)  # (g, n, 2 ends, 2)
    step = ground[:, :, 1] - ground[:, :, 0]
    angle = np.arctan2(step[..., 1], step[..., 0])
    count = len(ends)
    for reference in range(count):
        turned = angle - angle[:, reference : reference + 1]
        usable = below & below[:, reference : reference + 1]
        parallel = usable & (np.abs((turned + 0.5 * np.pi) % np.pi - 0.5 * np.pi) < _LEVEL)
        square = usable & (np.abs(turned % np.pi - 0.5 * np.pi) < _LEVEL)
        parallel[:, reference] = False
        # The reference is a, or it is c.
        g, b, c = np.nonzero(parallel[:, :, None] & square[:, None, :])
        g2, a2, b2 = np.nonzero(
            square[:, :, None] & square[:, None, :] & np.tri(count, k=-1, dtype=np.bool_)
        )
        a = np.append(np.full(len(g), reference), a2)
        b, c = np.append(b, b2), np.append(c, np.full(len(g2), reference))
        direction = np.append(angle[g, reference], angle[g2, reference] + 0.5 * np.pi)
        g = np.append(g, g2)
        along = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        both = ground[g[:, None], np.stack([a, b], axis=-1)]  # (k, 2, 2 ends, 2)
        third = ground[g, c]
        yield _Triples(
            focal[g],
            tilt[g],
            along,
            np.einsum("ksei,ki->ks", both, normal) / 2.0,
            np.sort(np.einsum("ksei,ki->kse", both, along), axis=-1),
            np.einsum("kei,ki->k", third, along) / 2.0,
            np.sort(np.einsum("kei,ki->ke", third, normal), axis=-1),
        )


def _homogeneous(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _project(candidates: _Candidates, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return pixels (k, n, 2) from the middle of the image, and whether they exist."""
    local = np.einsum("kij,knj->kni", candidates.rotations, points - candidates.centers[:, None])
    depth = local[..., 2]
    front = depth > 1.0
    flat = local[..., :2] / np.where(front, depth, 1.0)[..., None]
    square = (flat**2).sum(-1)
    radial = candidates.radial[:, None]
    front &= 1.0 + 3.0 * radial * square > 0.0  # before the lens folds
    stretch = (1.0 + radial * square) * candidates.focals[:, None]
    return flat * stretch[..., None], front


def _look(paint: PaintMap, samples: LineSamples, candidates: _Candidates) -> _Seen:
    """Return the samples in the images of candidates, with the paint nearest to them."""
    width, height = paint.size
    places = samples.points_world
    step = 0.25
    pixels, front = _project(candidates, places)
    ahead, ahead_front = _project(candidates, places + step * samples.along_world)
    way = ahead - pixels
    normals = np.arctan2(way[..., 1], way[..., 0]) + 0.5 * np.pi
    spacing = _sample_spacing(samples)
    image = pixels + 0.5 * np.array([width - 1, height - 1])
    inside = front & ahead_front & (image > 1.0).all(-1) & (image < [width - 2, height - 2]).all(-1)
    lengths = np.where(inside, np.hypot(way[..., 0], way[..., 1]) / step * spacing, 0.0)
    # A marking that runs towards the camera does not count for more than its image.
    lengths = np.minimum(lengths, 60.0)
    at = np.where(inside[..., None], image, 0.0).astype(np.int64)
    orientation = np.round(normals / np.pi * ORIENTATIONS).astype(np.int64) % ORIENTATIONS
    index = (orientation, at[..., 1], at[..., 0])
    on_pitch = paint.area[at[..., 1], at[..., 0]]
    distances = np.where(on_pitch, paint.distances[index], np.inf)
    return _Seen(pixels, normals, lengths, distances, paint.nearest[index])


def _sample_spacing(samples: LineSamples) -> Floats:
    """Return the length of marking (n,) that each sample stands for [m]."""
    steps = np.linalg.norm(np.diff(samples.points_world, axis=0), axis=-1)
    inner = np.diff(samples.marking) == 0
    spacing = np.zeros(len(samples.marking))
    spacing[:-1] += 0.5 * steps * inner
    spacing[1:] += 0.5 * steps * inner
    return spacing


def _score(paint: PaintMap, samples: LineSamples, candidates: _Candidates, spread: float) -> Floats:
    """Return log probability ratios (k,) of the paint, with each camera against without.

    Args:
        paint: of the image.
        samples: of the markings.
        candidates: (k,) cameras.
        spread: standard deviation of a marking's distance from its paint [px].
    """
    gain, loss = np.log(_FOUND / _BY_CHANCE), np.log((1.0 - _FOUND) / (1.0 - _BY_CHANCE))
    scores = np.zeros(len(candidates))
    for first in range(0, len(candidates), 1000):
        part = slice(first, first + 1000)
        seen = _look(paint, samples, candidates[part])
        found = np.exp(-0.5 * np.minimum(seen.distances / spread, 10.0) ** 2)
        worth = loss + (gain - loss) * found
        scores[part] = (seen.lengths * worth).sum(axis=1) / (_INDEPENDENT * paint.size[0])
    return scores


def _log_prior(candidates: _Candidates, prior: CameraPrior, size: tuple[int, int]) -> Floats:
    """Return log densities (k,) of heights, distances and focal lengths, up to a constant."""
    deviations = (
        np.log(candidates.centers[:, 2] / prior.height_m) / prior.log_height_std,
        np.log(np.linalg.norm(candidates.centers[:, :2], axis=1) / prior.distance_m)
        / prior.log_distance_std,
        np.log(candidates.focals / (size[0] * prior.focal)) / prior.log_focal_std,
    )
    return np.asarray(-0.5 * np.square(deviations).sum(axis=0))


def _thin_out(candidates: _Candidates) -> _Candidates:
    """Return candidates that differ from all before, at most as many as will be refined."""
    centers = candidates.centers
    near = np.maximum(5.0, 0.1 * np.linalg.norm(centers, axis=1))[:, None]
    places = np.concatenate(
        [
            centers / near,
            10.0 * candidates.rotations[:, 2],
            5.0 * np.log(candidates.focals)[:, None],
        ],
        axis=1,
    )
    kept: list[int] = []
    for index, place in enumerate(places):
        if len(kept) == _REFINED:
            break
        if not kept or (np.abs(places[kept] - place).max(axis=1) > 1.0).all():
            kept.append(index)
    return candidates[np.array(kept, dtype=np.int64)]


def _refine(
    paint: PaintMap,
    samples: LineSamples,
    candidates: _Candidates,
    radii: Sequence[float],
    free: tuple[bool, bool],
) -> _Candidates:
    """Return candidates moved so that their markings lie on the nearest paint of their direction.

    Gauss-Newton steps with Cauchy weights. The paint's distance across the marking is the residual.

    Args:
        paint: of the image.
        samples: of the markings.
        candidates: starts.
        radii: distances within which paint attracts a marking, one stage after another [px].
        free: whether focal length and k1 are solved for.
    """
    rolls = candidates.rotations[:, 0, 2]
    for radius in radii:
        for _ in range(_ITERATIONS):
            step, usable = _step(paint, samples, candidates, rolls, radius, free)
            candidates, rolls = _move(candidates, step)[usable], rolls[usable]
            if not len(candidates):
                return candidates
    return candidates


def _step(
    paint: PaintMap,
    samples: LineSamples,
    candidates: _Candidates,
    rolls: Floats,
    radius: float,
    free: tuple[bool, bool],
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return steps (k, 8): rotation, center, log focal length, k1; and whether they exist."""
    seen = _look(paint, samples, candidates)
    width, height = paint.size
    middle = 0.5 * np.array([width - 1, height - 1])
    target = paint.points[seen.nearest] - middle
    across = np.stack([np.cos(seen.normals), np.sin(seen.normals)], axis=-1)
    residual = ((target - seen.pixels) * across).sum(-1)
    used = (seen.distances < radius) & (seen.lengths > 0.0)
    weight = np.where(used, np.minimum(seen.lengths, 20.0) / 8.0, 0.0)
    weight /= 1.0 + (residual / (radius / 3.0)) ** 2
    residual = np.where(used, residual, 0.0)
    local = np.einsum(
        "kij,knj->kni", candidates.rotations, samples.points_world - candidates.centers[:, None]
    )
    depth = np.where(used, local[..., 2], 1.0)
    x, y = np.where(used, local[..., 0], 0.0) / depth, np.where(used, local[..., 1], 0.0) / depth
    square, radial = x**2 + y**2, candidates.radial[:, None]
    focal = candidates.focals[:, None]
    stretch = 1.0 + radial * square
    # Derivative of the pixel, along the normal, by the flat place (x, y).
    nx, ny = across[..., 0], across[..., 1]
    inward = 2.0 * radial * (x * nx + y * ny)
    by_x, by_y = focal * (stretch * nx + inward * x), focal * (stretch * ny + inward * y)
    by_point = np.stack([by_x, by_y, -(by_x * x + by_y * y)], axis=-1) / depth[..., None]
    point = np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None]
    radially = focal * (x * nx + y * ny)
    rows = np.concatenate(
        [
            np.cross(point, by_point),
            -np.einsum("kni,kij->knj", by_point, candidates.rotations),
            (stretch * radially)[..., None],
            (square * radially)[..., None],
        ],
        axis=-1,
    )
    weighted = rows * weight[..., None]
    system = np.einsum("kni,knj->kij", weighted, rows)
    right = np.einsum("kni,kn->ki", weighted, residual)
    corner = (0.5 * np.hypot(width, height) / candidates.focals) ** 2
    bend = _BEND_STD[int(bool(paint.lens.distortion.any()))]
    radial_info = (corner / bend) ** 2 if free[1] else np.full(len(candidates), 1e12)
    damping = np.tile([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 4.0 if free[0] else 1e12, 0.0], (len(x), 1))
    damping[:, 7] = radial_info
    system += damping[:, :, None] * np.eye(8)
    if free[1]:
        right[:, 7] -= radial_info * candidates.radial
    # The roll is the height of the camera's right axis; it turns by the rotation step.
    roll, turning = candidates.rotations[:, 0, 2] - rolls, np.zeros((len(x), 8))
    turning[:, 1], turning[:, 2] = candidates.rotations[:, 2, 2], -candidates.rotations[:, 1, 2]
    system += turning[:, :, None] * turning[:, None, :] / _ROLL_STD**2
    right -= turning * roll[:, None] / _ROLL_STD**2
    step = np.linalg.solve(system, right[..., None])[..., 0]
    usable = (np.count_nonzero(used, axis=1) >= 12) & np.isfinite(step).all(axis=1)
    usable &= candidates.centers[:, 2] + step[:, 5] > 1.0
    return np.where(usable[:, None], step, 0.0), usable


def _move(candidates: _Candidates, step: Floats) -> _Candidates:
    """Return candidates after a step (k, 8)."""
    turned = np.array([cv2.Rodrigues(turn)[0] for turn in step[:, :3]]).reshape(-1, 3, 3)
    return _Candidates(
        turned @ candidates.rotations,
        candidates.centers + step[:, 3:6],
        candidates.focals * np.exp(np.clip(step[:, 6], -0.3, 0.3)),
        candidates.radial + step[:, 7],
    )


def _different(paint: PaintMap, samples: LineSamples, candidates: _Candidates) -> NDArray[np.int64]:
    """Return indices of the candidates whose markings lie elsewhere than those of all before."""
    seen = _look(paint, samples, candidates)
    visible = seen.lengths > 0.0
    kept: list[int] = []
    for index in range(len(candidates)):
        for before in kept:
            either = visible[index] & visible[before]
            moved = np.linalg.norm(seen.pixels[index] - seen.pixels[before], axis=-1)[either]
            shared = np.count_nonzero(either) > 0.8 * np.count_nonzero(visible[before])
            if shared and len(moved) and np.median(moved) < _SAME:
                break
        else:
            kept.append(index)
    return np.array(kept, dtype=np.int64)


def _stand_on(candidates: _Candidates, side: Side) -> _Candidates:
    """Return candidates on one side of the pitch: themselves, or turned by half a turn about z."""
    axis, sign = {"near": (1, -1.0), "far": (1, 1.0), "left": (0, -1.0), "right": (0, 1.0)}[side]
    turn = np.where(candidates.centers[:, axis] * sign < 0.0, -1.0, 1.0)[:, None]
    half = np.concatenate([turn, turn, np.ones_like(turn)], axis=1)
    return replace(
        candidates,
        rotations=candidates.rotations * half[:, None, :],
        centers=candidates.centers * half,
    )


def _support(
    paint: PaintMap, samples: LineSamples, seen: _Seen
) -> tuple[tuple[MarkingSupport, ...], ClickedMarkings]:
    """Return each visible marking's support, and the pixels of those that were found."""
    support, drawn = [], []
    for index, name in enumerate(samples.names):
        mine = (samples.marking == index) & (seen.lengths[0] > 0.0)
        length = float(seen.lengths[0, mine].sum())
        if length < _ON_PAINT:
            continue
        on = mine & (seen.distances[0] < _ON_PAINT)
        found = float(seen.lengths[0, on].sum()) / length
        support.append(MarkingSupport(name, length, found))
        if found * length < _INDEPENDENT * paint.size[0] or found < 0.5:
            continue
        nearest = np.unique(seen.nearest[0, on])
        chosen = np.linspace(0, len(nearest) - 1, min(len(nearest), _DRAWN)).astype(np.int64)
        pixels = paint.origins[nearest[chosen]]
        drawn.append(DrawnMarking(name=name, xy=tuple((x, y) for x, y in pixels.tolist())))
    support.sort(key=lambda each: -each.visible_px)
    return tuple(support), ClickedMarkings(drawn=tuple(drawn))


def _explained(paint: PaintMap, seen: _Seen) -> float:
    """Return the share of the segments' length that lies on a projected marking [1]."""
    width, height = paint.size
    canvas = np.ones((height, width), np.uint8)
    image = seen.pixels[0][seen.lengths[0] > 0.0] + 0.5 * np.array([width - 1, height - 1])
    for x, y in image:
        cv2.circle(canvas, (round(x), round(y)), 1, 0, -1)
    away = cv2.distanceTransform(canvas, cv2.DIST_L2, 5)
    total = on = 0.0
    for start, end in paint.segments:
        count = max(2, int(np.linalg.norm(end - start)))
        x, y = np.linspace(start, end, count).T
        row, column = np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)
        # Samples of markings are up to tens of pixels apart.
        on += float((away[row.astype(int), column.astype(int)] < 3.0 * _ON_PAINT).sum())
        total += count
    return on / max(total, 1.0)


def _lens_camera(lens: LensCalibration, size: tuple[int, int]) -> Camera:
    return Camera(
        focal=np.array([lens.focal_px, lens.focal_px]),
        principal_point=np.array(lens.principal_point_px),
        distortion=np.array(lens.distortion),
        cam_from_world=Rigid(np.eye(3), np.zeros(3)),
        image_size=np.array(size),
    )


def _to_camera(candidates: _Candidates, paint: PaintMap) -> Camera:
    """Return the first candidate, a camera of the straight copy, as a camera of the image."""
    rotation, center = candidates.rotations[0], candidates.centers[0]
    stretch = float(candidates.focals[0]) / paint.focal
    k1, k2, p1, p2, k3 = paint.lens.distortion
    # The lens of a camera `stretch` times as long has the same curvature in pixels.
    powers = stretch ** np.array([2.0, 4.0, 1.0, 1.0, 6.0])
    distortion = np.array([k1, k2, p1, p2, k3]) * powers
    distortion[0] += candidates.radial[0]
    return replace(
        paint.lens,
        focal=paint.lens.focal * stretch,
        distortion=distortion,
        cam_from_world=Rigid(rotation, -rotation @ center),
    )
