"""Scenarios: what happens, where, who films it and how well people are found."""

from __future__ import annotations

from typing import Final

from pydantic import Field

from data_contracts.pitch import PitchSpec
from data_contracts.records import Name, Record
from worldpose.synthetic.noise import ObservationNoise

Range = tuple[float, float]


class CrowdSettings(Record):
    """The people and the part of the pitch they move on."""

    people: int = Field(default=5, ge=0)
    """How many [1]."""
    area_center: tuple[float, float] = (-20.0, 14.0)
    """Middle of the area [m]: off both axes, so that a wrong sign or a flat pitch shows."""
    area_size: tuple[float, float] = (20.0, 14.0)
    """Length along x and y [m]; people turn back towards the middle at its border."""
    speed: Range = (1.0, 4.0)
    """Slowest and fastest [m/s]: a stroll and a steady run."""
    height: Range = (1.70, 1.95)
    """Shortest and tallest body height [m]: professional players."""


class RigSettings(Record):
    """Static cameras that stand around the area and look at it."""

    cameras: int = Field(default=6, ge=1)
    """How many [1]."""
    image_size: tuple[int, int] = (1920, 1080)
    """Width and height [px] (C8)."""
    distance: Range = (30.0, 60.0)
    """Along the ground from the area's middle [m]: stands of a stadium."""
    height: Range = (10.0, 20.0)
    """Above the pitch [m]: roofs and upper tiers."""
    person_height: float = Field(default=115.0, gt=0)
    """Height of a person of 1.8 m in the area's middle [px]; sets the focal length. Over the
    area people then are 80 to 200 px tall."""


class Scenario(Record):
    """One synthetic match: everything but the seed."""

    name: Name
    about: str
    """One sentence for people who choose."""
    duration: float = Field(gt=0)
    """[s]"""
    fps: float = Field(default=25.0, gt=0)
    """[1/s]"""
    crowd: CrowdSettings = CrowdSettings()
    rig: RigSettings = RigSettings()
    noise: ObservationNoise = ObservationNoise()
    pitch: PitchSpec = PitchSpec()


SCENARIOS: Final = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="tiny",
            about="5 people walk and run for 4 s before 6 static cameras: seconds to reconstruct.",
            duration=4.0,
        ),
    )
}
"""All scenarios by name; a new one is a new `Scenario` in this tuple."""
