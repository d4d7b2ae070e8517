"""pitch.json: surveyed markings of one stadium (C1)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from data_contracts.records import CONTRACT_VERSION, Name, Record

Coordinate = Annotated[float, Field(ge=-300, le=300)]
"""[m], world."""
Point = tuple[Coordinate, Coordinate, Coordinate] | tuple[Coordinate, Coordinate]
"""x, y and z, which contains the crown; without z, the point lies on the crowned surface."""
Angle = Annotated[float, Field(ge=-13, le=13)]
"""[rad], at most two turns."""


class LineSpec(Record):
    """A straight line between two named points."""

    start: Name
    end: Name
    painted: bool = True
    """False for the edge of a mowing stripe and the like: it can be drawn, and no white paint is
    expected there."""


class StripesSpec(Record):
    """Mowing stripes across the pitch: their edges are lines that can be clicked and drawn.

    Edges are counted from either goal line to the halfway line: edge 1 of the left half has the
    name `stripe_left_1` and the ends `stripe_left_1_near` and `stripe_left_1_far` on the touch
    lines.
    """

    spacing: float = Field(ge=1, le=50)
    """Distance between edges [m]: 5.5 where three stripes fill a penalty area."""
    first: float | None = Field(default=None, gt=0, le=50)
    """Distance of edge 1 from its goal line [m]; absent = the spacing."""


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
    end_fall: float = Field(default=0.0, ge=-1, le=1)
    """Height of the halfway line above the goal lines [m]: a pitch that falls to its ends."""
    points: dict[Name, Point] = {}
    """Surveyed positions that replace the nominal ones, by name; world [m]."""
    lines: dict[Name, LineSpec] = {}
    """Further lines, or replacements of standard ones, by name."""
    arcs: dict[Name, ArcSpec] = {}
    """Further arcs, or replacements of standard ones, by name."""
    stripes: StripesSpec | None = None
    """Mowing stripes, if their edges are clicked."""
