"""pitch.json: template, dimensions and surveyed markings of one pitch or court."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from data_contracts.records import CONTRACT_VERSION, Name, Record

Coordinate = Annotated[float, Field(ge=-300, le=300)]
"""[m], world."""
Point = tuple[Coordinate, Coordinate, Coordinate] | tuple[Coordinate, Coordinate]
"""x, y and z, which contains the crown; without z, the point lies on the crowned surface."""
Angle = Annotated[float, Field(ge=-13, le=13)]
"""[rad], at most two turns."""


TemplateName = Literal["football", "football_9v9", "futsal", "handball", "basketball", "volleyball"]
"""Games whose markings have names and places."""
_FOOTBALL: Final = {
    **{"length": 105.0, "width": 68.0, "crown": 0.2},
    **{"penalty_area_depth": 16.5, "penalty_area_width": 40.32, "penalty_mark_distance": 11.0},
    **{"goal_area_depth": 5.5, "goal_area_width": 18.32, "goal_width": 7.32, "goal_height": 2.44},
    **{"center_circle_radius": 9.15, "penalty_arc_radius": 9.15, "corner_arc_radius": 1.0},
}
_HALL: Final = {"length": 40.0, "width": 20.0, "crown": 0.0}
_HALL_GOAL: Final = {"goal_width": 3.0, "goal_height": 2.0}
TEMPLATES: Final[Mapping[TemplateName, Mapping[str, float]]] = {
    "football": _FOOTBALL,
    # The Football Association's: 80 x 50 yards, an area of 13 x 32, goals of 16 x 7 feet.
    "football_9v9": {
        **_FOOTBALL,
        **{"length": 73.15, "width": 45.72, "crown": 0.13},
        **{"penalty_area_depth": 11.89, "penalty_area_width": 29.26, "penalty_mark_distance": 8.23},
        **{"goal_area_depth": 0.0, "goal_area_width": 0.0, "goal_width": 4.88, "goal_height": 2.13},
        **{"center_circle_radius": 6.4, "penalty_arc_radius": 0.0},
    },
    "futsal": {
        **_HALL,
        **{"penalty_area_radius": 6.0, "penalty_area_front": 3.16, "penalty_mark_distance": 6.0},
        **{"second_penalty_mark_distance": 10.0, **_HALL_GOAL},
        **{"center_circle_radius": 3.0, "corner_arc_radius": 0.25},
    },
    "handball": {
        **_HALL,
        **{"goal_area_radius": 6.0, "goal_area_front": 3.0, **_HALL_GOAL},
        **{"free_throw_radius": 9.0, "seven_meter_distance": 7.0, "seven_meter_width": 1.0},
        "center_circle_radius": 0.0,
    },
    "basketball": {
        **{"length": 28.0, "width": 15.0, "crown": 0.0, "center_circle_radius": 1.8},
        **{"restricted_area_depth": 5.8, "restricted_area_width": 4.9, "free_throw_radius": 1.8},
        **{"three_point_radius": 6.75, "three_point_margin": 0.9, "no_charge_radius": 1.25},
        **{"basket_distance": 1.575, "backboard_distance": 1.2, "backboard_width": 1.8},
        **{"backboard_bottom": 2.9, "backboard_top": 3.95},
    },
    "volleyball": {
        **{"length": 18.0, "width": 9.0, "crown": 0.0},
        **{"attack_line_distance": 3.0, "net_height": 2.43},
    },
}
"""Dimensions of each template [m]; `crown` 0 = a level floor. A marking with a dimension of 0 is
not there."""
_KEYS: Final = ("length", "width", "crown")
"""Dimensions that have keys of their own in pitch.json."""


def _nominal(name: str) -> Callable[[dict[str, Any]], float]:
    """Return what gives a field a dimension of the template as default."""

    def default(given: dict[str, Any]) -> float:
        return TEMPLATES[given.get("template", "football")][name]

    return default


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
    template: TemplateName = "football"
    """The game: it names the markings, and has a dimension for each key that is absent."""
    length: float = Field(default_factory=_nominal("length"), gt=0, le=200)
    """Between the centres of the goal lines [m]: for football 80 to 130, unless `any_size`."""
    width: float = Field(default_factory=_nominal("width"), gt=0, le=200)
    """Between the centres of the touch lines [m]: for football 40 to 100, unless `any_size`."""
    dimensions: dict[str, Annotated[float, Field(ge=0, le=100)]] = {}
    """Dimensions of the markings that differ from the template's, by name [m]; 0 = not there."""
    any_size: bool = False
    """The pitch is not of the Laws: its size, and the places of points that have names of the Laws,
    are not checked."""
    crown: float = Field(default_factory=_nominal("crown"), ge=0, le=1)
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

    @model_validator(mode="after")
    def _check_dimensions(self) -> Self:
        known = [name for name in TEMPLATES[self.template] if name not in _KEYS]
        wrong = sorted(self.dimensions.keys() - known)
        if wrong:
            raise ValueError(
                f"dimensions names {', '.join(wrong)}; a {self.template} pitch has "
                f"{', '.join(known)}, and length, width and crown are keys beside dimensions"
            )
        return self

    @property
    def is_level(self) -> bool:
        """Whether the game is played on a level floor."""
        return TEMPLATES[self.template]["crown"] == 0.0

    @property
    def sizes(self) -> dict[str, float]:
        """Dimensions of the markings [m] by name."""
        own = {name: size for name, size in TEMPLATES[self.template].items() if name not in _KEYS}
        return own | self.dimensions
