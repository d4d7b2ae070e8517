"""Simulated clicks in the image of a known camera."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from camera_builders import look_at_camera

from data_contracts.cameras import LensCalibration
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.from_paint.paint import Ridges, guess_lens, straighten_paint
from worldpose.static_calibration.parameters import step_between

SIZE = (1920, 1080)
PITCH = PitchTemplate.standard()
DISTORTION = np.array([-0.30, 0.12, 0.002, -0.001, -0.02])


def pinhole(center, aim, focal, size=(1280, 720), k1=0.0, roll=0.0):
    """A camera at a place that looks at another, with its principal point in the middle."""
    return look_at_camera(center, aim, focal, size, lens=(k1, 0.0, 0.0, 0.0, 0.0), roll=roll)


def paint_of(camera, names, pitch=PITCH):
    """Paint of markings in a camera's image, as a flawless detector would find it."""
    points, normals = [], []
    size = tuple(camera.image_size.tolist())
    for name in names:
        pixels = camera.project(pitch.marking_points(name, 0.02))
        inside = ((pixels >= 0.0) & (pixels <= np.array(size) - 1.0)).all(axis=1)
        way = np.gradient(pixels, axis=0)
        points.append(pixels[inside])
        normals.append((np.arctan2(way[:, 1], way[:, 0]) + 0.5 * np.pi)[inside] % np.pi)
    ridges = Ridges(np.concatenate(points), np.concatenate(normals))
    return straighten_paint(ridges, np.ones(size[::-1], np.bool_), guess_lens(0.0, size), 1.0)


def seat(index, seed=0):
    """A camera of the synthetic stadium, and the generator that continues from it."""
    rng = np.random.default_rng([seed, index])
    rig = SCENARIOS["match"].rig
    return place_camera(rig, index, np.zeros(3), PitchSpec(), rng), rng


def visible(camera, names=None):
    """Pixels by name of the template's points that the camera sees well inside its image."""
    names = list(PITCH.points) if names is None else names
    pixels = camera.project(PITCH.positions(names))
    inside = np.isfinite(pixels).all(axis=1)
    inside[inside] = ((pixels[inside] > 4) & (pixels[inside] < np.array(SIZE) - 5)).all(axis=1)
    return {name: xy for name, xy, seen in zip(names, pixels, inside, strict=True) if seen}


def click(camera, rng, count=10, noise=1.0, wrong=0.0):
    """Clicks on random visible points; with `wrong`, the first lies that many pixels off."""
    seen = visible(camera)
    names = list(rng.permutation(list(seen)))[:count]
    pixels = {name: seen[name] + noise * rng.standard_normal(2) for name in names}
    if wrong:
        angle = rng.uniform(0, 2 * np.pi)
        pixels[names[0]] = pixels[names[0]] + wrong * np.array([np.cos(angle), np.sin(angle)])
    limit = np.array(SIZE) - 1
    return SimpleNamespace(
        clicked=points({name: np.clip(xy, 0, limit) for name, xy in pixels.items()}),
        first=str(names[0]),
    )


def points(pixels):
    return ClickedMarkings(
        points=tuple(
            ClickedPoint(name=str(k), xy=(float(x), float(y))) for k, (x, y) in pixels.items()
        )
    )


def draw(camera, names, rng, count=4, noise=0.0, pitch=PITCH):
    """Pixels on the visible part of markings."""
    drawn = []
    for name in names:
        pixels = camera.project(pitch.marking_points(name, 0.2))
        inside = np.isfinite(pixels).all(axis=1)
        inside[inside] = ((pixels[inside] > 4) & (pixels[inside] < np.array(SIZE) - 5)).all(axis=1)
        pixels = pixels[inside]
        if len(pixels) < 2:
            continue
        chosen = pixels[np.linspace(0, len(pixels) - 1, count).astype(int)]
        chosen = chosen + noise * rng.standard_normal(chosen.shape)
        drawn.append(DrawnMarking(name=name, xy=tuple((float(x), float(y)) for x, y in chosen)))
    return tuple(drawn)


def ground_errors(estimate, truth, places):
    """Distance on the surface between places and where the estimate puts their true pixels [m]."""
    pixels = truth.project(places)
    inside = np.isfinite(pixels).all(axis=1)
    inside[inside] = ((pixels[inside] > 0) & (pixels[inside] < truth.image_size - 1)).all(axis=1)
    rays, places = estimate.unproject(pixels[inside]), places[inside]
    height = places[:, 2]
    for _ in range(4):  # the crown's slope is 1 %: each round is a hundred times closer
        depth = (height - rays.origins[:, 2]) / rays.directions[:, 2]
        found = rays.origins + depth[:, None] * rays.directions
        height = PITCH.height(found[:, 0], found[:, 1])
    return np.linalg.norm(found - places, axis=1)


def on_the_pitch(rng, count=60):
    x, y = rng.uniform(-52.5, 52.5, count), rng.uniform(-34, 34, count)
    return np.stack([x, y, PITCH.height(x, y)], axis=1)


def surprise_of(estimate, truth):
    """Squared Mahalanobis distance of the true camera, and its degrees of freedom."""
    step = step_between(estimate.camera, truth)
    free = np.diag(estimate.covariance) > 0
    inner = estimate.covariance[np.ix_(free, free)]
    return float(step[free] @ np.linalg.solve(inner, step[free])), int(free.sum())


def wide_camera(seed):
    """A camera with a lens that bends its corners, off its middle, and the generator."""
    camera, rng = seat(seed % 4, seed)
    focal = 0.6 * camera.focal
    middle = camera.principal_point + [25.0, -14.0]
    return replace(camera, focal=focal, principal_point=middle, distortion=DISTORTION), rng


def lens_of(camera, rng, focal=1.0):
    """The lens as a board calibration with a deviation of half a per cent gives it."""
    f = focal * float(camera.focal[0]) * (1.0 + 0.005 * rng.standard_normal())
    x, y = camera.principal_point + 3.0 * rng.standard_normal(2)
    return LensCalibration(
        id="cam",
        image_size=SIZE,
        focal_px=f,
        principal_point_px=(float(x), float(y)),
        distortion=tuple(camera.coefficients.tolist()),
        focal_std_px=0.005 * f,
        principal_point_std_px=3.0,
        distortion_std=0.001,
    )
