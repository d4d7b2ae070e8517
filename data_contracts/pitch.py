"""pitch.json: surveyed markings of one stadium (C1)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from data_contracts.records import CONTRACT_VERSION, Name, Record

Coordinate = Annotated[float, Field(ge=-300, le=300)]
"""[m], world."""
Point = tuple[Coordinate, Coordinate, Coordinate]
Angle = Annotated[float, Field(ge=-13, le=13)]
"""[rad], at most two turns."""


class LineSpec(Record):
    """A straight painted line between two named points."""

    start: Name
    end: Name


class ArcSpec(Record):
    """A circular painted arc in plan view; its height follows the crown.

    Angles are measured from the x axis towards the y axis; the arc runs from `start_angle` to
    `end_angle`, and a full circle spans 2 pi.
    """

    center: Name
    radius: float = Field(gt=0, le=100)
    """[m]"""
    start_angle: Angle
    """[rad]"""
    end_angle: Angle
    """[rad]"""


class PitchSpec(Record):
    """pitch.json; absent in a match folder = the standard 105 x 68 m pitch with a 0.2 m crown."""

    contract: Literal[1] = CONTRACT_VERSION
    length: float = Field(default=105.0, gt=0, le=200)
    """Between the centres of the goal lines [m]: 80 to 130, unless `any_size`."""
    width: float = Field(default=68.0, gt=0, le=200)
    """Between the centres of the touch lines [m]: 40 to 100, unless `any_size`."""
    any_size: bool = False
    """The pitch is not of the Laws: its size, and the places of points that have names of the Laws,
    are not checked."""
    crown: float = Field(default=0.2, ge=0, le=1)
    """Height of the long axis above the touch lines [m]."""
    points: dict[Name, Point] = {}
    """Surveyed positions that replace the nominal ones, by name; world [m]."""
    lines: dict[Name, LineSpec] = {}
    """Further lines, or replacements of standard ones, by name."""
    arcs: dict[Name, ArcSpec] = {}
    """Further arcs, or replacements of standard ones, by name."""
