"""People followed from frame to frame: matching, births, losses, merges (T1, T2)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from worldpose.tracking.affinity import match_greedily, match_optimally, ray_affinity
from worldpose.tracking.camera_gates import CameraGates
from worldpose.tracking.epipolar import associate
from worldpose.tracking.intersection import intersect_people
from worldpose.tracking.joining import Candidate, End, decide, ends_of, join_costs
from worldpose.tracking.person import Person, separations
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.sightings import Sighting

MIN_AREA = 25.0
"""Least ground on which strangers may appear [m^2]: a room."""


class Follower:
    """The people of a clip, frame by frame.

    Attributes:
        active: who is being followed.
        lost: whom nobody saw for a while; only in causal mode, where they may come back.
        ended: whose track is over.
        joins: causal decisions about who came back.
        merged: tracks that turned out to be on another's person.
        detections: detections with enough joints to be matched.
    """

    def __init__(
        self,
        centers: NDArray[np.float64],
        fps: float,
        ground: bool,
        people: int | None,
        settings: TrackingSettings,
    ) -> None:
        self.centers, self.fps, self.settings = centers, fps, settings
        self.ground, self.people = ground, people
        self.birth_views = min(settings.birth_views, max(2, len(centers)))
        self.confirmed_after = math.ceil(settings.min_track * fps)
        self.active: list[Person] = []
        self.lost: list[Person] = []
        self.ended: list[Person] = []
        self.joins: list[Candidate] = []
        self.near_since: dict[tuple[int, int], int] = {}
        self.born = self.merged = self.detections = 0
        self.gates = CameraGates(len(centers))
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)

    @property
    def area(self) -> float:
        """The ground on which people were seen so far [m^2]."""
        return max(MIN_AREA, float(np.prod(self.high - self.low)) if self.born else 0.0)

    def step(
        self, frame: int, directions: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> None:
        """Take in one frame's rays (cameras, detections, 17, 3) and weights."""
        usable = np.count_nonzero(weights > 0.0, axis=-1) >= self.settings.min_joints
        self.detections += int(np.count_nonzero(usable))
        for person in self.active:
            person.advance(frame, self.fps, self.settings)
        taken = self._match(frame, directions, weights)
        if (usable & ~taken).any():
            left = np.where(taken[..., None], 0.0, weights)
            self._add(frame, associate(self.centers, directions, left, self.ground, self.settings))
        self._merge(frame)
        self._end(frame)

    def everyone(self) -> list[Person]:
        """Return all people ever started, in order."""
        return sorted(self.active + self.lost + self.ended, key=lambda person: person.number)

    def _confirmed(self, person: Person) -> bool:
        return person.evidence >= self.confirmed_after

    def _match(
        self, frame: int, directions: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Match the people known so far; return the detections (cameras, detections) they took."""
        settings = self.settings
        taken = np.zeros(directions.shape[:2], dtype=np.bool_)
        if not self.active:
            return taken
        self.active.sort(key=lambda person: (not self._confirmed(person), person.number))
        confirmed = sum(map(self._confirmed, self.active))
        poses = np.stack([person.pose for person in self.active])
        doubt = [person.uncertainty(frame, self.fps, settings) for person in self.active]
        usual = np.maximum(
            settings.gate_spreads * self.gates.usual[:, None],
            settings.gate_growth * np.array([person.misfit for person in self.active]),
        )
        gates = np.hypot(np.clip(usual, settings.min_gate, settings.gate), doubt)
        affinity = ray_affinity(
            poses, self.centers, directions, weights, gates, settings.min_joints
        )
        index = np.full(affinity.shape[:2], -1)
        for turn in (slice(0, confirmed), slice(confirmed, None)):
            left = np.where(taken[:, None], -np.inf, affinity[:, turn])
            if settings.hungarian:
                index[:, turn] = match_optimally(left, -float(gates.max()))
            else:
                index[:, turn] = match_greedily(left)
            camera, person = np.nonzero(index >= 0)
            taken[camera, index[camera, person]] = True
        distance = -np.take_along_axis(affinity, np.maximum(index, 0)[..., None], axis=2)[..., 0]
        distance[index < 0] = np.nan
        self.gates.learn(distance)
        joints = intersect_people(
            self.centers,
            directions,
            weights,
            index,
            poses,
            settings.gate,
            math.sin(settings.min_angle),
        )
        views = np.count_nonzero(index >= 0, axis=0)
        for n in np.flatnonzero(views).tolist():
            sighting = Sighting(index[:, n], distance[:, n], joints[n])
            self.active[n].see(frame, sighting, self.fps, settings, self._evidence(views[n]))
        return taken

    def _evidence(self, views: int) -> float:
        """Return what a frame with that many views says for a person."""
        return 1.0 if views >= self.birth_views else self.settings.pair_evidence

    def _add(self, frame: int, groups: list[Sighting]) -> None:
        """Give associated groups to lost people within reach, else start new people."""
        seen = [person for person in self.active if person.last_fixed == frame]
        # A group on a person in view comes from second detections of that person.
        new = [
            group
            for group in groups
            if not _apart([group.joints], seen).min(initial=np.inf) < self.settings.merge_distance
        ]
        found = self._found_again(frame, new) if self.settings.causal and self.lost else []
        back = {join.after: join.before for join in found if join.decided}
        lost = {person.number: person for person in self.lost}
        numbers = []
        for place, group in enumerate(new):
            if place in back:
                person = lost[back[place]]
                self.lost.remove(person)
            else:
                person = Person(self.born, group.joints, frame)
                self.born += 1
            numbers.append(person.number)
            ground = np.nanmean(group.joints[:, :2], axis=0)
            self.low, self.high = np.minimum(self.low, ground), np.maximum(self.high, ground)
            self.active.append(person)
            views = int(np.count_nonzero(group.index >= 0))
            person.see(frame, group, self.fps, self.settings, self._evidence(views))
        self.joins += [replace(join, after=numbers[join.after]) for join in found]

    def _found_again(self, frame: int, groups: list[Sighting]) -> list[Candidate]:
        """Return which of the groups (`after`) are lost people, as far as the past can tell."""
        before = [self.end_of(person)[1] for person in self.lost]
        now = np.array([frame])
        after = [
            ends_of(place, now, group.joints[None], self.fps, self.settings)[0]
            for place, group in enumerate(groups)
        ]
        costs = join_costs(before, after, self.fps, self.area, self.settings)
        return decide(before, after, costs, self.settings)

    def end_of(self, person: Person) -> tuple[End, End]:
        """Return how a person's track begins and stops."""
        fixed = [
            (frame, sighting.joints)
            for frame, sighting in person.sightings.items()
            if np.isfinite(sighting.joints).any()
        ]
        frames = np.array([frame for frame, _ in fixed])
        joints = np.stack([joints for _, joints in fixed])
        return ends_of(person.number, frames, joints, self.fps, self.settings)

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
                if not self.settings.causal:
                    kept.absorb(other, near[pair])
                self.active.remove(other)
                self.ended.append(other)
                self.merged += 1
        self.near_since = near

    def _end(self, frame: int) -> None:
        """Lose people unseen for too long; ghosts have little patience."""
        settings = self.settings
        for person in list(self.active):
            patience = settings.max_coast if self._confirmed(person) else settings.min_track
            if (frame - person.last_fixed) / self.fps > patience:
                self.active.remove(person)
                back = settings.causal and self._confirmed(person)
                (self.lost if back else self.ended).append(person)
        for person in list(self.lost):
            if (frame - person.last_fixed) / self.fps > settings.max_lost:
                self.lost.remove(person)
                self.ended.append(person)


def _apart(poses: list[NDArray[np.float64]], people: list[Person]) -> NDArray[np.float64]:
    """Return mean joint distances (poses, people) [m]."""
    if not poses or not people:
        return np.empty((len(poses), len(people)))
    return separations(np.stack(poses), np.stack([person.pose for person in people]))
