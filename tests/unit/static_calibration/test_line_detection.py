"""Bars in images drawn here by area coverage, so that their middles are exact."""

import cv2
import numpy as np

from worldpose.static_calibration.from_paint.thin_paint import trace_marking

SIZE = (1920, 400)


def grass(seed=80):
    rng = np.random.default_rng(seed)
    image = np.full((SIZE[1], SIZE[0], 3), (70, 110, 60), np.float64)
    return image + rng.normal(0.0, 3.0, (SIZE[1], SIZE[0], 1))


def paint(image, places, strength=0.45):
    """Add a line one pixel wide along places (n, 2), at sub-pixel accuracy."""
    cover = np.zeros(image.shape[:2], np.uint8)
    shift = 4
    points = np.round(places * 2**shift).astype(np.int32)
    cv2.polylines(cover, [points], False, 255, 1, cv2.LINE_AA, shift)
    return image + (230.0 - image) * strength * (cover[..., None] / 255.0)


def as_picture(image):
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def projected():
    x = np.linspace(20.0, 1900.0, 200)
    return np.stack([x, 200.0 - 0.03 * x], axis=1)


def true_places(offset=4.0, sag=2.0):
    """The real line: beside its projection and bent."""
    line = projected()
    share = (line[:, 0] - 960.0) / 960.0
    return line + np.stack([np.zeros(len(line)), offset - sag * share**2], axis=1)


def test_thin_paint_beside_its_projection_is_traced_despite_letters():
    image = paint(grass(), true_places())
    rng = np.random.default_rng(81)
    for x in range(900, 1500, 14):  # letters behind the line
        y = 200.0 - 0.03 * x - 4.0 + rng.uniform(-2.0, 2.0)
        cv2.rectangle(image, (x, int(y)), (x + 9, int(y) + 2), (220.0, 220.0, 220.0), -1)
    found = trace_marking(as_picture(image), projected())
    assert len(found) > 150
    expected = np.interp(found[:, 0], *true_places().T)
    assert np.abs(np.median(found[:, 1] - expected)) < 0.15
    assert np.quantile(np.abs(found[:, 1] - expected), 0.95) < 1.0
