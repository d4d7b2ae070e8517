"""What people click in a static camera's picture, and the result of stage `static_calibration`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.cameras import CAMERA_ARRAYS, CAMERA_LABELS
from data_contracts.records import CONTRACT_VERSION, Name, PixelCoordinate, Record

Pixel = tuple[PixelCoordinate, PixelCoordinate]
"""x, y [px]; (0, 0) is the centre of the top-left pixel."""


class ClickedPoint(Record):
    """A named point of the pitch template where a person saw it."""

    name: Name
    """Point of the template, such as `corner_left_near`."""
    xy: Pixel


class DrawnMarking(Record):
    """Points along a line or arc of the pitch template; where along it they lie is not known."""

    name: Name
    """Line or arc of the template, such as `touch_line_near` or `center_circle`, or a goal's
    `goal_post_left_near` or `crossbar_left`."""
    xy: tuple[Pixel, ...] = Field(min_length=1)


class ClickedMarkings(Record):
    """annotations/static_calibration/<camera>.json: everything clicked for one camera."""

    contract: Literal[1] = CONTRACT_VERSION
    points: tuple[ClickedPoint, ...] = ()
    drawn: tuple[DrawnMarking, ...] = ()


CAMERA_STEP = (
    "rx",
    "ry",
    "rz",
    "tx",
    "ty",
    "tz",
    "log_focal",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
)
"""A small change of a camera: rotation about its center [rad] and shift [m] in its own axes, the
logarithm of the focal length, principal point [px], distortion [1]."""

_GROUND = tuple(
    ArrayLayout(
        name=f"ground_{axis}",
        dims=(f"ground_{axis}",),
        dtype="float64",
        unit="m",
        missing="none",
        about=f"{axis} of the places of `ground_error`, world",
    )
    for axis in ("x", "y")
)
_EVIDENCE = (
    ArrayLayout(
        name="covariance",
        dims=("parameter", "parameter_"),
        dtype="float64",
        unit="1",
        missing="none",
        about="covariance of a step of the camera, in the units of its parameters; zero for "
        "parameters that were not solved for",
    ),
    ArrayLayout(
        name="point_pixel",
        dims=("point", "axis"),
        dtype="float64",
        unit="px",
        missing="none",
        about="where it was clicked",
    ),
    ArrayLayout(
        name="point_residual",
        dims=("point", "axis"),
        dtype="float64",
        unit="px",
        missing="nan",
        about="projected minus clicked; missing where the camera cannot image the point",
    ),
    ArrayLayout(
        name="point_surprise",
        dims=("point",),
        dtype="float64",
        unit="1",
        missing="nan",
        about="residual in standard deviations of what the other evidence predicts; missing where "
        "the camera cannot image the point",
    ),
    ArrayLayout(
        name="point_inlier",
        dims=("point",),
        dtype="bool",
        unit="1",
        missing="none",
        about="does the camera rest on this click",
    ),
    ArrayLayout(
        name="marking_rms",
        dims=("marking",),
        dtype="float64",
        unit="px",
        missing="none",
        about="root mean square distance of the drawn pixels to the projected marking",
    ),
    ArrayLayout(
        name="marking_worst",
        dims=("marking",),
        dtype="float64",
        unit="px",
        missing="none",
        about="largest distance of a drawn pixel to the projected marking",
    ),
    ArrayLayout(
        name="marking_inlier",
        dims=("marking",),
        dtype="bool",
        unit="1",
        missing="none",
        about="does the camera rest on this drawn marking",
    ),
    ArrayLayout(
        name="ground_error",
        dims=("ground_y", "ground_x"),
        dtype="float64",
        unit="m",
        missing="nan",
        about="expected distance on the surface between a place and where the camera puts its "
        "true pixel; missing where the camera does not see",
    ),
)
_ABOUT = {
    "point": "names of the clicked points, the most surprising first",
    "point_problem": "for each clicked point that the camera does not rest on, why; else empty",
    "marking": "names of the drawn markings, the worst first",
    "free": "parameters that were solved for",
    "decisions": "what was chosen, and the figures that decided",
    "reasons": "why the camera is weak, or why it is left out; empty where it is neither",
    "add_next": "points and markings whose clicks would lower the expected error most",
    "noise_scale": "factor on the stated noise that is taken; null for a given one",
    "condition": "condition number of the free parameters' correlation; null for a given one",
}

STATIC_CALIBRATION = GroupLayout(
    stage="static_calibration",
    about="One static camera, and, unless it was given, how well it is known and why. A camera "
    "that cannot be calibrated has no arrays, and its reasons say why it is left out.",
    coordinates=_GROUND,
    arrays=(*CAMERA_ARRAYS, *_EVIDENCE),
    labels={**CAMERA_LABELS, "parameter": CAMERA_STEP, "parameter_": CAMERA_STEP},
    attributes={
        "camera_id": "camera of the match",
        "origin": "given, points (stages 1 and 2), lines (stage 3), or none for a camera that is "
        "left out",
        **_ABOUT,
    },
    optional=tuple(array.name for array in (*_GROUND, *CAMERA_ARRAYS, *_EVIDENCE)),
)
