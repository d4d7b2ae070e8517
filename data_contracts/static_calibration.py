"""What people click in a static camera's picture, and the result of stage `static_calibration`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import CONTRACT_VERSION, Name, Record

Pixel = tuple[float, float]
"""x, y [px]; (0, 0) is the centre of the top-left pixel."""


class ClickedPoint(Record):
    """A named point of the pitch template where a person saw it."""

    name: Name
    """Point of the template, such as `corner_left_near`."""
    xy: Pixel


class DrawnMarking(Record):
    """Points along a line or arc of the pitch template; where along it they lie is not known."""

    name: Name
    """Line or arc of the template, such as `touch_line_near` or `center_circle`."""
    xy: tuple[Pixel, ...] = Field(min_length=1)


class ClickedMarkings(Record):
    """annotations/static_calibration/<camera>.json: everything clicked for one camera."""

    contract: Literal[1] = CONTRACT_VERSION
    points: tuple[ClickedPoint, ...] = ()
    drawn: tuple[DrawnMarking, ...] = ()
