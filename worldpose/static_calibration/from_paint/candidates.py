"""Candidate cameras from segments of paint, and their fit to the paint.

A triple of segments, two along one axis of the pitch and one along the other, with names from the
template and a camera without roll, determines a camera. The search over names is exhaustive. A
score compares the markings that a camera predicts with the paint; refinement moves them onto it.

All cameras are those of the straight copy of `PaintMap`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.match import Side
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import cauchy_weight
from worldpose.geometry.rigid import Rigid
from worldpose.geometry.rows import Index, take_rows
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.paint import ORIENTATIONS, PaintMap
from worldpose.static_calibration.line_samples import LineSamples
from worldpose.static_calibration.settings import CameraPrior
from worldpose.static_calibration.sides import place_at

TILTS: Final = np.radians(np.geomspace(3.0, 45.0, 16))
"""Tilts below the horizon to try [rad]."""
SEGMENTS: Final = 12
"""Maximum segments to name, those with the most paint [1]."""
_HEIGHTS: Final = (1.8, 80.0)
"""Heights of cameras above the pitch [m]."""
INDEPENDENT: Final = 1.0 / 32.0
"""Length of a marking that counts as one observation, in image widths [1]: what hides paint has
this size."""


@dataclass(frozen=True, eq=False)
class Candidates:
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

    @property
    def cameras(self) -> Camera:
        """Batch (k,) of cameras whose pixels count from the middle of the image."""
        shift = -np.einsum("kij,kj->ki", self.rotations, self.centers)
        return Camera(
            focal=np.repeat(self.focals[:, None], 2, axis=1),
            principal_point=np.zeros(2),
            distortion=self.radial[:, None] * np.eye(5)[0],
            cam_from_world=Rigid(self.rotations, shift),
            image_size=np.ones(2, dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.focals)

    def __getitem__(self, index: Index) -> Candidates:
        return take_rows(self, index)


class SeenMarkings(NamedTuple):
    """Samples of markings in the images of candidates."""

    pixels: Floats
    """(k, n, 2) [px] from the middle of the image."""
    normals: Floats
    """(k, n) angles across the projected markings [rad]."""
    lengths: Floats
    """(k, n) length of marking per sample [px]; 0 outside of the image."""
    distances: Floats
    """(k, n) to paint of this direction [px]; infinite outside of the pitch's area."""
    nearest: NDArray[np.int32]
    """(k, n) this paint's index in `PaintMap.points`."""


def thin_out(candidates: Candidates, most: int) -> Candidates:
    """Return candidates that differ from all before, at most this many."""
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
        if len(kept) == most:
            break
        if not kept or (np.abs(places[kept] - place).max(axis=1) > 1.0).all():
            kept.append(index)
    return candidates[np.array(kept, dtype=np.int64)]


def stand_on(candidates: Candidates, side: Side) -> Candidates:
    """Return candidates on one side of the pitch: themselves, or turned by half a turn about z."""
    turn = np.where(candidates.centers @ place_at(side) < 0.0, -1.0, 1.0)[:, None]
    half = np.concatenate([turn, turn, np.ones_like(turn)], axis=1)
    return replace(
        candidates,
        rotations=candidates.rotations * half[:, None, :],
        centers=candidates.centers * half,
    )


def straight_lines(pitch: PitchTemplate) -> tuple[Floats, Floats]:
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


def name_triples(paint: PaintMap, pitch: PitchTemplate, focals: Floats, roll: float) -> Candidates:
    """Return the cameras with a roll of all triples of segments under all names that fit them."""
    x_lines, y_lines = straight_lines(pitch)
    rows = [np.empty((0, 9))]
    for triples in _ground_triples(paint, focals, roll):
        for axis, (lines, crossing) in enumerate(((x_lines, y_lines), (y_lines, x_lines))):
            for pair in permutations(lines, 2):
                rows.extend(_locate_cameras(pitch, triples, axis, pair, crossing))
    level = level_cameras(np.concatenate(rows))
    return replace(level, rotations=turn_about_axis(roll) @ level.rotations)


def _locate_cameras(
    pitch: PitchTemplate, triples: _Triples, axis: int, pair: Sequence[Floats], crossing: Floats
) -> Iterator[Floats]:
    """Yield rows of `level_cameras` for triples with a and b on two lines, c on one line each time.

    The two lines run along `axis`, 0 = x, 1 = y, and the others (n, 3) across it.
    """
    # The normal of a line along x points to y; that of a line along y, to -x.
    sign = 1.0 if axis == 0 else -1.0
    gap = triples.offsets[:, 0] - triples.offsets[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = sign * (pair[0][0] - pair[1][0]) / gap
    tall = np.flatnonzero((heights > _HEIGHTS[0]) & (heights < _HEIGHTS[1]))
    height = heights[tall]
    across = sign * pair[0][0] - height * triples.offsets[tall, 0]
    for line in crossing:
        ahead = line[0] - height * triples.offset[tall]
        x, y = (ahead, across) if axis == 0 else (-across, ahead)
        fits = are_plausible(pitch, height, x, y)
        for index in (0, 1):
            ends = triples.reach[tall, index] * height[:, None] + ahead[:, None]
            fits &= _lies_on_line(ends, pair[index][1:])
        ends = triples.across[tall] * height[:, None] + across[:, None]
        fits &= _lies_on_line(ends, line[1:] if axis == 0 else -line[:0:-1])
        kept = tall[fits]
        along = triples.along[kept]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        axes = (along, normal) if axis == 0 else (-normal, along)
        yield np.column_stack(
            [triples.focals[kept], triples.tilts[kept], height[fits], *axes, x[fits], y[fits]]
        )


def are_plausible(pitch: PitchTemplate, height: Floats, x: Floats, y: Floats) -> Flags:
    """Return whether cameras (k,) at these heights and places [m] are outside of the pitch."""
    half = 0.5 * np.array([pitch.length, pitch.width]) - 1.0
    fits = (height > _HEIGHTS[0]) & (height < _HEIGHTS[1]) & (np.hypot(x, y) < 200.0)
    return np.asarray(fits & ((np.abs(x) > half[0]) | (np.abs(y) > half[1])))


def turn_about_axis(roll: float) -> Floats:
    """Return the turn (3, 3) of a camera about its axis."""
    cosine, sine = np.cos(roll), np.sin(roll)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _lies_on_line(ends: Floats, line: Floats) -> Flags:
    """Return whether segments with ends (k, 2) lie on a marking from line[0] to line[1]."""
    overshoot = (0.15, 1.5)  # reach beyond the marking: share of the length, and [m]
    beyond = overshoot[0] * (ends[:, 1] - ends[:, 0]) + overshoot[1]
    return np.asarray((ends[:, 0] > line[0] - beyond) & (ends[:, 1] < line[1] + beyond))


def level_cameras(rows: Floats) -> Candidates:
    """Return cameras on the near side of rows (k, 9).

    A row is the focal length, tilt, height, right and forward component of the pitch's x and y
    axis, x, y.
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
    return Candidates(rotations, centers, focals, zero)


def _ground_triples(paint: PaintMap, focals: Floats, roll: float) -> Iterator[_Triples]:
    """Yield triples at all focal lengths and tilts, one segment's direction after another's."""
    max_angle = np.radians(5.0)  # from a right angle, or from parallels, on the pitch
    width, height = paint.size
    middle = 0.5 * np.array([width - 1, height - 1])
    ends = (paint.segments[:SEGMENTS] - middle) @ turn_about_axis(roll)[:2, :2]
    if len(ends) < 3:
        return
    focal, tilt = (part.ravel() for part in np.meshgrid(focals * width, TILTS, indexing="ij"))
    cosine, sine = np.cos(tilt)[:, None, None], np.sin(tilt)[:, None, None]
    away = focal[:, None, None]
    depth = ends[None, ..., 1] * cosine + away * sine
    with np.errstate(divide="ignore", invalid="ignore"):
        right = ends[None, ..., 0] / depth
        forward = (away * cosine - ends[None, ..., 1] * sine) / depth
    below: Flags = np.asarray((depth > 1e-3 * away).all(axis=-1))
    ground = np.stack([right, forward], axis=-1)  # (g, n, 2 ends, 2)
    step = ground[:, :, 1] - ground[:, :, 0]
    angle = np.arctan2(step[..., 1], step[..., 0])
    count = len(ends)
    for reference in range(count):
        turned = angle - angle[:, reference : reference + 1]
        usable = below & below[:, reference : reference + 1]
        parallel = usable & (np.abs((turned + 0.5 * np.pi) % np.pi - 0.5 * np.pi) < max_angle)
        square = usable & (np.abs(turned % np.pi - 0.5 * np.pi) < max_angle)
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


def project_markings(paint: PaintMap, samples: LineSamples, candidates: Candidates) -> SeenMarkings:
    """Return the samples in the images of candidates, with the paint nearest to them."""
    width, height = paint.size
    places = samples.points_world
    step = 0.25
    cameras = candidates.cameras
    pixels, ahead = cameras.project(places), cameras.project(places + step * samples.along_world)
    seen = np.asarray(np.isfinite(pixels).all(-1) & np.isfinite(ahead).all(-1))
    pixels, ahead = np.where(seen[..., None], pixels, 0.0), np.where(seen[..., None], ahead, 0.0)
    way = ahead - pixels
    normals = np.arctan2(way[..., 1], way[..., 0]) + 0.5 * np.pi
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    inner = np.diff(samples.marking) == 0
    spacing = np.zeros(len(samples.marking))  # the length of marking that a sample stands for [m]
    spacing[:-1] += 0.5 * steps * inner
    spacing[1:] += 0.5 * steps * inner
    image = pixels + 0.5 * np.array([width - 1, height - 1])
    inside = seen & (image > 1.0).all(-1) & (image < [width - 2, height - 2]).all(-1)
    lengths = np.where(inside, np.hypot(way[..., 0], way[..., 1]) / step * spacing, 0.0)
    # A marking that runs towards the camera does not count for more than its image.
    lengths = np.minimum(lengths, 60.0)
    at = np.where(inside[..., None], image, 0.0).astype(np.int64)
    orientation = np.round(normals / np.pi * ORIENTATIONS).astype(np.int64) % ORIENTATIONS
    index = (orientation, at[..., 1], at[..., 0])
    on_pitch = paint.area[at[..., 1], at[..., 0]]
    distances = np.where(on_pitch, paint.distances[index], np.inf)
    return SeenMarkings(pixels, normals, lengths, distances, paint.nearest[index])


def score_candidates(
    paint: PaintMap, samples: LineSamples, candidates: Candidates, spread: float
) -> Floats:
    """Return log probability ratios (k,) of the paint, with each camera against without.

    The spread is the standard deviation of a marking's distance from its paint [px].
    """
    chance_rate = 0.05  # of paint near a place without a marking
    hit_rate = 0.7  # players, shadows and wear hide the rest
    gain, loss = (np.log(hit_rate / chance_rate), np.log((1.0 - hit_rate) / (1.0 - chance_rate)))
    scores = np.zeros(len(candidates))
    for first in range(0, len(candidates), 1000):
        part = slice(first, first + 1000)
        seen = project_markings(paint, samples, candidates[part])
        found = np.exp(-0.5 * np.minimum(seen.distances / spread, 10.0) ** 2)
        worth = loss + (gain - loss) * found
        scores[part] = (seen.lengths * worth).sum(axis=1) / (INDEPENDENT * paint.size[0])
    return scores


def score_with_prior(
    paint: PaintMap, samples: LineSamples, found: Candidates, prior: CameraPrior, spread: float
) -> Floats:
    """Return `score_candidates` with the densities of heights, distances and focal lengths."""
    deviations = (
        np.log(found.centers[:, 2] / prior.height_m) / prior.log_height_std,
        np.log(np.linalg.norm(found.centers[:, :2], axis=1) / prior.distance_m)
        / prior.log_distance_std,
        np.log(found.focals / (paint.size[0] * prior.focal)) / prior.log_focal_std,
    )
    scores = score_candidates(paint, samples, found, spread)
    return np.asarray(scores - 0.5 * np.square(deviations).sum(axis=0))


def refine_candidates(
    paint: PaintMap,
    samples: LineSamples,
    candidates: Candidates,
    radii: Sequence[float],
    free: tuple[bool, bool],
) -> Candidates:
    """Return candidates moved so that their markings lie on the nearest paint of their direction.

    Gauss-Newton steps with Cauchy weights. The paint's distance across the marking is the residual;
    paint attracts within radii [px], one stage after another. Focal length and k1 may be free.
    """
    rolls = candidates.rotations[:, 0, 2]
    for radius in radii:
        for _ in range(4):
            step, usable = _step(paint, samples, candidates, rolls, radius, free)
            candidates, rolls = _move(candidates, step)[usable], rolls[usable]
            if not len(candidates):
                return candidates
    return candidates


def _step(
    paint: PaintMap,
    samples: LineSamples,
    candidates: Candidates,
    rolls: Floats,
    radius: float,
    free: tuple[bool, bool],
) -> tuple[Floats, Flags]:
    """Return steps (k, 8): rotation, center, log focal length, k1; and whether they exist."""
    roll_std = 0.015
    seen = project_markings(paint, samples, candidates)
    width, height = paint.size
    middle = 0.5 * np.array([width - 1, height - 1])
    target = paint.points[seen.nearest] - middle
    across = np.stack([np.cos(seen.normals), np.sin(seen.normals)], axis=-1)
    residual = ((target - seen.pixels) * across).sum(-1)
    used = (seen.distances < radius) & (seen.lengths > 0.0)
    weight = np.where(used, np.minimum(seen.lengths, 20.0) / 8.0, 0.0)
    weight *= cauchy_weight(residual**2, radius / 3.0)
    residual = np.where(used, residual, 0.0)
    projected = candidates.cameras.project_with_jacobians(samples.points_world)
    by_step = np.concatenate(
        [
            projected.d_pose[..., :3],
            -projected.d_points,
            seen.pixels[..., None],
            projected.d_distortion[..., :1],
        ],
        axis=-1,
    )
    rows = np.einsum("knd,kndj->knj", across, np.where(used[..., None, None], by_step, 0.0))
    weighted = rows * weight[..., None]
    system = np.einsum("kni,knj->kij", weighted, rows)
    right = np.einsum("kni,kn->ki", weighted, residual)
    corner = (0.5 * np.hypot(width, height) / candidates.focals) ** 2
    # Displacement of the image corner by k1, in images that look straight and in others: less than
    # of an unknown lens, so that a wrong name does not bend the image.
    corner_std = (0.005, 0.02)[int(bool(paint.lens.distortion.any()))]
    radial_info = (corner / corner_std) ** 2 if free[1] else np.full(len(candidates), 1e12)
    trust = np.tile(
        [1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 4.0 if free[0] else 1e12, 0.0], (len(candidates), 1)
    )
    trust[:, 7] = radial_info
    system += trust[:, :, None] * np.eye(8)
    if free[1]:
        right[:, 7] -= radial_info * candidates.radial
    # The roll is the height of the camera's right axis; it turns by the rotation step.
    roll, by_roll = candidates.rotations[:, 0, 2] - rolls, np.zeros((len(candidates), 8))
    by_roll[:, 1], by_roll[:, 2] = candidates.rotations[:, 2, 2], -candidates.rotations[:, 1, 2]
    system += by_roll[:, :, None] * by_roll[:, None, :] / roll_std**2
    right -= by_roll * roll[:, None] / roll_std**2
    step = np.linalg.solve(system, right[..., None])[..., 0]
    usable = (np.count_nonzero(used, axis=1) >= 12) & np.isfinite(step).all(axis=1)
    usable &= candidates.centers[:, 2] + step[:, 5] > 1.0
    return np.where(usable[:, None], step, 0.0), usable


def _move(candidates: Candidates, step: Floats) -> Candidates:
    """Return candidates after a step (k, 8)."""
    turned = np.array([cv2.Rodrigues(turn)[0] for turn in step[:, :3]]).reshape(-1, 3, 3)
    return Candidates(
        turned @ candidates.rotations,
        candidates.centers + step[:, 3:6],
        candidates.focals * np.exp(np.clip(step[:, 6], -0.3, 0.3)),
        candidates.radial + step[:, 7],
    )


def explained_share(paint: PaintMap, seen: SeenMarkings) -> float:
    """Return the share of the segments' length on a marking of the first candidate [1]."""
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
        # Samples are up to tens of pixels apart.
        on += float((away[row.astype(int), column.astype(int)] < 12.0).sum())
        total += count
    return on / max(total, 1.0)
