"""Bars in images drawn here by area coverage, so that their middles are exact."""

import cv2
import numpy as np
import pytest

from worldpose.static_calibration.line_detection import (
    CANDIDATES,
    CrossSections,
    find_bars,
    fit_bars,
)


def bars(middle, width, *, left=80.0, right=80.0, paint=200.0, shape=(40, 80)):
    """An image with a vertical bar: the mean of what each pixel covers, through a sharp lens."""
    low, high = middle - 0.5 * width, middle + 0.5 * width
    x = np.arange(shape[1])
    before = np.clip(low - (x - 0.5), 0.0, 1.0)
    after = np.clip(x + 0.5 - high, 0.0, 1.0)
    row = left * before + right * after + paint * (1.0 - before - after)
    row = cv2.GaussianBlur(row[None], (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE)[0]
    return np.tile(np.rint(row).astype(np.uint8), (shape[0], 1))


def across(x, width, curvature=0.0):
    """The cross section of a vertical bar at a column."""
    place, normal = np.array([[x, 20.0]]), np.array([[1.0, 0.0]])
    return CrossSections(place, normal, np.array([width]), np.array([curvature]))


def found(picture, x, width, reach=10.0, contrast=6.0):
    offsets, strengths = np.empty((1, CANDIDATES)), np.empty((1, CANDIDATES))
    find_bars(picture, across(x, width), np.array([reach]), contrast, offsets, strengths)
    return offsets[0]


def fitted(picture, x, width, start, contrast=6.0, curvature=0.0):
    offset, variance = np.empty(1), np.empty(1)
    sections = across(x, width, curvature)
    fit_bars(picture, sections, np.array([start]), contrast, offset, variance)
    return offset[0], variance[0]


@pytest.mark.parametrize(("width", "middle"), [(0.8, 40.0), (1.5, 40.27), (6.0, 40.81)])
def test_middle_of_a_bar_is_found_whatever_its_width(width, middle):
    picture = bars(middle, width)
    offsets = found(picture, 36.0, width)
    # Readings are half a pixel apart and pixels one: 0.75 px is their sum's half.
    assert abs(36.0 + offsets[0] - middle) <= 0.75
    offset, _ = fitted(picture, 36.0, width, offsets[0])
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
    straight, _ = fitted(ring, 40.0, 2.0, 0.0)
    along, _ = fitted(ring, 40.0, 2.0, 0.0, curvature=-1.0 / 8.0)
    # Two pixels to either side the ring is a quarter of a pixel inside its tangent, and blur draws
    # it 0.035 px inwards; of the third order 0.02 px are left.
    assert straight < -0.12
    assert abs(along) < 0.04


def test_variance_is_that_of_the_offsets():
    rng = np.random.default_rng(1)
    clean = bars(40.3, 3.0).astype(np.float64)
    fits = np.array(
        [
            fitted(
                np.clip(np.rint(clean + 6.0 * rng.standard_normal(clean.shape)), 0, 255).astype(
                    np.uint8
                ),
                39.0,
                3.0,
                1.0,
            )
            for _ in range(300)
        ]
    )
    # 300 draws give a variance to 8 %, and the fit's rest holds the lens's misfit besides noise.
    assert 0.6 < fits[:, 0].var() / fits[:, 1].mean() < 1.5
