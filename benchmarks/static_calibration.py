"""Prints accuracy and time of static calibration's stages next to OpenCV and SciPy, in one run.

    python benchmarks/static_calibration.py [--cameras 4] [--rounds 5]

Clicks: ten named points with 1 px of noise. Lines: a rendered image and a start with an error of 5
px, 2000 samples. The peers of the line refinement minimise the paper's distance map (Canny edges
near the start's lines, `cv2.distanceTransform`), interpolated between pixels, with SciPy's
Levenberg-Marquardt and with a damped Gauss-Newton, both with a robust loss. Errors are root mean
squares over the visible markings against the true camera. All take turns in one process with one
thread; the best round counts. The map is computed before the clock starts and timed separately; so
are the iterations of ours, without the analysis of the image.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from data_contracts.arrays import Floats, Image
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.line_detection import brightness
from worldpose.static_calibration.line_refinement import refine_by_search, refine_on_lines
from worldpose.static_calibration.line_search import LineFit, LineSearch, MeasuredLines
from worldpose.static_calibration.parameters import (
    CameraEstimate,
    CameraOnPitch,
    project_with_jacobian,
    step_camera,
)
from worldpose.static_calibration.settings import LineRefinementSettings

PITCH = PitchTemplate.standard()
SPREAD = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 2e-3, 4.0, 4.0, 0.01, 0.01, 0.0])
"""Proportions of a start's errors, in the order of `PARAMETERS`."""
FREE = SPREAD > 0.0
START_ERROR = 5.0
FARTHEST = 30.0
"""Upper limit of the distance map [px]."""
ROBUST = 3.0
"""Cauchy scale of the peers' residuals on the map [px]: boards and shadows have edges, too."""


def line_points(camera: Camera, count: int) -> Floats:
    """Return evenly chosen points of the markings in a camera's image (count, 3)."""
    points = PITCH.sample_lines(0.1).points_world
    pixels = camera.project(points)
    points = points[((pixels > 3.0) & (pixels < camera.image_size - 4.0)).all(axis=-1)]
    chosen: Floats = points[np.linspace(0, len(points) - 1, count).astype(int)]
    return chosen


def line_error(camera: Camera, true: Camera) -> float:
    """Return the root mean square error over the markings [px]."""
    points = line_points(true, 2000)
    off = camera.project(points) - true.project(points)
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


def some_pixels_off(true: Camera, rng: np.random.Generator) -> tuple[Camera, Floats]:
    """Return a camera with marking errors of 5 px, and the spread that it was drawn with.

    All methods have that spread as their prior.
    """
    drawn, size = rng.standard_normal(12), 1.0
    for _ in range(4):
        size *= START_ERROR / line_error(step_camera(true, size * SPREAD * drawn), true)
    return step_camera(true, size * SPREAD * drawn), size * SPREAD


def distance_map(picture: NDArray[np.uint8], start: Camera) -> NDArray[np.float32]:
    """Return the distance to the nearest edge within 15 px of the start's lines [px] (C4)."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.0), 40, 100)
    near = np.zeros_like(grey)
    for x, y in np.rint(start.project(line_points(start, 6000))).astype(int):
        cv2.circle(near, (int(x), int(y)), 15, 255, -1)
    away = cv2.distanceTransform(255 - cv2.bitwise_and(edges, near), cv2.DIST_L2, 5)
    return np.minimum(away, FARTHEST).astype(np.float32)


def looked_up(away: MatLike, pixels: Floats) -> Floats:
    """Return the map interpolated at pixels (n,)."""
    # Not as one map and an empty second one: OpenCV 5 then reads arbitrary values.
    x, y = np.ascontiguousarray(pixels.T, dtype=np.float32)[:, None]
    mapped = cv2.remap(away, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(mapped[0], float)


def by_scipy(away: NDArray[np.float32], start: Camera, points: Floats, spread: Floats) -> Camera:
    """Return SciPy's Levenberg-Marquardt on the map; steps are 0.01 of the prior's spread."""

    def whole(scaled: Floats) -> Floats:
        step = np.zeros(12)
        step[FREE] = scaled * spread[FREE]
        return step

    def residuals(scaled: Floats) -> Floats:
        pixels = step_camera(start, whole(scaled)).project(points)
        value = ROBUST * np.sqrt(np.log1p((looked_up(away, pixels) / ROBUST) ** 2))
        return np.concatenate([value, 3.0 * scaled])

    zero = np.zeros(int(FREE.sum()))
    found = least_squares(residuals, zero, method="lm", diff_step=1e-2, max_nfev=300)
    return step_camera(start, whole(found.x))


def by_gauss_newton(
    away: NDArray[np.float32], start: Camera, points: Floats, spread: Floats
) -> Camera:
    """Return a damped Gauss-Newton result on the map, with its gradient and our Jacobian."""
    gx = cv2.Sobel(away / 8.0, cv2.CV_32F, 1, 0, ksize=3)
    gy = cv2.Sobel(away / 8.0, cv2.CV_32F, 0, 1, ksize=3)
    prior = 9.0 / spread[FREE] ** 2
    best, cost, damping = np.zeros(int(FREE.sum())), np.inf, 1e-2
    trial, camera = best, start
    normal, right = np.diag(prior), best
    for _ in range(15):
        step = np.zeros(12)
        step[FREE] = trial
        moved = step_camera(start, step)
        pixels, jacobian = project_with_jacobian(moved, points)
        value = looked_up(away, pixels)
        new = float(ROBUST**2 * np.log1p((value / ROBUST) ** 2).sum() + (prior * trial**2).sum())
        if new < cost:
            best, cost, camera, damping = trial, new, moved, damping / 4.0
            slope = np.stack([looked_up(gx, pixels), looked_up(gy, pixels)], axis=-1)
            rows = np.einsum("ni,nij->nj", slope, jacobian)[:, FREE]
            weighted = rows / (1.0 + (value / ROBUST) ** 2)[:, None]
            normal = weighted.T @ rows + np.diag(prior)
            right = weighted.T @ value + prior * best
        else:
            damping *= 8.0
        trial = best - np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
    return camera


def clicks_by_opencv(world: Floats, pixels: Floats, size: tuple[int, int]) -> Camera | None:
    """Return `cv2.calibrateCamera` with one view, square pixels, k1 and k2; None if it fails."""
    width, height = size
    guess = np.array([[2200.0, 0.0, width / 2], [0.0, 2200.0, height / 2], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_PRINCIPAL_POINT
    try:
        _, matrix, lens, rotations, shifts = cv2.calibrateCamera(
            [world.astype(np.float32)], [pixels.astype(np.float32)], size, guess, None, flags=flags
        )
    except cv2.error:
        return None
    return _camera(matrix, np.ravel(lens)[:5], rotations[0], shifts[0], size)


def clicks_by_scipy(world: Floats, pixels: Floats, size: tuple[int, int]) -> Camera:
    """Return `cv2.solvePnP` at the usual focal length, then SciPy; the principal point is fixed."""
    width, height = size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix = np.array([[2200.0, 0.0, middle[0]], [0.0, 2200.0, middle[1]], [0.0, 0.0, 1.0]])
    _, rotvec, shift = cv2.solvePnP(world, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    start = _camera(matrix, np.zeros(5), rotvec, shift, size)
    scale = np.array([1e-2, 1e-2, 1e-2, 1.0, 1.0, 1.0, 1e-1, 0.0, 0.0, 0.05, 0.02, 0.0])
    used = scale > 0.0

    def move_camera(scaled: Floats) -> Camera:
        step = np.zeros(12)
        step[used] = scaled * scale[used]
        return step_camera(start, step)

    def residuals(scaled: Floats) -> Floats:
        off = np.nan_to_num(move_camera(scaled).project(world) - pixels, nan=1e4).ravel()
        return np.concatenate([off, scaled[-2:]])

    found = least_squares(residuals, np.zeros(int(used.sum())), method="lm", max_nfev=2000)
    return move_camera(found.x)


def _camera(
    matrix: ArrayLike, lens: ArrayLike, rotvec: ArrayLike, shift: ArrayLike, size: tuple[int, int]
) -> Camera:
    matrix = np.asarray(matrix)
    return Camera(
        focal=np.array([matrix[0, 0], matrix[1, 1]]),
        principal_point=matrix[:2, 2],
        distortion=np.resize(lens, 5),
        cam_from_world=Rigid.from_rotvec(np.ravel(rotvec), np.ravel(shift)),
        image_size=np.array(size),
    )


class TimedSearch(LineSearch):
    """A line search that adds up the time of its own iterations, without the reading of bars.

    Attributes:
        seconds: spent in `converge` [s].
    """

    seconds = 0.0

    def converge(self, at: MeasuredLines, fine: bool) -> LineFit:
        """Return the converged fit to bars at fixed pixels."""
        begin = time.perf_counter()
        found = super().converge(at, fine)
        self.seconds += time.perf_counter() - begin
        return found


def measure_sides(
    sides: dict[str, Callable[[], Camera | None]], rounds: int
) -> dict[str, tuple[Camera | None, float]]:
    """Return each side's camera and best time [s], taken in turns after one unmeasured call."""
    results: dict[str, tuple[Camera | None, float]] = {
        name: (run(), np.inf) for name, run in sides.items()
    }
    for _ in range(rounds):
        for name, run in sides.items():
            begin = time.perf_counter()
            run()
            seconds = time.perf_counter() - begin
            results[name] = results[name][0], min(results[name][1], seconds)
    return results


def methods(
    prior: CameraOnPitch, spread: Floats, picture: Image, world: Floats, clicked: Floats
) -> dict[str, Callable[[], Camera | None]]:
    """Return all methods that start at one camera, by name."""
    start, size = prior.camera, (picture.shape[1], picture.shape[0])
    away, points = distance_map(picture, start), line_points(prior.camera, 2000)

    def make_map() -> None:
        distance_map(picture, start)

    return {
        "start": lambda: start,
        "lines: ours, from the picture": lambda: (
            refine_on_lines(prior, PITCH, picture, survey_error=0.0).estimate.camera
        ),
        "lines: Gauss-Newton, from the map": lambda: by_gauss_newton(away, start, points, spread),
        "lines: SciPy LM, from the map": lambda: by_scipy(away, start, points, spread),
        "lines: making the map": make_map,
        "clicks: calibrateCamera": lambda: clicks_by_opencv(world, clicked, size),
        "clicks: solvePnP + SciPy": lambda: clicks_by_scipy(world, clicked, size),
    }


def main() -> None:
    """Print one line per method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    scenario = SCENARIOS["match"]
    table: dict[str, list[tuple[float, float]]] = {}
    own: list[float] = []
    for index in range(options.cameras):
        rng = np.random.default_rng(index)
        true = place_camera(scenario.rig, index, np.zeros(3), scenario.pitch, rng)
        picture = render_pitch(true, PITCH, None, index)
        start, spread = some_pixels_off(true, rng)
        prior = CameraOnPitch.on_known_surface(
            CameraEstimate(start, np.diag(spread**2)), (PITCH.crown, PITCH.end_fall)
        )
        places = PITCH.positions(list(PITCH.points))
        seen = true.project(places)
        inside = ((seen > 4.0) & (seen < true.image_size - 5.0)).all(axis=-1)
        chosen = rng.permutation(np.flatnonzero(inside))[:10]
        world, clicked = places[chosen], seen[chosen] + rng.standard_normal((len(chosen), 2))
        sides = methods(prior, spread, picture, world, clicked)
        grey, alone = brightness(picture), []
        for _ in range(options.rounds):
            search = TimedSearch(prior, PITCH, grey, 0.0, LineRefinementSettings())
            refine_by_search(search, PITCH)
            alone.append(search.seconds)
        own.append(min(alone))
        for name, (camera, seconds) in measure_sides(sides, options.rounds).items():
            off = np.nan if camera is None else line_error(camera, true)
            table.setdefault(name, []).append((seconds, off))
        print(f"\r  camera {index + 1} of {options.cameras}", end="", file=sys.stderr, flush=True)
    print("\r" + " " * 30, end="\r", file=sys.stderr, flush=True)
    print(f"{options.cameras} cameras, best of {options.rounds} rounds, one thread; medians")
    print(f"{'lines: ours, iterations only':36s} {1e3 * np.median(own):8.1f} ms")
    for name, rows in table.items():
        seconds, errors = np.array(rows).T
        error = "" if np.isnan(errors).all() else f"{np.nanmedian(errors):8.3f} px"
        worst = "" if np.isnan(errors).all() else f"  worst {np.nanmax(errors):8.3f} px"
        print(f"{name:36s} {1e3 * np.median(seconds):8.1f} ms {error}{worst}")


if __name__ == "__main__":
    main()
