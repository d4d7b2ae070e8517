"""Matches of the second simulator: people, rig, detections, user inputs, and match folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.interpolate import make_interp_spline

from data_contracts.arrays import Floats, Integers
from data_contracts.cameras import CameraCalibration
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.formats.joints_file import JointTracks
from worldpose.ingest.writing import MatchAnnotations, write_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.foreign.detectors import PROFILES, Detector, Filming
from worldpose.simulation.foreign.gait import walk_posture
from worldpose.simulation.foreign.recordings import Recordings, play_motion, read_recordings
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
from worldpose.simulation.foreign.scenarios import ForeignScenario
from worldpose.simulation.foreign.skeletons import (
    STATURE,
    Ground,
    Kind,
    Skeleton,
    draw_skeleton,
    place_joints,
)
from worldpose.simulation.foreign.trajectories import (
    LEAD,
    TRACK_SMOOTHING,
    Role,
    Trajectory,
    wander,
)
from worldpose.simulation.recorded_files import follow_track
from worldpose.simulation.reference import CLIP_ID, Report, write_reference
from worldpose.simulation.settings import MatchOptions


@dataclass(frozen=True, eq=False)
class Person:
    """One person: bones, joints (samples, 17, 3) [m] of the motion's times, and its origin."""

    skeleton: Skeleton
    joints: Floats
    motion: str


@dataclass(frozen=True, eq=False)
class ForeignScene:
    """A match of the second simulator in memory; what is by camera has its id.

    Attributes:
        fps: frame rate [1/s].
        truth: anatomical joints; `views` counts the cameras that see the joint.
        defined: joints as the detector defines them.
        people: bones, motion and joints of each person.
        cameras: true cameras.
        given: cameras of calibration.toml; empty if they are to be clicked.
        clicked: clicks of cameras without calibration.
        misnamed: name of the point under a wrongly named click, by camera and wrong name.
        reports: detections.
        offsets: offsets of the cameras' frame numbers, as stated [frame].
        clock_offsets: clock offset of a camera's exposure [frame].
        pitch: None in a hall.
        record: all other drawn values, for world.json.
    """

    fps: float
    truth: JointTracks
    defined: Floats
    people: Sequence[Person]
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
    options: MatchOptions = MatchOptions(),  # noqa: B008
    recordings: Recordings | None = None,
) -> ForeignScene:
    """Return a match, the same for the same arguments; the options of footage do not matter."""
    streams = np.random.SeedSequence([seed, *scenario.name.encode()]).spawn(6)
    rng = np.random.default_rng(streams[0])
    on_pitch = bool(rng.random() < scenario.pitch)
    pitch = draw_pitch(rng) if on_pitch else None
    given = bool(rng.random() < scenario.given) or not on_pitch or options.calibrated
    fps = float(rng.choice(scenario.rates))
    count = int(rng.integers(scenario.people[0], scenario.people[1] + 1))
    mounted = int(rng.integers(scenario.cameras[0], scenario.cameras[1] + 1))
    unsynchronised = bool(rng.random() < scenario.unsynchronised)
    drawn = scenario.layouts[rng.integers(len(scenario.layouts))]
    layout: Layout = drawn if on_pitch else "hall"
    side = rng.uniform(*scenario.hall, 2)
    part = rng.uniform(*scenario.area, 2)
    count, mounted = options.players or count, options.cameras or mounted

    frames = round((options.duration or scenario.duration) * fps)
    times, on_frames = _motion_times(frames, fps)
    center, size, painted = np.zeros(2), side, None
    ground: Ground = _flat_ground
    if pitch is not None:
        painted = PitchTemplate.from_spec(pitch.painted)
        field = np.array([pitch.painted.length, pitch.painted.width])
        size = part * field
        center = 0.5 * (1.0 - part) * field * rng.uniform(-1.0, 1.0, 2)
        ground = painted.height
    persons = _draw_people(
        scenario, count, times, (center, size), pitch, ground, recordings, streams[1]
    )
    joints = np.stack([person.joints[on_frames] for person in persons], axis=1)

    rng = np.random.default_rng(streams[2])
    space = (
        (pitch.painted.length, pitch.painted.width) if pitch else (float(size[0]), float(size[1]))
    )
    clickable = None if given else painted
    named = _mount_cameras(mounted, layout, space, joints, clickable, rng)

    rng = np.random.default_rng(streams[3])
    detector = Detector.draw(PROFILES[list(PROFILES)[rng.integers(len(PROFILES))]], rng)
    personal = rng.standard_normal((count, 17, 3))
    statures = np.array([person.skeleton.stature for person in persons])
    motion = make_interp_spline(times, np.stack([p.joints for p in persons], axis=1), k=3)
    clock_offsets, offsets, pillars = {}, {}, {}
    reports = dict[str, Report]()
    views = np.zeros(joints.shape[:3], np.int64)
    # Ranges of a camera's frame number at the match's first frame, one of which is drawn [frame].
    offset_ranges = ((0, 1), (0, 1), (-40, 41), (0, 90000))
    for (name, camera), own in zip(named.items(), streams[4].spawn(mounted), strict=True):
        rng = np.random.default_rng(own)
        clock_offsets[name] = float(rng.uniform(-0.5, 0.5)) if unsynchronised else 0.0
        offsets[name] = int(rng.integers(*offset_ranges[rng.integers(len(offset_ranges))]))
        pillars[name] = _draw_pillar(float(camera.camera.image_size[0]), rng)
        lost = float(rng.choice([0.0, 0.0, 0.0, 0.01, 0.03]))
        then = joints
        if clock_offsets[name]:
            then = np.asarray(motion(times[on_frames] + clock_offsets[name] / fps))
        view = view_people(camera, then, statures, pillars[name])
        taken = camera.project(detector.define(then, personal))
        filming = Filming(detector, view, camera.camera.image_size, fps, rng)
        reports[name] = filming.detect(taken, lost)
        views += view.seen

    rng = np.random.default_rng(streams[5])
    accuracy = (
        0.0
        if options.calibrated
        else float(rng.uniform(0.3, 2.0)) * (0.2 if pitch is None else 1.0)
    )
    calibrations, clicked, misnamed = {}, {}, {}
    for name, camera in named.items():
        if given:
            found = measure_camera(camera.camera, accuracy, rng)
            calibrations[name] = found.to_calibration(name)
        elif painted is not None:
            clicked[name], misnamed[name] = click_points(camera, painted, rng)
    return ForeignScene(
        fps=fps,
        truth=JointTracks(np.arange(frames), np.arange(count), joints, views=views),
        defined=detector.define(joints, personal),
        people=persons,
        cameras=named,
        given=calibrations,
        clicked=clicked,
        misnamed=misnamed,
        reports=reports,
        offsets=offsets,
        clock_offsets=clock_offsets,
        pitch=pitch,
        record={
            "scenario": scenario.name,
            "layout": layout,
            "pitch": None if pitch is None else pitch.how,
            "calibration": f"given, accuracy {accuracy:.2f}" if given else "clicked",
            "detector": detector.profile.model_dump(mode="json"),
            "definition_m": detector.definition.round(5).tolist(),
            "people": [{"motion": each.motion, **asdict(each.skeleton)} for each in persons],
            "cameras": {
                name: {
                    "lens": camera.lens,
                    "mounting": camera.mounting,
                    "beyond": list(camera.beyond),
                    "pillar": pillars[name],
                }
                for name, camera in named.items()
            },
        },
    )


def _motion_times(frames: int, fps: float) -> tuple[Floats, Integers]:
    """Return the times of the motion [s], and which of them are frames."""
    multiple = int(np.ceil(100.0 / fps))  # the motion is computed 100 times a second or more
    step = 1.0 / (fps * multiple)
    lead = round(LEAD / step)
    ticks = np.arange((frames - 1) * multiple + 1 + 2 * lead) - lead
    return np.asarray(ticks * step, dtype=np.float64), lead + multiple * np.arange(frames)


def _draw_pillar(width: float, rng: np.random.Generator) -> tuple[float, float] | None:
    """Return left and right border of a pillar before some cameras [px]."""
    if rng.random() >= 0.12:
        return None
    left = rng.uniform(0.0, 0.95) * width
    return left, left + rng.uniform(0.02, 0.06) * width


def _draw_people(
    scenario: ForeignScenario,
    count: int,
    times: Floats,
    area: tuple[Floats, Floats],
    pitch: Pitch | None,
    ground: Ground,
    recordings: Recordings | None,
    stream: np.random.SeedSequence,
) -> list[Person]:
    """Return people with their motion: replayed, tracked, or by social forces.

    The area where they move has a center and a size (2,) [m].
    """
    common, *own = stream.spawn(1 + count)
    rng = np.random.default_rng(common)
    rngs = [np.random.default_rng(one) for one in own]
    kinds = cast("list[Kind]", list(STATURE))
    skeletons = [draw_skeleton(kinds[rng.choice(3, p=scenario.kinds)], one) for one in rngs]
    known: dict[int, Trajectory] = {}
    replayed = {}
    if pitch is not None and recordings is not None:
        known = _follow_tracking(recordings, count, times, pitch, rng)
    if recordings is not None and recordings.motions:
        # Share of people who replay motion capture [1].
        for person in np.flatnonzero(rng.random(count) < 0.3).tolist():
            one = recordings.motions[rng.integers(len(recordings.motions))]
            place = area[0] + area[1] * rng.uniform(-0.4, 0.4, 2)
            if person in known:
                place = known[person].root[len(times) // 2]
            known[person], replayed[person] = play_motion(
                one, skeletons[person], times, place, rngs[person]
            )
    free = [person for person in range(count) if person not in known]
    roles: list[Role] = [scenario.roles[rng.integers(len(scenario.roles))] for _ in free]
    trajectories = wander(times, roles, *area, list(known.values()), rng)
    known |= dict(zip(free, trajectories, strict=True))
    fps = 1.0 / (times[1] - times[0])
    people = []
    for person, (skeleton, rng) in enumerate(zip(skeletons, rngs, strict=True)):
        trajectory, posture = known[person], replayed.get(person)
        if posture is None:
            course = (trajectory.root, trajectory.heading)
            posture = walk_posture(times, *course, skeleton.leg, scenario.gestures, rng)
        joints = place_joints(skeleton, posture, trajectory.root, trajectory.heading, fps, ground)
        people.append(Person(skeleton, joints, trajectory.source))
    return people


def _follow_tracking(
    recordings: Recordings, count: int, times: Floats, pitch: Pitch, rng: np.random.Generator
) -> dict[int, Trajectory]:
    """Return the trajectories of tracked people, in most matches if the data are long enough."""
    tracked = 0.75  # share of matches on a pitch whose people follow tracking data [1]
    long = [track for track in recordings.tracks if track.clock[-1] >= times[-1] - LEAD]
    if not long or rng.random() >= tracked:
        return {}
    tracking = long[rng.integers(len(long))]
    there = np.flatnonzero(np.isfinite(tracking.xy).all(axis=(0, 2)))
    players = there[rng.permutation(len(there))[:count]]
    scale = np.array([pitch.painted.length / 105.0, pitch.painted.width / 68.0])
    begin = rng.uniform(0.0, max(tracking.clock[-1] - times[-1] + LEAD, 0.0))
    known = {}
    for person, player in enumerate(players):
        source = f"tracking {tracking.name}, player {player}, {begin:.2f} s"
        xy, clock = tracking.xy[:, player], tracking.clock - begin
        place, heading = follow_track(times, clock, xy, TRACK_SMOOTHING, scale)
        known[person] = Trajectory(times, place, heading, source)
    return known


def _mount_cameras(
    count: int,
    layout: Layout,
    space: tuple[float, float],
    joints: Floats,
    clickable: PitchTemplate | None,
    rng: np.random.Generator,
) -> dict[str, RigCamera]:
    """Return cameras by id; if they are to be clicked, others for those that see few markings."""
    enough_points = 6  # fewest named points in the image of a camera that is clicked [1]
    # Heads, hips and feet at intervals.
    action = joints[:: max(1, len(joints) // 15)][:, :, [0, 11, 15]].reshape(-1, 3)
    mounted = draw_rig(count, layout, space, action, rng)
    for index in range(count):
        for _ in range(12):
            if clickable is None or len(visible_points(mounted[index], clickable)) >= enough_points:
                break
            mounted[index] = draw_rig(1, layout, space, action, rng)[0]
    return {f"view{index:02d}": camera for index, camera in enumerate(mounted)}


def _flat_ground(x: Floats, y: Floats) -> Floats:
    """Return the ground of a hall."""
    return np.asarray(0.0 * x + 0.0 * y)


def simulate_foreign_match(
    scenario: ForeignScenario,
    seed: int,
    out: Path,
    options: MatchOptions = MatchOptions(),  # noqa: B008
    recordings: Path | None = None,
) -> MatchSpec:
    """Write a match folder of the second simulator as `simulate_match`, and return its match.yaml.

    The recordings are those of `read_recordings`; without, all motion is computed.
    """
    replayed = None if recordings is None else read_recordings(recordings)
    scene = simulate_foreign_scene(scenario, seed, options, replayed)
    # Cameras number frames on their own.
    reports = {}
    for name, report in scene.reports.items():
        frame = report.observations.frame + scene.offsets[name]
        reports[name] = replace(report, observations=replace(report.observations, frame=frame))
    records = {"clocks": scene.clock_offsets, "world": scene.record}
    if scene.pitch is not None:
        records["clicks"] = {name: {"wrong": each} for name, each in scene.misnamed.items()}
    sizes = {name: each.camera.image_size.tolist() for name, each in scene.cameras.items()}
    spec = MatchSpec(
        match_id=options.name(scenario.name, seed, *["recordings"] * (recordings is not None)),
        fps=scene.fps,
        cameras=tuple(
            CameraSpec(id=name, width=width, height=height, offset_frames=scene.offsets[name])
            for name, (width, height) in sizes.items()
        ),
        clips=(ClipSpec(id=CLIP_ID, frame_count=len(scene.truth.frames)),),
        pitch="none" if scene.pitch is None else None,
    )
    write_match(
        out,
        spec,
        calibrations=scene.given,
        observations={name: report.observations for name, report in reports.items()},
        pitch=None if scene.pitch is None else scene.pitch.stated,
        annotations=MatchAnnotations(clicked=scene.clicked),
        further=lambda folder: write_reference(
            folder / "reference",
            scene.truth,
            scene.defined,
            {name: each.camera for name, each in scene.cameras.items()},
            reports,
            records,
            None if scene.pitch is None else scene.pitch.painted,
        ),
    )
    return spec
