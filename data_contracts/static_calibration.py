"""Clicks in the image of a static camera, and the result of stage `static_calibration`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from data_contracts.arrays import GroupLayout, array_layout, array_layouts
from data_contracts.cameras import CAMERA_ARRAYS, CAMERA_LABELS
from data_contracts.records import CONTRACT_VERSION, Name, PixelCoordinate, Record

Pixel = tuple[PixelCoordinate, PixelCoordinate]
"""x, y [px]; (0, 0) is the centre of the top-left pixel."""


class ClickedPoint(Record):
    """A named point of the pitch template, as clicked in the image."""

    name: Name
    """Point of the template, such as `corner_left_near`."""
    xy: Pixel


class DrawnMarking(Record):
    """Pixels along a line or arc of the pitch template, at unknown positions along it."""

    name: Name
    """Line or arc of the template, such as `touch_line_near` or `center_circle`, or a goal's
    `goal_post_left_near` or `crossbar_left`."""
    xy: tuple[Pixel, ...] = Field(min_length=1)


class ClickedMarkings(Record):
    """annotations/static_calibration/<camera>.json: all clicks of one camera."""

    contract: Literal[1] = CONTRACT_VERSION
    points: tuple[ClickedPoint, ...] = ()
    drawn: tuple[DrawnMarking, ...] = ()

    def by_name(self) -> dict[str, JsonValue]:
        """Return points and drawn markings by name, as recipes list them [px]."""
        return {
            "points": {point.name: list(point.xy) for point in self.points},
            "drawn": {marking.name: [list(xy) for xy in marking.xy] for marking in self.drawn},
        }


CAMERA_STEP = (*("rx", "ry", "rz", "tx", "ty", "tz"), *("log_focal", "cx", "cy", "k1", "k2", "k3"))
"""A step of a camera: rotation about its center [rad] and shift [m] in its own axes, the
logarithm of the focal length, principal point [px], distortion [1]."""

_GROUND = tuple(
    array_layout(
        f"ground_{axis}",
        f"(ground_{axis}) float64 [m]",
        f"{axis} of the places of `ground_error`, world",
    )
    for axis in ("x", "y")
)
_EVIDENCE = array_layouts(
    """
    covariance (parameter, parameter_) float64 [1]:
        covariance of a step of the camera, in the units of its parameters; zero for parameters that
        were not solved for
    point_pixel (point, axis) float64 [px]:
        clicked pixel
    point_residual (point, axis) float64 [px], missing nan:
        projected minus clicked; missing if the camera cannot image the point
    point_surprise (point) float64 [1], missing nan:
        Mahalanobis distance of the residual, given the other evidence; missing if the camera cannot
        image the point
    point_inlier (point) bool [1]:
        the click is an inlier
    marking_rms (marking) float64 [px]:
        root mean square distance of the drawn pixels to the projected marking
    marking_worst (marking) float64 [px]:
        largest distance of a drawn pixel to the projected marking
    marking_inlier (marking) bool [1]:
        the drawn marking is an inlier
    ground_error (ground_y, ground_x) float64 [m], missing nan:
        expected distance on the surface between a place and the back-projection of its true pixel;
        missing outside of the camera's view
    """
)
_VENUE = array_layouts(
    """
    venue_number (unknown) int64 [1]:
        unknowns of the pitch that all cameras share: 3 p + axis = error of the template's point p;
        from -1000000 down, uneven paint; the last two, crown and end fall
    venue_prior_mean (unknown) float64 [m]:
        the unknowns before the image
    venue_prior (unknown, unknown_) float64 [1/m^2]:
        information of `venue_prior_mean`
    venue_mean (unknown) float64 [m]:
        the unknowns at this camera
    venue_information (unknown, unknown_) float64 [1/m^2]:
        what the evidence of this camera alone tells about the unknowns
    venue_response (parameter, unknown) float64 [1/m]:
        step of the camera per change of the unknowns, in the units of its parameters
    """
)
_ABOUT = {
    "point": "names of the clicked points, the largest Mahalanobis distance first",
    "point_problem": "why a clicked point is an outlier; otherwise empty",
    "marking": "names of the drawn markings, the worst first",
    "free": "parameters that were solved for",
    "decisions": "choices made, with the metrics that decided",
    "reasons": "why the camera is weak or left out; otherwise empty",
    "add_next": "points and markings whose clicks would lower the expected error most",
    "noise_scale": "factor on the stated click noise; null for a given camera",
    "condition": "condition number of the free parameters' correlation; null for a given camera",
}

STATIC_CALIBRATION = GroupLayout(
    stage="static_calibration",
    about="One static camera on its own, with covariance and evidence unless it was given. Later "
    "stages join cameras that were refined on lines by `venue_*`. A camera that cannot be "
    "calibrated has no arrays; its `reasons` say why it is left out.",
    coordinates=_GROUND,
    arrays=(*CAMERA_ARRAYS, *_EVIDENCE, *_VENUE),
    labels={**CAMERA_LABELS, "parameter": CAMERA_STEP, "parameter_": CAMERA_STEP},
    attributes={
        "camera_id": "camera of the match",
        "origin": "given, points (stages 1 and 2), lines (stage 3), or none for a camera that is "
        "left out",
        **_ABOUT,
    },
    optional=tuple(array.name for array in (*_GROUND, *CAMERA_ARRAYS, *_EVIDENCE, *_VENUE)),
)
