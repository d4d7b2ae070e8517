"""What a scenario is made of: people, cameras, how well they are known and how people are found."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from data_contracts.pitch import Coordinate, PitchSpec
from data_contracts.records import Count, FramesPerSecond, ImageLength, Name, Positive, Record
from worldpose.synthetic.looks import RenderingSettings
from worldpose.synthetic.noise import ObservationNoise

Value = Annotated[float, Field(ge=-1e6, le=1e6)]
Range = tuple[Value, Value]


class ActionRates(Record):
    """How often people do something besides going somewhere.

    Shares are of the ball's touches, of which there are 18 a minute. Rates and what was measured
    in matches: docs/synthetic.md.
    """

    headers: float = Field(default=0.12, ge=0, le=1)
    """Share of balls that two opponents jump for [1]: 9 headers a player and match."""
    tackles: float = Field(default=0.06, ge=0, le=1)
    """Share of balls that an opponent slides into [1]."""
    tripped: float = Field(default=0.5, ge=0, le=1)
    """Share of those slid into who fall [1]; the others hurdle the leg."""
    shots: float = Field(default=0.12, ge=0, le=1)
    """Share of balls within 28 m of a goal that are shot at it [1]."""
    jumps: float = Field(default=3.0, ge=0, le=1000)
    """Of everybody who wanders [1/min]: as in a penalty area."""
    falls: float = Field(default=0.4, ge=0, le=100)
    """Of everybody who wanders [1/min]."""
    standing_about: float = Field(default=0.7, ge=0, le=1)
    """Share of the time of standing, rests under 1.6 s left out, in which people shift their
    weight, look around or rest their hands on their hips [1]."""

    @classmethod
    def none(cls) -> ActionRates:
        """Nobody does anything but go and stand."""
        return cls(headers=0, tackles=0, shots=0, jumps=0, falls=0, standing_about=0)


class CrowdSettings(Record):
    """The people and the part of the pitch they move on."""

    people: int = Field(default=5, ge=0, le=1000)
    """How many [1]."""
    movement: Literal["wander", "football", "corner", "crossing"] = "wander"
    """Each for himself within the area, two teams that follow a ball, a contest for it in the
    area, or runs to and fro through its middle; personal space holds for those who wander, area and
    speed for all but teams."""
    officials: int = Field(default=0, ge=0, le=100)
    """How many of them are a referee and assistants [1], the last ones; only in football."""
    area_center: tuple[Coordinate, Coordinate] = (-41.0, 12.0)
    """Middle of the area [m]: off both axes, so that a wrong sign or a flat pitch shows, and at a
    corner of a penalty area, so that cameras have markings to be calibrated from."""
    area_size: tuple[Positive, Positive] = (20.0, 14.0)
    """Length along x and y [m]; people turn back towards the middle at its border."""
    speed: Range = (1.0, 4.0)
    """Slowest and fastest [m/s]: a stroll and a steady run; while below zero, they stand."""
    personal_space: float = Field(default=1.5, ge=0, le=1000)
    """Distance under which others are avoided [m]."""
    height: Range = (1.70, 1.95)
    """Shortest and tallest body height [m]: professional players."""
    actions: ActionRates = ActionRates()
    """What people do besides."""


class Seat(Record):
    """Where a static camera of a stadium stands and what it looks at."""

    place: tuple[Coordinate, Coordinate, Coordinate]
    """Its center, world [m]."""
    aim: tuple[Coordinate, Coordinate]
    """Point of the pitch in the middle of its picture [m]."""
    focal: float = Field(gt=0, le=1e5)
    """Focal length [px]."""


class RigSettings(Record):
    """Static cameras: in given seats, or in a ring around the people's area off the pitch."""

    cameras: int = Field(default=6, ge=1, le=1000)
    """How many [1]."""
    seats: tuple[Seat, ...] = ()
    """Seats, taken in order; none = a ring. Cameras beyond the seats stand in the ring."""
    seat_spread: float = Field(default=0.5, ge=0, le=100)
    """By how much seats and aims differ between seeds, along each axis [m]."""
    image_size: tuple[ImageLength, ImageLength] = (1920, 1080)
    """Width and height [px] (C8)."""
    distance: Range = (6.0, 30.0)
    """Of the ring from where the pitch ends [m]: stands of a stadium."""
    height: Range = (10.0, 20.0)
    """Of the ring above the pitch [m]: roofs and upper tiers."""
    person_height: float = Field(default=115.0, gt=0, le=100000)
    """Height of a person of 1.8 m in the area's middle in the ring's pictures [px]; sets the
    focal length."""
    clock_spread: float = Field(default=0.0, ge=0, le=100)
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
    aside: float = Field(default=0.3, ge=0, le=100)
    """Most it stands beside the halfway line [m]."""
    focal: Range = (2900.0, 6200.0)
    """Widest and closest zoom within a clip [px]; the clips together span 2400 to 7100."""
    zoom_period: Range = (10.0, 24.0)
    """Time from wide to close and back [s]; the focal length then changes by at most about
    20 px a frame."""
    lag: float = Field(default=0.5, gt=0, le=100)
    """Time in which the operator follows the action [s]: a reaction, and a damped head."""
    sway: float = Field(default=4.0, ge=0, le=1000)
    """How far the aim drifts off the action along x [m]: operators lead and trail play."""
    sweep: float = Field(default=0.0, ge=0, le=100)
    """Amplitude along x of a steady pan back and forth beside the action [m]."""


class CalibrationErrors(Record):
    """How the static cameras of calibration.toml differ from the true ones.

    Spreads are standard deviations. All zero = exact. About a third of a milliradian and a
    tenth of a metre is what careful calibration from pitch markings leaves.
    """

    rotation: float = Field(default=0.0, ge=0, le=100)
    """About each axis of the camera [rad]."""
    center: float = Field(default=0.0, ge=0, le=100)
    """Along each axis of the world [m]; the rotation then keeps the middle of the picture on the
    same point 60 m away, as a fit to markings does."""
    focal: float = Field(default=0.0, ge=0, le=100)
    """Of the focal length, relative [1]."""
    bad_cameras: int = Field(default=0, ge=0, le=100)
    """How many cameras err `bad_factor` times as much [1]."""
    bad_factor: float = Field(default=10.0, ge=1, le=1000)
    """[1]"""


class ClickSettings(Record):
    """How a person clicks named pitch points in the picture of a static camera."""

    points: tuple[Count, Count] = (8, 12)
    """Fewest and most in one camera [1], as far as there are that many to see."""
    noise: float = Field(default=1.0, ge=0, le=100)
    """Error of a click, standard deviation along each image axis [px]: a click on the middle of a
    painted corner at the picture's own size."""
    clustered: float = Field(default=0.0, ge=0, le=1)
    """Share of cameras in which all points lie within `window` [1]: where one part of the picture
    holds most of the markings, as behind a goal, people look no farther."""
    window: float = Field(default=0.34, gt=0, le=1)
    """Of the picture's width [1]."""
    clustered_points: tuple[Count, Count] = (5, 7)
    """Fewest and most points in such a camera [1]."""
    wrong: float = Field(default=0.2, ge=0, le=1)
    """Share of cameras with one wrong click [1]: every second of them a point named for another,
    the other a slip."""
    wrong_distance: Range = (20.0, 60.0)
    """How far a slip goes [px]."""
    enough: int = Field(default=8, ge=0, le=1000)
    """Where fewer points can be seen, lines and arcs are drawn too [1]."""
    drawn_points: int = Field(default=8, ge=2, le=1000)
    """Most points along a drawn marking [1]; they err as the others do."""


class Scenario(Record):
    """One synthetic match: everything but the seed."""

    name: Name
    about: str
    """One sentence for people who choose."""
    duration: float = Field(gt=0, le=100_000)
    """[s]"""
    fps: FramesPerSecond = 25.0
    """[1/s]"""
    crowd: CrowdSettings = CrowdSettings()
    rig: RigSettings = RigSettings()
    broadcast: BroadcastSettings | None = None
    """None = no moving camera."""
    key_frames: int = Field(default=0, ge=0, le=100)
    """Frames of the broadcast camera that are clicked [1]; with some, its video is written."""
    calibration: CalibrationErrors = CalibrationErrors()
    noise: ObservationNoise = ObservationNoise()
    clicks: ClickSettings = ClickSettings()
    look: RenderingSettings = RenderingSettings()
    """Of rendered footage."""
    pitch: PitchSpec = PitchSpec()
    """As it is painted."""
    survey_error: float = Field(default=0.006, ge=0, le=1)
    """Of the points in pitch.json, standard deviation along each axis [m], together about 1 cm: a
    total station knows millimetres, what is the middle of a painted corner does not."""
