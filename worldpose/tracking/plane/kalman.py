"""The Kalman filter of one person on the pitch plane: place and constant velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.tracking.plane.paths import PlanePath
from worldpose.tracking.plane.shirts import ShirtMemory

CORRELATION_S: Final = 0.16
"""Correlation time of the errors of feet [s], about half a step."""


class Motion(NamedTuple):
    """Motion of people from frame to frame.

    Attributes:
        move: (4, 4) step of the state.
        drift: (4, 4) covariance of this step.
        inflation: factor on the noise of places, whose errors are correlated [1].
    """

    move: Floats
    drift: Floats
    inflation: float

    @classmethod
    def at(cls, fps: float) -> Self:
        """Return the motion at a frame rate [1/s]."""
        dt = 1.0 / fps
        move = np.eye(4)
        move[:2, 2:] = dt * np.eye(2)
        push = np.concatenate([0.5 * dt**2 * np.eye(2), dt * np.eye(2)])
        # A player's acceleration has a standard deviation of 4 m/s^2 and lasts for 0.2 s.
        drift = 4.0**2 * push @ push.T * max(1.0, 0.2 * fps)
        return cls(move, drift, max(1.0, 2.0 * CORRELATION_S * fps))


_Step = tuple[Floats, Floats, Floats, Floats]


@dataclass(eq=False)
class PlaneTrack:
    """One person while the filter runs; the state is place and velocity (4,) [m, m/s]."""

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
    def start(cls, place: Floats, noise: Floats, frame: int) -> Self:
        """Return a person who appears at a place (2,) [m] with a covariance (2, 2) [m^2]."""
        speed = 3.0  # Standard deviation of the velocity, per axis [m/s].
        covariance = np.diag([0.0, 0.0, speed**2, speed**2])
        covariance[:2, :2] = noise
        state = np.array([*place, 0.0, 0.0])
        return cls(
            state, covariance, frame, frame, frame, steps=[(state, covariance, state, covariance)]
        )

    def predict(self, motion: Motion) -> None:
        """Go to the next frame."""
        self.state, self.covariance = _predict(
            self.state, self.covariance, motion.move, motion.drift
        )
        if len(self.steps) >= 256:
            self.packed.append(_pack(self.steps))
            self.steps.clear()
        self.steps.append((self.state, self.covariance, self.state, self.covariance))

    def correct(self, place: Floats, noise: Floats, clock: float) -> None:
        """Update the state with a place in an image `clock` [s] after the frame."""
        self.state, self.covariance = _correct(self.state, self.covariance, place, noise, clock)
        self.steps[-1] = (*self.steps[-1][:2], self.state, self.covariance)

    def note(self, frame: int, camera: int, detection: int, *, is_whole: bool) -> None:
        """Assign a detection of a camera to this person."""
        self.index.setdefault(frame, {})[camera] = detection
        self.last_seen = frame
        if is_whole and (self.last_whole < frame or not self.seen):
            self.seen += 1
            self.last_whole = frame

    def smooth(self, motion: Motion) -> PlanePath:
        """Return the path up to the last sighting, smoothed backwards."""
        parts = [*self.packed, _pack(self.steps)]
        count = self.last_seen - self.first + 1
        expected, expected_covariance, state, covariance = (
            np.concatenate(column)[:count] for column in zip(*parts, strict=True)
        )
        _smooth_backwards(motion.move, expected, expected_covariance, state, covariance)
        return PlanePath(self.first, state, covariance, self.index, self.person)


def _pack(steps: Sequence[_Step]) -> _Step:
    """Return steps as arrays whose first dimension is the frame."""
    expected, expected_covariance, state, covariance = map(np.array, zip(*steps, strict=True))
    return expected, expected_covariance, state, covariance


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
    move: Floats, expected: Floats, expected_covariance: Floats, state: Floats, covariance: Floats
) -> None:
    """Smooth filtered states (frames, 4) and covariances (frames, 4, 4) in place.

    Rauch, Tung and Striebel; `expected` and its covariance are the predicted ones.
    """
    for n in range(len(state) - 2, -1, -1):
        gain = covariance[n] @ move.T @ np.linalg.inv(expected_covariance[n + 1])
        state[n] += gain @ (state[n + 1] - expected[n + 1])
        covariance[n] += gain @ (covariance[n + 1] - expected_covariance[n + 1]) @ gain.T


@compile_kernel
def compare(
    states: Floats, covariance: Floats, places: Floats, noise: Floats, clock: float
) -> tuple[Floats, Floats]:
    """Return squared Mahalanobis distances and log determinants (tracks, sights).

    Predicted states (tracks, 4) have a covariance (tracks, 4, 4), places (sights, 2) [m], seen
    `clock` [s] after the frame, a noise (sights, 2, 2) [m^2].
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
