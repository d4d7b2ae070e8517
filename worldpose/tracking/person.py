"""Compact storage of a person's detections and joints per frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, MutableMapping, Sequence
from dataclasses import InitVar, dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers, Singles
from worldpose.compiled import compile_kernel
from worldpose.tracking.settings import TrackingSettings

BLOCK: Final = 16
"""Frames stored together: most ghosts need one block, and array headers cost little."""


@dataclass(frozen=True)
class Sighting:
    """Detections of one person in different views of one frame.

    Attributes:
        index: (cameras,) index of the detection; -1 = not seen.
        ray_distance: (cameras,) mean distance of its rays to the person [m]; NaN = not seen.
        joints: (17, 3) [m], world; NaN where the rays do not determine them.
    """

    index: Integers
    ray_distance: Floats
    joints: Floats

    def fill_from(self, other: Sighting) -> Sighting:
        """Return this with the other's detections in cameras without one of its own."""
        own = self.index >= 0
        return Sighting(
            np.where(own, self.index, other.index),
            np.where(own, self.ray_distance, other.ray_distance),
            np.where(np.isfinite(self.joints), self.joints, other.joints),
        )


Block = tuple[NDArray[np.int16], Singles, Singles]


class Sightings(MutableMapping[int, Sighting]):
    """Sightings by frame; stored as int16 and float32."""

    def __init__(self) -> None:
        self._place: dict[int, int] = {}
        self._blocks: list[Block] = []
        self._used = 0

    def __setitem__(self, frame: int, sighting: Sighting) -> None:
        place = self._place.get(frame, self._used)
        number, row = divmod(place, BLOCK)
        if number == len(self._blocks):
            self._blocks.append(
                (
                    np.empty((BLOCK, *sighting.index.shape), np.int16),
                    np.empty((BLOCK, *sighting.ray_distance.shape), np.float32),
                    np.empty((BLOCK, *sighting.joints.shape), np.float32),
                )
            )
        index, ray_distance, joints = self._blocks[number]
        index[row] = sighting.index
        ray_distance[row] = sighting.ray_distance
        joints[row] = sighting.joints
        self._place[frame] = place
        self._used = max(self._used, place + 1)

    def __getitem__(self, frame: int) -> Sighting:
        number, row = divmod(self._place[frame], BLOCK)
        index, ray_distance, joints = self._blocks[number]
        return Sighting(
            index[row].astype(np.int64),
            ray_distance[row].astype(np.float64),
            joints[row].astype(np.float64),
        )

    def __delitem__(self, frame: int) -> None:
        del self._place[frame]

    def stack(self) -> tuple[Integers, NDArray[np.int16], Singles, Singles]:
        """Return all sightings: frame (n,), rising, and the arrays of a sighting, each (n, ...)."""
        frame = np.array(sorted(self._place), dtype=np.int64)
        place = np.array([self._place[each] for each in frame.tolist()], dtype=np.int64)
        index, ray_distance, joints = (
            np.concatenate(parts)[place] for parts in zip(*self._blocks, strict=True)
        )
        return frame, index, ray_distance, joints

    def __iter__(self) -> Iterator[int]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)


LONE_S: Final = 1.0
"""Time for which one camera alone can follow a person [s]: bodies fill gaps up to this."""


@dataclass(eq=False)
class Person:
    """The state of one track, updated frame by frame.

    Attributes:
        number: order of birth.
        pose: (17, 3) [m], world, at the current frame; NaN for joints never determined.
        last_fixed: last frame whose rays determined the position.
        departure: (cameras,) recent mean distance of each view's rays from those of the other
            views, over its limit [1].
        followed: (cameras,) last frame in which this camera alone showed the person.
        velocity: (3,) [m/s], of the whole body.
        sightings: detections of the person, by frame.
        misfit: recent mean ray distance [m]: large where a body falls or jumps.
        fixed: number of frames whose rays determined the position.
        evidence: the same number, in which a frame with fewer views than a birth needs counts in
            part [1].
        shown_from: first frame with the evidence of a birth; -1 = none so far.
    """

    number: int
    pose: Floats
    last_fixed: int
    cameras: InitVar[int]
    departure: Floats = field(init=False)
    followed: Integers = field(init=False)
    velocity: Floats = field(default_factory=lambda: np.zeros(3))
    sightings: Sightings = field(default_factory=Sightings)
    misfit: float = 0.0
    fixed: int = 0
    evidence: float = 0.0
    shown_from: int = -1

    def __post_init__(self, cameras: int) -> None:
        self.departure, self.followed = np.zeros(cameras), np.full(cameras, -1)

    def advance(self, frame: int, fps: float, settings: TrackingSettings) -> None:
        """Predict the pose at `frame`, one frame later."""
        if settings.predict_motion:
            self.pose = self.pose + self.velocity / fps
            if self.last_fixed < frame - 1:
                self.velocity = self.velocity * math.exp(-1.0 / (fps * settings.coast_time_s))

    def see(
        self,
        frame: int,
        sighting: Sighting,
        fps: float,
        settings: TrackingSettings,
        evidence: float = 1.0,
    ) -> None:
        """Update with the sighting in `frame`; undetermined joints follow the others."""
        self.sightings[frame] = sighting
        gain = 1.0 - math.exp(-1.0 / (fps * settings.velocity_time_s))
        elapsed = (frame - self.last_fixed) / fps
        pose, shift, is_known, misfit = _shift_pose(
            self.pose, sighting.joints, sighting.ray_distance, elapsed > 0.0
        )
        self.misfit += gain * (misfit - self.misfit)
        if not is_known:
            return
        if elapsed > 0.0:
            gain = 1.0 - math.exp(-elapsed / settings.velocity_time_s)
            self.velocity = self.velocity + gain * shift / elapsed
        self.pose = pose
        self.last_fixed = frame
        self.fixed += 1
        self.evidence += evidence
        if self.shown_from < 0 and self.evidence >= 1.0 - 1e-9:
            self.shown_from = frame

    def last_followed(self, fps: float) -> int:
        """Return the last frame that fixed the person, or in which one camera then followed."""
        lone = min(int(self.followed.max()), self.last_fixed + round(LONE_S * fps))
        return max(self.last_fixed, lone)

    def follow(
        self,
        frame: int,
        center: Floats,
        camera: int,
        rays: Floats,
        fps: float,
        settings: TrackingSettings,
    ) -> None:
        """Move the predicted pose across the rays (17, 3) of the only camera that sees it."""
        away = self.pose - center
        across = (away * rays).sum(axis=-1, keepdims=True) * rays - away
        if np.isfinite(across).all(axis=-1).any():
            shift = np.nanmedian(across, axis=0)
            gain = 1.0 - math.exp(-1.0 / (fps * settings.velocity_time_s))
            self.pose, self.velocity = self.pose + shift, self.velocity + gain * fps * shift
            self.followed[camera] = frame

    def absorb(self, other: Person, since: int) -> None:
        """Move the other's sightings from frame `since` on to this person."""
        share = other.evidence / max(1, other.fixed)
        for frame in [frame for frame in other.sightings if frame >= since]:
            theirs = other.sightings.pop(frame)
            own = self.sightings.get(frame)
            self.sightings[frame] = theirs if own is None else own.fill_from(theirs)
            if np.isfinite(theirs.joints).any():
                is_new = own is None or not np.isfinite(own.joints).any()
                self.fixed += is_new
                self.evidence += is_new * share
                self.last_fixed = max(self.last_fixed, frame)
                other.fixed -= 1
        other.evidence = min(other.evidence, float(other.fixed))


def measure_doubt(
    people: Sequence[Person], frame: int, fps: float, settings: TrackingSettings
) -> Floats:
    """Return standard deviations (cameras, people) of the positions predicted at `frame` [m].

    A camera that followed the person alone knows the position across its rays.
    """
    seen = np.maximum(
        np.array([person.followed for person in people]).T.copy(),
        [person.last_fixed for person in people],
    )
    unseen = (frame - seen) / fps
    wander = settings.velocity_change_std_m_s * np.sqrt(unseen**3 / 3.0)
    # The velocity estimate needs a few frames; before, a person may be running.
    known = [1.0 - math.exp(-each.fixed / (fps * settings.velocity_time_s)) for each in people]
    away = (1.0 - np.array(known)) * settings.rms_speed_m_s * unseen
    return np.asarray(np.hypot(wander, away))


@compile_kernel
def _shift_pose(
    pose: Floats, joints: Floats, ray_distance: Floats, move: bool
) -> tuple[Floats, Floats, bool, float]:
    """Update a pose with the joints of a new frame, which are NaN where unknown.

    Return the pose, in which known joints are replaced and the others shifted by the median motion
    of the known ones; this shift (3,); whether any joint is known; the mean ray distance [m].
    """
    both, known = np.empty((len(pose), 3)), False
    count = 0
    for joint in range(len(pose)):
        if not math.isnan(joints[joint, 0]):
            known = True
            if not math.isnan(pose[joint, 0]):
                both[count] = joints[joint] - pose[joint]
                count += 1
    shift = np.zeros(3)
    if move and count:
        for axis in range(3):
            shift[axis] = np.median(both[:count, axis])
    out = pose + shift
    for joint in range(len(pose)):
        if not math.isnan(joints[joint, 0]):
            out[joint] = joints[joint]
    total, views = 0.0, 0
    for c in range(len(ray_distance)):
        if not math.isnan(ray_distance[c]):
            total, views = total + ray_distance[c], views + 1
    return out, shift, known, total / views


@compile_kernel
def separations(a: Floats, b: Floats) -> Floats:
    """Return mean distances (n, m) [m] of poses a (n, 17, 3) and b (m, 17, 3) [m], world.

    It is that of the joints known in both; infinite without any.
    """
    out = np.full((len(a), len(b)), np.inf)
    for n in range(len(a)):
        for m in range(len(b)):
            total, count = 0.0, 0
            for joint in range(a.shape[1]):
                x = a[n, joint, 0] - b[m, joint, 0]
                y = a[n, joint, 1] - b[m, joint, 1]
                z = a[n, joint, 2] - b[m, joint, 2]
                distance = math.sqrt(x * x + y * y + z * z)
                if not math.isnan(distance):
                    total += distance
                    count += 1
            if count:
                out[n, m] = total / count
    return out
