"""Live preview of a calibration from clicks: projected pitch and proposed next clicks (C7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data_contracts.static_calibration import ClickedMarkings
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration import (
    CalibrationReport,
    StaticCalibrationSettings,
    calibrate,
)

SPACING = 0.5
"""Spacing of points along a drawn marking [m]: the chords of a curved marking are only a few pixels
long."""
MARGIN = 0.25
"""Margin beyond the image for drawn markings, relative to its size [1]: far outside, unconstrained
distortion may fold them back."""


@dataclass(frozen=True, eq=False)
class PitchDrawing:
    """A pitch with cached sample points for repeated drawing.

    Attributes:
        template: the stadium's template.
    """

    template: PitchTemplate

    @cached_property
    def markings(self) -> dict[str, NDArray[np.float64]]:
        """Points (n, 3) [m], world, along every marking, by name."""
        names = self.template.marking_names
        return {name: self.template.marking_points(name, SPACING) for name in names}

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The named points (n, 3) [m], world."""
        return self.template.positions(tuple(self.template.points))

    def drawn(self, camera: Camera) -> dict[str, list[NDArray[np.float64]]]:
        """Return polylines (n, 2) [px] of every marking in or near the image, by name."""
        stacked = camera.project(np.concatenate(list(self.markings.values())))
        found, begin = {}, 0
        for name, points in self.markings.items():
            end = begin + len(points)
            pieces = _pieces(stacked[begin:end], camera.image_size)
            begin = end
            if pieces:
                found[name] = pieces
        return found

    def placed(self, camera: Camera) -> dict[str, NDArray[np.float64]]:
        """Return the projections of the named points inside the image (2,) [px], by name."""
        pixels = camera.project(self.points)
        inside = _inside(pixels, camera.image_size, 0.0)
        names = self.template.points
        return {name: pixels[k] for k, name in enumerate(names) if inside[k]}


@dataclass(frozen=True, eq=False)
class Preview:
    """Camera, report and projected pitch from the current clicks.

    Attributes:
        camera: the camera.
        report: its accuracy and warnings.
        markings: polylines (n, 2) [px] by name.
        points: projections of the named points (2,) [px], by name.
    """

    camera: Camera
    report: CalibrationReport
    markings: Mapping[str, list[NDArray[np.float64]]]
    points: Mapping[str, NDArray[np.float64]]


def preview(
    drawing: PitchDrawing,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    *,
    picture: NDArray[np.uint8] | None = None,
    settings: StaticCalibrationSettings = StaticCalibrationSettings(),  # noqa: B008
) -> Preview:
    """Return the camera from the current clicks, and the projected pitch.

    Args:
        drawing: the pitch.
        clicked: the current clicks.
        image_size: width, height [px].
        picture: (height, width, 3); if given, the calibration refines the camera on the painted
            lines, which takes seconds and not milliseconds.
        settings: as for the stage `static_calibration`.

    Raises:
        InputError: the clicks do not determine a camera; the message says which clicks to add.
    """
    found = calibrate(
        drawing.template, clicked, image_size, picture=picture, settings=settings, where="so far"
    )
    camera = found.estimate.camera
    return Preview(camera, found.report, drawing.drawn(camera), drawing.placed(camera))


def _pieces(
    pixels: NDArray[np.float64], image_size: NDArray[np.int64]
) -> list[NDArray[np.float64]]:
    """Return the runs of two points or more in or near the image."""
    near = _inside(pixels, image_size, MARGIN)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]])))
    runs = zip(bounds[::2], bounds[1::2], strict=True)
    return [pixels[begin:end] for begin, end in runs if end - begin > 1]


def _inside(
    pixels: NDArray[np.float64], image_size: NDArray[np.int64], margin: float
) -> NDArray[np.bool_]:
    """Return a mask (n,) of pixels (n, 2) in the image or within a margin relative to its size."""
    room = margin * np.asarray(image_size)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5 - room) & (pixels <= image_size - 0.5 + room)
    return np.asarray(inside.all(axis=1))
