"""Initial cameras from homographies, and from a grid of plausible places in the stands.

Homographies between pitch plane and image come from the normalized DLT.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from itertools import pairwise, product
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import WIDTH
from worldpose.geometry.rigid import Rigid
from worldpose.static_calibration.evidence import ClickEvidence
from worldpose.static_calibration.fit import CameraProblem, fit_cameras
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings

_PLANE_SCALE = 50.0
"""Half a pitch [m]: coordinates of order one keep the DLT well conditioned."""


def plane_from_image(
    points_image: Floats,
    points_plane: Floats,
    line_pixels: Floats,
    lines: Floats,
    scale: float,
    middle: Floats,
) -> Floats | None:
    """Return the (3, 3) homography H from pixels x to the plane [m], x' = H x, by the DLT, or None.

    A point gives two equations; a pixel drawn anywhere on a straight line gives one, which is
    linear as well in this direction: line . (H pixel) = 0. None if they do not determine one
    homography.

    Args:
        points_image: (n, 2) [px].
        points_plane: (n, 2) [m].
        line_pixels: (d, 2) [px].
        lines: (d, 3) line per pixel, a x + b y + c = 0 with a^2 + b^2 = 1 [m].
        scale: half the image diagonal [px].
        middle: (2,) image center [px].
    """
    pixel = _homogeneous((points_image - middle) / scale)
    x, y = (points_plane / _PLANE_SCALE).T
    zero = np.zeros_like(pixel)
    rows = [
        np.concatenate([pixel, zero, -x[:, None] * pixel], axis=1),
        np.concatenate([zero, pixel, -y[:, None] * pixel], axis=1),
    ]
    drawn = _homogeneous((line_pixels - middle) / scale)
    line = lines * np.array([1.0, 1.0, 1.0 / _PLANE_SCALE])
    rows.append((line[:, :, None] * drawn[:, None, :]).reshape(-1, 9))
    system = np.concatenate(rows)
    if len(system) < 8:
        return None
    _, values, basis = np.linalg.svd(system)
    if values[7] < 1e-3 * values[0] / np.sqrt(len(system)):
        return None
    homography: Floats = (
        np.diag([_PLANE_SCALE, _PLANE_SCALE, 1.0])
        @ basis[8].reshape(3, 3)
        @ np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, scale]])
    )
    return homography


def camera_from_homography(
    image_from_plane: Floats,
    image_size: tuple[int, int],
    seen: Floats,
    focal_range: tuple[float, float],
) -> Camera | None:
    """Return the camera of a homography (3, 3) from the plane z = 0, or None.

    Decomposes H ~ K [r1 r2 t], the inverse of the paper's H, with r1, r2 the columns of R.

    Pixels are square and the principal point is the image center: a plane gives two equations for
    the internal parameters, here both for the focal length. Where they contradict each other or are
    degenerate (a view straight down), the focal length is clipped to its range [px]. The pitch is
    in front of the camera at the pixel `seen` (2,) [px].
    """
    width, height = image_size
    middle = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    centred = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, 1.0]])
    h = centred @ image_from_plane
    if not np.isfinite(h).all() or abs(np.linalg.det(h)) < 1e-12 * np.abs(h).max() ** 3:
        return None
    # With w = 1 / f^2: the columns are orthogonal, and of one length.
    factors = np.array(
        [h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1], (h[:2, 0] ** 2 - h[:2, 1] ** 2).sum()]
    )
    constants = np.array([h[2, 0] * h[2, 1], h[2, 0] ** 2 - h[2, 1] ** 2])
    squared = float(factors @ factors)
    inverse = -float(factors @ constants) / squared if squared > 0.0 else 0.0
    low, high = focal_range
    focal = 1.0 / np.sqrt(np.clip(inverse, high**-2.0, low**-2.0))
    columns = np.diag([1.0 / focal, 1.0 / focal, 1.0]) @ h
    columns = columns / np.sqrt(np.linalg.norm(columns[:, 0]) * np.linalg.norm(columns[:, 1]))
    # The plane point behind `seen` has positive depth.
    place = np.linalg.solve(h, np.append(seen - middle, 1.0))
    depth = columns[2] @ (place / place[2])
    columns = columns * (1.0 if depth > 0.0 else -1.0)
    across = np.cross(columns[:, 0], columns[:, 1])
    u, _, v = np.linalg.svd(np.stack([columns[:, 0], columns[:, 1], across], axis=1))
    rotation = u @ v
    if np.linalg.det(rotation) < 0.0:
        return None
    return Camera(
        focal=np.array([focal, focal]),
        principal_point=middle,
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, columns[:, 2]),
        image_size=np.array(image_size),
    )


def homographies(
    evidence: ClickEvidence, image_size: tuple[int, int], tolerance: float, *, leave_out: bool
) -> list[Floats]:
    """Return candidate homographies (3, 3) from the plane to pixels, the best one first.

    Candidates are: the DLT over straight markings and the inliers of RANSAC (four clicks at a time,
    from five clicks on), the DLT over straight markings and all clicks, and the DLT over straight
    markings alone; also without each straight marking in turn, if asked for. The tolerance of
    inliers [px] covers distortion and the crown.
    """
    middle = np.array([0.5 * (image_size[0] - 1), 0.5 * (image_size[1] - 1)])
    scale = 0.5 * float(np.hypot(image_size[0], image_size[1]))
    # Includes the crown, excludes the goals' upper ends.
    low = np.abs(evidence.points_world[:, 2]) < 0.5
    plane, pixels = evidence.points_world[low, :2], evidence.points_image[low]
    line_pixels, lines, marking = _surface_lines(evidence)
    consensus = _consensus(pixels, plane, middle, scale, tolerance)
    everything, nothing = np.ones(len(plane), dtype=np.bool_), np.zeros(len(plane), dtype=np.bool_)
    every_line = np.ones(len(lines), dtype=np.bool_)
    choices = [(kept, every_line) for kept in (consensus, everything, nothing)]
    if leave_out:
        choices += [(consensus, marking != index) for index in np.unique(marking)]
    candidates: list[Floats] = []
    for kept, on in choices:
        found = plane_from_image(
            pixels[kept], plane[kept], line_pixels[on], lines[on], scale, middle
        )
        if found is not None and np.linalg.cond(found) < 1e12:
            candidates.append(np.asarray(np.linalg.inv(found), dtype=np.float64))
    return candidates


def _consensus(
    pixels: Floats, plane: Floats, middle: Floats, scale: float, tolerance: float
) -> Flags:
    """Return the inlier mask (n,) of the best homography from four clicks."""
    max_subsets = 300  # with two outliers of twelve clicks, 40 % of them are clean
    best = np.ones(len(plane), dtype=np.bool_)
    if len(plane) < 5:
        return best
    subsets = np.array(list(itertools.combinations(range(len(plane)), 4)))
    if len(subsets) > max_subsets:
        chosen = np.random.default_rng(0).choice(len(subsets), max_subsets, replace=False)
        subsets = subsets[chosen]
    source = plane / _PLANE_SCALE
    target = (pixels - middle) / scale
    ones = np.ones(len(source))
    rows = np.zeros((len(source), 2, 8))
    rows[:, 0, :3] = rows[:, 1, 3:6] = np.stack([*source.T, ones], axis=1)
    rows[:, :, 6:] = -target[:, :, None] * source[:, None, :]
    systems = rows[subsets].reshape(-1, 8, 8)
    usable = np.abs(np.linalg.det(systems)) > 1e-9
    if not usable.any():
        return best
    answers = target[subsets[usable]].reshape(-1, 8, 1)
    solved = np.linalg.solve(systems[usable], answers)[..., 0]
    homography = np.concatenate([solved, np.ones((len(solved), 1))], axis=1).reshape(-1, 3, 3)
    mapped = np.einsum("hij,nj->hni", homography, _homogeneous(source))
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.linalg.norm(mapped[..., :2] / mapped[..., 2:] - target, axis=-1) * scale
    errors = np.where(np.isfinite(errors), errors, np.inf)
    # Clipped squared errors rank consensus sets of equal size by their residuals.
    costs = np.minimum(errors, tolerance) ** 2
    winner = int(np.argmin(costs.sum(axis=1)))
    return np.asarray(errors[winner] < tolerance)


def _surface_lines(evidence: ClickEvidence) -> tuple[Floats, Floats, Integers]:
    """Return pixels (d, 2) on straight surface markings, their lines (d, 3) and markings (d,)."""
    straight = evidence.straight[evidence.drawn_marking]
    lines = np.zeros((len(evidence.markings), 3))
    for index, (first, stop) in enumerate(itertools.pairwise(evidence.bounds)):
        start, end = evidence.samples_world[first, :2], evidence.samples_world[stop - 1, :2]
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        normal = np.array([-along[1], along[0]])
        lines[index] = [*normal, -normal @ start]
    marking = evidence.drawn_marking[straight]
    return evidence.drawn_image[straight], lines[marking], marking


def _homogeneous(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


_COMPARISON_LOSS: Final = 60.0
"""Cauchy scale of all residuals while starts compete [standard deviations]: it bounds the influence
of residuals of hundreds of pixels, but not of tens."""


def cameras_from_homographies(
    problem: CameraProblem, prior: CameraPrior, *, leave_out: bool
) -> Floats:
    """Return cameras (b, WIDTH) of the homographies from points and straight markings.

    Each straight marking may be left out in turn: one name may be wrong.
    """
    evidence, width = problem.evidence, problem.image_size[0]
    spread = np.exp(2.5 * prior.log_focal_std)
    focal_range = (prior.focal * width / spread, prior.focal * width * spread)
    pixels = np.concatenate([evidence.points_image, evidence.drawn_image])
    seen = np.median(pixels, axis=0)
    rows = []
    # The tolerance covers distortion of a few percent at the border, and the crown's height.
    for homography in homographies(
        evidence, problem.image_size, 0.012 * width, leave_out=leave_out
    ):
        found = camera_from_homography(homography, problem.image_size, seen, focal_range)
        several = [found]
        if found is not None and not focal_range[0] < found.focal[0] < focal_range[1]:
            # The fit hardly moves along an open focal length, which other terms decide.
            several = [
                camera_from_homography(homography, problem.image_size, seen, (focal, focal))
                for focal in np.geomspace(*focal_range, 9)
            ]
        rows += [camera.numbers for camera in several if camera is not None]
    return np.array(rows).reshape(-1, WIDTH)


def plausible_cameras(problem: CameraProblem, prior: CameraPrior) -> Floats:
    """Return level cameras (b, WIDTH) all around the stadium, oriented towards the clicks.

    The mean of the clicked pixels shows the mean of the clicked points, or each of the places along
    the drawn markings in turn.
    """
    spreads = (-1.0, 0.3)  # of heights and distances from the middle
    azimuths = 16  # 22 degrees apart, so that the fit converges
    evidence = problem.evidence
    pixels = np.concatenate([evidence.points_image, evidence.drawn_image])
    height = prior.height_m * np.exp(np.array(spreads) * prior.log_height_std)
    distance = prior.distance_m * np.exp(np.array(spreads) * prior.log_distance_std)
    focal = (
        problem.image_size[0]
        * prior.focal
        * np.exp(np.array((-1.0, 0.0, 1.0)) * prior.log_focal_std)
    )
    azimuth = 2.0 * np.pi * np.arange(azimuths) / azimuths
    grid = np.array(list(product(azimuth, distance, height, focal, range(len(_aims(problem))))))
    centers = np.stack(
        [grid[:, 1] * np.cos(grid[:, 0]), grid[:, 1] * np.sin(grid[:, 0]), grid[:, 2]], axis=1
    )
    aims = _aims(problem)[grid[:, 4].astype(np.int64)]
    rows = np.zeros((len(grid), WIDTH))
    rows[:, :2] = grid[:, 3:4]
    rows[:, 2:4] = problem.prior[2:4]
    rotation = _rotations_towards(centers, aims, pixels.mean(axis=0) - rows[:, 2:4], grid[:, 3])
    rows[:, 9:18] = rotation.reshape(-1, 9)
    rows[:, 18:21] = -np.einsum("bij,bj->bi", rotation, centers)
    rows[:, 21] = np.inf
    return rows


def _aims(problem: CameraProblem) -> Floats:
    """Return places (a, 3) [m], world, that the mean of the clicked pixels may show."""
    evidence = problem.evidence
    middles = [
        evidence.samples_world[first:stop].mean(axis=0) for first, stop in pairwise(evidence.bounds)
    ]
    together = np.concatenate([evidence.points_world, np.array(middles).reshape(-1, 3)])
    aims = [together.mean(axis=0)]
    if len(evidence.points) < 2:
        # The image may show only a part of a long line, and the clicks do not tell which.
        for first, stop in pairwise(evidence.bounds):
            inner = np.linspace(first, stop - 1, 7)[1:-1:2].astype(np.int64)
            aims.extend(evidence.samples_world[inner])
    unique: Floats = np.unique(np.round(aims, -1), axis=0)
    return unique


def _rotations_towards(centers: Floats, aims: Floats, offsets: Floats, focal: Floats) -> Floats:
    """Return rotations (b, 3, 3) of level cameras with `aims` at `offsets` [px] from the center."""
    forward = aims - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    # Pan and tilt by the angles between the mean of the clicks and the image center.
    tilt = np.arcsin(forward[:, 2]) + np.arctan(offsets[:, 1] / focal)
    pan = np.arctan2(forward[:, 1], forward[:, 0]) + np.arctan(offsets[:, 0] / focal)
    forward = np.stack(
        [np.cos(tilt) * np.cos(pan), np.cos(tilt) * np.sin(pan), np.sin(tilt)], axis=1
    )
    right = np.stack([np.sin(pan), -np.cos(pan), np.zeros_like(pan)], axis=1)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def find_start(problem: CameraProblem, settings: StaticCalibrationSettings) -> Floats:
    """Return the (WIDTH,) camera that the outlier search starts from."""
    count = 2 * len(problem.evidence.points) + len(problem.evidence.drawn_image)
    rows = cameras_from_homographies(problem, settings.prior, leave_out=False)
    if len(rows):
        best, cost = fit_from_starts(problem, rows, settings.wrong_click)
        if cost < 0.5 * 4.0 * count:
            return best
    coarse = replace(problem, drawn_loss=_COMPARISON_LOSS)
    everywhere = plausible_cameras(problem, settings.prior)
    weighed = fit_cameras(coarse, everywhere, click_loss=_COMPARISON_LOSS, iterations=0)
    chosen = everywhere[np.argsort(weighed.cost, kind="stable")[: settings.search_cameras]]
    rows = cameras_from_homographies(problem, settings.prior, leave_out=True)
    return fit_from_starts(problem, np.concatenate([rows, chosen]), settings.wrong_click)[0]


def fit_from_starts(
    problem: CameraProblem, rows: Floats, click_loss: float
) -> tuple[Floats, float]:
    """Return the best camera (WIDTH,) reached from starts (b, WIDTH), and its robust cost.

    A wide loss first moves every start into its basin; then a sharper loss decides, which a marking
    under a wrong name cannot dominate.
    """
    iterations = 12
    coarse = replace(problem, drawn_loss=_COMPARISON_LOSS)
    near = fit_cameras(coarse, rows, click_loss=_COMPARISON_LOSS, iterations=iterations)
    sharp = fit_cameras(problem, near.rows, click_loss=click_loss, iterations=iterations)
    direct = fit_cameras(problem, rows, click_loss=click_loss, iterations=iterations)
    cost = np.concatenate([sharp.cost, direct.cost])
    best = int(np.argmin(cost))
    return np.concatenate([sharp.rows, direct.rows])[best], float(cost[best])
