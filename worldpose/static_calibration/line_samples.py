"""Samples of the template's markings as a camera has them: where, across what, how well known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worldpose.cameras import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.parameters import by_step

Floats = NDArray[np.float64]

OFFSETS: Final = 5
"""Unknowns of one marking: how far the paint lies from the template sideways and upwards, at both
ends of a line or along x and y for an arc, and a constant shift in the picture."""
_CLEARANCE: Final = 0.4
"""Between a sample and other markings [m]: three widths of paint."""
_NEIGHBOURS: Final = 10
"""More samples than a marking has within `_CLEARANCE` at 0.2 m, and one of another [1]."""
_NARROWEST: Final = 0.5
"""Paint that is narrower in the picture is not looked for [px]."""


@dataclass(frozen=True, eq=False)
class LineSamples:
    """Points of the markings, those of one marking in order along it.

    Attributes:
        points_world: (n, 3) [m], world.
        across_world: (n, 3) unit vectors on the surface, across the marking.
        sideways: (n, 2) how far a sample moves across, when either end of its line does, or the
            arc's center along x or y [m/m].
        upwards: (n, 2) how far it moves up, when either end does, or the arc [m/m].
        marking: (n,) indices into `names`, rising.
        names: the markings.
    """

    points_world: Floats
    across_world: Floats
    sideways: Floats
    upwards: Floats
    marking: NDArray[np.int64]
    names: tuple[str, ...]

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> LineSamples:
        return LineSamples(
            self.points_world[index],
            self.across_world[index],
            self.sideways[index],
            self.upwards[index],
            self.marking[index],
            self.names,
        )


@dataclass(frozen=True, eq=False)
class SeenLines:
    """Samples in a picture.

    Attributes:
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the projected marking.
        widths: (n,) of the paint across it [px].
        by_camera: (n, 12) how a place moves along its normal with a step of `PARAMETERS`.
        by_paint: (n, OFFSETS) how it moves with the marking's unknowns, these being one standard
            deviation large.
        visible: (n,) whether it is in the picture and wide enough.
    """

    places: Floats
    normals: Floats
    widths: Floats
    by_camera: Floats
    by_paint: Floats
    visible: NDArray[np.bool_]


def sample_markings(pitch: PitchTemplate, spacing: float) -> LineSamples:
    """Return samples of all painted markings.

    Args:
        pitch: the template, with its crown.
        spacing: largest distance between neighbours [m].
    """
    samples = pitch.sample_lines(spacing)
    points, marking = samples.points_world, samples.marking
    along, share = np.empty_like(points), np.empty(len(points))
    for index in range(len(samples.names)):
        mine = np.flatnonzero(marking == index)
        along[mine] = np.gradient(points[mine], axis=0)
        share[mine] = np.linspace(0.0, 1.0, len(mine))
    for name, arc in pitch.arcs.items():
        if np.isclose(arc.end_angle - arc.start_angle, 2.0 * np.pi):
            mine = np.flatnonzero(marking == samples.names.index(name))
            along[mine] = np.roll(points[mine], -1, axis=0) - np.roll(points[mine], 1, axis=0)
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    ends = np.stack([1.0 - share, share], axis=-1)
    curved = (marking >= len(pitch.lines))[:, None]
    return LineSamples(
        points,
        across,
        np.where(curved, across[:, :2], ends),
        np.where(curved, [1.0, 0.0], ends),
        marking,
        samples.names,
    )


def apart(samples: LineSamples, index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return those of some samples that no other marking comes near: bars cross there.

    Args:
        samples: all of them.
        index: which to look at.
    """
    tree = cKDTree(samples.points_world)
    points = samples.points_world[index]
    _, near = tree.query(points, k=_NEIGHBOURS, distance_upper_bound=_CLEARANCE)
    # Beyond the last sample stand neighbours that are not there.
    neighbour = np.append(samples.marking, -1)[near]
    own = (neighbour == samples.marking[index][:, None]) | (neighbour == -1)
    return np.asarray(index[own.all(axis=1)])


def see_lines(
    camera: Camera, samples: LineSamples, line_width: float, survey_error: float, shift: float
) -> SeenLines:
    """Return samples as a camera has them.

    Args:
        camera: a single camera.
        samples: of `sample_markings`.
        line_width: of the paint [m].
        survey_error: of the ends of a marking, each axis, standard deviation [m].
        shift: of a whole marking in the picture, standard deviation [px].
    """
    points = samples.points_world
    projected = camera.project_with_jacobians(points)
    image, jacobian = projected.points_image, by_step(camera, projected)
    across = samples.across_world
    along = np.stack([across[:, 1], -across[:, 0], np.zeros(len(across))], axis=-1)
    spread = (projected.d_points * across[:, None, :]).sum(-1)
    ahead = (projected.d_points * along[:, None, :]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        normals = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        side = (spread * normals).sum(-1)
        widths = np.abs(side) * line_width
        inside = ((image > 0.0) & (image < camera.image_size - 1.0)).all(-1)
        visible = inside & (widths >= _NARROWEST) & np.isfinite(jacobian).all((1, 2))
    rise = (projected.d_points[..., 2] * normals).sum(-1)
    by_paint = np.concatenate(
        [
            survey_error * side[:, None] * samples.sideways,
            survey_error * rise[:, None] * samples.upwards,
            np.full((len(points), 1), shift),
        ],
        axis=1,
    )
    return SeenLines(
        image, normals, widths, np.einsum("ni,nij->nj", normals, jacobian), by_paint, visible
    )


def thinned(seen: SeenLines, samples: LineSamples, spacing: float, most: int) -> NDArray[np.int64]:
    """Return indices of visible samples that are about evenly spaced in the picture.

    Args:
        seen: the samples in the picture.
        samples: the same in the world.
        spacing: between neighbours [px], more where there would be too many.
        most: how many at most, about.
    """
    index = np.flatnonzero(seen.visible)
    if not len(index):
        return index
    step = np.linalg.norm(np.diff(seen.places[index], axis=0), axis=-1)
    # Between two markings, or the two parts of one that leaves the picture, a new count begins.
    step[np.diff(index) > 1] = 0.0
    way = np.concatenate([[0.0], np.cumsum(step)])
    bins = np.floor(way / max(spacing, way[-1] / most)).astype(np.int64)
    fresh = np.diff(bins, prepend=-1) > 0
    fresh |= np.diff(samples.marking[index], prepend=-1) != 0
    return np.asarray(index[fresh])
