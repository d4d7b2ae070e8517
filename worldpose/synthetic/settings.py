"""What a scenario is made of: people, cameras, how well they are known and how people are found."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.pitch import PitchSpec
from data_contracts.records import Name, Record
from worldpose.synthetic.noise import ObservationNoise

Range = tuple[float, float]


class CrowdSettings(Record):
    """The people and the part of the pitch they move on."""

    people: int = Field(default=5, ge=0)
    """How many [1]."""
    movement: Literal["wander", "football"] = "wander"
    """Each for himself within the area, or two teams that follow a ball; area, speed and
    personal space hold for those who wander."""
    officials: int = Field(default=0, ge=0)
    """How many of them are a referee and assistants [1], the last ones; only in football."""
    area_center: tuple[float, float] = (-20.0, 14.0)
    """Middle of the area [m]: off both axes, so that a wrong sign or a flat pitch shows."""
    area_size: tuple[float, float] = (20.0, 14.0)
    """Length along x and y [m]; people turn back towards the middle at its border."""
    speed: Range = (1.0, 4.0)
    """Slowest and fastest [m/s]: a stroll and a steady run; while below zero, they stand."""
    personal_space: float = Field(default=1.5, ge=0)
    """Distance under which others are avoided [m]."""
    height: Range = (1.70, 1.95)
    """Shortest and tallest body height [m]: professional players."""


class Seat(Record):
    """Where a static camera of a stadium stands and what it looks at."""

    place: tuple[float, float, float]
    """Its center, world [m]."""
    aim: tuple[float, float]
    """Point of the pitch in the middle of its picture [m]."""
    focal: float = Field(gt=0)
    """Focal length [px]."""


class RigSettings(Record):
    """Static cameras: in given seats, or in a ring around the people's area off the pitch."""

    cameras: int = Field(default=6, ge=1)
    """How many [1]."""
    seats: tuple[Seat, ...] = ()
    """Seats, taken in order; none = a ring. Cameras beyond the seats stand in the ring."""
    seat_spread: float = Field(default=0.5, ge=0)
    """By how much seats and aims differ between seeds, along each axis [m]."""
    image_size: tuple[int, int] = (1920, 1080)
    """Width and height [px] (C8)."""
    distance: Range = (6.0, 30.0)
    """Of the ring from where the pitch ends [m]: stands of a stadium."""
    height: Range = (10.0, 20.0)
    """Of the ring above the pitch [m]: roofs and upper tiers."""
    person_height: float = Field(default=115.0, gt=0)
    """Height of a person of 1.8 m in the area's middle in the ring's pictures [px]; sets the
    focal length."""
    clock_spread: float = Field(default=0.0, ge=0)
    """Standard deviation of how much later than match.yaml says a camera's frames are [frame];
    unknown to the factory."""


class BroadcastSettings(Record):
    """The moving camera: a tripod on the main stand and an operator.

    Ranges are those of 20 released clips of the 2022 World Cup (K, k, R, t of WorldPose).
    """

    setback: Range = (67.0, 88.0)
    """From the long axis of the pitch [m], at negative y."""
    height: Range = (12.0, 19.0)
    """Above the pitch [m]."""
    aside: float = Field(default=0.3, ge=0)
    """Most it stands beside the halfway line [m]."""
    focal: Range = (2900.0, 6200.0)
    """Widest and closest zoom within a clip [px]; the clips together span 2400 to 7100."""
    zoom_period: Range = (10.0, 24.0)
    """Time from wide to close and back [s]; the focal length then changes by at most about
    20 px a frame."""
    lag: float = Field(default=0.5, gt=0)
    """Time in which the operator follows the action [s]: a reaction, and a damped head."""
    sway: float = Field(default=4.0, ge=0)
    """How far the aim drifts off the action along x [m]: operators lead and trail play."""
    sweep: float = Field(default=0.0, ge=0)
    """Amplitude along x of a steady pan back and forth beside the action [m]."""


class CalibrationErrors(Record):
    """How the static cameras of calibration.toml differ from the true ones.

    Spreads are standard deviations. All zero = exact. About a third of a milliradian and a
    tenth of a metre is what careful calibration from pitch markings leaves.
    """

    rotation: float = Field(default=0.0, ge=0)
    """About each axis of the camera [rad]."""
    center: float = Field(default=0.0, ge=0)
    """Along each axis of the world [m]; the rotation then keeps the middle of the picture on the
    same point 60 m away, as a fit to markings does."""
    focal: float = Field(default=0.0, ge=0)
    """Of the focal length, relative [1]."""
    bad_cameras: int = Field(default=0, ge=0)
    """How many cameras err `bad_factor` times as much [1]."""
    bad_factor: float = Field(default=10.0, ge=1)
    """[1]"""


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
    broadcast: BroadcastSettings | None = None
    """None = no moving camera."""
    calibration: CalibrationErrors = CalibrationErrors()
    noise: ObservationNoise = ObservationNoise()
    pitch: PitchSpec = PitchSpec()
