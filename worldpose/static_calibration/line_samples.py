"""Projected samples of the template's markings: positions, normals, widths and derivatives.

Across a sample with no other white structure near it in the image there is one bar, with grass on
both sides. A crossbar, and the other side of a far circle, are close to a sample in the image only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rows import Index, take_rows
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.line_detection import CrossSections
from worldpose.static_calibration.parameters import by_step

FIRST_KNOT: Final = -1_000_000
"""Number of the first knot's unknown; others follow downwards."""


@dataclass(frozen=True)
class PaintNoise:
    """Standard deviations of the paint from the template, and of its detection.

    Paint deviates from the template by centimetres on real pitches: ground and paint are uneven
    over a few metres. On a camera 8 m up and 50 m away, 2 cm of height are a pixel. So the
    residuals of one image decide: the unevenness and the error of a reading by empirical Bayes
    (MacKay 1992, "Bayesian interpolation"), with stated minima.

    Attributes:
        points_m: standard deviation of the points that define markings, each axis [m].
        unevenness_m: standard deviation of paint and ground at knots along a marking, across it and
            in height [m].
        shift_px: standard deviation of the shift of a whole marking in the image [px].
        reading: factor on the standard deviation of a fitted bar [1].
    """

    points_m: float
    unevenness_m: float
    shift_px: float
    reading: float

    def update(self, least: PaintNoise, paint: PaintUnknowns, residuals: Floats) -> PaintNoise:
        """Return the noise after one step of the evidence maximization, at least the stated one.

        The unknowns of the paint and the residuals (n,), in standard deviations of the present
        reading, are those of a fit with this noise.
        """
        gaussian_median = 0.6745  # median absolute value of a standard Gaussian
        max_uneven = 0.1  # [m]; beyond, lines have wrong names
        weight = 4.0  # degrees of freedom of the prior
        mine = paint.numbers <= FIRST_KNOT
        # Beyond three standard deviations an unknown is an outlier for the noise.
        squares = float(np.minimum(paint.values[mine] ** 2, 3.0**2).sum())
        total = weight * least.unevenness_m**2 + squares * self.unevenness_m**2
        uneven = float(np.sqrt(total / (weight + paint.freedom[mine].sum())))
        middle = float(np.median(np.abs(residuals))) if len(residuals) else gaussian_median
        return replace(
            self,
            unevenness_m=float(np.clip(uneven, least.unevenness_m, max_uneven)),
            reading=float(np.clip(self.reading * middle / gaussian_median, 1.0, 8.0)),
        )


EXACT_PAINT: Final = PaintNoise(points_m=0.0, unevenness_m=0.0, shift_px=0.0, reading=1.0)
"""Paint where the template has it."""


@dataclass(frozen=True, eq=False)
class PaintUnknowns:
    """Unknowns of the paint after a fit.

    Attributes:
        numbers: (k,) rising, see `ProjectedLines`.
        values: (k,) values in standard deviations of their prior.
        freedom: (k,) degrees of freedom that the samples determine of each, 0 to 1.
    """

    numbers: Integers
    values: Floats
    freedom: Floats


def stated_noise(survey_error: float, shift: float) -> PaintNoise:
    """Return the minimum: the noise of a surveyed pitch without unevenness.

    Points that define markings have a survey error [m], each axis, and whole markings a shift [px].
    """
    # Below 0.2 mm, errors of readings are larger in any image.
    return PaintNoise(max(survey_error, 1e-6), 0.0002, max(shift, 1e-6), 1.0)


@dataclass(frozen=True, eq=False)
class LineSamples:
    """Points of the markings, those of one marking in order along it.

    Attributes:
        points_world: (n, 3) [m], world.
        across_world: (n, 3) unit vectors on the surface, across the marking.
        bend_world: (n, 3) second derivative of the marking along itself [1/m].
        ends: (n, 2) indices of the template's points that define a sample: the ends of its line,
            or its arc's center twice.
        shares: (n, 2) derivatives of the sample by these points [m/m].
        knots: (n, 2) numbers of the marking's knots on either side, see `_KNOT_SPACING`.
        knot_shares: (n, 2) weights of these knots in the unevenness [1].
        by_surface: (n, 2) derivatives of the height by crown and end fall [m/m].
        marking: (n,) indices into `names`, rising.
        names: the markings.
    """

    points_world: Floats
    across_world: Floats
    bend_world: Floats
    ends: Integers
    shares: Floats
    knots: Integers
    knot_shares: Floats
    by_surface: Floats
    marking: Integers
    names: tuple[str, ...]

    @property
    def along_world(self) -> Floats:
        """(n, 3) unit vectors on the surface, along the marking."""
        across = self.across_world
        return np.stack([across[:, 1], -across[:, 0], np.zeros(len(across))], axis=-1)

    def beside(self, way: float) -> Floats:
        """Return places (n, 3) [m], world, at a distance [m] along the marking from samples."""
        return self.points_world + way * self.along_world + 0.5 * way**2 * self.bend_world

    def raise_surface(self, change: Floats) -> LineSamples:
        """Return the samples at their places after a change (2,) of crown and end fall [m]."""
        places = self.points_world.copy()
        places[:, 2] += self.by_surface @ change
        return replace(self, points_world=places)

    def __getitem__(self, index: Index) -> LineSamples:
        return take_rows(self, index, "names")


@dataclass(frozen=True, eq=False)
class ProjectedLines:
    """Marking samples projected into an image.

    Attributes:
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the projected marking.
        widths: (n,) widths of the paint across it [px].
        curvatures: (n,) curvatures of the projected marking, positive where it turns to its normal
            [1/px].
        by_camera: (n, 14) derivatives of a place along its normal by a step of `PARAMETERS`, and by
            crown and end fall.
        by_paint: (n, 11) derivatives by the paint's unknowns, per standard deviation: both ends
            along x, y, z, a shift of the marking in the image, and at two knots its unevenness in
            height and across the marking.
        unknowns: (n, 11) numbers of these; markings that share a point share its error.
        visible: (n,) whether the sample is in the image and its paint wide enough.
    """

    places: Floats
    normals: Floats
    widths: Floats
    curvatures: Floats
    by_camera: Floats
    by_paint: Floats
    unknowns: Integers
    visible: Flags

    @property
    def sections(self) -> CrossSections:
        """Cross sections at the samples, to look for bars in."""
        return CrossSections(self.places, self.normals, self.widths, self.curvatures)

    def __getitem__(self, index: Index) -> ProjectedLines:
        return take_rows(self, index)


def sample_markings(pitch: PitchTemplate, spacing: float) -> LineSamples:
    """Return samples of all painted markings, with neighbours at most a spacing [m] apart."""
    samples = pitch.sample_lines(spacing)
    points, marking = samples.points_world, samples.marking
    along, share = np.empty_like(points), np.empty(len(points))
    for index in range(len(samples.names)):
        mine = np.flatnonzero(marking == index)
        along[mine] = np.gradient(points[mine], axis=0)
        share[mine] = np.linspace(0.0, 1.0, len(mine))
    bend = np.zeros_like(points)
    for name, arc in pitch.arcs.items():
        mine = np.flatnonzero(marking == samples.names.index(name))
        bend[mine, :2] = (pitch.points[arc.center] - points[mine])[:, :2] / arc.radius**2
        if np.isclose(arc.end_angle - arc.start_angle, 2.0 * np.pi):
            along[mine] = np.roll(points[mine], -1, axis=0) - np.roll(points[mine], 1, axis=0)
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    names = {name: index for index, name in enumerate(pitch.points)}
    ends = [(names[line.start], names[line.end]) for line in pitch.lines.values()]
    ends += [(names[arc.center], names[arc.center]) for arc in pitch.arcs.values()]
    curved = (marking >= len(pitch.lines))[:, None]
    return LineSamples(
        points,
        across,
        bend,
        np.array(ends)[marking],
        np.where(curved, [1.0, 0.0], np.stack([1.0 - share, share], axis=-1)),
        *_place_knots(points, marking, len(samples.names)),
        pitch.samples_by_surface(spacing),
        marking,
        samples.names,
    )


def _place_knots(points: Floats, marking: Integers, count: int) -> tuple[Integers, Floats]:
    """Return the knots (n, 2) on either side of samples, and their linear weights (n, 2)."""
    knots, weights, first = np.zeros((len(points), 2), np.int64), np.zeros((len(points), 2)), 0
    for index in range(count):
        mine = np.flatnonzero(marking == index)
        steps = np.linalg.norm(np.diff(points[mine, :2], axis=0), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        # Residuals of real markings keep their sign over 3 to 10 m.
        parts = max(1, round(way[-1] / 6.0))
        place = np.minimum(way / max(way[-1], 1e-9) * parts, parts - 1e-9)
        before = np.floor(place).astype(np.int64)
        knots[mine] = first + before[:, None] + [0, 1]
        weights[mine, 1] = place - before
        first += parts + 1
    weights[:, 0] = 1.0 - weights[:, 1]
    return knots, weights


def project_lines(
    camera: Camera, samples: LineSamples, line_width: float, noise: PaintNoise
) -> ProjectedLines:
    """Return samples projected into a single camera's image, with derivatives."""
    points = samples.points_world
    projected = camera.project_with_jacobians(points)
    image, jacobian = projected.points_image, by_step(camera, projected)
    across = samples.across_world
    along = samples.along_world
    spread = (projected.d_points * across[:, None, :]).sum(-1)
    ahead = (projected.d_points * along[:, None, :]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        normals = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        side = (spread * normals).sum(-1)
        widths = np.abs(side) * line_width
        inside = ((image > 0.0) & (image < camera.image_size - 1.0)).all(-1)
        visible = inside & (widths >= 0.5) & np.isfinite(jacobian).all((1, 2))
    curvatures = _curvatures(camera, samples, normals)
    by_place = np.einsum("nij,ni->nj", projected.d_points, normals)
    by_point = noise.points_m * by_place
    moved = (samples.shares[:, :, None] * by_point[:, None]).reshape(len(points), 6)
    axes = (3 * samples.ends[:, :, None] + np.arange(3)).reshape(len(points), 6)
    # Numbers below zero belong to markings, not to points.
    own = -1 - samples.marking[:, None]
    uneven = noise.unevenness_m * np.stack([by_place[:, 2], side], axis=-1)
    # Each knot has an unknown in height and one across the marking.
    knots = FIRST_KNOT - 2 * samples.knots[:, None, :] - np.arange(2)[:, None]
    by_step_of_camera = np.einsum("ni,nij->nj", normals, jacobian)
    return ProjectedLines(
        image,
        normals,
        widths,
        curvatures,
        np.concatenate([by_step_of_camera, by_place[:, 2:] * samples.by_surface], axis=1),
        np.concatenate(
            [
                moved,
                np.full((len(points), 1), noise.shift_px),
                (uneven[:, :, None] * samples.knot_shares[:, None]).reshape(len(points), 4),
            ],
            axis=1,
        ),
        np.concatenate([axes, own, knots.reshape(len(points), 4)], axis=1),
        visible,
    )


def _curvatures(camera: Camera, samples: LineSamples, normals: Floats) -> Floats:
    """Return curvatures (n,) of projected markings towards their normals (n, 2) [1/px]."""
    stride = 0.1  # [m], for finite differences
    curvatures = np.zeros(len(normals))
    arcs = np.flatnonzero(samples.bend_world.any(axis=1))
    before, middle, after = (
        camera.project(samples[arcs].beside(s)) for s in (-stride, 0.0, stride)
    )
    turned = ((before + after - 2.0 * middle) * normals[arcs]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        curvatures[arcs] = 4.0 * turned / ((after - before) ** 2).sum(-1)
    return curvatures


def thin_samples(seen: ProjectedLines, samples: LineSamples, spacing: float, most: int) -> Integers:
    """Return indices of about `most` visible samples at most, at about even spacing [px]."""
    index = np.flatnonzero(seen.visible)
    if not len(index):
        return index
    step = np.linalg.norm(np.diff(seen.places[index], axis=0), axis=-1)
    # The distance restarts between two markings, or two parts of one that leaves the image.
    step[np.diff(index) > 1] = 0.0
    way = np.concatenate([[0.0], np.cumsum(step)])
    bins = np.floor(way / max(spacing, way[-1] / most)).astype(np.int64)
    fresh = np.diff(bins, prepend=-1) > 0
    fresh |= np.diff(samples.marking[index], prepend=-1) != 0
    return np.asarray(index[fresh])


@dataclass(frozen=True, eq=False)
class WhiteStructures:
    """White structures of a pitch: concatenated polylines of markings and goals.

    Attributes:
        points_world: (n, 3) corners [m], world.
        label: (n,) structure; markings have the indices of `PitchTemplate.sample_lines`, posts and
            crossbars higher ones.
    """

    points_world: Floats
    label: Integers


def white_structures(pitch: PitchTemplate) -> WhiteStructures:
    """Return the polylines of a template's markings and goals."""
    # The error of a corner arc is then 3 cm, a quarter of its width.
    parts = [pitch.marking_points(name, 0.5) for name in pitch.white_names]
    return WhiteStructures(
        np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    )


def clear(
    camera: Camera,
    whites: WhiteStructures,
    half_width: float,
    places: Floats,
    room: Floats,
    marking: Integers,
) -> Flags:
    """Return a mask of places (n,) with no structure but their own marking within a distance.

    `whites` are white structures of the template, `half_width` [m] is that of paint and posts.
    `places` (n, 2) [px] of samples need `room` (n,) [px] to other structures than their own
    `marking` (n,).
    """
    depth = camera.cam_from_world.apply(whites.points_world)[:, 2]
    corners = camera.project(whites.points_world)
    with np.errstate(divide="ignore"):
        radius = np.where(depth > 0.0, half_width * camera.focal[0] / depth, 0.0)
    result = np.empty(len(places), dtype=np.bool_)
    _clear(corners, radius, whites.label, places, room, marking, result)
    return result


@compile_kernel
def _clear(
    corners: Floats,
    radius: Floats,
    label: Integers,
    places: Floats,
    room: Floats,
    marking: Integers,
    result: Flags,
) -> None:
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        result[i] = True
        for j in range(len(corners) - 1):
            if label[j] == marking[i] or label[j] != label[j + 1]:
                continue
            ax, ay = corners[j, 0] - x, corners[j, 1] - y
            dx, dy = corners[j + 1, 0] - corners[j, 0], corners[j + 1, 1] - corners[j, 1]
            share = -(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-18)
            share = min(max(share, 0.0), 1.0)
            ax, ay = ax + share * dx, ay + share * dy
            limit = room[i] + max(radius[j], radius[j + 1])
            # Points behind the camera are NaN, which compares false.
            if ax * ax + ay * ay < limit * limit:
                result[i] = False
                break
