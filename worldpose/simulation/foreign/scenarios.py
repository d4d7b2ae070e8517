"""Scenarios of the second simulator."""

from __future__ import annotations

from typing import Final

from pydantic import Field

from data_contracts.records import Name, Record
from worldpose.simulation.foreign.rigs import Layout
from worldpose.simulation.foreign.trajectories import Role

Range = tuple[float, float]


class ForeignScenario(Record):
    """A kind of match of the second simulator; a seed draws all its parameters."""

    name: Name
    about: str
    """One sentence for a user who chooses."""
    duration: float = Field(default=4.0, gt=0)
    """[s]"""
    cameras: tuple[int, int]
    """Minimum and maximum [1]."""
    people: tuple[int, int]
    """Minimum and maximum [1]."""
    pitch: float = Field(default=1.0, ge=0, le=1)
    """Share of matches on a pitch [1]; the others are in a hall without markings."""
    given: float = Field(default=0.0, ge=0, le=1)
    """Share of matches on a pitch whose cameras are given, with small errors [1]; in a hall they
    always are."""
    layouts: tuple[Layout, ...] = ("bowl", "one-side", "low", "goals", "mixed")
    """Camera layouts on a pitch."""
    roles: tuple[Role, ...] = ("roam", "duel", "stand", "sprint", "cross")
    """Roles, drawn for each person who replays no recording."""
    area: Range = (0.5, 0.9)
    """Part of the pitch's length and width that people use, minimum and maximum [1]."""
    hall: Range = (3.0, 8.0)
    """Side of the space that people in a hall use, minimum and maximum [m]."""
    rates: tuple[float, ...] = (23.976, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0)
    """Frame rates to draw from [1/s]."""
    kinds: tuple[float, float, float] = (0.6, 0.33, 0.07)
    """Shares of men, women and children [1]."""
    gestures: float = Field(default=5.0, ge=0)
    """Gestures of each person per minute [1/min]."""
    unsynchronised: float = Field(default=0.5, ge=0, le=1)
    """Share of matches in which cameras expose up to half a frame before or after the clock [1]."""


FOREIGN_SCENARIOS: Final = {
    scenario.name: scenario
    for scenario in (
        ForeignScenario(
            name="foreign-match",
            about="The second world: 22 people on a pitch, 8 to 18 cameras in a stadium.",
            cameras=(8, 18),
            people=(22, 22),
            given=0.25,
            layouts=("bowl", "mixed"),
            kinds=(0.7, 0.3, 0.0),
        ),
        ForeignScenario(
            name="foreign-lab",
            about="The second world: 1 to 4 people close together, 4 to 8 given cameras, no pitch.",
            cameras=(4, 8),
            people=(1, 4),
            pitch=0.0,
            roles=("cross", "duel", "roam", "stand"),
            hall=(2.5, 6.0),
            kinds=(0.45, 0.4, 0.15),
            gestures=14.0,
        ),
        ForeignScenario(
            name="foreign-two",
            about="The second world: 2 or 3 cameras, a few people, on a pitch or in a hall.",
            cameras=(2, 3),
            people=(1, 8),
            pitch=0.6,
            given=0.4,
            area=(0.15, 0.4),
        ),
        ForeignScenario(
            name="foreign-many",
            about="The second world: 25 to 40 cameras of all kinds around a pitch.",
            cameras=(25, 40),
            people=(10, 25),
            given=0.25,
            layouts=("mixed", "bowl"),
        ),
        ForeignScenario(
            name="foreign-mixed",
            about="The second world: everything drawn, 2 to 40 cameras, 1 to 25 people.",
            cameras=(2, 40),
            people=(1, 25),
            pitch=0.75,
            given=0.35,
            area=(0.15, 0.95),
            hall=(2.5, 9.0),
            gestures=8.0,
        ),
    )
}
"""By name."""
