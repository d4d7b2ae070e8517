"""Tracks of people on the pitch plane, where views cannot triangulate (T1).

One camera, or cameras side by side, do not give joints in 3D; the feet give places on the pitch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from worldpose.tracking.feet import GroundPositions

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
MIN_TRACK_S: Final = 0.4
"""Least time with detections of a track [s]."""
MIN_SEEN: Final = 0.4
"""Least share of its frames in which a track is seen [1]."""
HEIGHTS: Final = (1.1, 2.4)
"""Range of a track's median height [m]."""
FLAG_DISTANCE: Final = 1.0
"""A track that never leaves this distance from a corner is a flag [m]."""
DOUBLE_DISTANCE: Final = 1.0
"""A second track of a person stays this near to the first [m]."""
BODY_DISTANCE: Final = 0.5
"""Two tracks nearer than this for half of their common time are one person [m]."""
MAX_DOUBLE: Final = 0.7
"""Largest length of such a track relative to the first [1]."""
SAME_PERSON_M: Final = 1.0
"""Two tracks nearer than this on average, that no camera sees apart, are one person [m]."""


@dataclass(frozen=True, eq=False)
class GroundTracks:
    """A clip's people on the pitch plane.

    Attributes:
        detection_index: (frames, cameras, persons) int16, each person's detection; -1 = not seen.
        xy: (frames, persons, 2) [m], world, smoothed over the track; NaN outside of it.
        velocity: (frames, persons, 2) [m/s].
        covariance: (frames, persons, 2, 2) [m^2], of `xy`: noise of the feet, and calibration.
        height: (persons,) [m], median over the track; NaN where not known.
    """

    detection_index: NDArray[np.int16]
    xy: Floats
    velocity: Floats
    covariance: Floats
    height: Floats


@dataclass(frozen=True, eq=False)
class _Sight:
    """One detection: its place (2,) [m] and covariance (2, 2) [m^2]."""

    place: Floats
    noise: Floats

    @classmethod
    def of(
        cls, positions: GroundPositions, frame: int, camera: int, detection: int, colour: float
    ) -> _Sight:
        """Return a detection, with the inflation of correlated errors."""
        where = (frame, camera, detection)
        return cls(positions.xy[where], colour * positions.noise[where])


@dataclass(eq=False)
class _Track:
    """One person while the filter runs."""

    state: Floats
    covariance: Floats
    first: int
    last_seen: int
    seen: int = 0
    steps: list[tuple[Floats, Floats, Floats, Floats]] = field(default_factory=list)
    """By frame: predicted state and covariance, updated state and covariance."""
    index: dict[int, dict[int, int]] = field(default_factory=dict)
    """Frame to camera to detection."""

    @classmethod
    def start(cls, sight: _Sight, frame: int) -> _Track:
        """Return a person who appears."""
        covariance = np.diag([0.0, 0.0, SPEED**2, SPEED**2])
        covariance[:2, :2] = sight.noise
        state = np.array([*sight.place, 0.0, 0.0])
        return cls(state, covariance, frame, frame, steps=[(state, covariance, state, covariance)])

    def predict(self, move: Floats, drift: Floats) -> None:
        """Go to the next frame."""
        self.state = move @ self.state
        self.covariance = move @ self.covariance @ move.T + drift
        self.steps.append((self.state, self.covariance, self.state, self.covariance))

    def correct(self, sight: _Sight, clock: float) -> None:
        """Update the state with a detection in an image `clock` [s] after the frame."""
        look = _look(clock)
        gain = self.covariance @ look.T
        gain = gain @ np.linalg.inv(look @ gain + sight.noise)
        self.state = self.state + gain @ (sight.place - look @ self.state)
        self.covariance = self.covariance - gain @ look @ self.covariance
        before = self.steps[-1]
        self.steps[-1] = (before[0], before[1], self.state, self.covariance)

    def note(self, frame: int, camera: int, detection: int) -> None:
        """Assign a detection of a camera to this person."""
        seen = self.index.setdefault(frame, {})
        self.seen += not seen
        seen[camera] = detection
        self.last_seen = frame


def _look(clock: float) -> Floats:
    """Return the matrix (2, 4) that maps a state to the position `clock` [s] later."""
    return np.concatenate([np.eye(2), clock * np.eye(2)], axis=1)


def track_on_plane(
    positions: GroundPositions,
    fps: float,
    clock_s: Sequence[float] | Floats | None = None,
    *,
    pitch_size: tuple[float, float],
    margin_m: float = 2.0,
) -> GroundTracks:
    """Return the tracks of people by their feet (T1, without triangulation).

    A Kalman filter at constant velocity predicts each person. In every frame, each camera in turn
    gives its detections to the predicted people by the Hungarian method; the remaining detections
    start people. A backward pass smooths each track. Tracks of two cameras that stay together are
    one person.

    Args:
        positions: the clip's foot positions.
        fps: frames per second [1/s].
        clock_s: by camera, time of its image minus time of the frame [s]; None = in step.
        pitch_size: length and width of the pitch [m].
        margin_m: people always farther outside than this are bystanders [m].
    """
    frames, cameras = positions.xy.shape[:2]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    dt = 1.0 / fps
    move, drift, colour = _motion(fps)
    running: list[_Track] = []
    ended: list[_Track] = []
    for frame in range(frames):
        for track in running:
            track.predict(move, drift)
        for c in range(cameras):
            _update(running, positions, frame, c, float(clocks[c]), colour)
        lost = [track for track in running if (frame - track.last_seen) * dt > MAX_LOST_S]
        ended += lost
        running = [track for track in running if track not in lost]
    kept = [
        track
        for track in ended + running
        if track.seen * dt >= min(MIN_TRACK_S, frames * dt)
        and track.seen >= MIN_SEEN * (track.last_seen - track.first + 1)
    ]
    paths = _merge_tracks([_smooth(track, move) for track in kept], fps)
    half = 0.5 * np.asarray(pitch_size) + margin_m
    paths = [path for path in paths if (np.abs(path.xy) <= half).all(axis=1).any()]
    paths = [
        path
        for path in paths
        if not _is_flag(path, pitch_size) and not _has_odd_height(path, positions)
    ]
    paths = _drop_doubles(paths)
    paths.sort(key=lambda path: path.first)
    return _collect(paths, positions)


def locate_tracks(
    positions: GroundPositions,
    detection_index: NDArray[np.integer],
    fps: float,
    clock_s: Sequence[float] | Floats | None = None,
) -> GroundTracks:
    """Return smoothed places of people whose detections are known.

    Args:
        positions: the clip's foot positions.
        detection_index: (frames, cameras, persons), each person's detection; -1 = not seen.
        fps: frames per second [1/s].
        clock_s: as in `track_on_plane`.
    """
    cameras, persons = detection_index.shape[1:]
    clocks = np.zeros(cameras) if clock_s is None else np.asarray(clock_s, dtype=np.float64)
    move, drift, colour = _motion(fps)
    paths = []
    for person in range(persons):
        index = detection_index[:, :, person]
        seen = np.flatnonzero((index >= 0).any(axis=1))
        track: _Track | None = None
        for frame in range(seen[0], seen[-1] + 1) if len(seen) else ():
            if track is not None:
                track.predict(move, drift)
            for camera in np.flatnonzero(index[frame] >= 0).tolist():
                detection = int(index[frame, camera])
                if not np.isfinite(positions.xy[frame, camera, detection, 0]):
                    continue
                sight = _Sight.of(positions, frame, camera, detection, colour)
                if track is None:
                    track = _Track.start(sight, frame)
                else:
                    track.correct(sight, float(clocks[camera]))
                track.note(frame, camera, detection)
        paths.append(None if track is None else _smooth(track, move))
    return _collect(paths, positions, detection_index)


def _is_flag(path: _Path, pitch_size: tuple[float, float]) -> bool:
    """Return whether a path never leaves a corner: a flag, which nets mistake for people."""
    corner = np.abs(path.xy) - 0.5 * np.asarray(pitch_size)
    return bool((np.linalg.norm(corner, axis=1) < FLAG_DISTANCE).all())


def _drop_doubles(paths: list[_Path]) -> list[_Path]:
    """Drop paths that always stay close to a longer one: second boxes of the same person.

    Two players in a tackle have been apart before, or part after it.
    """
    kept: list[_Path] = []
    for path in sorted(paths, key=lambda path: -len(path.xy)):
        if not any(_is_double(path, other) for other in kept):
            kept.append(path)
    return kept


def _is_double(path: _Path, other: _Path) -> bool:
    """Return whether `path` lies in the time of `other`, which is longer, and always near it."""
    if len(path.xy) > MAX_DOUBLE * len(other.xy):
        return False
    if path.first < other.first or path.last > other.last:
        return False
    there = other.xy[path.first - other.first : path.last - other.first + 1]
    return bool((np.linalg.norm(path.xy - there, axis=1) < DOUBLE_DISTANCE).all())


def _track_height(path: _Path, positions: GroundPositions) -> float:
    """Return the median height of a path's person [m]; NaN where not known."""
    heights = [
        positions.height[frame, camera, detection]
        for frame, seen in path.index.items()
        for camera, detection in seen.items()
    ]
    known = np.array(heights)[np.isfinite(heights)]
    return float(np.median(known)) if len(known) else np.nan


def _has_odd_height(path: _Path, positions: GroundPositions) -> bool:
    """Return whether no person has the path's height: a ball, a mark, two people in one box."""
    height = _track_height(path, positions)
    return bool(np.isfinite(height)) and not HEIGHTS[0] <= height <= HEIGHTS[1]


def _motion(fps: float) -> tuple[Floats, Floats, float]:
    """Return the step of the state, its covariance, and the inflation of correlated errors."""
    dt = 1.0 / fps
    move = np.eye(4)
    move[:2, 2:] = dt * np.eye(2)
    push = np.concatenate([0.5 * dt**2 * np.eye(2), dt * np.eye(2)])
    drift = ACCELERATION**2 * push @ push.T * max(1.0, ACCELERATION_S * fps)
    return move, drift, max(1.0, 2.0 * CORRELATION_S * fps)


def _update(
    tracks: list[_Track],
    positions: GroundPositions,
    frame: int,
    camera: int,
    clock: float,
    colour: float,
) -> None:
    """Match the detections of one camera with people; the others start people."""
    here = np.flatnonzero(np.isfinite(positions.xy[frame, camera, :, 0]))
    look = _look(clock)
    sights = [_Sight.of(positions, frame, camera, int(d), colour) for d in here]
    free = np.ones(len(here), dtype=np.bool_)
    if len(here) and tracks:
        places = np.stack([sight.place for sight in sights])
        wide = np.stack([sight.noise for sight in sights])
        wide += positions.calibration[frame, camera, here]
        states = np.stack([track.state for track in tracks])
        spread = look @ np.stack([track.covariance for track in tracks]) @ look.T
        total = spread[:, None] + wide[None]
        off = places[None] - (states @ look.T)[:, None]
        squared = np.einsum("tdi,tdij,tdj->td", off, np.linalg.inv(total), off)
        size = np.log(np.linalg.det(total))
        cost = np.where(squared < GATE, squared + size, GATE + size.max() + 1.0)
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if squared[row, column] < GATE:
                tracks[row].correct(sights[column], clock)
                tracks[row].note(frame, camera, int(here[column]))
                free[column] = False
    for column in np.flatnonzero(free):
        track = _Track.start(sights[column], frame)
        track.note(frame, camera, int(here[column]))
        tracks.append(track)


@dataclass(frozen=True, eq=False)
class _Path:
    """A smoothed track.

    Attributes:
        first: first frame.
        state: (frames, 4) of the track, place and velocity [m, m/s].
        covariance: (frames, 4, 4).
        index: frame to camera to detection.
    """

    first: int
    state: Floats
    covariance: Floats
    index: dict[int, dict[int, int]]

    @property
    def xy(self) -> Floats:
        return self.state[:, :2]

    @property
    def last(self) -> int:
        return self.first + len(self.state) - 1


def _smooth(track: _Track, move: Floats) -> _Path:
    """Return the track up to its last sighting, smoothed backwards (Rauch, Tung and Striebel)."""
    steps = track.steps[: track.last_seen - track.first + 1]
    state, covariance = steps[-1][2], steps[-1][3]
    states, covariances = [state], [covariance]
    for here, after in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
        gain = here[3] @ move.T @ np.linalg.inv(after[1])
        state = here[2] + gain @ (state - after[0])
        covariance = here[3] + gain @ (covariance - after[1]) @ gain.T
        states.append(state)
        covariances.append(covariance)
    return _Path(track.first, np.stack(states[::-1]), np.stack(covariances[::-1]), track.index)


def _merge_tracks(paths: list[_Path], fps: float) -> list[_Path]:
    """Join paths that are one person's."""
    merged = True
    while merged:
        merged = False
        for a, b in combinations(range(len(paths)), 2):
            if _is_same_person(paths[a], paths[b], fps):
                both = _join(paths[a], paths[b])
                paths = [path for i, path in enumerate(paths) if i not in (a, b)] + [both]
                merged = True
                break
    return paths


def _common(a: _Path, b: _Path) -> tuple[slice, slice]:
    """Return the common frames of two paths, as rows of each; empty if there are none."""
    first, last = max(a.first, b.first), max(min(a.last, b.last), max(a.first, b.first) - 1)
    return (
        slice(first - a.first, last - a.first + 1),
        slice(first - b.first, last - b.first + 1),
    )


def _is_same_person(a: _Path, b: _Path, fps: float) -> bool:
    """Return whether two paths are one person's.

    Either they stay near each other and no camera sees both in one frame, or they lie so close for
    so long that two bodies would be in one place: two boxes of one person.
    """
    ours, theirs = _common(a, b)
    apart = np.linalg.norm(a.xy[ours] - b.xy[theirs], axis=1)
    if not len(apart):
        return False
    inside = len(apart) >= MIN_TRACK_S * fps and np.quantile(apart, 0.9) < DOUBLE_DISTANCE
    if inside and np.median(apart) < BODY_DISTANCE:
        return True
    frames = set(a.index) & set(b.index)
    return bool(apart.mean() <= SAME_PERSON_M) and not any(
        set(a.index[frame]) & set(b.index[frame]) for frame in frames
    )


def _join(a: _Path, b: _Path) -> _Path:
    """Return two paths of one person as one; the longer one's detections count where both have."""
    if len(b.index) > len(a.index):
        a, b = b, a
    ours, theirs = _common(a, b)
    start, stop = min(a.first, b.first), max(a.last, b.last)
    state = np.full((stop - start + 1, 4), np.nan)
    covariance = np.full((stop - start + 1, 4, 4), np.nan)
    for path in (a, b):
        rows = slice(path.first - start, path.last - start + 1)
        state[rows], covariance[rows] = path.state, path.covariance
    rows = slice(a.first + ours.start - start, a.first + ours.stop - start)
    inverse_a, inverse_b = (np.linalg.inv(p.covariance[s]) for p, s in ((a, ours), (b, theirs)))
    covariance[rows] = np.linalg.inv(inverse_a + inverse_b)
    total = inverse_a @ a.state[ours][..., None] + inverse_b @ b.state[theirs][..., None]
    state[rows] = (covariance[rows] @ total)[..., 0]
    index = {
        frame: {**b.index.get(frame, {}), **a.index.get(frame, {})}
        for frame in sorted(set(a.index) | set(b.index))
    }
    return _Path(start, state, covariance, index)


def _collect(
    paths: Sequence[_Path | None],
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
        height[n] = _track_height(path, positions)
        rows = slice(path.first, path.last + 1)
        state[rows, n] = path.state
        covariance[rows, n] = path.covariance[:, :2, :2]
        lasting = np.zeros((2, 2))
        for frame in range(path.first, path.last + 1):
            seen = path.index.get(frame, {})
            for camera, detection in seen.items():
                index[frame, camera, n] = detection
            if seen:
                each = [positions.calibration[frame, camera, d] for camera, d in seen.items()]
                lasting = min(each, key=np.trace)
            covariance[frame, n] += lasting
    if detection_index is not None:
        index = detection_index.astype(np.int16)
    return GroundTracks(index, state[..., :2], state[..., 2:], covariance, height)
