"""How a detector errs: one rate per kind of error, and the random processes behind them."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.signal import lfilter

from data_contracts.records import Record


class ObservationNoise(Record):
    """Errors of a 2D pose detector on people who are small in the picture.

    Spreads are standard deviations per image axis. Those relative to a person's height in the
    picture hold for a joint of average difficulty; each joint's own is in proportion to its COCO
    sigma (eyes a third, hips four thirds).
    """

    white: float = Field(default=0.015, ge=0)
    """Error anew in every frame [person height]: what heatmap detectors show on people of 100 px;
    with `slow` it comes to 2 % of the height, 4 cm."""
    slow: float = Field(default=0.015, ge=0)
    """Error that drifts [person height]: a pose, a shirt or a background misleads for a while, so
    that averaging over frames does not remove it."""
    slow_time: float = Field(default=0.3, gt=0)
    """Time in which the drift forgets itself by a factor e [s]: a fraction of a stride."""
    floor: float = Field(default=0.5, ge=0)
    """Added to `white` in squares [px]: no detector beats its heatmap's grid."""
    fewest_joints: int = Field(default=5, ge=0)
    """A person with fewer joints in the picture is not found [1]: detectors want a body, not a
    hand at the border."""
    joint_missed: float = Field(default=0.02, ge=0, le=1)
    """Share of visible joints not reported [1]: detectors withhold the least sure ones."""
    person_missed: float = Field(default=0.03, ge=0, lt=1)
    """Share of frames in which a visible person is not found at all [1]."""
    person_missed_time: float = Field(default=0.2, gt=0)
    """Mean length of such a gap [s]: misses come in bursts, for the picture hardly changes."""
    hidden_spread: float = Field(default=1.0, ge=0)
    """Further error of a joint hidden behind a person, in units of its usual one [1]: the
    detector guesses from the rest of the body; 1 doubles the error."""
    hidden_joint_missed: float = Field(default=0.4, ge=0, le=1)
    """Share of hidden joints not reported [1]."""
    hidden_person_missed: float = Field(default=0.9, ge=0, le=1)
    """Share of frames in which a mostly hidden person is not found [1]: one box is left of two
    when they overlap that much."""
    swapped: float = Field(default=0.02, ge=0, lt=1)
    """Share of person-frames with left and right exchanged [1]: backs taken for fronts."""
    swapped_time: float = Field(default=0.15, gt=0)
    """Mean length of such an exchange [s]."""
    false_people: float = Field(default=0.1, ge=0, lt=1)
    """People reported where nobody is, mean number a frame and camera [1]: shadows, boards."""
    false_people_time: float = Field(default=0.3, gt=0)
    """Mean time one of them stays [s]."""
    false_doubt: float = Field(default=0.4, ge=0, lt=1)
    """By how much they lower the confidence, as a share of it [1]."""
    confidence_drop: float = Field(default=8.0, ge=0)
    """A joint with error e [person height] has confidence exp(-drop e) [1]: 0.85 at 2 %."""
    hidden_doubt: float = Field(default=0.5, ge=0, lt=1)
    """By how much being hidden lowers a joint's confidence, as a share of it [1]."""
    confidence_spread: float = Field(default=0.05, ge=0)
    """Error of the confidence itself, relative [1]: it reflects the truth, not gives it away."""

    @classmethod
    def none(cls) -> Self:
        """A detector that reports every joint in the picture, exactly and surely."""
        rates = [name for name in cls.model_fields if not name.endswith("_time")]
        return cls(**dict.fromkeys(rates, 0.0))


def drift(
    shape: tuple[int, ...], time: float, fps: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A stationary first-order autoregressive process of unit variance along the first axis.

    Args:
        shape: (frames, ...).
        time: time constant [s].
        fps: [1/s].
        rng: draws `shape` normal numbers.
    """
    keep = float(np.exp(-1.0 / (time * fps)))
    shocks = rng.standard_normal(shape)
    shocks[1:] *= np.sqrt(1.0 - keep**2)
    process: NDArray[np.float64] = lfilter([1.0], [1.0, -keep], shocks, axis=0)
    return process


def bursts(
    share: float, time: float, shape: tuple[int, ...], fps: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """A stationary on-off process along the first axis: on for a given share of the frames.

    Args:
        share: of frames that are on, below 1.
        time: mean length of a stretch that is on [s]; at least a frame.
        shape: (frames, ...).
        fps: [1/s].
        rng: draws `shape` uniform numbers.
    """
    draws = rng.random(shape)
    # A draw below `start` switches on, one above 1 - stop switches off, others change nothing.
    rate = min(1.0, 1.0 / (time * fps * (1.0 - share)))
    start, stop = share * rate, (1.0 - share) * rate
    event = (draws < start).astype(np.int8) - (draws >= 1.0 - stop)
    event[:1] = np.where(draws[:1] < share, 1, -1)
    frame = np.arange(shape[0]).reshape(-1, *(1 for _ in shape[1:]))
    latest = np.maximum.accumulate(np.where(event != 0, frame, 0), axis=0)
    on: NDArray[np.bool_] = np.take_along_axis(event, latest, axis=0) > 0
    return on
