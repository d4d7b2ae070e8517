"""Tracks of people on the pitch plane, where views cannot triangulate.

One camera, or cameras side by side, do not give joints in 3D; the feet give places on the pitch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import AnyFloats, Floats, Singles
from data_contracts.conventions import COCO17_HIPS
from worldpose.geometry.boxes import box_iou
from worldpose.tracking.plane.feet import FrameBlocks, GroundPositions
from worldpose.tracking.plane.kalman import Motion, PlaneTrack, compare
from worldpose.tracking.plane.paths import (
    MIN_TRACK_S,
    PlanePath,
    drop_doubles,
    has_odd_height,
    is_contradicted,
    is_flag,
    merge_paths,
    track_height,
)
from worldpose.tracking.plane.shirts import ShirtMemory, ShirtModel

TRIANGULATED_NOISE: Final = np.diag([0.15**2, 0.15**2])
"""Covariance of the feet from the mid-hip of a triangulated person [m^2]."""


@dataclass(frozen=True, eq=False)
class TriangulatedPeople:
    """People triangulated in some frames, which plane tracks may continue.

    Attributes:
        xy: (frames, persons, 2) [m], world, mid-hip; NaN where not triangulated.
        is_tracked: (frames, persons), whether the tracker in 3D has detections of the person.
    """

    xy: Floats
    is_tracked: NDArray[np.bool_]


def triangulated_places(joints: Singles) -> Floats:
    """Return the mid-hips on the ground (frames, persons, 2) [m] of joints (..., 17, 3)."""
    return np.asarray(joints[:, :, COCO17_HIPS, :2].mean(axis=2), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class GroundTracks:
    """A clip's people on the pitch plane.

    Attributes:
        detection_index: (frames, cameras, persons) int16, each person's detection; -1 = not seen.
        xy: (frames, persons, 2) [m], world, smoothed over the track; NaN outside of it.
        velocity: (frames, persons, 2) [m/s].
        covariance: (frames, persons, 2, 2) [m^2], of `xy`: noise of the feet, and calibration.
        height: (persons,) [m], median over the track; NaN where not known.
        continues: (persons,) index of the triangulated person whose track this is where the person
            is not triangulated, possibly in several parts; -1 = never triangulated.
    """

    detection_index: NDArray[np.int16]
    xy: Floats
    velocity: Floats
    covariance: Floats
    height: Floats
    continues: NDArray[np.int64]


def track_on_plane(
    positions: GroundPositions,
    fps: float,
    clock_s: Sequence[float] | Floats | None = None,
    *,
    pitch_size: tuple[float, float],
    margin_m: float = 1.5,
    triangulated: TriangulatedPeople | None = None,
    covering: NDArray[np.integer] | FrameBlocks | None = None,
) -> GroundTracks:
    """Return the tracks of people by their feet without triangulation.

    A Kalman filter at constant velocity predicts each person. In every frame, each camera in turn
    gives its detections to the predicted people by the Hungarian method, by place and, where known,
    by the colour of the shirt; the remaining detections start people. A backward pass smooths each
    track. Tracks of two cameras that stay together are one person.

    A triangulated person is a track as well, which takes the detections near it and continues where
    triangulation ends. A track by feet that meets a person who begins to be triangulated becomes
    that person's. The positions are then NaN where a detection is a triangulated person's.

    `clock_s` is the time of each camera's image minus that of the frame [s], None = all cameras are
    synchronous; `pitch_size` is the length and width of the pitch [m]. People always farther than
    `margin_m` [m] outside are bystanders; assistants run within a metre of the lines. `covering`
    (frames, cameras, detections) counts cameras that should see a person there: people seen by few
    of them are dropped; None = not known.
    """
    frames, cameras = positions.xy.shape[:2]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    dt = 1.0 / fps
    motion = Motion.at(fps)
    shirts = _learn_shirts(positions)
    is_seen = positions.number_seen() > 0
    running: list[PlaneTrack] = []
    ended: list[PlaneTrack] = []
    for frame in range(frames):
        for track in running:
            track.predict(motion)
        if triangulated is not None:
            _follow_triangulated(running, triangulated.xy[frame], frame)
        for c in np.flatnonzero(is_seen[frame]).tolist():
            _update(running, positions, (frame, c), float(clocks[c]), motion.inflation, shirts[c])
        lost = [track for track in running if _is_lost(track, frame, dt)]
        ended += lost
        running = [track for track in running if track not in lost]
    kept = [
        track
        for track in ended + running
        if track.person >= 0
        or (
            track.seen * dt >= min(MIN_TRACK_S, frames * dt)
            and track.seen >= 0.4 * (track.last_seen - track.first + 1)
        )
    ]
    paths = merge_paths([track.smooth(motion) for track in kept], fps, positions)
    half = 0.5 * np.asarray(pitch_size) + margin_m
    paths = [
        path
        for path in paths
        if path.person >= 0
        or (
            (np.abs(path.xy) <= half).all(axis=1).any()
            and not is_flag(path, pitch_size)
            and not has_odd_height(path, positions)
            and not is_contradicted(path, covering)
        )
    ]
    paths = drop_doubles(paths)
    paths.sort(key=lambda path: path.first)
    if triangulated is None:
        return _collect(paths, positions)
    return _without_triangulated(_collect(paths, positions), triangulated)


def _without_triangulated(tracks: GroundTracks, triangulated: TriangulatedPeople) -> GroundTracks:
    """Return the tracks where their people are not tracked in 3D."""
    index = tracks.detection_index.copy()
    xy, velocity, covariance = (
        array.copy() for array in (tracks.xy, tracks.velocity, tracks.covariance)
    )
    for n, person in enumerate(tracks.continues.tolist()):
        if person < 0:
            continue
        seen = (index[:, :, n] >= 0).any(axis=1) & ~triangulated.is_tracked[:, person]
        stays = np.zeros(len(seen), dtype=np.bool_)
        # Between two sightings, unless the person is tracked in 3D there.
        stretch = np.cumsum(triangulated.is_tracked[:, person])
        for part in np.unique(stretch[seen]):
            inside = np.flatnonzero(seen & (stretch == part))
            stays[inside[0] : inside[-1] + 1] = True
        index[~stays, :, n] = -1
        for array in (xy, velocity, covariance):
            array[~stays, n] = np.nan
    kept = (index >= 0).any(axis=(0, 1))
    return GroundTracks(
        index[:, :, kept],
        xy[:, kept],
        velocity[:, kept],
        covariance[:, kept],
        tracks.height[kept],
        tracks.continues[kept],
    )


def locate_tracks(
    positions: GroundPositions,
    detection_index: NDArray[np.integer],
    fps: float,
    clock_s: Sequence[float] | Floats | None = None,
    triangulated_xy: Floats | None = None,
) -> GroundTracks:
    """Return smoothed places of people whose detections are known.

    `detection_index` (frames, cameras, persons) is each person's, -1 = not seen; `clock_s` is as in
    `track_on_plane`. `triangulated_xy` (frames, persons, 2) [m] is of the same people, NaN or None
    where they are not triangulated.
    """
    cameras, persons = detection_index.shape[1:]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    motion = Motion.at(fps)
    paths = []
    for person in range(persons):
        index = detection_index[:, :, person]
        fixed = np.full((len(index), 2), np.nan)
        if triangulated_xy is not None and (index >= 0).any():
            fixed = triangulated_xy[:, person]
        seen = np.flatnonzero((index >= 0).any(axis=1) | np.isfinite(fixed[:, 0]))
        track: PlaneTrack | None = None
        for frame in range(seen[0], seen[-1] + 1) if len(seen) else ():
            if track is not None:
                track.predict(motion)
            if np.isfinite(fixed[frame, 0]):
                track = _sight(track, (fixed[frame], TRIANGULATED_NOISE), frame)
                track.last_seen = frame
            for camera in np.flatnonzero(index[frame] >= 0).tolist():
                where = (frame, camera, int(index[frame, camera]))
                place, noise = positions.xy[where], motion.inflation * positions.noise[where]
                if np.isfinite(place[0]):
                    track = _sight(track, (place, noise), frame, float(clocks[camera]))
                    track.note(*where, is_whole=True)
        paths.append(None if track is None else track.smooth(motion))
    return _collect(paths, positions, detection_index)


def find_given_people(given: Floats, boxes: AnyFloats) -> NDArray[np.int64]:
    """Return the detection of each given person (frames, persons); -1 = none at the person's box.

    Known people's boxes are (frames, persons, 4), NaN when absent, all boxes (frames, detections,
    4) [px].
    """
    index = np.full(given.shape[:2], -1, dtype=np.int64)
    least = 0.3  # Least intersection over union of a person's given box and the detection's [1].
    for frame, overlap in enumerate(box_iou(given, np.asarray(boxes, dtype=np.float64))):
        person, detection = linear_sum_assignment(-overlap)
        near = overlap[person, detection] >= least
        index[frame, person[near]] = detection[near]
    return index


def _sight(
    track: PlaneTrack | None, sight: tuple[Floats, Floats], frame: int, clock: float = 0.0
) -> PlaneTrack:
    """Return the track after a place and its covariance were seen; a new one without a track."""
    if track is None:
        return PlaneTrack.start(*sight, frame)
    track.correct(*sight, clock)
    return track


def _is_lost(track: PlaneTrack, frame: int, dt: float) -> bool:
    """Return whether a track ends; a new one soon, because it may be a part of another person."""
    if track.person < 0 and track.seen * dt < MIN_TRACK_S:
        return (frame - track.last_whole) * dt > 0.2
    return (frame - track.last_seen) * dt > 1.0


def _learn_shirts(positions: GroundPositions) -> list[ShirtModel | None]:
    """Return the statistics of colours in each camera; None where they are not known."""
    if positions.shirts is None:
        return [None] * positions.xy.shape[1]
    return [
        ShirtModel.learn(positions.shirts[:, c], positions.xy[:, c])
        for c in range(positions.xy.shape[1])
    ]


def _update(
    tracks: list[PlaneTrack],
    positions: GroundPositions,
    image: tuple[int, int],
    clock: float,
    inflation: float,
    shirts: ShirtModel | None,
) -> None:
    """Match the detections of one image with people; the others start people.

    Detections of parts of people come last and start no track: most are a second box of the same
    person.
    """
    frame, camera = image
    seen = np.isfinite(positions.xy[frame, camera, :, 0])
    whole = seen if positions.is_whole is None else seen & positions.is_whole[frame, camera]
    colours = None
    if shirts is not None and positions.shirts is not None:
        colours = positions.shirts[frame, camera]
    unseen = tracks
    for is_whole, chosen in ((True, whole), (False, seen & ~whole)):
        here = np.flatnonzero(chosen)
        places = positions.xy[frame, camera, here]
        noise = inflation * positions.noise[frame, camera, here]
        total = noise + positions.calibration[frame, camera, here]
        odds = None
        if shirts is not None and colours is not None and unseen:
            known = [track.shirts.get(camera) for track in unseen]
            odds = np.stack([shirts.same_person(each, colours[here]) for each in known])
        pairs = {column: row for row, column in _match(unseen, places, total, clock, odds)}
        taken = set()
        for column, detection in enumerate(here.tolist()):
            if column in pairs:
                track = unseen[pairs[column]]
                track.correct(places[column], noise[column], clock)
            elif is_whole:
                track = PlaneTrack.start(places[column], noise[column], frame)
                tracks.append(track)
            else:
                continue
            track.note(frame, camera, detection, is_whole=is_whole)
            if colours is not None:
                track.shirts.setdefault(camera, ShirtMemory()).see(colours[detection])
            taken.add(id(track))
        unseen = [track for track in unseen if id(track) not in taken]


def _match(
    tracks: list[PlaneTrack],
    places: Floats,
    noise: Floats,
    clock: float,
    shirts: Floats | None = None,
) -> list[tuple[int, int]]:
    """Return pairs of track and place by the Hungarian method, within the gate."""
    if not tracks or not len(places):
        return []
    # Not `np.stack`, which takes several times as long for lists of small arrays.
    squared, size = compare(
        np.array([track.state for track in tracks]),
        np.array([track.covariance for track in tracks]),
        places,
        noise,
        clock,
    )
    other = np.zeros_like(squared) if shirts is None else -2.0 * shirts
    # 99.9 % of two dimensions. Shirts that differ count; shirts that agree do not widen the gate.
    gate = 13.8
    near = squared + np.maximum(other, 0.0) < gate
    cost = np.where(near, squared + size + other, gate + size.max() + 1.0)
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    return [(int(row), int(column)) for row, column in pairs if near[row, column]]


def _follow_triangulated(tracks: list[PlaneTrack], places: Floats, frame: int) -> None:
    """Correct the tracks of triangulated people; one who has none takes a track nearby."""
    followed = {track.person: track for track in tracks if track.person >= 0}
    here = np.flatnonzero(np.isfinite(places[:, 0])).tolist()
    new = [person for person in here if person not in followed]
    free = [track for track in tracks if track.person < 0]
    noise = np.tile(TRIANGULATED_NOISE, (len(new), 1, 1))
    for row, column in _match(free, places[new], noise, 0.0):
        free[row].person = new[column]
        followed[new[column]] = free[row]
    for person in here:
        known = followed.get(person)
        track = _sight(known, (places[person], TRIANGULATED_NOISE), frame)
        track.last_seen = frame
        if known is None:
            track.person = person
            tracks.append(track)


def _collect(
    paths: Sequence[PlanePath | None],
    positions: GroundPositions,
    detection_index: NDArray[np.integer] | None = None,
) -> GroundTracks:
    """Return the arrays of all paths; a given index is kept."""
    frames, cameras = positions.xy.shape[:2]
    index = np.full((frames, cameras, len(paths)), -1, dtype=np.int16)
    state = np.full((frames, len(paths), 4), np.nan)
    covariance = np.full((frames, len(paths), 2, 2), np.nan)
    height = np.full(len(paths), np.nan)
    for n, path in enumerate(paths):
        if path is None:
            continue
        height[n] = track_height(path, positions)
        rows = slice(path.first, path.last + 1)
        state[rows, n] = path.state
        covariance[rows, n] = path.covariance[:, :2, :2]
        frames_seen = sorted(path.index)
        lasting = np.zeros((len(frames_seen) + 1, 2, 2))
        for number, frame in enumerate(frames_seen):
            seen = path.index[frame]
            for camera, detection in seen.items():
                index[frame, camera, n] = detection
            each = [positions.calibration[frame, camera, d] for camera, d in seen.items()]
            lasting[number + 1] = min(each, key=np.trace)
        # That of the last frame in which the person was seen.
        last = np.searchsorted(frames_seen, np.arange(path.first, path.last + 1), side="right")
        covariance[rows, n] += lasting[last]
    if detection_index is not None:
        index = detection_index.astype(np.int16)
    continues = np.array([-1 if path is None else path.person for path in paths], dtype=np.int64)
    return GroundTracks(index, state[..., :2], state[..., 2:], covariance, height, continues)
