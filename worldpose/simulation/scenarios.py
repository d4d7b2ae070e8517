"""Scenarios: people, place, cameras and detector quality of each synthetic match."""

from __future__ import annotations

from typing import Final

from data_contracts.pitch import PitchSpec
from worldpose.simulation.settings import (
    BroadcastSettings,
    CalibrationErrors,
    ClickSettings,
    CrowdSettings,
    ObservationNoise,
    RenderingSettings,
    RigSettings,
    Scenario,
    Seat,
)

_QUARTER: Final = (
    # Of a camera in the quarter x > 0, y > 0: position, aim, focal length.
    Seat(place_m=(13.0, 60.0, 22.0), aim_m=(19.2, 11.4), focal_px=2254.0),
    Seat(place_m=(76.0, 14.0, 19.0), aim_m=(41.2, -16.0), focal_px=2228.0),
    Seat(place_m=(38.0, 57.0, 16.0), aim_m=(33.5, 17.7), focal_px=2096.0),
    Seat(place_m=(66.0, 48.0, 26.0), aim_m=(34.6, -3.4), focal_px=2387.0),
)


def _mirror_seat(seat: Seat, x: float, y: float) -> Seat:
    return Seat(
        place_m=(x * seat.place_m[0], y * seat.place_m[1], seat.place_m[2]),
        aim_m=(x * seat.aim_m[0], y * seat.aim_m[1]),
        focal_px=seat.focal_px,
    )


STADIUM_SEATS: Final = (
    *(
        _mirror_seat(seat, x, y)
        for seat in _QUARTER
        for x, y in ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0))
    ),
    Seat(place_m=(0.0, 62.0, 25.0), aim_m=(0.0, 0.0), focal_px=2100.0),
    Seat(place_m=(0.0, -62.0, 25.0), aim_m=(0.0, 0.0), focal_px=2100.0),
)
"""18 seats in stands of 13 to 27 m behind the lines and 16 to 26 m up; the first 16 see every
point of the pitch from four sides or more with people 40 to 150 px tall."""

CORNER_SEATS: Final = (
    Seat(place_m=(66.0, 48.0, 26.0), aim_m=(48.0, 30.0), focal_px=3300.0),
    Seat(place_m=(38.0, 57.0, 16.0), aim_m=(46.6, 32.3), focal_px=4000.0),
    Seat(place_m=(-76.0, 14.0, 19.0), aim_m=(-49.2, 29.5), focal_px=3400.0),
    Seat(place_m=(-38.0, -57.0, 16.0), aim_m=(-34.0, -27.0), focal_px=3800.0),
    Seat(place_m=(13.0, 60.0, 22.0), aim_m=(39.8, 28.7), focal_px=4100.0),
    Seat(place_m=(66.0, -48.0, 26.0), aim_m=(43.0, -27.0), focal_px=3300.0),
)
"""Six of these stands, with lenses so long that an image shows one or two corners of markings."""

_TINY: Final = Scenario(
    name="tiny",
    about="5 people walk and run for 4 s before 6 static cameras and the broadcast camera: "
    "seconds to reconstruct.",
    duration=4.0,
    rig=RigSettings(person_height_px=95.0),
    broadcast=(BroadcastSettings(),),
)
_STADIUM: Final = RigSettings(cameras=16, seats=STADIUM_SEATS)
_TEAMS: Final = CrowdSettings(
    people=25, movement="football", officials=3, area_center_m=(0.0, 0.0), area_size_m=(105.0, 68.0)
)
_MATCH: Final = Scenario(
    name="match",
    about="4 s of play: 22 players, 3 officials, 16 static cameras around the pitch and the "
    "broadcast camera.",
    duration=4.0,
    fps=50.0,
    crowd=_TEAMS,
    rig=_STADIUM,
    broadcast=(BroadcastSettings(),),
    noise=ObservationNoise(),
)
_BOX: Final = CrowdSettings(
    people=6,
    area_center_m=(-44.0, 2.0),
    area_size_m=(8.0, 9.0),
    speed_m_s=(-0.8, 4.5),
    personal_space_m=0.9,
)
_TRIAL: Final = ObservationNoise(
    white=0.026,
    slow=0.028,
    blur_s=0.004,
    shared_bias_m=0.032,
    own_bias_m=0.009,
    view_bias=0.013,
    hidden_joint_missed=0.35,
    stolen=0.2,
    swapped=0.03,
)
_SPRAWL: Final = RigSettings(cameras=10, person_height_px=105.0, height_m=(10.0, 28.0))


def _variant(name: str, about: str, base: Scenario, **changes: object) -> Scenario:
    return base.model_copy(update={"name": name, "about": about, **changes})


SCENARIOS: Final = {
    scenario.name: scenario
    for scenario in (
        _TINY,
        _variant(
            "tiny-broadcast",
            "tiny, with key frames clicked in the broadcast camera's video.",
            _TINY,
            key_frames=4,
        ),
        _MATCH,
        Scenario(
            name="penalty-box",
            about="The paper's trial: 6 players in close contact for 2 s before 10 cameras, with "
            "a detector as rough as its errors.",
            duration=2.0,
            fps=50.0,
            crowd=_BOX,
            rig=_SPRAWL,
            broadcast=(BroadcastSettings(),),
            noise=_TRIAL,
            # A line is 7 px wide here: a click on its edge instead of its middle is 3.5 px off.
            clicks=ClickSettings(clustered=1.0, clustered_points=(5, 5), noise_px=3.0),
        ),
        Scenario(
            name="crossing",
            about="12 people run through each other on 9 x 9 m, half of them shoulder to shoulder; "
            "their identities are ambiguous when they separate.",
            duration=4.0,
            fps=50.0,
            crowd=CrowdSettings(
                people=12,
                movement="crossing",
                area_center_m=(40.0, -9.0),
                area_size_m=(9.0, 9.0),
                speed_m_s=(2.0, 6.0),
            ),
            rig=RigSettings(cameras=10, person_height_px=95.0, height_m=(7.0, 14.0)),
            broadcast=(BroadcastSettings(),),
        ),
        Scenario(
            name="corner-kick",
            about="18 players jostle before a goal, as at a corner kick; most occlude each other.",
            duration=4.0,
            fps=50.0,
            crowd=CrowdSettings(
                people=18,
                movement="corner",
                area_center_m=(45.0, 0.0),
                area_size_m=(11.0, 15.0),
                speed_m_s=(0.0, 5.0),
            ),
            rig=_STADIUM,
            broadcast=(BroadcastSettings(),),
            # Detectors mix up limbs in crowds.
            noise=ObservationNoise(stolen=0.25),
        ),
        _variant(
            "hard",
            "The match with 8 % of keypoints far off, clocks half a frame apart, lost frames, "
            "an uncertain calibration and one camera ten times worse.",
            _MATCH,
            rig=_STADIUM.model_copy(update={"clock_std_frames": 0.5}),
            noise=_TRIAL.model_copy(
                update={"displaced": 0.08, "dropped_share": 0.01, "false_people": 0.4}
            ),
            calibration=CalibrationErrors(
                rotation_rad=0.0003, center_m=0.1, focal=0.001, bad_cameras=1, bad_factor=10.0
            ),
        ),
        Scenario(
            name="sparse-corner",
            about="Static calibration alone: 6 cameras that see one or two corners of markings.",
            duration=1.0,
            crowd=CrowdSettings(people=4, area_center_m=(44.0, 24.0), area_size_m=(14.0, 14.0)),
            rig=RigSettings(cameras=6, seats=CORNER_SEATS, seat_std_m=0.3),
            # A wrong point among one or two cannot be detected.
            clicks=ClickSettings(wrong=0.0),
        ),
        Scenario(
            name="fog",
            about="To be rendered: 12 people, small, in fog under floodlights, in patterned kits.",
            duration=4.0,
            crowd=CrowdSettings(people=12, area_center_m=(38.0, -6.0), area_size_m=(26.0, 24.0)),
            rig=RigSettings(person_height_px=55.0),
            broadcast=(BroadcastSettings(),),
            look=RenderingSettings(
                light="floodlights",
                fog_per_m=0.012,
                brightness=0.85,
                patterns=("halves", "sash", "chequers"),
                blur_px=1.0,
                noise=4.0,
            ),
        ),
        _variant("long", "The match for two minutes.", _MATCH, duration=120.0),
        _variant(
            "youth-9v9",
            "tiny on a youth pitch of 73 x 46 m, with smaller areas and goals.",
            _TINY,
            pitch=PitchSpec(template="football_9v9"),
            crowd=CrowdSettings(area_center_m=(-25.0, 9.0), area_size_m=(16.0, 12.0)),
        ),
        _variant(
            "basketball",
            "tiny on a basketball court: cameras 3 to 8 m up in a hall.",
            _TINY,
            pitch=PitchSpec(template="basketball"),
            crowd=CrowdSettings(area_center_m=(-6.0, 1.0), area_size_m=(12.0, 10.0)),
            rig=RigSettings(distance_m=(2.0, 6.0), height_m=(3.0, 8.0), person_height_px=200.0),
            broadcast=(),
        ),
        Scenario(
            name="leaving",
            about="14 people in one part of the pitch for 40 s; two leave for 10 s and come back, "
            "and one is replaced by another.",
            duration=40.0,
            crowd=CrowdSettings(people=14, leavers=2, substitutes=1),
            rig=RigSettings(cameras=8, person_height_px=95.0),
        ),
        _variant(
            "broadcast-pan",
            "20 s of the match, the broadcast camera panning to and fro.",
            _MATCH,
            duration=20.0,
            broadcast=(BroadcastSettings(sweep_m=22.0, focal_px=(3300.0, 4200.0)),),
            key_frames=4,
        ),
        _variant(
            "broadcast-zoom",
            "20 s of the match, the broadcast camera zooming from its widest to its closest.",
            _MATCH,
            duration=20.0,
            broadcast=(BroadcastSettings(focal_px=(2500.0, 7000.0), zoom_period_s=(14.0, 20.0)),),
            key_frames=4,
        ),
        _variant(
            "three-broadcast",
            "6 s of the match with three broadcast cameras, one at 59.94 frames per second, one of "
            "4K.",
            _MATCH,
            duration=6.0,
            broadcast=(
                BroadcastSettings(),
                BroadcastSettings(fps=59.94, aside_m=12.0, focal_px=(3500.0, 5500.0)),
                BroadcastSettings(
                    image_size_px=(3840, 2160), aside_m=20.0, focal_px=(2500.0, 3600.0)
                ),
            ),
            key_frames=4,
        ),
    )
}
"""All scenarios by name; a new one is a new `Scenario` in this tuple."""
