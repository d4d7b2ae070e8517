"""Comparison of a rig's cameras at sampled frames, as stated and under fault hypotheses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.camera_consistency.hypotheses import STATED, Hypothesis
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.compiled import compile_kernel, map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.tracking.epipolar import associate
from worldpose.tracking.ray_matching import match_greedily, ray_affinity
from worldpose.tracking.settings import TrackingSettings

ORBITS_DEG: Final = (105.0, 215.0, 50.0, 320.0, 160.0, 270.0)
"""Rotations of a camera about the people that leave only chance matches [degree]."""
JOINT_NOISES: Final = (0.015, 0.025, 0.04, 0.06, 0.08)
"""Candidate standard deviations of a detector's joint on the body [m]."""
MIN_JOINTS = 6
"""Minimum number of common joints of two detections."""
_EARLY_JOINTS, _EARLY_LIMIT = 4, 13.0
"""After this number of joints a pair with a larger mean squared deviation is rejected."""
PIVOT_RANGE: Final = (3.0, 150.0)
"""Range of distances of the pivot of rotation from the camera [m]."""


class CameraRays(NamedTuple):
    """Rays of one camera's detections.

    Attributes:
        rays: (frames, detections, 17, 3) unit vectors, world; NaN where not seen.
        center: (3,) [m], world.
        spread: (frames, detections) standard deviation of a ray's direction [rad].
    """

    rays: Floats
    center: Floats
    spread: Floats


@dataclass(frozen=True, eq=False)
class Trial:
    """Agreement of a camera with its partners under a hypothesis.

    Attributes:
        hypothesis: the fault, with its correction.
        matches: matches above chance, summed over the partners [persons per frame].
        chance: matches expected by chance [persons per frame].
        partners: cameras that agree clearly.
        by_frame: (frames,) matches, chance included; NaN where the camera has no frame.
    """

    hypothesis: Hypothesis
    matches: float
    chance: float
    partners: int
    by_frame: Floats

    def certainty(self, other: Trial) -> float:
        """Return the gain of matches over another trial, in standard errors."""
        gain = self.by_frame - other.by_frame
        gain = gain[np.isfinite(gain)]
        if len(gain) < 4:
            return 0.0
        # Neighbouring frames show the same people: half of them count.
        error = float(np.std(gain, ddof=1)) / math.sqrt(0.5 * len(gain))
        return float(gain.mean()) / max(error, 1e-3)


class Comparison:
    """Cameras, their detections, and the agreement between them.

    Attributes:
        cameras: batch (cameras,), as stated.
        sample: (n,) frames at which cameras are compared.
        search: indices of the sampled frames at which hypotheses are fitted.
        held_out: indices of those at which hypotheses are tested.
        people_seen: (cameras,) mean number of detections per frame.
    """

    def __init__(
        self,
        cameras: Camera,
        pixel_noise: Floats,
        keypoints: Floats,
        ground: bool,
        settings: ConsistencySettings,
        joint_noise: float = JOINT_NOISES[-1],
    ) -> None:
        """Sample frames and convert their detections to rays.

        The noise (cameras,) [px] is that of keypoints and of the calibration. Keypoints (frames,
        cameras, detections, 17, 2) [px] are NaN where not found; on the ground, people stand at z =
        0; the joint noise is that of a joint on the body [m].
        """
        self.cameras = cameras
        self.count = int(cameras.batch_shape[0])
        self.frames = len(keypoints)
        wanted = min(settings.sample_frames, self.frames)
        self.sample = np.unique(np.linspace(0, self.frames - 1, wanted).round().astype(np.int64))
        places = np.arange(len(self.sample))
        self.search = places[::3]
        self.held_out = np.setdiff1d(places, self.search) if len(places) > 3 else places
        self._everywhere = places
        self._ground = ground
        self._heights = (-0.4, 2.2) if ground else (-math.inf, math.inf)
        self._joint_noise = joint_noise
        self._pixel_noise = pixel_noise
        self._keypoints = [_pack(keypoints[:, c]) for c in range(self.count)]
        self.views = [self.view(c, STATED) for c in range(self.count)]
        self.people_seen = np.array(
            [np.isfinite(v.rays[..., 0]).any(axis=-1).sum(axis=1).mean() for v in self.views]
        )

    def view(self, c: int, hypothesis: Hypothesis, frames: Integers | None = None) -> CameraRays:
        """Return a camera's rays under a hypothesis, in frames (n,), -1 = none, or sampled ones."""
        camera = self.cameras[c] if hypothesis.camera is None else hypothesis.camera
        points = self._keypoints[c if hypothesis.source is None else hypothesis.source]
        frames = self.times(hypothesis) if frames is None else frames
        points = np.where((frames >= 0)[:, None, None, None], points[frames], np.nan)
        points = hypothesis.correct(points, camera.image_size)
        rays = np.full((*points.shape[:-1], 3), np.nan)
        known = np.isfinite(points).all(axis=-1)
        rays[known] = camera.unproject(points[known]).directions
        spread = np.full(points.shape[:2], self._pixel_noise[c] / float(camera.focal.mean()))
        return CameraRays(rays, np.array(camera.center), spread)

    def times(self, hypothesis: Hypothesis) -> Integers:
        """Return the camera's frame at each sampled frame under a hypothesis; -1 = none."""
        return self.sample if hypothesis.time is None else hypothesis.time

    def scores(
        self, view: CameraRays, partner: CameraRays, at: Integers, there: Integers
    ) -> Floats:
        """Return the matches (n,) of two views at pairs of their frames; -1 = no frame."""
        # Contiguous: numba compiles a kernel again for every other memory layout.
        times = np.ascontiguousarray(at), np.ascontiguousarray(there)
        scores = pair_scores(view, times[0], partner, times[1], self._heights, self._joint_noise)
        return np.asarray(scores)

    def quick(self, c: int, hypothesis: Hypothesis, partners: Sequence[int]) -> float:
        """Return the matches per frame in the fitting frames under a hypothesis, with chance."""
        view = self.view(c, hypothesis, self.times(hypothesis)[self.search])
        places = np.arange(len(self.search))
        return float(
            sum(self.scores(view, self.views[p], places, self.search).mean() for p in partners)
        )

    def trial(self, c: int, hypothesis: Hypothesis, partners: Sequence[int]) -> Trial:
        """Return how camera `c` agrees with partners under a hypothesis in held-out frames."""
        view, there = self.view(c, hypothesis), self.held_out
        at = np.where(self.times(hypothesis)[there] < 0, -1, there)
        matches = chance = 0.0
        agreeing = 0
        by_frame = np.where(at < 0, np.nan, 0.0)
        at, there = at[at >= 0], there[at >= 0]
        if not len(at):
            return Trial(hypothesis, 0.0, 0.0, 0, by_frame)
        for p in partners:
            scores = self.scores(view, self.views[p], at, there)
            by_frame[np.isfinite(by_frame)] += scores
            found = scores.mean()
            usual = np.median(
                [
                    self.scores(moved, self.views[p], at, there).mean()
                    for moved in _orbit(view, self.views[p], ORBITS_DEG[:4])
                ]
            )
            matches += max(0.0, float(found - usual))
            chance += float(usual)
            agreeing += found - usual > 4.0 * chance_noise(usual)
        return Trial(hypothesis, matches, chance, agreeing, by_frame)

    def agreement(self, a: int, b: int) -> tuple[float, float]:
        """Return matches of two cameras above chance per frame, and their standard deviation."""
        found = self.scores(self.views[a], self.views[b], self._everywhere, self._everywhere)
        chance = [
            self.scores(moved, self.views[b], self.search, self.search).mean()
            for moved in _orbit(self.views[a], self.views[b], ORBITS_DEG)
        ]
        usual = float(np.median(chance))
        spread = 1.4826 * float(np.median(np.abs(np.array(chance) - usual)))
        return float(found.mean()) - usual, max(spread, chance_noise(usual))

    def is_side_by_side(self, a: int, b: int) -> bool:
        """Return whether both cameras see the people from nearly the same direction.

        Rays of such cameras meet anywhere along themselves, so the cameras cannot be inconsistent.
        """
        view, partner = self.views[a], self.views[b]
        ray = _mean_ray(view)
        depth = float(view.center[2] / -ray[2]) if self._ground and ray[2] < 0.0 else np.nan
        if not np.isfinite(depth):
            depth = float(np.linalg.norm(_meeting_place(view, partner) - view.center))
        apart = float(np.linalg.norm(view.center - partner.center))
        # A centimetre across rays at 0.03 rad is 0.3 m along them.
        return apart < 0.03 * float(np.clip(depth, PIVOT_RANGE[0], PIVOT_RANGE[1]))

    def fit_noise(self) -> None:
        """Choose the least joint noise with nearly as much agreement as the best one.

        People close together can be separated, and small faults detected, only at the actual noise;
        it differs between detectors and with people's size in the image.
        """
        pairs = [(a, b) for a in range(self.count) for b in range(a)]

        def above_chance(pair: tuple[int, int]) -> list[float]:
            view, partner = (self.views[c] for c in pair)
            moved = list(_orbit(view, partner, ORBITS_DEG[:2]))
            above = []
            for noise in JOINT_NOISES:
                found, *chance = (
                    pair_scores(each, self.search, partner, self.search, self._heights, noise)
                    for each in (view, *moved)
                )
                usual = np.mean([each.mean() for each in chance])
                above.append(max(0.0, float(found.mean() - usual)))
            return above

        totals = [sum(each) for each in zip(*map_in_threads(above_chance, pairs), strict=True)]
        # The chosen noise keeps three quarters of the most matches.
        enough = np.array(totals) >= 0.75 * max(totals)
        self._joint_noise = JOINT_NOISES[int(np.argmax(enough))]

    def same_video(self, a: int, b: int) -> bool:
        """Return whether two cameras have the same detections, up to compression."""
        same = people = frames = 0
        for n in self.search:
            first, second = (self._keypoints[c][self.sample[n]] for c in (a, b))
            first = first[np.isfinite(first[..., 0]).sum(axis=-1) >= MIN_JOINTS]
            second = second[np.isfinite(second[..., 0]).sum(axis=-1) >= MIN_JOINTS]
            if not (len(first) and len(second)):
                continue
            apart = np.linalg.norm(first[:, None] - second[None], axis=-1)
            height = np.nanmax(first[..., 1], axis=-1) - np.nanmin(first[..., 1], axis=-1)
            common = np.isfinite(apart).sum(axis=-1) >= MIN_JOINTS
            mean = np.where(common, np.nansum(apart, axis=-1), np.inf)
            mean = mean / np.maximum(1, np.isfinite(apart).sum(axis=-1))
            # Compression moves keypoints.
            near = mean < np.maximum(1.5, 0.015 * height)[:, None]
            same += int(near.any(axis=1).sum())
            people += min(len(first), len(second))
            frames += 1
        return frames >= 3 and same >= 0.7 * people

    def people(self, among: Sequence[int]) -> list[Floats]:
        """Return the people (persons, 17, 3) [m] whom three cameras or all see, frame by frame."""
        found, settings = [], TrackingSettings(birth_views=min(3, len(among)))
        most = max(self.views[c].rays.shape[1] for c in among)
        centers = np.stack([self.views[c].center for c in among])
        focal = self.cameras.focal.mean(axis=-1)
        for n in range(len(self.sample)):
            rays = np.full((len(among), most, 17, 3), np.nan)
            weights = np.zeros(rays.shape[:3])
            for k, c in enumerate(among):
                own = self.views[c].rays[n]
                rays[k, : len(own)] = own
                weights[k, : len(own)] = np.isfinite(own[..., 0]) * focal[c] ** 2
            groups = associate(centers, rays, weights, self._ground, settings)
            joints = [g.joints for g in groups]
            found.append(np.stack(joints) if joints else np.zeros((0, 17, 3)))
        return found

    def shares(
        self, c: int, hypothesis: Hypothesis, people: Sequence[Floats]
    ) -> tuple[float, float, int]:
        """Return the agreement of a camera with people detected by others.

        The share of the camera's detections that match these people, the share of the people in its
        image that it detected, and their number [person-frames].
        """
        camera = self.cameras[c] if hypothesis.camera is None else hypothesis.camera
        view = self.view(c, hypothesis)
        at = self.times(hypothesis)
        matched = detections = expected = found = 0
        gate = TrackingSettings().gate_m
        for n, joints in enumerate(people):
            if at[n] < 0:
                continue
            rays = view.rays[n][None]
            # An uncertain pose may shift all people off their detections.
            distance = np.linalg.norm(np.nanmean(joints, axis=1) - view.center, axis=-1)
            gates = gate + 2.0 * float(view.spread[n].max(initial=0.0)) * distance
            weights = np.isfinite(rays[..., 0]).astype(np.float64)
            detections += int((weights.sum(axis=-1) >= MIN_JOINTS).sum())
            if not len(joints):
                continue
            center, gates = view.center[None], gates[None]
            affinity = ray_affinity(joints, center, rays, weights, gates, MIN_JOINTS)
            index = match_greedily(affinity)[0]
            matched += int((index >= 0).sum())
            image = camera.project(joints.reshape(-1, 3)).reshape(*joints.shape[:2], 2)
            inside = ((image >= 0.0) & (image < camera.image_size)).all(axis=-1)
            visible = inside.sum(axis=1) >= 0.7 * np.isfinite(joints[..., 0]).sum(axis=1)
            expected += int(visible.sum())
            found += int((visible & (index >= 0)).sum())
        return matched / max(1, detections), found / max(1, expected), expected


def chance_noise(chance: float) -> float:
    """Return the deviation of chance matches per frame: a clip has some ten independent moments."""
    return 0.3 * math.sqrt(float(chance) + 0.05)


def _orbit(view: CameraRays, partner: CameraRays, degrees: Sequence[float]) -> Iterator[CameraRays]:
    """Yield the view rotated about the vertical through the point that both cameras look at.

    It shows as many people at the same heights as before, at wrong positions: a translation would
    keep matches along the rays.
    """
    pivot = _meeting_place(view, partner)
    for angle in np.radians(degrees):
        cosine, sine = math.cos(angle), math.sin(angle)
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        rays = np.ascontiguousarray(view.rays @ turn.T)
        yield view._replace(rays=rays, center=pivot + turn @ (view.center - pivot))


def _meeting_place(view: CameraRays, partner: CameraRays) -> Floats:
    """Return the point (3,) [m] on a view's mean ray that is nearest to its partner's."""
    ray, other = (_mean_ray(each) for each in (view, partner))
    way = partner.center - view.center
    cosine = float(ray @ other)
    depth = float(way @ ray - cosine * (way @ other)) / max(1e-9, 1.0 - cosine**2)
    return np.asarray(view.center + np.clip(depth, PIVOT_RANGE[0], PIVOT_RANGE[1]) * ray)


def _mean_ray(view: CameraRays) -> Floats:
    """Return the mean direction (3,) of a view's rays."""
    known = np.isfinite(view.rays[..., 0])
    mean = view.rays[known].sum(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.0 else np.array([1.0, 0.0, 0.0])


def _pack(keypoints: Floats) -> Floats:
    """Return detections (frames, detections, 17, 2) with enough joints, without gaps."""
    known = np.isfinite(keypoints[..., 0]).sum(axis=-1) >= MIN_JOINTS
    order = np.argsort(~known, axis=1, kind="stable")
    most = max(1, int(known.sum(axis=1).max(initial=1)))
    order = order[:, :most]
    packed = np.take_along_axis(keypoints, order[:, :, None, None], axis=1)
    there = np.take_along_axis(known, order, axis=1)
    return np.ascontiguousarray(np.where(there[..., None, None], packed, np.nan))


@compile_kernel
def pair_scores(
    view: CameraRays,
    frames: Integers,
    partner: CameraRays,
    partner_frames: Integers,
    heights: tuple[float, float],
    joint_noise: float,
) -> Floats:
    """Return the number of one-to-one matches between two cameras' detections, frame by frame.

    A match counts between 0 and 1, by the distance between its rays in standard deviations. The
    assignment is greedy, best first. Compared frames (n,), -1 = none, have each a partner's (n,).
    `heights` are the lowest and highest mean height of a person's joints [m]; infinite = unknown
    ground. `joint_noise` is the standard deviation of a detector's joint, on the body [m].
    """
    scores = np.zeros(len(frames))
    for n in range(len(frames)):
        fa, fb = frames[n], partner_frames[n]
        if fa < 0 or fb < 0:
            continue
        weights = _weights(
            view.rays[fa],
            view.center,
            view.spread[fa],
            partner.rays[fb],
            partner.center,
            partner.spread[fb],
            heights,
            joint_noise,
        )
        scores[n] = _one_to_one(weights)
    return scores


@compile_kernel
def _one_to_one(weights: Floats) -> float:
    """Return the sum of the best pairs, each row and column used once; clears `weights`."""
    total = 0.0
    rows, columns = weights.shape
    while True:
        best, row, column = 0.0, -1, -1
        for i in range(rows):
            for j in range(columns):
                if weights[i, j] > best:
                    best, row, column = weights[i, j], i, j
        if row < 0:
            return total
        total += best
        weights[row, :] = 0.0
        weights[:, column] = 0.0


@compile_kernel
def _weights(
    rays_a: Floats,
    center_a: Floats,
    spread_a: Floats,
    rays_b: Floats,
    center_b: Floats,
    spread_b: Floats,
    heights: tuple[float, float],
    joint_noise: float,
) -> Floats:
    """Return the match weight, 0 to 1, of each pair of a detection in a and one in b, (a, b)."""
    min_sine = 0.08  # nearly parallel rays meet everywhere
    count_a, joints, _ = rays_a.shape
    count_b = rays_b.shape[0]
    weights = np.zeros((count_a, count_b))
    bx, by, bz = center_b[0] - center_a[0], center_b[1] - center_a[1], center_b[2] - center_a[2]
    points = np.empty((joints, 3))
    for i in range(count_a):
        for j in range(count_b):
            count, total = 0, 0.0
            for step in range(joints):
                # From the torso outwards: the face comes last.
                joint = (11 + step) % joints if step < 6 else (5 + step - 6) % joints
                if step >= 12:
                    joint = step - 12
                ux, uy, uz = rays_a[i, joint, 0], rays_a[i, joint, 1], rays_a[i, joint, 2]
                vx, vy, vz = rays_b[j, joint, 0], rays_b[j, joint, 1], rays_b[j, joint, 2]
                cosine = ux * vx + uy * vy + uz * vz
                squared = 1.0 - cosine * cosine
                if not squared > min_sine * min_sine:  # also NaN
                    continue
                along_u = bx * ux + by * uy + bz * uz
                along_v = bx * vx + by * vy + bz * vz
                s = (along_u - cosine * along_v) / squared
                t = (cosine * along_u - along_v) / squared
                if s <= 0.0 or t <= 0.0:  # the rays meet behind a camera
                    total = math.inf
                    break
                dx, dy, dz = s * ux - bx - t * vx, s * uy - by - t * vy, s * uz - bz - t * vz
                variance = (s * spread_a[i]) ** 2 + (t * spread_b[j]) ** 2
                variance += 2.0 * joint_noise**2
                points[count, 0] = center_a[0] + s * ux - 0.5 * dx
                points[count, 1] = center_a[1] + s * uy - 0.5 * dy
                points[count, 2] = center_a[2] + s * uz - 0.5 * dz
                total += min(16.0, (dx * dx + dy * dy + dz * dz) / variance)
                count += 1
                if count == _EARLY_JOINTS and total > _EARLY_LIMIT * _EARLY_JOINTS:
                    break
            if count < MIN_JOINTS:
                continue
            # At 1.5 deviations a match counts 61 %: the noise is known to a factor of two.
            weight = math.exp(-0.5 * total / count / 1.5**2)
            if weight > 0.05 and _is_person(points[:count], heights):
                weights[i, j] = weight
    return weights


@compile_kernel
def _is_person(points: Floats, heights: tuple[float, float]) -> bool:
    """Return whether joints (n, 3) [m] have a person's size and height above the ground."""
    size_range = (0.15, 1.1)  # [m]; 0.45 for a standing adult, more along nearly parallel rays
    n = len(points)
    x = y = z = xx = 0.0
    for k in range(n):
        x += points[k, 0] / n
        y += points[k, 1] / n
        z += points[k, 2] / n
    for k in range(n):
        xx += ((points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2 + (points[k, 2] - z) ** 2) / n
    low, high = size_range
    return low * low <= xx <= high * high and heights[0] <= z <= heights[1]
