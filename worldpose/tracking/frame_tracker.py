"""Frame-by-frame tracking: matching, births, losses, merges."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.geometry.cameras import Camera
from worldpose.tracking.epipolar import associate
from worldpose.tracking.joins import (
    Candidate,
    End,
    Takeover,
    choose_joins,
    find_takeovers,
    fit_track_ends,
    join_costs,
)
from worldpose.tracking.pair_births import (
    CameraGates,
    CameraVisibility,
    Pairs,
    group_pairs,
    judge_pairs,
)
from worldpose.tracking.person import Person, Sighting, measure_doubt, separations
from worldpose.tracking.ray_matching import (
    drop_inconsistent_views,
    intersect_people,
    match_greedily,
    match_optimally,
    ray_affinity,
    view_distances,
)
from worldpose.tracking.settings import TrackingSettings


class FrameTracker:
    """A clip's tracker state, updated frame by frame.

    Attributes:
        active: people being tracked.
        lost: people unseen for a while; only in causal mode, where they may come back.
        ended: people whose track is over.
        joins: causal decisions about people who came back.
        takeovers: frames in which a track may have passed to another person.
        merged: number of tracks that duplicated another's person.
        detections: number of detections with enough joints to be matched.
        departure: (cameras,) recent distance of a camera's rays from those of the others for most
            people, over its limit [1].
    """

    def __init__(
        self,
        cameras: Camera,
        fps: float,
        ground: bool,
        people: int | None,
        settings: TrackingSettings,
    ) -> None:
        if not ground:
            settings = settings.model_copy(update={"newcomer_odds": settings.visitor_odds})
        self.visibility = CameraVisibility(cameras)
        self.centers, self.fps, self.settings = self.visibility.centers, fps, settings
        self.ground, self.people = ground, people
        self.confirmed_after = math.ceil(settings.min_track_s * fps)
        self.active: list[Person] = []
        self.lost: list[Person] = []
        self.ended: list[Person] = []
        self.joins: list[Candidate] = []
        self.takeovers: list[Takeover] = []
        self.near_since: dict[tuple[int, int], int] = {}
        self.born = self.merged = self.detections = 0
        self.gates = CameraGates(len(self.centers))
        self.departure = np.zeros(len(self.centers))
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)

    @property
    def area(self) -> float:
        """Ground area on which people were seen so far [m^2]."""
        # Least ground area on which strangers may appear [m^2]: a room.
        return max(25.0, float(np.prod(self.high - self.low)) if self.born else 0.0)

    @property
    def is_idle(self) -> bool:
        """Whether a frame without detections changes nothing: no person is followed or lost."""
        return not (self.active or self.lost)

    def step(self, frame: int, directions: Floats, weights: Floats) -> None:
        """Update with one frame's rays (cameras, detections, 17, 3) and weights."""
        usable = np.count_nonzero(weights > 0.0, axis=-1) >= self.settings.min_joints
        self.detections += int(np.count_nonzero(usable))
        for person in self.active:
            person.advance(frame, self.fps, self.settings)
        index, distance, joints = self._match(frame, directions, weights)
        left = _drop_matched(weights, index)
        gate = self._clear_gate()
        groups = associate(self.centers, directions, left, self.ground, self.settings, gate)
        views = np.count_nonzero(index >= 0, axis=0)
        known = views >= self.settings.birth_views
        known |= np.array([self._is_confirmed(person) for person in self.active], dtype=np.bool_)
        found = _stack_matches(groups, len(self.centers))
        self._learn(frame, joints, index, known, groups, directions, weights)
        pairs: Pairs | None = None
        left = _drop_matched(left, found)
        if (views[~known] == 2).any() or _has_two_cameras(left, self.settings.min_joints):
            free = _drop_matched(_drop_matched(weights, index[:, known]), found)
            pairs = judge_pairs(
                directions,
                free,
                self.visibility,
                self.gates,
                self.ground,
                self.settings,
                everything=weights,
            )
            # A clear pair explains its detections better than three views far from each other.
            # Odds of two views of a new person that rule out three views far from each other [1].
            clear = group_pairs(pairs, left, self.settings, 10.0)
            left = _drop_matched(left, _stack_matches(clear, len(self.centers)))
            wide = associate(self.centers, directions, left, self.ground, self.settings)
            left = _drop_matched(left, _stack_matches(wide, len(self.centers)))
            groups += clear + wide + group_pairs(pairs, left, self.settings)
        for n in np.flatnonzero(views).tolist():
            sighting = Sighting(index[:, n], distance[:, n], joints[n])
            evidence = self._evidence(sighting, None if known[n] else pairs)
            self.active[n].see(frame, sighting, self.fps, self.settings, evidence)
        self._add(frame, groups, pairs)
        self._merge(frame)
        self._end(frame)

    def _clear_gate(self) -> float:
        """Return the distance of rays within which three views agree without doubt [m]."""
        widest = self.settings.epipolar_gate_m
        usual = self.gates.usual[np.isfinite(self.gates.usual)]
        gate = self.settings.gate_factor * float(np.median(usual)) if len(usual) else 0.0
        # Mean distance of rays within which three views of a new person agree without doubt, at
        # least [m].
        return min(max(gate, 0.15), widest)

    def _learn(
        self,
        frame: int,
        joints: Floats,
        index: Integers,
        known: Flags,
        groups: list[Sighting],
        directions: Floats,
        weights: Floats,
    ) -> None:
        """Update visibility statistics with new groups, and every few frames with known people."""
        # Interval between frames in which visibility statistics use known people.
        used = np.flatnonzero(known).tolist() if frame % 5 == 0 else []
        seen = [(joints[n], index[:, n] >= 0) for n in used]
        seen += [(group.joints, group.index >= 0) for group in groups]
        seen = [each for each in seen if np.isfinite(each[0]).any()]
        if seen:
            bodies = np.array([each for each, _ in seen])
            showing = np.ascontiguousarray(np.array([each for _, each in seen]).T)
            self.visibility.learn(bodies, directions, weights, showing)

    def all_people(self) -> list[Person]:
        """Return all people ever started, in order."""
        return sorted(self.active + self.lost + self.ended, key=lambda person: person.number)

    def _is_confirmed(self, person: Person) -> bool:
        return person.evidence >= self.confirmed_after

    def _match(
        self, frame: int, directions: Floats, weights: Floats
    ) -> tuple[Integers, Floats, Floats]:
        """Match the known people."""
        settings = self.settings
        taken = np.zeros(directions.shape[:2], dtype=np.bool_)
        if not self.active:
            none = np.full((len(self.centers), 0), -1)
            return none, np.empty(none.shape), np.empty((0, directions.shape[2], 3))
        self.active.sort(key=lambda person: (not self._is_confirmed(person), person.number))
        confirmed = sum(map(self._is_confirmed, self.active))
        poses = np.array([person.pose for person in self.active])
        doubt = measure_doubt(self.active, frame, self.fps, settings)
        usual = np.maximum(
            settings.gate_factor * self.gates.usual[:, None],
            settings.gate_growth * np.array([person.misfit for person in self.active]),
        )
        gates = np.hypot(np.clip(usual, settings.min_gate_m, settings.gate_m), doubt)
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
        self._drop_outlying_views(index, directions, affinity)
        self.takeovers += find_takeovers(self.active, frame, index, affinity)
        distance = -np.take_along_axis(affinity, np.maximum(index, 0)[..., None], axis=2)[..., 0]
        distance[index < 0] = np.nan
        self.gates.learn(distance)
        for n in np.flatnonzero(np.count_nonzero(index >= 0, axis=0) == 1).tolist():
            lone = int(index[:, n].argmax())
            rays = directions[lone, index[lone, n]]
            self.active[n].follow(frame, self.centers[lone], lone, rays, self.fps, settings)
        joints = intersect_people(
            self.centers,
            directions,
            weights,
            index,
            poses,
            settings.gate_m,
            math.sin(settings.min_angle_rad),
        )
        return index, distance, joints

    def _drop_outlying_views(self, index: Integers, directions: Floats, affinity: Floats) -> None:
        """Remove, from `index`, matches whose rays pass too far from those of the other views.

        Of two views, the one nearer to the prediction stays. After a crossing, the detection of a
        neighbour can remain within the gate: its rays are apart for a while, in each frame by less
        than tells in one frame (`drop_inconsistent_views`). A camera that moved keeps its people.
        """
        apart = view_distances(self.centers, directions, index)
        camera = np.arange(len(index))
        noise = self.gates.pair_noise(camera[:, None], camera)
        for n in np.flatnonzero(np.count_nonzero(index >= 0, axis=0) == 2).tolist():
            a, b = np.flatnonzero(index[:, n] >= 0)
            # Largest distance of the rays of two views of one person, in standard deviations.
            limit = max(3.0 * noise[a, b], self.settings.gate_growth * self.active[n].misfit)
            if not apart[n, a, b] <= limit:
                i, j = index[a, n], index[b, n]
                index[a if affinity[a, n, i] < affinity[b, n, j] else b, n] = -1
        gain = 1.0 - math.exp(-1.0 / (self.fps * self.settings.velocity_time_s))
        # The same for mean distances, and the motion between images half a frame apart.
        speed = np.linalg.norm([person.velocity for person in self.active], axis=1)
        shares = apart / (2.5 * noise + 0.5 * speed[:, None, None] / self.fps)
        moved = self._find_moved_cameras(shares, gain)
        shares[:, moved] = shares[:, :, moved] = math.inf
        departure = np.array([person.departure for person in self.active])
        drop_inconsistent_views(shares, index, departure, gain)
        for person, each in zip(self.active, departure, strict=True):
            person.departure = each

    def _find_moved_cameras(self, shares: Floats, gain: float) -> Flags:
        """Return the cameras (cameras,) that depart for most people: they moved.

        `shares` (persons, cameras, cameras) are distances of rays over their limits, infinite if
        unknown; `gain` is that of the running mean of the people's lower median.
        """
        by_person = _lower_median(shares)
        middle, many = _lower_median(by_person.T), np.isfinite(by_person).sum(axis=0) > 1
        self.departure[many] += gain * (middle - self.departure)[many]
        # About 0.1 without a fault; a knock by 27 px at 10 m gives 1.
        return np.asarray(self.departure > 0.5)

    def _evidence(self, sighting: Sighting, pairs: Pairs | None) -> float:
        """Return a sighting's weight as evidence that its person exists [1].

        Two views count in full if the odds are clear, not at all if the detections more likely
        belong to others, and in part otherwise.
        """
        settings = self.settings
        views = np.count_nonzero(sighting.index >= 0)
        if views >= settings.birth_views:
            return 1.0
        if views < 2 or pairs is None:
            return settings.pair_evidence
        pair = pairs.find(sighting.index)
        if pair is None or not pairs.unique[pair]:
            return 0.0
        return 1.0 if pairs.odds[pair] >= settings.pair_odds else settings.pair_evidence

    def _add(self, frame: int, groups: list[Sighting], pairs: Pairs | None) -> None:
        """Assign associated groups to lost people within reach, else start new people."""
        seen = [person for person in self.active if person.last_fixed == frame]
        # A group at a person in view, or at another group, consists of duplicate detections of that
        # person.
        taken, new = [person.pose for person in seen], list[Sighting]()
        for group in groups:
            beside = separations(group.joints[None], np.array(taken)) if taken else np.array(np.inf)
            if not beside.min() < self.settings.merge_distance_m:
                new.append(group)
                taken.append(group.joints)
        found = self._recover_lost(frame, new) if self.settings.causal and self.lost else []
        back = {join.after: join.before for join in found if join.decided}
        lost = {person.number: person for person in self.lost}
        numbers = []
        for place, group in enumerate(new):
            if place in back:
                person = lost[back[place]]
                self.lost.remove(person)
            else:
                person = Person(self.born, group.joints, frame, len(self.centers))
                self.born += 1
            numbers.append(person.number)
            ground = np.nanmean(group.joints[:, :2], axis=0)
            self.low, self.high = np.minimum(self.low, ground), np.maximum(self.high, ground)
            self.active.append(person)
            evidence = self._evidence(group, pairs)
            person.see(frame, group, self.fps, self.settings, evidence)
        self.joins += [replace(join, after=numbers[join.after]) for join in found]

    def _recover_lost(self, frame: int, groups: list[Sighting]) -> list[Candidate]:
        """Return which of the groups (`after`) are lost people, judged from the past alone."""
        before = [self.track_ends(person)[1] for person in self.lost]
        now = np.array([frame])
        after = [
            fit_track_ends(
                *(place, now, group.joints[None], _views(group.index[None])),
                *(self.fps, self.settings, len(self.centers)),
            )[0]
            for place, group in enumerate(groups)
        ]
        costs = join_costs(before, after, self.fps, self.area, self.settings)
        return choose_joins(before, after, costs, self.fps, self.settings)

    def track_ends(self, person: Person) -> tuple[End, End]:
        """Return the start and the end of a person's track."""
        frames, index, _, joints = person.sightings.stack()
        fixed = np.isfinite(joints).any(axis=(1, 2))
        places = joints[fixed].astype(np.float64)
        views = _views(index[fixed])
        given = person.number, frames[fixed], places, views, self.fps, self.settings
        return fit_track_ends(*given, len(self.centers))

    def _merge(self, frame: int) -> None:
        """End people whose track has coincided with another's for `merge_time_s`."""
        seen = [person for person in self.active if person.last_fixed == frame]
        seen.sort(key=lambda person: (-person.fixed, person.number))
        apart = _pose_distances([person.pose for person in seen], seen)
        near: dict[tuple[int, int], int] = {}
        for a, b in np.argwhere(np.triu(apart < self.settings.merge_distance_m, 1)):
            kept, other = seen[a], seen[b]
            pair = (min(kept.number, other.number), max(kept.number, other.number))
            near[pair] = self.near_since.get(pair, frame)
            long_enough = (frame - near[pair]) / self.fps >= self.settings.merge_time_s
            if long_enough and kept in self.active and other in self.active:
                if not self.settings.causal:
                    kept.absorb(other, near[pair])
                self.active.remove(other)
                self.ended.append(other)
                self.merged += 1
        self.near_since = near

    def _end(self, frame: int) -> None:
        """End or lose people unseen for too long; unconfirmed ones have a shorter limit."""
        settings = self.settings
        for person in list(self.active):
            known, since = self._is_confirmed(person), person.last_fixed
            patience = settings.max_coast_s if known else settings.min_track_s
            if known and (frame - since) / self.fps > patience:
                since = person.last_followed(self.fps)
            if (frame - since) / self.fps > patience:
                self.active.remove(person)
                (self.lost if known and settings.causal else self.ended).append(person)
        for person in list(self.lost):
            if (frame - person.last_fixed) / self.fps > settings.max_lost_s:
                self.lost.remove(person)
                self.ended.append(person)


def _views(index: NDArray[np.integer]) -> Integers:
    """Return the number of cameras (n,) with a detection among those of sightings (n, cameras)."""
    return np.asarray(np.count_nonzero(index >= 0, axis=1))


def _drop_matched(weights: Floats, index: Integers) -> Floats:
    """Return weights (cameras, detections, 17), 0 for matched detections (cameras, n)."""
    left = weights.copy()
    camera, person = np.nonzero(index >= 0)
    left[camera, index[camera, person]] = 0.0
    return left


def _stack_matches(groups: list[Sighting], cameras: int) -> Integers:
    """Return the detections (cameras, groups) of groups; -1 = none."""
    none = np.full((cameras, 0), -1)
    return np.stack([group.index for group in groups], axis=1) if groups else none


def _has_two_cameras(weights: Floats, min_joints: int) -> bool:
    """Return whether two cameras have detections with enough joints."""
    usable = np.count_nonzero(weights > 0.0, axis=-1) >= min_joints
    return bool(np.count_nonzero(usable.any(axis=1)) >= 2)


def _pose_distances(poses: list[Floats], people: list[Person]) -> Floats:
    """Return mean joint distances (poses, people) [m]."""
    if not poses or not people:
        return np.empty((len(poses), len(people)))
    return separations(np.array(poses), np.array([person.pose for person in people]))


def _lower_median(values: Floats) -> Floats:
    """Return the lower median of the finite values in each row (..., n); infinite if none is."""
    last = np.maximum(np.isfinite(values).sum(axis=-1, keepdims=True) - 1, 0)
    return np.asarray(np.take_along_axis(np.sort(values, axis=-1), last // 2, axis=-1)[..., 0])
