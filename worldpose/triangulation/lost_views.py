"""Cameras whose people meet nobody from some frame on: knocked far, or many frames late.

A detection meets a person where the middles of their torsos are nearer than a reach r in the image.
If a change is too large for the tracker to follow, this share of the detections and people that
could meet falls at once. The change is the shift of the view, or of the clock, with which most meet
again, detections i and people p that are tracked at t:

    max_d sum_t min(#{i: min_p e_ip(t) < r}, #{p: min_i e_ip(t) < r}),
    e_ip(t) = |x_i(t) - d - pi(X_p(t))|, or |x_i(t) - pi(X_p(t + k))| for max_k.

So neither bystanders nor hidden people count, nor people who stood there while they were tracked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from data_contracts.arrays import AnyFloats, ClipArray, Flags, Floats, Integers
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.camera_changes import MeasuredChange
from worldpose.triangulation.change_sums import WIDTH, Kind


def find_lost_views(
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    joints: AnyFloats,
    fps: float,
    kinds: Sequence[Kind] = ("clock", "view"),
) -> list[MeasuredChange]:
    """Return the sudden changes that keep a camera's people from meeting those of the others.

    The one by which most detections meet again is the first; it may be the cause of the others.

    Args:
        cameras: batch (cameras,); fewer than three never have any.
        detections: all detections of a clip, (frames, cameras, detections).
        joints: (frames, persons, 17, 3) of tracked people [m], world.
        fps: frames per second [1/s].
        kinds: what may change.
    """
    each = _meetings(cameras, detections, joints, fps)
    found = [camera.find_change(c, kinds) for c, camera in enumerate(each)]
    lost = [change for change in found if change is not None]
    return sorted(lost, key=lambda change: -change.gain)


def find_lone_views(
    cameras: Camera, detections: KeypointDetections[ClipArray], joints: AnyFloats, fps: float
) -> dict[int, int]:
    """Return the cameras most of whose people meet nobody from some row on, and that row.

    The others place people in the camera's view, and it has more detections that meet nobody than
    before: people who are hidden or who leave, and bystanders, do not add any. No change explains
    them if `find_lost_views` does not. Arguments as there.
    """
    each = _meetings(cameras, detections, joints, fps)
    rows = ((c, camera.find_lone_row()) for c, camera in enumerate(each))
    return {c: row for c, row in rows if row is not None}


def _meetings(
    cameras: Camera, detections: KeypointDetections[ClipArray], joints: AnyFloats, fps: float
) -> Iterator[_Meetings]:
    """Yield what each camera of a rig sees, by the arguments of `find_lost_views`."""
    if len(cameras.focal) < 3 or not joints.shape[1]:
        return
    seen = _middles(detections)
    people = np.asarray(joints[:, :, _TORSO], dtype=np.float64).mean(axis=2)
    for c in range(len(cameras.focal)):
        yield _Meetings(cameras[c], seen[:, c], people, fps)


_TORSO = [COCO17.index(f"{side}_{at}") for side in ("left", "right") for at in ("shoulder", "hip")]


def _middles(detections: KeypointDetections[ClipArray]) -> Floats:
    """Return the middles of torsos (frames, cameras, detections, 2) [px], read in blocks."""
    block, parts = 256, []
    for start in range(0, detections.score.shape[0], block):
        seen = detections[start : start + block]
        middle = np.asarray(seen.keypoints[:, :, :, _TORSO], dtype=np.float64)
        middle[~(seen.confidence[:, :, :, _TORSO] > 0.0)] = np.nan
        parts.append(middle.mean(axis=3))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class _Meetings:
    """Detections of a camera and the people whom all cameras track.

    Attributes:
        seen: (frames, detections, 2) middles of torsos [px].
        people: (frames, persons, 3) middles of torsos [m], world.
    """

    camera: Camera
    seen: Floats
    people: Floats
    fps: float

    def find_change(self, number: int, kinds: Sequence[Kind]) -> MeasuredChange | None:
        """Return the change of this camera, the given one of the rig; None if there is none."""
        second = max(2, round(self.fps))
        rows, margin = self._moments()
        met, count = self._met(rows), self._count(rows)
        place = _fall(met, count, margin)
        if place is None:
            return None
        chosen = rows[np.unique(np.linspace(place, len(rows) - 1, 100).astype(int))]
        seen = self._count(chosen)
        # One person always meets the others somewhere.
        if seen[seen > 0].mean() < 1.2:
            return None
        late, shift = self._best_delay(chosen, 2 * second), self._best_shift(chosen)
        changes: dict[Kind, tuple[int, Floats]] = {"clock": (late, np.zeros(2)), "view": (0, shift)}
        for wide in (1.0, 2.0):  # a turned view is not shifted everywhere alike
            usual = self._met(rows[:place], wide).sum() / count[:place].sum()
            now = self._met(chosen, wide).sum() / seen.sum()
            by = {k: self._met(chosen, wide, *changes[k]).sum() / seen.sum() for k in kinds}
            kind, *others = sorted(kinds, key=lambda each: -by[each])
            # Where both may explain it, the people who are tracked tell more.
            if by[kind] - max([now, *(by[k] for k in others)]) >= 0.4 * (usual - now):
                break
        else:
            return None
        late, shift = changes[kind]
        # The tracker follows less: such a change is found from its people.
        if abs(late) < 3 and np.linalg.norm(shift) < 0.5 * self._reach(chosen):
            return None
        amount = np.zeros(WIDTH)
        amount[:2], amount[4] = shift, self._finer_delay(chosen, late) if late else 0.0
        near = np.arange(
            max(0, rows[place] - 2 * second), min(len(self.seen), rows[place] + 2 * second)
        )
        gain = self._met(near) - self._met(near, late=late, shift=shift)
        row = int(near[int(np.argmax(np.concatenate([[0], np.cumsum(gain)])[: len(near)]))])
        again = (by[kind] - now) * seen.mean() * (len(rows) - place)
        return MeasuredChange(number, kind, row, amount, gain=again)

    def find_lone_row(self) -> int | None:
        """Return the row from which on most of the camera's people meet nobody; None = they do."""
        rows, margin = self._moments()
        met, count = self._met(rows), self._count(rows)
        place = _fall(met, count, margin)
        if place is None:
            return None
        shown = self._project(rows)[2].any(axis=1)
        count = self._count_detections(rows)
        parts = [shown & side for side in (rows < rows[place], rows >= rows[place])]
        if min(part.sum() for part in parts) < margin:
            return None
        (met_before, met_now), (alone_before, alone_now) = (
            [each[part].mean() for part in parts] for each in (met, count - met)
        )
        # In small rooms, some meet others by chance.
        is_rare = met_now <= 0.4 * met_before
        more, least = alone_now - alone_before, max(met_before - met_now, alone_before)
        return int(rows[place]) if is_rare and more >= 0.5 * least else None

    def _moments(self) -> tuple[Integers, int]:
        """Return rows to compare, and how many of them are the least before or after a change."""
        second = max(2, round(self.fps))
        # Long clips need no more moments, and have many people.
        every = max(1, second // 10, len(self.seen) // 3000)
        return np.arange(0, len(self.seen), every), max(5, second // every)

    def _count(self, rows: Integers) -> Integers:
        """Return how many detections (n,) could each meet a person in view."""
        people = self._project(rows)[2].sum(axis=1)
        return np.asarray(np.minimum(self._count_detections(rows), people))

    def _count_detections(self, rows: Integers) -> Integers:
        """Return the number (n,) of detections."""
        return np.asarray(np.isfinite(self.seen[rows, :, 0]).sum(axis=1))

    def _met(
        self, rows: Integers, wide: float = 1.0, late: int = 0, shift: Floats | float = 0.0
    ) -> Integers:
        """Return how many (n,) detections and people meet within reaches, with a change."""
        met = np.zeros(len(rows), dtype=np.int64)
        block = 256  # moments in memory
        for start in range(0, len(rows), block):
            some = rows[start : start + block]
            image, reach, inside = self._project(some, late)
            off = np.linalg.norm((self.seen[some] - shift)[:, :, None] - image[:, None], axis=-1)
            near = inside[:, None] & (off < wide * reach[:, None])
            pairs = near.any(axis=2).sum(axis=1), near.any(axis=1).sum(axis=1)
            met[start : start + block] = np.minimum(*pairs)
        return met

    def _project(self, rows: Integers, late: int = 0) -> tuple[Floats, Floats, Flags]:
        """Return images of people (n, persons, 2), their reach [px], and who is in view."""
        reach_m = 0.3
        then = rows + late
        there = (then >= 0) & (then < len(self.people))
        people = self.people[np.clip(then, 0, len(self.people) - 1)]
        depth = self.camera.cam_from_world.apply(people.reshape(-1, 3))[:, 2].reshape(
            people.shape[:2]
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            image = self.camera.project(people.reshape(-1, 3)).reshape(*people.shape[:2], 2)
            reach = reach_m * self.camera.focal.mean() / depth
            # Whoever is not tracked now may stand where he stood then.
            inside = there[:, None] & (depth > 0.0) & np.isfinite(self.people[rows, :, 0])
            inside &= ((image >= 0.0) & (image < self.camera.image_size)).all(axis=-1)
        return image, reach, inside

    def _reach(self, rows: Integers) -> float:
        """Return the usual reach of people [px]."""
        _, reach, inside = self._project(rows)
        return float(np.median(reach[inside])) if inside.any() else np.inf

    def _best_delay(self, rows: Integers, most: int) -> int:
        """Return the delay [frame] by which most detections meet people."""
        delays = np.arange(-most, most + 1)
        met = np.array([self._met(rows, late=int(k)).sum() for k in delays])
        # People who move little meet at several delays.
        return int(np.median(delays[met >= 0.98 * met.max()]))

    def _finer_delay(self, rows: Integers, late: int) -> float:
        """Return the delay [frame] near a whole one with the least distances of those who meet.

        With the motion u of their images in a frame, sum |x - pi(X(t + late)) - d u|^2 is least.
        """
        image, reach, inside = self._project(rows, late)
        motion = 0.5 * (self._project(rows, late + 1)[0] - self._project(rows, late - 1)[0])
        off = self.seen[rows][:, :, None] - image[:, None]
        motion = np.broadcast_to(motion[:, None], off.shape)
        near = inside[:, None] & (np.linalg.norm(off, axis=-1) < reach[:, None])
        near &= np.isfinite(motion).all(axis=-1)
        least = float((motion[near] ** 2).sum())
        return late + float(np.clip((motion[near] * off[near]).sum() / max(least, 1e-9), -2.0, 2.0))

    def _best_shift(self, rows: Integers) -> Floats:
        """Return the shift (2,) [px] by which most detections meet people: six degrees at most."""
        image, reach, inside = self._project(rows)
        off = self.seen[rows][:, :, None] - image[:, None]
        with np.errstate(invalid="ignore"):
            near = inside[:, None] & (np.abs(off) < 0.1 * self.camera.focal.mean()).all(axis=-1)
        votes = off[near]
        if not len(votes):
            return np.zeros(2)
        radius = float(np.median(np.broadcast_to(reach[:, None], near.shape)[near]))
        # Cells of half a radius; the true shift is spread over some of them.
        cells = np.arange(votes.min() - radius, votes.max() + radius, 0.5 * radius)
        counts = uniform_filter(
            np.histogram2d(votes[:, 0], votes[:, 1], bins=[cells, cells])[0], 3, mode="constant"
        )
        best = np.unravel_index(np.argmax(counts), counts.shape)
        shift = cells[np.array(best)] + 0.25 * radius
        for _ in range(5):
            shift = votes[np.linalg.norm(votes - shift, axis=1) < radius].mean(axis=0)
        return np.asarray(shift)


def _fall(met: Integers, count: Integers, margin: int) -> int | None:
    """Return where the share of detections that meet people falls by a quarter or more."""
    before, after = np.cumsum(met), met.sum() - np.cumsum(met)
    seen_before, seen_after = np.cumsum(count), count.sum() - np.cumsum(count)
    inner = np.arange(margin, len(met) - margin)
    inner = inner[(seen_before[inner] >= 15) & (seen_after[inner] >= 15)]
    if not len(inner):
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        high, low = before[inner] / seen_before[inner], after[inner] / seen_after[inner]
        spread = seen_before[inner] * seen_after[inner] * (high - low) ** 2
    place = int(np.argmax(np.where(high > low, spread, -1.0)))
    is_fall = high[place] >= 0.3 and low[place] <= 0.75 * high[place]
    return int(inner[place]) + 1 if is_fall else None
