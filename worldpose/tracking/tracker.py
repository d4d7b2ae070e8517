"""Who is who, in every camera and over time: matching, births, losses, merges (T1, T2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from data_contracts.records import Record
from data_contracts.tracking import Track
from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.tracking.affinity import match_greedily, ray_affinity
from worldpose.tracking.epipolar import associate
from worldpose.tracking.intersection import intersect_people
from worldpose.tracking.person import Person, Sighting, separations
from worldpose.tracking.settings import TrackingSettings

JOINTS = len(COCO17)
BLOCK = 64
"""Frames whose rays are computed at a time: bounds the memory, not the result."""


class TrackingReport(Record):
    """How tracking went."""

    births: int
    """Tracks started [1]."""
    dropped: int
    """Of these, dropped for being too short [1]: ghosts."""
    merged: int
    """Of these, ended because another was on the same person [1]."""
    losses: int
    """Tracks that ended before the clip did [1]."""
    refound: int
    """Times that a lost person was found again by association [1]."""
    detections: int
    """Detections with enough joints to be matched [1]."""
    unmatched_share: float | None
    """Share of them that is no tracked person; None without any."""
    mean_ray_distance_m: float | None
    """Mean of `ray_distance` [m]; None without a match."""


@dataclass(frozen=True)
class Tracking:
    """Which detection is which person.

    Attributes:
        person: (persons,) int32 ids from 0, in the order of first appearance.
        detection_index: (frames, cameras, persons) int16, place among the detections of this
            frame and camera; -1 = not seen.
        ray_distance: (frames, cameras, persons) float32, mean distance of the detection's rays to
            the person when matched [m]; NaN = not seen.
        joints: (frames, persons, 17, 3) float32 quick joints [m], world; NaN where fewer than two
            views determine one.
        tracks: one summary a person.
        report: figures for the whole clip.
    """

    person: NDArray[np.int32]
    detection_index: NDArray[np.int16]
    ray_distance: NDArray[np.float32]
    joints: NDArray[np.float32]
    tracks: tuple[Track, ...]
    report: TrackingReport


def track_people(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    fps: float,
    settings: TrackingSettings,
    progress: Callable[[int, int], None] | None = None,
) -> Tracking:
    """Return which detection of every camera is which person, over a clip.

    Every frame, known people take detections by ray distance, best first, confirmed people before
    new ones (T1); detections left over are associated across views and start people, or continue
    lost ones (T2).

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17) in (0, 1]; NaN or 0 leaves a keypoint out.
        fps: frames per second [1/s].
        settings: gates, least views and times.
        progress: called with frames done and frames in all.

    Raises:
        InputError: the shapes do not fit together.

    Note:
        T1, T2. Constant velocity between frames departs from the paper (`predict_motion`).
    """
    if keypoints.shape != (*confidence.shape, 2) or cameras.batch_shape != confidence.shape[1:2]:
        raise InputError(
            "tracking",
            expected="keypoints (frames, cameras, detections, joints, 2), confidence without the "
            "last, cameras (cameras,)",
            found=f"{keypoints.shape}, {confidence.shape}, {cameras.batch_shape}",
            todo="Give arrays of the same clip and cameras.",
        )
    tracker = _Tracker(np.ascontiguousarray(cameras.center), fps, settings)
    frames = len(keypoints)
    for start in range(0, frames, BLOCK):
        image = np.asarray(keypoints[start : start + BLOCK], dtype=np.float64)
        weights = np.array(confidence[start : start + BLOCK], dtype=np.float64, order="C")
        directions = cameras.unproject(image.reshape(*image.shape[:2], -1, 2)).directions
        directions = directions.reshape(*image.shape[:-1], 3)
        seen = np.isfinite(directions[..., 0]) & (weights > 0.0)
        # Angles are known to a pixel over the focal length.
        weights *= (cameras.focal**2).mean(axis=-1)[:, None, None]
        weights[~seen] = 0.0
        directions = np.where(seen[..., None], directions, np.nan)
        for offset in range(len(image)):
            tracker.step(start + offset, directions[offset], weights[offset])
            if progress is not None:
                progress(start + offset + 1, frames)
    return tracker.result(frames)


class _Tracker:
    """The people of a clip, frame by frame."""

    def __init__(
        self, centers: NDArray[np.float64], fps: float, settings: TrackingSettings
    ) -> None:
        self.centers, self.fps, self.settings = centers, fps, settings
        self.confirmed_after = math.ceil(settings.min_track * fps)
        self.active: list[Person] = []
        self.ended: list[Person] = []
        self.near_since: dict[tuple[int, int], int] = {}
        self.merged = self.refound = self.detections = 0

    def step(
        self, frame: int, directions: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> None:
        """Take in one frame's rays (cameras, detections, 17, 3) and weights."""
        usable = np.count_nonzero(weights > 0.0, axis=-1) >= self.settings.min_joints
        self.detections += int(np.count_nonzero(usable))
        for person in self.active:
            person.advance(frame, self.fps, self.settings)
        taken = self._match(frame, directions, weights)
        groups = associate(
            self.centers,
            np.where(taken[..., None, None], np.nan, directions),
            np.where(taken[..., None], 0.0, weights),
            self.settings,
        )
        self._add(frame, groups)
        self._merge(frame)
        self._end(frame)

    def _match(
        self, frame: int, directions: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Match the people known so far; return the detections (cameras, detections) they took."""
        taken = np.zeros(directions.shape[:2], dtype=np.bool_)
        if not self.active:
            return taken
        self.active.sort(key=lambda person: (person.fixed < self.confirmed_after, person.number))
        confirmed = sum(person.fixed >= self.confirmed_after for person in self.active)
        poses = np.stack([person.pose for person in self.active])
        affinity = ray_affinity(poses, self.centers, directions, self.settings.min_joints)
        index = np.full(affinity.shape[:2], -1)
        for turn in (slice(0, confirmed), slice(confirmed, None)):
            left = np.where(taken[:, None], -np.inf, affinity[:, turn])
            index[:, turn] = match_greedily(left, self.settings.gate)
            camera, person = np.nonzero(index >= 0)
            taken[camera, index[camera, person]] = True
        distance = -np.take_along_axis(affinity, np.maximum(index, 0)[..., None], axis=2)[..., 0]
        distance[index < 0] = np.nan
        joints = intersect_people(
            self.centers,
            directions,
            weights,
            index,
            poses,
            self.settings.gate,
            math.sin(self.settings.min_angle),
        )
        for n, someone in enumerate(self.active):
            if (index[:, n] >= 0).any():
                sighting = Sighting(index[:, n], distance[:, n], joints[n])
                someone.see(frame, sighting, self.fps, self.settings)
        return taken

    def _add(self, frame: int, groups: list[Sighting]) -> None:
        """Give associated groups to lost people within reach, else start new people."""
        seen = [person for person in self.active if person.last_fixed == frame]
        lost = [person for person in self.active if person.last_fixed < frame]
        # A group on a person in view comes from second detections of that person.
        new = [
            group
            for group in groups
            if not _apart([group.joints], seen).min(initial=np.inf) < self.settings.merge_distance
        ]
        apart = _apart([group.joints for group in new], lost)
        unseen = np.array([frame - person.last_fixed for person in lost]) / self.fps
        apart[apart > self.settings.gate + self.settings.refound_speed * unseen] = np.inf
        place = match_greedily(-apart[None], np.finfo(np.float64).max)[0]
        for group, old in zip(new, place, strict=True):
            if old >= 0:
                person = lost[old]
                self.refound += 1
            else:
                person = Person(len(self.active) + len(self.ended), group.joints, frame)
                self.active.append(person)
            person.see(frame, group, self.fps, self.settings)

    def _merge(self, frame: int) -> None:
        """End people who have been where another is for `merge_time`."""
        seen = [person for person in self.active if person.last_fixed == frame]
        seen.sort(key=lambda person: (-person.fixed, person.number))
        apart = _apart([person.pose for person in seen], seen)
        near: dict[tuple[int, int], int] = {}
        for a, b in np.argwhere(np.triu(apart < self.settings.merge_distance, 1)):
            kept, other = seen[a], seen[b]
            pair = (min(kept.number, other.number), max(kept.number, other.number))
            near[pair] = self.near_since.get(pair, frame)
            long_enough = (frame - near[pair]) / self.fps >= self.settings.merge_time
            if long_enough and kept in self.active and other in self.active:
                kept.absorb(other, near[pair])
                self._retire(other)
                self.merged += 1
        self.near_since = near

    def _end(self, frame: int) -> None:
        """End people unseen for too long; ghosts have little patience."""
        for person in list(self.active):
            confirmed = person.fixed >= self.confirmed_after
            patience = self.settings.max_lost if confirmed else self.settings.min_track
            if (frame - person.last_fixed) / self.fps > patience:
                self._retire(person)

    def _retire(self, person: Person) -> None:
        self.active.remove(person)
        self.ended.append(person)

    def result(self, frames: int) -> Tracking:
        """Return the tracks that lasted, over `frames` frames."""
        everyone = sorted(self.active + self.ended, key=lambda person: person.number)
        needed = min(max(1, self.confirmed_after), frames)
        kept = [person for person in everyone if person.fixed >= needed]
        cameras = len(self.centers)
        index = np.full((frames, cameras, len(kept)), -1, dtype=np.int16)
        distance = np.full(index.shape, np.nan, dtype=np.float32)
        joints = np.full((frames, len(kept), JOINTS, 3), np.nan, dtype=np.float32)
        tracks = []
        for n, person in enumerate(kept):
            for frame, sighting in person.sightings.items():
                # What single views matched after the last fix may be anyone.
                if frame <= person.last_fixed:
                    index[frame, :, n] = sighting.index
                    distance[frame, :, n] = sighting.ray_distance
                    joints[frame, n] = sighting.joints
            views = np.count_nonzero(index[:, :, n] >= 0, axis=1)
            present = np.flatnonzero(views)
            tracks.append(
                Track(
                    person=n,
                    first_frame=int(present[0]),
                    last_frame=int(present[-1]),
                    frames_seen=len(present),
                    views=float(views[present].mean()),
                )
            )
        matched = np.isfinite(distance)
        count = int(np.count_nonzero(matched))
        report = TrackingReport(
            births=len(everyone),
            dropped=len(everyone) - len(kept),
            merged=self.merged,
            losses=sum(track.last_frame < frames - 1 for track in tracks),
            refound=self.refound,
            detections=self.detections,
            unmatched_share=1.0 - count / self.detections if self.detections else None,
            mean_ray_distance_m=float(distance[matched].mean(dtype=np.float64)) if count else None,
        )
        person_ids = np.arange(len(kept), dtype=np.int32)
        return Tracking(person_ids, index, distance, joints, tuple(tracks), report)


def _apart(poses: list[NDArray[np.float64]], people: list[Person]) -> NDArray[np.float64]:
    """Return mean joint distances (poses, people) [m]."""
    if not poses or not people:
        return np.empty((len(poses), len(people)))
    return separations(np.stack(poses), np.stack([person.pose for person in people]))
