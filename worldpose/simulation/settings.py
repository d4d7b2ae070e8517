"""Settings of a scenario: people, cameras, annotations, detector errors and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

from pydantic import Field

from data_contracts.pitch import Coordinate, PitchSpec
from data_contracts.records import Count, FramesPerSecond, ImageLength, Name, Positive, Record

Pattern = Literal["plain", "sleeves", "stripes", "hoops", "band", "halves", "sash", "chequers"]

PATTERNS: Final[tuple[Pattern, ...]] = ("plain", *get_args(Pattern))
"""Patterns of shirts; plain shirts are the most common."""


class RenderingSettings(Record):
    """Look of an image."""

    stripes: float = Field(default=0.16, ge=0, le=1)
    """Brightness of a mown stripe against its neighbour [1]; 0.1 to 0.2 in broadcast images."""
    paint: float = Field(default=1.0, ge=0, le=1)
    """Share of the grass that fresh paint hides [1]; 0 = no markings."""
    light: Literal["sun", "floodlights"] = "sun"
    """One hard shadow per person, or four faint ones."""
    stand_shadow: float = Field(default=0.45, ge=0, le=1)
    """Share of the light that a stand blocks on a part of the pitch [1], if the sun shines; 0 = no
    such shadow."""
    fog_per_m: float = Field(default=0.0, ge=0, le=100)
    """Extinction [1/m]; at 0.01 a third of the contrast is left at 100 m."""
    brightness: float = Field(default=1.0, gt=0, le=100)
    """Brightness of the whole image [1]."""
    patterns: tuple[Pattern, ...] = PATTERNS
    """Shirt patterns to draw from."""
    exposure_s: float = Field(default=0.004, ge=0, le=1)
    """Exposure time of every frame [s]: 1/250 s, usual for sport by day."""
    blur_px: float = Field(default=0.7, ge=0, le=100)
    """Standard deviation of the lens's and the codec's blur [px]; a sharp broadcast lens."""
    noise: float = Field(default=2.0, ge=0, le=1000)
    """Standard deviation of the sensor's noise [levels of 255], after a broadcast codec."""


class ObservationNoise(Record):
    """Errors of a 2D pose detector on people who are small in the image.

    Spreads are standard deviations per image axis. Those relative to a person's height in the image
    are for a joint of average difficulty; each joint's own is in proportion to its COCO sigma.
    """

    white: float = Field(default=0.015, ge=0, le=10)
    """Independent error per frame [person height]: typical of heatmap detectors on people of 100
    px; with `slow` it comes to 2 % of the height, 4 cm."""
    slow: float = Field(default=0.015, ge=0, le=10)
    """Error that drifts [person height]: a pose, a shirt or a background misleads for a while, so
    that averaging over frames does not remove it."""
    blur_s: float = Field(default=0.002, ge=0, le=1)
    """Error along a joint's motion in the image, as the time in which the joint moves that far [s]:
    a share of the exposure, 4 to 10 ms under floodlight."""
    shared_bias_m: float = Field(default=0.008, ge=0, le=1)
    """Offset of the detector's joint from the true one along each axis of the body [m]: one vector
    per joint (mirrored on the other side), the same for all people and cameras, because it is the
    joint definition of the training labels. No number of views removes it."""
    own_bias_m: float = Field(default=0.004, ge=0, le=1)
    """The same, drawn for every person [m]: clothes and build."""
    view_bias: float = Field(default=0.005, ge=0, le=1)
    """Bias that varies with the viewing direction of a body, with two periods per turn (front and
    back are alike, sides differ) [person height]; the same for all people and cameras."""
    hidden_joint_missed: float = Field(default=0.4, ge=0, le=1)
    """Share of hidden joints not reported [1]."""
    stolen: float = Field(default=0.1, ge=0, lt=1)
    """Share of hidden joints reported at the same joint of the occluding person [1]."""
    merged: float = Field(default=0.5, ge=0, le=1)
    """Share of those lost persons whose box is merged: the nearer person's box then covers both
    [1]."""
    swapped: float = Field(default=0.02, ge=0, lt=1)
    """Share of person-frames with a left-right swap [1]: a back that looks like a front."""
    displaced: float = Field(default=0.0, ge=0, lt=1)
    """Share of joints with gross errors of 4 to 10 standard deviations, at full confidence [1]; the
    ground truth flags them."""
    dropped_share: float = Field(default=0.0, ge=0, lt=1)
    """Share of frames that a camera lost [1]."""
    false_people: float = Field(default=0.1, ge=0, lt=1)
    """False positives, mean number per frame and camera [1]: shadows, boards."""


Value = Annotated[float, Field(ge=-1e6, le=1e6)]
Range = tuple[Value, Value]


class CrowdSettings(Record):
    """The people and the part of the pitch they move on."""

    people: int = Field(default=5, ge=0, le=1000)
    """Number [1]."""
    movement: Literal["wander", "football", "corner", "crossing"] = "wander"
    """People wander independently within the area, two teams follow a ball, players contest a ball
    in the area, or people run to and fro through its middle; personal space holds for those who
    wander, area and speed for all but teams."""
    officials: int = Field(default=0, ge=0, le=100)
    """Number of people who are a referee and assistants [1], the last ones; only in football."""
    area_center_m: tuple[Coordinate, Coordinate] = (-41.0, 12.0)
    """Middle of the area [m]: off both axes, so that a wrong sign or a flat pitch shows, and at a
    corner of a penalty area, so that cameras have markings to be calibrated from."""
    area_size_m: tuple[Positive, Positive] = (20.0, 14.0)
    """Length along x and y [m]; people turn back towards the middle at its border."""
    speed_m_s: Range = (1.0, 4.0)
    """Slowest and fastest [m/s]: a stroll and a steady run; while below zero, they stand."""
    personal_space_m: float = Field(default=1.5, ge=0, le=1000)
    """Distance below which people avoid others [m]."""
    height_m: Range = (1.70, 1.95)
    """Shortest and tallest body height [m]: professional players."""
    leavers: int = Field(default=0, ge=0, le=1000)
    """Number of people, the first ones, whom no camera sees for 10 s [1]; they come back."""
    substitutes: int = Field(default=0, ge=0, le=500)
    """Number of people after those who leave for good [1], each replaced after 10 s by one of as
    many people after them, whom no camera saw before."""


class Seat(Record):
    """Position and aim of a static camera of a stadium."""

    place_m: tuple[Coordinate, Coordinate, Coordinate]
    """Its center, world [m]."""
    aim_m: tuple[Coordinate, Coordinate]
    """Point of the pitch in the middle of its image [m]."""
    focal_px: float = Field(gt=0, le=1e5)
    """Focal length [px]."""


class RigSettings(Record):
    """Static cameras: in given seats, or in a ring around the people's area off the pitch."""

    cameras: int = Field(default=6, ge=1, le=1000)
    """Number [1]."""
    seats: tuple[Seat, ...] = ()
    """Seats, used in order; none = a ring. Cameras beyond the seats stand in the ring."""
    seat_std_m: float = Field(default=0.5, ge=0, le=100)
    """Variation of seats and aims between seeds, along each axis [m]."""
    image_size_px: tuple[ImageLength, ImageLength] = (1920, 1080)
    """Width and height [px]."""
    distance_m: Range = (6.0, 30.0)
    """Distance of the ring from the pitch border [m]: stands of a stadium."""
    height_m: Range = (10.0, 20.0)
    """Height of the ring above the pitch [m]: roofs and upper tiers."""
    person_height_px: float = Field(default=115.0, gt=0, le=100000)
    """Height of a person of 1.8 m in the area's middle in the ring's images [px]; sets the focal
    length."""
    clock_std_frames: float = Field(default=0.0, ge=0, le=100)
    """Standard deviation of a camera's clock offset from match.yaml [frame]; unknown to the
    factory."""


class BroadcastSettings(Record):
    """The moving camera: a tripod on the main stand and an operator.

    Ranges are those of 20 released clips of the 2022 World Cup (K, k, R, t of WorldPose).
    """

    height_m: Range = (12.0, 19.0)
    """Above the pitch [m]."""
    aside_m: float = Field(default=0.3, ge=0, le=100)
    """Maximum distance off the halfway line [m]."""
    focal_px: Range = (2900.0, 6200.0)
    """Widest and closest zoom within a clip, in pixels of an image 1920 wide; all clips together
    span 2400 to 7100."""
    zoom_period_s: Range = (10.0, 24.0)
    """Time from wide to close and back [s]; the focal length then changes by at most about 20 px
    per frame."""
    sweep_m: float = Field(default=0.0, ge=0, le=100)
    """Amplitude along x of a steady pan back and forth around the action [m]."""
    fps: FramesPerSecond | None = None
    """[1/s]; None = the scenario's."""
    image_size_px: tuple[ImageLength, ImageLength] | None = None
    """Width and height; None = those of the static cameras."""


class CalibrationErrors(Record):
    """Errors of the static cameras in calibration.toml against the true ones.

    Spreads are standard deviations. All zero = exact. Careful calibration from pitch markings
    leaves about a third of a milliradian and a tenth of a metre.
    """

    rotation_rad: float = Field(default=0.0, ge=0, le=100)
    """About each axis of the camera [rad]."""
    center_m: float = Field(default=0.0, ge=0, le=100)
    """Along each axis of the world [m]; the rotation then keeps the image centre on the same point
    60 m away, as a fit to markings does."""
    focal: float = Field(default=0.0, ge=0, le=100)
    """Relative error of the focal length [1]."""
    bad_cameras: int = Field(default=0, ge=0, le=100)
    """Number of cameras whose errors are `bad_factor` times as large [1]."""
    bad_factor: float = Field(default=10.0, ge=1, le=1000)
    """[1]"""


class ClickSettings(Record):
    """Model of a person's clicks on named pitch points in the image of a static camera."""

    points: tuple[Count, Count] = (8, 12)
    """Minimum and maximum in one camera [1], limited by the number of visible points."""
    noise_px: float = Field(default=1.0, ge=0, le=100)
    """Error of a click, standard deviation along each image axis [px]: a click on the middle of a
    painted corner at full resolution."""
    clustered: float = Field(default=0.0, ge=0, le=1)
    """Share of cameras in which all points lie within `window` [1]: where one part of the image
    holds most of the markings, as behind a goal, people look no farther."""
    window: float = Field(default=0.34, gt=0, le=1)
    """Width of the window, as a share of the image width [1]."""
    clustered_points: tuple[Count, Count] = (5, 7)
    """Minimum and maximum number of points per such camera [1]."""
    wrong: float = Field(default=0.2, ge=0, le=1)
    """Share of cameras with one wrong click [1]: every second of them a point with another's name,
    the other a slip."""
    enough: int = Field(default=8, ge=0, le=1000)
    """If fewer points are visible, lines and arcs are drawn, too [1]."""


class Scenario(Record):
    """One synthetic match: everything but the seed."""

    name: Name
    about: str
    """One sentence for a user who chooses."""
    duration: float = Field(gt=0, le=100_000)
    """[s]"""
    fps: FramesPerSecond = 25.0
    """[1/s]"""
    crowd: CrowdSettings = CrowdSettings()
    rig: RigSettings = RigSettings()
    broadcast: tuple[BroadcastSettings, ...] = ()
    """The moving cameras."""
    key_frames: int = Field(default=0, ge=0, le=100)
    """Number of annotated broadcast frames [1]; if there are any, the video is written."""
    calibration: CalibrationErrors = CalibrationErrors()
    noise: ObservationNoise = ObservationNoise()
    clicks: ClickSettings = ClickSettings()
    look: RenderingSettings = RenderingSettings()
    """Look of rendered footage."""
    pitch: PitchSpec = PitchSpec()
    """The pitch as painted."""
    survey_error: float = Field(default=0.006, ge=0, le=1)
    """Error of the points in pitch.json, standard deviation along each axis [m], together about 1
    cm: a total station measures to millimetres, but the middle of a painted corner is ambiguous."""


@dataclass(frozen=True)
class MatchOptions:
    """Changes of a simulated match to its scenario, and the files to write."""

    duration: float | None = None
    """[s], instead of the scenario's."""
    cameras: int | None = None
    """Number of static cameras, instead of the scenario's."""
    players: int | None = None
    """Number of people, instead of the scenario's."""
    trajectories: Path | None = None
    """Tracking data (`read_trajectories`) that drives the people instead; the clip ends with it."""
    mocap: Path | None = None
    """Motion capture (`worldpose.simulation.recordings.read_clip`) that one person plays."""
    calibrated: bool = False
    """Write the true static cameras as calibration.toml; without, the folder has such a file only
    if the scenario has calibration errors."""
    stills: bool = True
    """Add one image of every static camera, about a second each."""
    video: bool = True
    """If the scenario has key frames, add the broadcast camera's video, about 0.1 s per frame,
    annotated key frames, and bodies from a simulated monocular method (`estimates/`)."""
    render: bool = False
    """Film all cameras, and write no detections, so that pixels are the only input."""
    masks: bool = False
    """Add person masks of all filmed frames."""

    def name(self, scenario: str, seed: int, *replayed: str) -> str:
        """Return the id of a match: scenario, seed and its changes, as by replayed recordings."""
        sizes = ((self.duration, "s"), (self.cameras, "cameras"), (self.players, "players"))
        changes = [f"{value:g}{unit}" for value, unit in sizes if value is not None]
        changes += [*replayed, *["calibrated"] * self.calibrated]
        return "-".join([scenario, str(seed), *changes])
