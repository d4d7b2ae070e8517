"""Bars in images drawn here by area coverage, so that their middles are exact."""

import cv2
import numpy as np
import pytest

from worldpose.static_calibration.from_paint.thin_paint import trace_marking
from worldpose.static_calibration.line_detection import (
    CANDIDATES,
    CrossSections,
    find_bars,
    fit_bars,
)


def bars(middle, width):
    """An image with a vertical bar: the mean of what each pixel covers, through a sharp lens."""
    low, high = middle - 0.5 * width, middle + 0.5 * width
    x = np.arange(80)
    grass = np.clip(low - (x - 0.5), 0.0, 1.0) + np.clip(x + 0.5 - high, 0.0, 1.0)
    row = 200.0 - 120.0 * grass
    row = cv2.GaussianBlur(row[None], (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE)[0]
    return np.tile(np.rint(row).astype(np.uint8), (40, 1))


def across(x, width, curvature=0.0):
    """The cross section of a vertical bar at a column."""
    place, normal = np.array([[x, 20.0]]), np.array([[1.0, 0.0]])
    return CrossSections(place, normal, np.array([width]), np.array([curvature]))


def fitted(picture, x, width, start, curvature=0.0):
    offset, variance = np.empty(1), np.empty(1)
    fit_bars(picture, across(x, width, curvature), np.array([start]), 6.0, offset, variance)
    return offset[0]


@pytest.mark.parametrize(("width", "middle"), [(0.8, 40.0), (1.5, 40.27), (6.0, 40.81)])
def test_middle_of_a_bar_is_found_whatever_its_width(width, middle):
    picture = bars(middle, width)
    offsets, strengths = np.empty((1, CANDIDATES)), np.empty((1, CANDIDATES))
    find_bars(picture, across(36.0, width), np.array([10.0]), 6.0, offsets, strengths)
    # Readings are half a pixel apart and pixels one: 0.75 px is their sum's half.
    assert abs(36.0 + offsets[0, 0] - middle) <= 0.75
    offset = fitted(picture, 36.0, width, offsets[0, 0])
    # Whole grey levels and a lens that is not quite a logistic curve: hundredths of a pixel. A bar
    # below a pixel, just along the columns, is also as far off as straight interpolation is.
    assert abs(36.0 + offset - middle) < (0.05 if width > 1.0 else 0.15)


def test_middle_of_a_curved_bar_is_found():
    # A ring of radius 8 around (32, 20), drawn eight times as large and averaged.
    y, x = np.mgrid[0:320, 0:640] / 8.0 - 0.4375
    far = np.abs(np.hypot(x - 32.0, y - 20.0) - 8.0)
    fine = (80.0 + 120.0 * (far < 1.0)).astype(np.float32)
    ring = cv2.resize(fine, (80, 40), interpolation=cv2.INTER_AREA)
    ring = np.rint(cv2.GaussianBlur(ring, (0, 0), 0.7)).astype(np.uint8)
    straight = fitted(ring, 40.0, 2.0, 0.0)
    along = fitted(ring, 40.0, 2.0, 0.0, curvature=-1.0 / 8.0)
    # Two pixels to either side the ring is a quarter of a pixel inside its tangent, and blur draws
    # it 0.035 px inwards; of the third order 0.02 px are left.
    assert straight < -0.12
    assert abs(along) < 0.04


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
