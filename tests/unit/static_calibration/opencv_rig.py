"""Cameras and clicks that share no code with the simulator: OpenCV projects, wide lenses."""

import cv2
import numpy as np

from data_contracts.static_calibration import ClickedMarkings
from worldpose.pitch.template import PitchTemplate

SIZE = (1920, 1080)
PITCH = PitchTemplate.standard()


def wide_camera(rng, focal=(0.6, 1.7), center=(960.0, 540.0)):
    """Return OpenCV's matrix, coefficients, rotation and translation of a camera in a stand."""
    azimuth, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(55.0, 105.0)
    place = [distance * np.cos(azimuth), 0.75 * distance * np.sin(azimuth), rng.uniform(8.0, 32.0)]
    aim = np.array([rng.uniform(-30.0, 30.0), rng.uniform(-15.0, 15.0), 0.0])
    forward = (aim - place) / np.linalg.norm(aim - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    roll = cv2.Rodrigues(np.array([0.0, 0.0, rng.normal(0.0, 0.015)]))[0]
    rotation = roll @ np.stack([right, np.cross(forward, right), forward])
    f = SIZE[0] * np.exp(rng.uniform(*np.log(focal)))
    matrix = np.array([[f, 0.0, center[0]], [0.0, f, center[1]], [0.0, 0.0, 1.0]])
    # At the corner of the image a barrel of 1.5 %, give or take as much.
    k1 = rng.normal(-0.015, 0.015) * (f / (0.5 * np.hypot(*SIZE))) ** 2
    return matrix, np.array([k1, 0.0, 0.0, 0.0, 0.0]), rotation, -rotation @ place


def project(camera, points):
    """Return pixels (n, 2); NaN behind the camera and beyond the fold of its lens."""
    matrix, coefficients, rotation, translation = camera
    turn = cv2.Rodrigues(rotation)[0]
    pixels = cv2.projectPoints(points[:, None], turn, translation, matrix, coefficients)[0][:, 0]
    seen = points @ rotation.T + translation
    squared = (seen[:, :2] ** 2).sum(axis=1) / seen[:, 2] ** 2
    lost = (seen[:, 2] < 1.0) | (1.0 + 3.0 * coefficients[0] * squared <= 0.0)
    return np.where(lost[:, None], np.nan, pixels)


def seen(camera, points, margin=10.0):
    """Return which pixels (n,) are well inside the image."""
    with np.errstate(invalid="ignore"):
        pixels = project(camera, points)
        return ((pixels > margin) & (pixels < np.array(SIZE) - margin)).all(axis=1)


def click(camera, rng, count, noise):
    """Return a pixel (2,) of each clicked point by name; None where the camera sees too few."""
    names = np.array(list(PITCH.points))
    places = PITCH.positions(tuple(names))
    there = np.flatnonzero(seen(camera, places))
    if len(there) < count:
        return None
    chosen = rng.permutation(there)[:count]
    pixels = project(camera, places[chosen]) + noise * rng.standard_normal((count, 2))
    pixels = np.clip(pixels, 0.0, np.array(SIZE) - 1.0)
    return dict(zip(names[chosen].tolist(), pixels, strict=True))


def markings(points, drawn=None):
    """Return clicks and drawn pixels, by name, as the record that people write."""
    return ClickedMarkings.model_validate(
        {
            "points": [{"name": n, "xy": tuple(map(float, xy))} for n, xy in points.items()],
            "drawn": [
                {"name": name, "xy": [tuple(map(float, xy)) for xy in pixels]}
                for name, pixels in (drawn or {}).items()
            ],
        }
    )
