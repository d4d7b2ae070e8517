"""A camera while somebody clicks it: what it makes of the pitch, and what to click next (C7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data_contracts.static_calibration import ClickedMarkings
from worldpose.cameras import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration import (
    CalibrationReport,
    StaticCalibrationSettings,
    calibrate,
)

SPACING = 0.5
"""Between the points of a drawn marking [m]: its chords are no more than a few pixels long where
the marking is curved."""
MARGIN = 0.25
"""How far beyond the picture markings are drawn, in its size [1]: far outside, distortion that
nothing there holds may fold them back."""


@dataclass(frozen=True, eq=False)
class PitchDrawing:
    """A pitch made ready to be drawn again and again.

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
        """Polylines (n, 2) [px] of every marking that reaches the picture, by name."""
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
        """Where the camera puts the named points that are in its picture (2,) [px], by name."""
        pixels = camera.project(self.points)
        inside = _inside(pixels, camera.image_size, 0.0)
        names = self.template.points
        return {name: pixels[k] for k, name in enumerate(names) if inside[k]}


@dataclass(frozen=True, eq=False)
class Preview:
    """What clicks make of a camera.

    Attributes:
        camera: the camera.
        report: how well it is known and why.
        markings: polylines (n, 2) [px] by name.
        points: where it puts the named points (2,) [px], by name.
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
    """The camera that clicks make, and the pitch as it projects it.

    Args:
        drawing: the pitch.
        clicked: so far.
        image_size: width, height [px].
        picture: (height, width, 3); with it the camera is refined on the painted lines, which
            takes seconds and not milliseconds.
        settings: as the stage `static_calibration` takes them.

    Raises:
        InputError: the clicks do not determine a camera; the message says what to add.
    """
    found = calibrate(
        drawing.template, clicked, image_size, picture=picture, settings=settings, where="so far"
    )
    camera = found.estimate.camera
    return Preview(camera, found.report, drawing.drawn(camera), drawing.placed(camera))


def _pieces(
    pixels: NDArray[np.float64], image_size: NDArray[np.int64]
) -> list[NDArray[np.float64]]:
    """The runs of two points or more that are in or about the picture."""
    near = _inside(pixels, image_size, MARGIN)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]])))
    runs = zip(bounds[::2], bounds[1::2], strict=True)
    return [pixels[begin:end] for begin, end in runs if end - begin > 1]


def _inside(
    pixels: NDArray[np.float64], image_size: NDArray[np.int64], margin: float
) -> NDArray[np.bool_]:
    """Which pixels (n, 2) are in the picture, or about it by a share of its size; (n,)."""
    room = margin * np.asarray(image_size)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5 - room) & (pixels <= image_size - 0.5 + room)
    return np.asarray(inside.all(axis=1))
