"""Tracks of people on the pitch plane, where views cannot triangulate (T1).

One camera, or cameras side by side, do not give joints in 3D; the feet give places on the pitch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Singles
from worldpose.compiled import compile_kernel
from worldpose.tracking.feet import FrameBlocks, GroundPositions
from worldpose.tracking.plane_paths import (
    MIN_TRACK_S,
    PlanePath,
    drop_doubles,
    has_odd_height,
    is_contradicted,
    is_flag,
    merge_paths,
    track_height,
)
from worldpose.tracking.shirts import ShirtMemory, ShirtModel

HIPS: Final = [11, 12]
"""The hips in COCO-17."""
CORRELATION_S: Final = 0.16
"""Correlation time of the errors of feet [s], about half a step."""
ACCELERATION: Final = 4.0
"""Standard deviation of a player's acceleration [m/s^2]."""
ACCELERATION_S: Final = 0.2
"""Time for which an acceleration lasts [s]."""
SPEED: Final = 3.0
"""Standard deviation of the velocity of a person who appears, per axis [m/s]."""
GATE: Final = 13.8
"""Maximum squared Mahalanobis distance of a matched detection [1]: 99.9 % of two dimensions."""
MAX_LOST_S: Final = 1.0
"""Time after which an unseen person's track ends [s]."""
MAX_NEW_LOST_S: Final = 0.2
"""Time without a whole detection after which a track ends that has had few so far [s]."""
MIN_SEEN: Final = 0.4
"""Least share of its frames in which a track is seen [1]."""
BYSTANDER_M: Final = 1.5
"""A person always farther outside of the pitch is a bystander [m]: assistants run within a metre of
the lines; benches and photographers are 2 m away, and a place by feet can be 0.3 m off."""
TRIANGULATED_NOISE: Final = np.diag([0.15**2, 0.15**2])
"""Covariance of the feet from the mid-hip of a triangulated person [m^2]."""


@dataclass(frozen=True, eq=False)
class TriangulatedPeople:
    """People of a clip who are triangulated in some frames; plane tracks may continue them.

    Attributes:
        xy: (frames, persons, 2) [m], world, mid-hip; NaN where not triangulated.
        is_tracked: (frames, persons), whether the tracker in 3D has detections of the person.
    """

    xy: Floats
    is_tracked: NDArray[np.bool_]


def triangulated_places(joints: Singles) -> Floats:
    """Return the mid-hips on the ground (frames, persons, 2) [m] of joints (..., 17, 3)."""
    return np.asarray(joints[:, :, HIPS, :2].mean(axis=2), dtype=np.float64)


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


@dataclass(frozen=True, eq=False)
class _Sight:
    """One detection: its place (2,) [m] and covariance (2, 2) [m^2]."""

    place: Floats
    noise: Floats

    @classmethod
    def of(
        cls, positions: GroundPositions, frame: int, camera: int, detection: int, inflation: float
    ) -> _Sight:
        """Return a detection, with the inflation of correlated errors."""
        where = (frame, camera, detection)
        return cls(positions.xy[where], inflation * positions.noise[where])

    @classmethod
    def at_place(cls, place: Floats) -> _Sight:
        """Return the place of a triangulated person."""
        return cls(place, TRIANGULATED_NOISE)


_Step = tuple[Floats, Floats, Floats, Floats]
PACKED_STEPS: Final = 256
"""Frames of a track that are packed together."""


@dataclass(eq=False)
class _Track:
    """One person while the filter runs."""

    state: Floats
    covariance: Floats
    first: int
    last_seen: int
    last_whole: int
    seen: int = 0
    """Frames with a whole detection."""
    person: int = -1
    """Triangulated person; -1 = none."""
    steps: list[_Step] = field(default_factory=list)
    """Of the last frames: predicted state and covariance, updated state and covariance."""
    packed: list[_Step] = field(default_factory=list)
    """The same of the frames before, as arrays of some frames: single ones take thrice as much."""
    index: dict[int, dict[int, int]] = field(default_factory=dict)
    """Frame to camera to detection."""
    shirts: dict[int, ShirtMemory] = field(default_factory=dict)
    """Colour of the shirt by camera."""

    @classmethod
    def start(cls, sight: _Sight, frame: int) -> _Track:
        """Return a person who appears."""
        covariance = np.diag([0.0, 0.0, SPEED**2, SPEED**2])
        covariance[:2, :2] = sight.noise
        state = np.array([*sight.place, 0.0, 0.0])
        return cls(
            state, covariance, frame, frame, frame, steps=[(state, covariance, state, covariance)]
        )

    def predict(self, move: Floats, drift: Floats) -> None:
        """Go to the next frame."""
        self.state, self.covariance = _predict(self.state, self.covariance, move, drift)
        if len(self.steps) >= PACKED_STEPS:
            self.packed.append(_pack(self.steps))
            self.steps.clear()
        self.steps.append((self.state, self.covariance, self.state, self.covariance))

    def correct(self, sight: _Sight, clock: float) -> None:
        """Update the state with a detection in an image `clock` [s] after the frame."""
        self.state, self.covariance = _correct(
            self.state, self.covariance, sight.place, sight.noise, clock
        )
        before = self.steps[-1]
        self.steps[-1] = (before[0], before[1], self.state, self.covariance)

    def note(self, frame: int, camera: int, detection: int, *, is_whole: bool) -> None:
        """Assign a detection of a camera to this person."""
        self.index.setdefault(frame, {})[camera] = detection
        self.last_seen = frame
        if is_whole and (self.last_whole < frame or not self.seen):
            self.seen += 1
            self.last_whole = frame


@compile_kernel
def _predict(
    state: Floats, covariance: Floats, move: Floats, drift: Floats
) -> tuple[Floats, Floats]:
    """Return state (4,) and covariance (4, 4) after one frame."""
    return move @ state, move @ covariance @ move.T + drift


@compile_kernel
def _correct(
    state: Floats, covariance: Floats, place: Floats, noise: Floats, clock: float
) -> tuple[Floats, Floats]:
    """Return state (4,) and covariance (4, 4) after a position was seen `clock` [s] later."""
    look = np.zeros((2, 4))
    for axis in range(2):
        look[axis, axis], look[axis, axis + 2] = 1.0, clock
    gain = covariance @ look.T
    gain = gain @ np.linalg.inv(look @ gain + noise)
    return state + gain @ (place - look @ state), covariance - gain @ look @ covariance


@compile_kernel
def _smooth_backwards(
    move: Floats,
    expected: Floats,
    expected_covariance: Floats,
    state: Floats,
    covariance: Floats,
) -> None:
    """Smooth filtered states (frames, 4) and covariances (frames, 4, 4) in place.

    Rauch, Tung and Striebel; `expected` and its covariance are the predicted ones.
    """
    for n in range(len(state) - 2, -1, -1):
        gain = covariance[n] @ move.T @ np.linalg.inv(expected_covariance[n + 1])
        state[n] += gain @ (state[n + 1] - expected[n + 1])
        covariance[n] += gain @ (covariance[n + 1] - expected_covariance[n + 1]) @ gain.T


@compile_kernel
def _compare(
    states: Floats, covariance: Floats, places: Floats, noise: Floats, clock: float
) -> tuple[Floats, Floats]:
    """Return squared Mahalanobis distances and log determinants (tracks, sights).

    Args:
        states: (tracks, 4), predicted.
        covariance: (tracks, 4, 4), of them.
        places: (sights, 2) [m], seen `clock` [s] later.
        noise: (sights, 2, 2) [m^2], of these places.
        clock: time of the image minus time of the frame [s].
    """
    squared, size = np.empty((len(states), len(places))), np.empty((len(states), len(places)))
    for t in range(len(states)):
        state, own = states[t], covariance[t]
        x, y = state[0] + clock * state[2], state[1] + clock * state[3]
        xx = own[0, 0] + clock * (own[0, 2] + own[2, 0] + clock * own[2, 2])
        xy = own[0, 1] + clock * (own[0, 3] + own[2, 1] + clock * own[2, 3])
        yy = own[1, 1] + clock * (own[1, 3] + own[3, 1] + clock * own[3, 3])
        for d in range(len(places)):
            a, b, c = xx + noise[d, 0, 0], xy + noise[d, 0, 1], yy + noise[d, 1, 1]
            determinant = a * c - b * b
            u, v = places[d, 0] - x, places[d, 1] - y
            squared[t, d] = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
            size[t, d] = math.log(determinant)
    return squared, size


def track_on_plane(
    positions: GroundPositions,
    fps: float,
    clock_s: Sequence[float] | Floats | None = None,
    *,
    pitch_size: tuple[float, float],
    margin_m: float = BYSTANDER_M,
    triangulated: TriangulatedPeople | None = None,
    covering: NDArray[np.integer] | FrameBlocks | None = None,
) -> GroundTracks:
    """Return the tracks of people by their feet (T1, without triangulation).

    A Kalman filter at constant velocity predicts each person. In every frame, each camera in turn
    gives its detections to the predicted people by the Hungarian method, by place and, where known,
    by the colour of the shirt; the remaining detections start people. A backward pass smooths each
    track. Tracks of two cameras that stay together are one person.

    A triangulated person is a track as well, which takes the detections near it and continues where
    triangulation ends. A track by feet that meets a person who begins to be triangulated becomes
    that person's.

    Args:
        positions: the clip's foot positions; with `triangulated`, NaN where a detection is theirs.
        fps: frames per second [1/s].
        clock_s: time of each camera's image minus time of the frame [s]; None = all cameras are
            synchronous.
        pitch_size: length and width of the pitch [m].
        margin_m: people always farther outside than this are bystanders [m].
        triangulated: people who are triangulated in some frames; None = none.
        covering: (frames, cameras, detections), cameras that should see a person there; None =
            not known. People seen by few of them are dropped.
    """
    frames, cameras = positions.xy.shape[:2]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    dt = 1.0 / fps
    move, drift, inflation = _motion(fps)
    shirts = _learn_shirts(positions)
    is_seen = positions.number_seen() > 0
    running: list[_Track] = []
    ended: list[_Track] = []
    for frame in range(frames):
        for track in running:
            track.predict(move, drift)
        if triangulated is not None:
            _follow_triangulated(running, triangulated.xy[frame], frame)
        for c in np.flatnonzero(is_seen[frame]).tolist():
            _update(running, positions, (frame, c), float(clocks[c]), inflation, shirts[c])
        lost = [track for track in running if _is_lost(track, frame, dt)]
        ended += lost
        running = [track for track in running if track not in lost]
    kept = [
        track
        for track in ended + running
        if track.person >= 0
        or (
            track.seen * dt >= min(MIN_TRACK_S, frames * dt)
            and track.seen >= MIN_SEEN * (track.last_seen - track.first + 1)
        )
    ]
    paths = merge_paths([_smooth(track, move) for track in kept], fps, positions)
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

    Args:
        positions: the clip's foot positions.
        detection_index: (frames, cameras, persons), each person's detection; -1 = not seen.
        fps: frames per second [1/s].
        clock_s: as in `track_on_plane`.
        triangulated_xy: (frames, persons, 2) [m], where the same people are triangulated; NaN
            elsewhere. None = nowhere.
    """
    cameras, persons = detection_index.shape[1:]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    move, drift, inflation = _motion(fps)
    paths = []
    for person in range(persons):
        index = detection_index[:, :, person]
        fixed = np.full((len(index), 2), np.nan)
        if triangulated_xy is not None and (index >= 0).any():
            fixed = triangulated_xy[:, person]
        seen = np.flatnonzero((index >= 0).any(axis=1) | np.isfinite(fixed[:, 0]))
        track: _Track | None = None
        for frame in range(seen[0], seen[-1] + 1) if len(seen) else ():
            if track is not None:
                track.predict(move, drift)
            if np.isfinite(fixed[frame, 0]):
                sight = _Sight.at_place(fixed[frame])
                if track is None:
                    track = _Track.start(sight, frame)
                else:
                    track.correct(sight, 0.0)
                track.last_seen = frame
            for camera in np.flatnonzero(index[frame] >= 0).tolist():
                detection = int(index[frame, camera])
                if not np.isfinite(positions.xy[frame, camera, detection, 0]):
                    continue
                sight = _Sight.of(positions, frame, camera, detection, inflation)
                if track is None:
                    track = _Track.start(sight, frame)
                else:
                    track.correct(sight, float(clocks[camera]))
                track.note(frame, camera, detection, is_whole=True)
        paths.append(None if track is None else _smooth(track, move))
    return _collect(paths, positions, detection_index)


def _motion(fps: float) -> tuple[Floats, Floats, float]:
    """Return the step of the state, its covariance, and the inflation of correlated errors."""
    dt = 1.0 / fps
    move = np.eye(4)
    move[:2, 2:] = dt * np.eye(2)
    push = np.concatenate([0.5 * dt**2 * np.eye(2), dt * np.eye(2)])
    drift = ACCELERATION**2 * push @ push.T * max(1.0, ACCELERATION_S * fps)
    return move, drift, max(1.0, 2.0 * CORRELATION_S * fps)


def _is_lost(track: _Track, frame: int, dt: float) -> bool:
    """Return whether a track ends; a new one soon, because it may be a part of another person."""
    if track.person < 0 and track.seen * dt < MIN_TRACK_S:
        return (frame - track.last_whole) * dt > MAX_NEW_LOST_S
    return (frame - track.last_seen) * dt > MAX_LOST_S


def _learn_shirts(positions: GroundPositions) -> list[ShirtModel | None]:
    """Return the statistics of colours in each camera; None where they are not known."""
    if positions.shirts is None:
        return [None] * positions.xy.shape[1]
    return [
        ShirtModel.learn(positions.shirts[:, c], positions.xy[:, c])
        for c in range(positions.xy.shape[1])
    ]


def _update(
    tracks: list[_Track],
    positions: GroundPositions,
    image: tuple[int, int],
    clock: float,
    inflation: float,
    shirts: ShirtModel | None,
) -> None:
    """Match the detections of one image with people; the others start people.

    Detections of parts of people come last and start no track: most are a second box of the same
    person.

    Args:
        tracks: people before the image; those who appear are added.
        positions: the clip's foot positions.
        image: frame and camera.
        clock: time of the image minus time of the frame [s].
        inflation: factor on the noise of a place, for correlated errors [1].
        shirts: statistics of colours in this camera; None = not known.
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
        sights = [_Sight.of(positions, frame, camera, int(d), inflation) for d in here]
        lasting = positions.calibration[frame, camera, here]
        odds = None
        if shirts is not None and colours is not None and unseen:
            known = [track.shirts.get(camera) for track in unseen]
            odds = np.stack([shirts.same_person(each, colours[here]) for each in known])
        pairs = {column: row for row, column in _match(unseen, sights, lasting, clock, odds)}
        taken = set()
        for column, sight in enumerate(sights):
            if column in pairs:
                track = unseen[pairs[column]]
                track.correct(sight, clock)
            elif is_whole:
                track = _Track.start(sight, frame)
                tracks.append(track)
            else:
                continue
            track.note(frame, camera, int(here[column]), is_whole=is_whole)
            if colours is not None:
                track.shirts.setdefault(camera, ShirtMemory()).see(colours[here[column]])
            taken.add(id(track))
        unseen = [track for track in unseen if id(track) not in taken]


def _match(
    tracks: list[_Track],
    sights: list[_Sight],
    lasting: Floats,
    clock: float,
    shirts: Floats | None = None,
) -> list[tuple[int, int]]:
    """Return pairs of track and sight by the Hungarian method, within the gate.

    Args:
        tracks: predicted people.
        sights: detections of one camera.
        lasting: (sights, 2, 2) [m^2], error that does not change from frame to frame.
        clock: time of the image minus time of the frame [s].
        shirts: (tracks, sights), log odds that the shirts of a pair are one person's; None = not
            known.
    """
    if not tracks or not sights:
        return []
    # Not `np.stack`, which takes several times as long for lists of small arrays.
    squared, size = _compare(
        np.array([track.state for track in tracks]),
        np.array([track.covariance for track in tracks]),
        np.array([sight.place for sight in sights]),
        np.array([sight.noise for sight in sights]) + lasting,
        clock,
    )
    other = np.zeros_like(squared) if shirts is None else -2.0 * shirts
    # Shirts that differ count towards the gate; shirts that agree do not widen it.
    near = squared + np.maximum(other, 0.0) < GATE
    cost = np.where(near, squared + size + other, GATE + size.max() + 1.0)
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    return [(int(row), int(column)) for row, column in pairs if near[row, column]]


def _follow_triangulated(tracks: list[_Track], places: Floats, frame: int) -> None:
    """Correct the tracks of triangulated people; one who has none takes a track nearby."""
    followed = {track.person: track for track in tracks if track.person >= 0}
    here = [int(person) for person in np.flatnonzero(np.isfinite(places[:, 0]))]
    new = [person for person in here if person not in followed]
    free = [track for track in tracks if track.person < 0]
    sights = [_Sight.at_place(places[person]) for person in new]
    for row, column in _match(free, sights, np.zeros((len(new), 2, 2)), 0.0):
        free[row].person = new[column]
        followed[new[column]] = free[row]
    for person in here:
        sight = _Sight.at_place(places[person])
        if person in followed:
            followed[person].correct(sight, 0.0)
            followed[person].last_seen = frame
        else:
            track = _Track.start(sight, frame)
            track.person = person
            tracks.append(track)


def _pack(steps: Sequence[_Step]) -> _Step:
    """Return steps as arrays whose first dimension is the frame."""
    expected, expected_covariance, state, covariance = map(np.array, zip(*steps, strict=True))
    return expected, expected_covariance, state, covariance


def _smooth(track: _Track, move: Floats) -> PlanePath:
    """Return the track up to its last sighting, smoothed backwards."""
    parts = [*track.packed, _pack(track.steps)]
    count = track.last_seen - track.first + 1
    expected, expected_covariance, state, covariance = (
        np.concatenate(column)[:count] for column in zip(*parts, strict=True)
    )
    _smooth_backwards(move, expected, expected_covariance, state, covariance)
    return PlanePath(track.first, state, covariance, track.index, track.person)


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
