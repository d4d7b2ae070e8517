"""Scenarios: people, place, cameras and detector quality of each synthetic match."""

from __future__ import annotations

from typing import Final

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
    Seat(place=(13.0, 60.0, 22.0), aim=(19.2, 11.4), focal=2254.0),
    Seat(place=(76.0, 14.0, 19.0), aim=(41.2, -16.0), focal=2228.0),
    Seat(place=(38.0, 57.0, 16.0), aim=(33.5, 17.7), focal=2096.0),
    Seat(place=(66.0, 48.0, 26.0), aim=(34.6, -3.4), focal=2387.0),
)


def _mirrored(seat: Seat, x: float, y: float) -> Seat:
    return Seat(
        place=(x * seat.place[0], y * seat.place[1], seat.place[2]),
        aim=(x * seat.aim[0], y * seat.aim[1]),
        focal=seat.focal,
    )


STADIUM_SEATS: Final = (
    *(
        _mirrored(seat, x, y)
        for seat in _QUARTER
        for x, y in ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0))
    ),
    Seat(place=(0.0, 62.0, 25.0), aim=(0.0, 0.0), focal=2100.0),
    Seat(place=(0.0, -62.0, 25.0), aim=(0.0, 0.0), focal=2100.0),
)
"""18 seats in stands of 13 to 27 m behind the lines and 16 to 26 m up; the first 16 see every
point of the pitch from four sides or more with people 40 to 150 px tall."""

CORNER_SEATS: Final = (
    Seat(place=(66.0, 48.0, 26.0), aim=(48.0, 30.0), focal=3300.0),
    Seat(place=(38.0, 57.0, 16.0), aim=(46.6, 32.3), focal=4000.0),
    Seat(place=(-76.0, 14.0, 19.0), aim=(-49.2, 29.5), focal=3400.0),
    Seat(place=(-38.0, -57.0, 16.0), aim=(-34.0, -27.0), focal=3800.0),
    Seat(place=(13.0, 60.0, 22.0), aim=(39.8, 28.7), focal=4100.0),
    Seat(place=(66.0, -48.0, 26.0), aim=(43.0, -27.0), focal=3300.0),
)
"""Six of these stands, with lenses so long that an image shows one or two corners of markings."""

_TINY: Final = Scenario(
    name="tiny",
    about="5 people walk and run for 4 s before 6 static cameras and the broadcast camera: "
    "seconds to reconstruct.",
    duration=4.0,
    rig=RigSettings(person_height=95.0),
    broadcast=BroadcastSettings(),
)
_STADIUM: Final = RigSettings(cameras=16, seats=STADIUM_SEATS)
_TEAMS: Final = CrowdSettings(
    people=25, movement="football", officials=3, area_center=(0.0, 0.0), area_size=(105.0, 68.0)
)
_MATCH: Final = Scenario(
    name="match",
    about="4 s of play: 22 players, 3 officials, 16 static cameras around the pitch and the "
    "broadcast camera.",
    duration=4.0,
    fps=50.0,
    crowd=_TEAMS,
    rig=_STADIUM,
    broadcast=BroadcastSettings(),
    noise=ObservationNoise(),
    look=RenderingSettings(bystanders=8),
)
_BOX: Final = CrowdSettings(
    people=6,
    area_center=(-44.0, 2.0),
    area_size=(8.0, 9.0),
    speed=(-0.8, 4.5),
    personal_space=0.9,
)
_TRIAL: Final = ObservationNoise(
    white=0.026,
    slow=0.028,
    blur=0.004,
    shared_bias=0.032,
    own_bias=0.009,
    view_bias=0.013,
    hidden_joint_missed=0.35,
    stolen=0.2,
    swapped=0.03,
)
_SPRAWL: Final = RigSettings(cameras=10, person_height=105.0, height=(10.0, 28.0))


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
            broadcast=BroadcastSettings(),
            noise=_TRIAL,
            # A line is 7 px wide here: a click on its edge instead of its middle is 3.5 px off.
            clicks=ClickSettings(clustered=1.0, clustered_points=(5, 5), noise=3.0),
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
                area_center=(40.0, -9.0),
                area_size=(9.0, 9.0),
                speed=(2.0, 6.0),
            ),
            rig=RigSettings(cameras=10, person_height=95.0, height=(7.0, 14.0)),
            broadcast=BroadcastSettings(),
        ),
        Scenario(
            name="corner-kick",
            about="18 players jostle before a goal, as at a corner kick; most occlude each other.",
            duration=4.0,
            fps=50.0,
            crowd=CrowdSettings(
                people=18,
                movement="corner",
                area_center=(45.0, 0.0),
                area_size=(11.0, 15.0),
                speed=(0.0, 5.0),
            ),
            rig=_STADIUM,
            broadcast=BroadcastSettings(),
            # Detectors mix up limbs in crowds.
            noise=ObservationNoise(stolen=0.25),
        ),
        _variant(
            "hard",
            "The match with 8 % of keypoints far off, clocks half a frame apart, lost frames, "
            "an uncertain calibration and one camera ten times worse.",
            _MATCH,
            rig=_STADIUM.model_copy(update={"clock_spread": 0.5}),
            noise=_TRIAL.model_copy(
                update={"displaced": 0.08, "dropped_frames": 0.01, "false_people": 0.4}
            ),
            calibration=CalibrationErrors(
                rotation=0.0003, center=0.1, focal=0.001, bad_cameras=1, bad_factor=10.0
            ),
        ),
        Scenario(
            name="sparse-corner",
            about="Static calibration alone: 6 cameras that see one or two corners of markings.",
            duration=1.0,
            crowd=CrowdSettings(people=4, area_center=(44.0, 24.0), area_size=(14.0, 14.0)),
            rig=RigSettings(cameras=6, seats=CORNER_SEATS, seat_spread=0.3),
            # A wrong point among one or two cannot be detected.
            clicks=ClickSettings(wrong=0.0),
        ),
        Scenario(
            name="fog",
            about="To be rendered: 12 people, small, in fog under floodlights, in patterned kits.",
            duration=4.0,
            crowd=CrowdSettings(people=12, area_center=(38.0, -6.0), area_size=(26.0, 24.0)),
            rig=RigSettings(person_height=55.0),
            broadcast=BroadcastSettings(),
            look=RenderingSettings(
                light="floodlights",
                fog=0.012,
                exposure=0.85,
                patterns=("halves", "sash", "chequers"),
                blur=1.0,
                noise=4.0,
            ),
        ),
        _variant("long", "The match for two minutes.", _MATCH, duration=120.0),
        _variant(
            "broadcast-pan",
            "20 s of the match, the broadcast camera panning to and fro.",
            _MATCH,
            duration=20.0,
            broadcast=BroadcastSettings(sweep=22.0, focal=(3300.0, 4200.0)),
            key_frames=4,
        ),
        _variant(
            "broadcast-zoom",
            "20 s of the match, the broadcast camera zooming from its widest to its closest.",
            _MATCH,
            duration=20.0,
            broadcast=BroadcastSettings(focal=(2500.0, 7000.0), zoom_period=(14.0, 20.0)),
            key_frames=4,
        ),
    )
}
"""All scenarios by name; a new one is a new `Scenario` in this tuple."""
