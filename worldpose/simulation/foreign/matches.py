"""Matches of the second simulator: people, rig, detections, user inputs, and match folders."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from pydantic import Field
from scipy.interpolate import make_interp_spline

from data_contracts.arrays import Floats
from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from data_contracts.records import Name, Record
from data_contracts.static_calibration import ClickedMarkings
from worldpose.formats.archives import write_archive
from worldpose.formats.calibration_files import write_calibration_toml
from worldpose.formats.challenge import write_static_camera
from worldpose.formats.joints_file import JointTracks, write_joints
from worldpose.ingest.writing import MatchAnnotations, write_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.foreign.detectors import (
    PROFILES,
    Report,
    defined_joints,
    detect_people,
    draw_detector,
)
from worldpose.simulation.foreign.gait import draw_gestures, draw_manner, walk_posture
from worldpose.simulation.foreign.recordings import (
    Recordings,
    Tracking,
    play_motion,
    read_recordings,
)
from worldpose.simulation.foreign.rigs import (
    Layout,
    Pitch,
    RigCamera,
    click_points,
    draw_pitch,
    draw_rig,
    measure_camera,
    view_people,
    visible_points,
)
from worldpose.simulation.foreign.skeletons import (
    STATURE,
    Ground,
    Kind,
    Skeleton,
    draw_skeleton,
    place_joints,
)
from worldpose.simulation.foreign.trajectories import LEAD, Role, Trajectory, follow_tracks, wander

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


MOTION_RATE: Final = 100.0
"""Minimum rate of the motion's computation [1/s], a multiple of the frame rate."""
REPLAYED: Final = 0.3
"""Share of people who replay motion capture if there is any [1]."""
TRACKED: Final = 0.75
"""Share of matches on a pitch whose people follow tracking data if there is any [1]."""
_OFFSETS: Final = ((0, 1), (0, 1), (-40, 41), (0, 90000))
"""Ranges of a camera's frame number at the match's first frame, one of which is drawn [frame]."""
ENOUGH_POINTS: Final = 6
"""Minimum number of named points in the image of a camera to be calibrated from clicks [1]."""


@dataclass(frozen=True, eq=False)
class Person:
    """One person: bones, and joints over time.

    Attributes:
        skeleton: the bones.
        joints: (samples, 17, 3) [m], world, at `ForeignScene.times`.
        motion: its origin.
    """

    skeleton: Skeleton
    joints: Floats
    motion: str


@dataclass(frozen=True, eq=False)
class ForeignScene:
    """A match of the second simulator in memory.

    Attributes:
        fps: frame rate [1/s].
        truth: anatomical joints; `views` counts the cameras that see the joint.
        defined: joints as the detector defines them.
        people: bones, motion and joints of each person.
        cameras: true cameras, by id.
        given: cameras of calibration.toml, by id; empty if they are to be clicked.
        clicked: clicks, by id of a camera without calibration.
        misnamed: name of the point under a wrongly named click, by camera and wrong name.
        reports: detections, by camera.
        offsets: offsets of the cameras' frame numbers, as stated [frame].
        clock_offsets: clock offset of a camera's exposure, by id [frame].
        pitch: None in a hall.
        record: all other drawn values, for world.json.
    """

    fps: float
    truth: JointTracks
    defined: Floats
    people: tuple[Person, ...]
    cameras: dict[str, RigCamera]
    given: dict[str, CameraCalibration]
    clicked: dict[str, ClickedMarkings]
    misnamed: dict[str, dict[str, str]]
    reports: dict[str, Report]
    offsets: dict[str, int]
    clock_offsets: dict[str, float]
    pitch: Pitch | None
    record: dict[str, Any]


def simulate_foreign_scene(
    scenario: ForeignScenario,
    seed: int,
    *,
    duration: float | None = None,
    cameras: int | None = None,
    people: int | None = None,
    recordings: Recordings | None = None,
    calibrated: bool = False,
) -> ForeignScene:
    """Return a match of the second simulator; the same arguments give the same numbers.

    Args:
        scenario: ranges.
        seed: seed from 0.
        duration: [s], instead of the scenario's.
        cameras: number of them, instead of the scenario's.
        people: number of them, instead of the scenario's.
        recordings: motion capture and tracking data to replay; None = all motion is computed.
        calibrated: return the exact cameras.
    """
    streams = np.random.SeedSequence([seed, *scenario.name.encode()]).spawn(6)
    rng = np.random.default_rng(streams[0])
    on_pitch = bool(rng.random() < scenario.pitch)
    pitch = draw_pitch(rng) if on_pitch else None
    given = bool(rng.random() < scenario.given) or not on_pitch or calibrated
    fps = float(rng.choice(scenario.rates))
    count = int(rng.integers(scenario.people[0], scenario.people[1] + 1))
    mounted = int(rng.integers(scenario.cameras[0], scenario.cameras[1] + 1))
    unsynchronised = bool(rng.random() < scenario.unsynchronised)
    drawn = scenario.layouts[rng.integers(len(scenario.layouts))]
    layout: Layout = drawn if on_pitch else "hall"
    side = rng.uniform(*scenario.hall, 2)
    part = rng.uniform(*scenario.area, 2)
    count, mounted = people or count, cameras or mounted

    frames = round((duration or scenario.duration) * fps)
    multiple = int(np.ceil(MOTION_RATE / fps))
    step = 1.0 / (fps * multiple)
    lead = round(LEAD / step)
    ticks = np.arange((frames - 1) * multiple + 1 + 2 * lead) - lead
    times = np.asarray(ticks * step, dtype=np.float64)
    if pitch is None:
        center, size, painted = np.zeros(2), side, None
    else:
        painted = PitchTemplate.from_spec(pitch.painted)
        field = np.array([pitch.painted.length, pitch.painted.width])
        size = part * field
        center = 0.5 * (1.0 - part) * field * rng.uniform(-1.0, 1.0, 2)
    ground: Ground = _flat_ground if painted is None else painted.height
    persons = _draw_people(
        scenario, count, times, _Space(center, size, pitch, ground), recordings, streams[1]
    )
    on_frames = lead + multiple * np.arange(frames)
    joints = np.stack([person.joints[on_frames] for person in persons], axis=1)

    # Heads, hips and feet at intervals.
    action = joints[:: max(1, frames // 15)][:, :, [0, 11, 15]].reshape(-1, 3)
    rng = np.random.default_rng(streams[2])
    space = (
        (pitch.painted.length, pitch.painted.width) if pitch else (float(size[0]), float(size[1]))
    )
    rig = draw_rig(mounted, layout, space, action, rng)
    if painted is not None and not given:
        rig = _remount_cameras(rig, painted, layout, space, action, rng)
    named = {f"view{index:02d}": camera for index, camera in enumerate(rig)}

    rng = np.random.default_rng(streams[3])
    profile = PROFILES[list(PROFILES)[rng.integers(len(PROFILES))]]
    detector = draw_detector(profile, rng)
    personal = rng.standard_normal((count, 17, 3))
    statures = np.array([person.skeleton.stature for person in persons])
    motion = make_interp_spline(times, np.stack([p.joints for p in persons], axis=1), k=3)
    reports, clock_offsets, offsets, pillars = {}, {}, {}, {}
    views = np.zeros(joints.shape[:3], np.int64)
    for (name, camera), own in zip(named.items(), streams[4].spawn(mounted), strict=True):
        rng = np.random.default_rng(own)
        clock_offsets[name] = float(rng.uniform(-0.5, 0.5)) if unsynchronised else 0.0
        offsets[name] = int(rng.integers(*_OFFSETS[rng.integers(len(_OFFSETS))]))
        width = float(camera.camera.image_size[0])
        pillar = None
        if rng.random() < 0.12:
            left = rng.uniform(0.0, 0.95) * width
            pillar = (left, left + rng.uniform(0.02, 0.06) * width)
            pillars[name] = pillar
        lost = float(rng.choice([0.0, 0.0, 0.0, 0.01, 0.03]))
        then = joints
        if clock_offsets[name]:
            then = np.asarray(motion(times[on_frames] + clock_offsets[name] / fps))
        view = view_people(camera, then, statures, pillar)
        taken = camera.project(defined_joints(then, detector, personal))
        reports[name] = detect_people(
            detector, view, taken, camera.camera.image_size, fps, lost, rng
        )
        views += view.seen

    rng = np.random.default_rng(streams[5])
    accuracy = 0.0 if calibrated else float(rng.uniform(0.3, 2.0)) * (0.2 if pitch is None else 1.0)
    calibrations, clicked, misnamed = {}, {}, {}
    for name, camera in named.items():
        if given:
            found = measure_camera(camera.camera, accuracy, rng)
            calibrations[name] = found.to_calibration(name)
        elif painted is not None:
            clicked[name], misnamed[name] = click_points(camera, painted, rng)
    record = {
        "scenario": scenario.name,
        "layout": layout,
        "pitch": None if pitch is None else pitch.how,
        "calibration": f"given, accuracy {accuracy:.2f}" if given else "clicked",
        "detector": detector.profile.model_dump(mode="json"),
        "definition_m": detector.definition.round(5).tolist(),
        "people": [{"motion": person.motion, **person.skeleton.record()} for person in persons],
        "cameras": {
            name: {
                "lens": camera.lens,
                "mounting": camera.mounting,
                "beyond": list(camera.beyond),
                "pillar": pillars.get(name),
            }
            for name, camera in named.items()
        },
    }
    truth = JointTracks(np.arange(frames), np.arange(count), joints, views=views)
    return ForeignScene(
        fps=fps,
        truth=truth,
        defined=defined_joints(joints, detector, personal),
        people=tuple(persons),
        cameras=named,
        given=calibrations,
        clicked=clicked,
        misnamed=misnamed,
        reports=reports,
        offsets=offsets,
        clock_offsets=clock_offsets,
        pitch=pitch,
        record=record,
    )


@dataclass(frozen=True, eq=False)
class _Space:
    """Where people move.

    Attributes:
        center: (2,) center of their area [m].
        size: (2,) size of their area [m].
        pitch: None in a hall.
        ground: height of the ground.
    """

    center: Floats
    size: Floats
    pitch: Pitch | None
    ground: Ground


def _draw_people(
    scenario: ForeignScenario,
    count: int,
    times: Floats,
    space: _Space,
    recordings: Recordings | None,
    stream: np.random.SeedSequence,
) -> list[Person]:
    """Return people with their motion: replayed, tracked, or by social forces."""
    center, size, pitch, ground = space.center, space.size, space.pitch, space.ground
    common, *own = stream.spawn(1 + count)
    rng = np.random.default_rng(common)
    rngs = [np.random.default_rng(one) for one in own]
    kinds = cast("list[Kind]", list(STATURE))
    skeletons = [draw_skeleton(kinds[rng.choice(3, p=scenario.kinds)], one) for one in rngs]
    known: dict[int, Trajectory] = {}
    replayed = {}
    tracking = None if pitch is None else _draw_tracking(recordings, times, rng)
    if tracking is not None and pitch is not None:
        players = rng.permutation(len(tracking.players))[:count]
        scale = np.array([pitch.painted.length / 105.0, pitch.painted.width / 68.0])
        begin = rng.uniform(0.0, max(tracking.clock[-1] - times[-1] + LEAD, 0.0))
        clock = tracking.clock - begin
        for person, player in enumerate(players):
            source = f"tracking {tracking.name}, player {tracking.players[player]}, {begin:.2f} s"
            xy = tracking.xy[:, player]
            known[person] = follow_tracks(times, clock, xy, scale, source)
    if recordings is not None and recordings.motions:
        for person in np.flatnonzero(rng.random(count) < REPLAYED).tolist():
            one = recordings.motions[rng.integers(len(recordings.motions))]
            place = center + size * rng.uniform(-0.4, 0.4, 2)
            if person in known:
                place = known[person].root[len(times) // 2]
            known[person], replayed[person] = play_motion(
                one, skeletons[person], times, place, rngs[person]
            )
    free = [person for person in range(count) if person not in known]
    roles: list[Role] = [scenario.roles[rng.integers(len(scenario.roles))] for _ in free]
    trajectories = wander(times, roles, center, size, list(known.values()), rng)
    known |= dict(zip(free, trajectories, strict=True))
    fps = 1.0 / (times[1] - times[0])
    people = []
    for person, (skeleton, rng) in enumerate(zip(skeletons, rngs, strict=True)):
        trajectory, posture = known[person], replayed.get(person)
        if posture is None:
            manner = draw_manner(rng)
            gestures = draw_gestures(scenario.gestures, times[0], times[-1], rng)
            posture = walk_posture(
                times, trajectory.root, trajectory.heading, skeleton.leg, manner, gestures, rng
            )
        joints = place_joints(skeleton, posture, trajectory.root, trajectory.heading, fps, ground)
        people.append(Person(skeleton, joints, trajectory.source))
    return people


def _draw_tracking(
    recordings: Recordings | None, times: Floats, rng: np.random.Generator
) -> Tracking | None:
    """Return tracking data long enough for the clip, in most matches if there is any."""
    if recordings is None:
        return None
    needed = times[-1] - LEAD
    long = [track for track in recordings.tracks if track.clock[-1] >= needed]
    if not long or rng.random() >= TRACKED:
        return None
    return long[rng.integers(len(long))]


def _remount_cameras(
    rig: list[RigCamera],
    pitch: PitchTemplate,
    layout: Layout,
    space: tuple[float, float],
    action: Floats,
    rng: np.random.Generator,
) -> list[RigCamera]:
    """Return the rig, with new cameras for those that see too few markings."""
    mounted = []
    for camera in rig:
        for _ in range(12):
            if len(visible_points(camera, pitch)) >= ENOUGH_POINTS:
                break
            camera = draw_rig(1, layout, space, action, rng)[0]
        mounted.append(camera)
    return mounted


def _flat_ground(x: Floats, y: Floats) -> Floats:
    """Return the ground of a hall."""
    return np.asarray(0.0 * x + 0.0 * y)


CLIP_ID: Final = "clip"


def simulate_foreign_match(
    scenario: ForeignScenario,
    seed: int,
    out: Path,
    *,
    duration: float | None = None,
    cameras: int | None = None,
    people: int | None = None,
    recordings: Path | None = None,
    calibrated: bool = False,
) -> MatchSpec:
    """Write a match folder of the second simulator; the same arguments give the same bytes.

    Under reference/ are joints.npz, cameras/<camera>.npz, calibration.toml, identities/,
    pitch.json, clocks.json and clicks.json as in other simulated matches, and

    - defined_joints.npz: joints as the detector defines them, as a joints file;
    - world.json: motion and bones of every person, detector, lenses and mountings.

    Args:
        scenario: ranges.
        seed: seed from 0.
        out: absent or an empty folder; the write is atomic.
        duration: [s], instead of the scenario's.
        cameras: number of them, instead of the scenario's.
        people: number of them, instead of the scenario's.
        recordings: folder with npz files of motion capture and tracking data (`read_recordings`).
        calibrated: write the exact cameras.

    Returns:
        The match's match.yaml.

    Raises:
        InputError: `out` holds files, or the recordings cannot be used.
    """
    replayed = None if recordings is None else read_recordings(recordings)
    scene = simulate_foreign_scene(
        scenario,
        seed,
        duration=duration,
        cameras=cameras,
        people=people,
        recordings=replayed,
        calibrated=calibrated,
    )
    changes = {
        f"{duration:g}s" if duration else "": duration,
        f"{cameras}cameras": cameras,
        f"{people}players": people,
        "recordings": recordings,
        "calibrated": calibrated,
    }
    parts = [scenario.name, str(seed), *(text for text, made in changes.items() if made)]
    spec = MatchSpec(
        match_id="-".join(parts),
        fps=scene.fps,
        cameras=tuple(
            CameraSpec(
                id=name,
                width=int(camera.camera.image_size[0]),
                height=int(camera.camera.image_size[1]),
                offset_frames=scene.offsets[name],
            )
            for name, camera in scene.cameras.items()
        ),
        clips=(ClipSpec(id=CLIP_ID, frame_count=len(scene.truth.frames)),),
        pitch="none" if scene.pitch is None else None,
    )
    write_match(
        out,
        spec,
        calibrations=scene.given,
        observations={
            name: _number_frames(report.observations, scene.offsets[name])
            for name, report in scene.reports.items()
        },
        pitch=None if scene.pitch is None else scene.pitch.stated,
        annotations=MatchAnnotations(clicked=scene.clicked),
        further=lambda folder: _write_reference(folder / "reference", scene),
    )
    return spec


def _number_frames(observations: KeypointDetections, offset: int) -> KeypointDetections:
    """Return the observations with the camera's own frame numbers."""
    return replace(observations, frame=observations.frame + offset)


def _write_reference(folder: Path, scene: ForeignScene) -> None:
    write_joints(folder / "joints.npz", scene.truth)
    truth = scene.truth
    defined = JointTracks(truth.frames, truth.person_ids, scene.defined, views=truth.views)
    write_joints(folder / "defined_joints.npz", defined)
    records = {name: each.camera.to_calibration(name) for name, each in scene.cameras.items()}
    for name, record in records.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", record)
    write_calibration_toml(folder / "calibration.toml", records)
    for name, report in scene.reports.items():
        write_archive(
            folder / "identities" / f"{name}.npz",
            {
                "frame": report.observations.frame + scene.offsets[name],
                "person": report.person,
                "displaced": report.displaced.astype(np.uint8),
            },
        )
    if scene.pitch is not None:
        _write_json(folder / "pitch.json", scene.pitch.painted.model_dump(mode="json"))
        wrong = {name: {"wrong": each} for name, each in scene.misnamed.items()}
        _write_json(folder / "clicks.json", wrong)
    _write_json(folder / "clocks.json", scene.clock_offsets)
    _write_json(folder / "world.json", scene.record)


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
