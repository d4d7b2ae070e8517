"""People in the views of cameras whose poses are unknown: tracks, and first poses by them.

Two cameras start from the essential matrix of one person's joints, and each further camera from
these joints in 3D. All are adjusted after each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Flags, Floats
from data_contracts.cameras import LensCalibration
from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Observations
from worldpose.bundle_adjustment.residuals import (
    AdjustmentSolution,
    KeypointNoise,
    free_joints_problem,
)
from worldpose.bundle_adjustment.settings import SolverSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.detection.box_tracking import BoxTracker
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.triangulation.noise_model import STATURE

JOINTS: Final = np.arange(5, 17)
"""Joints of COCO-17 that are used: those of the face are labelled differently by every detector."""
MIN_FRAMES: Final = 20
"""Least frames in which two cameras show a person [frame]."""
MIN_AGREEMENT: Final = 0.5
"""Least share of joints that agree for two views to be of one person [1]."""
SAMPLE: Final = 400
"""Most joints of a person in the random search for a pose [1]."""
DRAWS: Final = 300
"""Draws of this search [1]; half of the joints being right, 150 of 5 have none wrong in 99 %."""
LOSS_SCALE: Final = 3.0
"""Standard deviations beyond which a keypoint counts less (Cauchy's loss) [1]."""


def refusal(names: Sequence[str], expected: str, found: str) -> InputError:
    """Return the error of people who do not determine cameras."""
    return InputError(
        f"cameras from people: {', '.join(names) or 'none'}",
        expected=expected,
        found=found,
        todo="Film one person, seen as a whole, who walks through the whole scene for half a "
        "minute in front of all cameras at once, or click markings.",
    )


def find_walkers(
    detections: KeypointDetections, fps: float, names: Sequence[str]
) -> list[list[Floats]]:
    """Return the keypoints (frames, 12, 2) [px] of the people in each camera's images.

    InputError if a camera shows no person for long enough, or no person walks.
    """
    min_motion = 0.25
    every = []
    for c, name in enumerate(names):
        points = np.where(
            (detections.confidence[:, c] > 0.3)[..., None], detections.keypoints[:, c], np.nan
        ).astype(np.float64)[:, :, JOINTS]
        tracks = _track(points, fps)
        if not tracks:
            raise refusal([name], f"a person for {MIN_FRAMES} frames or more", "none")
        every.append(tracks[:5])
    farthest = max(_walking_distance(track) for tracks in every for track in tracks)
    if farthest < min_motion:
        raise refusal(
            names,
            f"a person who walks for {min_motion:g} heights of the person in an image",
            f"people who stand still: they move by {farthest:.2f} heights at most",
        )
    return every


def _track(points: Floats, fps: float) -> list[Floats]:
    """Return people (frames, 12, 2) of points (frames, detections, 12, 2), the longest first."""
    tracker = BoxTracker(0.0, round(0.5 * fps))
    tracks: dict[int, Floats] = {}
    for frame, people in enumerate(points):
        there = np.flatnonzero(np.isfinite(people[..., 0]).sum(axis=1) >= len(JOINTS) // 2)
        seen = people[there]
        boxes = np.concatenate([np.nanmin(seen, axis=1), np.nanmax(seen, axis=1)], axis=1)
        boxes = boxes.reshape(-1, 4)
        for person, track in zip(seen, tracker.update(boxes, np.ones(len(boxes))), strict=True):
            whole = tracks.setdefault(int(track), np.full((len(points), *points.shape[2:]), np.nan))
            whole[frame] = person
    shown = [track for track in tracks.values() if _frames(track).sum() >= MIN_FRAMES]
    return sorted(shown, key=lambda track: -int(_frames(track).sum()))


def _frames(track: Floats) -> Flags:
    """Return the frames (frames,) with a person."""
    return np.asarray(np.isfinite(track[..., 0]).any(axis=1))


def _height(track: Floats) -> float:
    """Return the usual height of a person in the image, from shoulders to ankles [px]."""
    seen = track[_frames(track), :, 1]
    return float(np.median(np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)))


def _walking_distance(track: Floats) -> float:
    """Return how far a person moves or changes in size in the image, in the person's heights."""
    seen = track[_frames(track)]
    middle = np.nanmean(seen, axis=1)
    tall = np.nanmax(seen[..., 1], axis=1) - np.nanmin(seen[..., 1], axis=1)
    usual = max(float(np.median(tall)), 1e-6)
    low, high = np.quantile(np.column_stack([middle, tall]), [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low) / usual)


def _rigid(rotation: ArrayLike, translation: ArrayLike) -> Rigid:
    """Return the motion of OpenCV's arrays."""
    return Rigid(
        np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64).ravel()
    )


class Start(NamedTuple):
    """Cameras, and the joints that they see."""

    cameras: Camera
    observed: Observations


class _Pair(NamedTuple):
    """The second camera's pose in the first one's axes, by the people that both show."""

    cameras: tuple[int, int]
    pose: Rigid
    people: tuple[tuple[int, int], ...]
    """Tracks of the first and the second camera that show one person."""
    worth: float
    """Joints that agree, less where both cameras look along one line."""


class Views:
    """People in all images, on the plane at depth one."""

    def __init__(self, lenses: Sequence[LensCalibration], tracks: list[list[Floats]]) -> None:
        self.records, self.names = lenses, [lens.id for lens in lenses]
        self.lenses = Camera.stack([Camera.from_lens(lens) for lens in lenses])
        frames = tracks[0][0].shape[0]
        some = sum(np.stack([_frames(one) for one in each]).any(axis=0) for each in tracks) >= 2
        rows = np.flatnonzero(some)
        if len(rows) < MIN_FRAMES:
            raise refusal(
                self.names, f"people in two cameras at once for {MIN_FRAMES} frames", f"{len(rows)}"
            )
        # More frames add time and little information.
        take = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), 120)).round())
        self.rows = rows[take.astype(np.int64)]
        self.frames = frames
        self.pixels = [[one[self.rows] for one in each] for each in tracks]
        self.planes = [
            [self.lenses[c].normalize(one) for one in each] for c, each in enumerate(self.pixels)
        ]
        # Two standard deviations of a detector, 5 cm.
        self.limits = [
            [0.05 / STATURE[0] * _height(one) / float(self.lenses.focal[c, 0]) for one in each]
            for c, each in enumerate(self.pixels)
        ]

    def starts(self) -> list[Start]:
        """Return the cameras from the best pairs.

        InputError if no two cameras show one person, or one shares no person with the others.
        """
        pairs = [self._pair(a, b) for a, b in combinations(range(len(self.names)), 2)]
        good = sorted((one for one in pairs if one is not None), key=lambda one: -one.worth)
        if not good:
            raise refusal(
                self.names,
                f"two cameras that show one person for {MIN_FRAMES} frames",
                "none whose joints agree",
            )
        found, groups = list[Start](), list[tuple[int, ...]]()
        for pair in good:
            if len(groups) >= 3 and found:
                break
            poses, shown = self._grow(pair)
            groups.append(tuple(sorted(poses)))
            if len(poses) == len(self.names):
                found.append(self._start(poses, shown))
        if not found:
            raise self._explain_groups(sorted(groups, key=len, reverse=True))
        return found

    def _explain_groups(self, groups: list[tuple[int, ...]]) -> InputError:
        """Return the error of cameras that could not be joined, the largest groups first."""
        apart: list[tuple[int, ...]] = []
        for group in groups:
            if not any(set(group) & set(other) for other in apart):
                apart.append(group)
        named = [", ".join(self.names[c] for c in group) for group in sorted(apart)]
        rest = [name for c, name in enumerate(self.names) if c not in apart[0]]
        if len(apart) == 1:
            return refusal(
                rest,
                f"a person for {MIN_FRAMES} frames that the others show at the same time",
                "none whose joints agree",
            )
        return InputError(
            "cameras from people",
            expected="a person whom cameras of all groups show at the same time",
            found=f"{len(apart)} groups that share no person: {'; '.join(named)}",
            todo="Locate one group at a time: take the others out of match.yaml. Or film a person "
            "who walks from one group's view into the other's.",
        )

    def _pair(self, a: int, b: int) -> _Pair | None:
        """Return the pose of b by its people; None if no person is in both cameras."""
        import cv2  # late: it takes 0.2 s, and few commands need it

        best: tuple[int, Floats] = (0, np.empty((0, 3)))
        for i, j in np.ndindex(len(self.planes[a]), len(self.planes[b])):
            one, other, limit = self._shared_joints(a, i, b, j)
            if len(one) < MIN_FRAMES * len(JOINTS) // 2:
                continue
            some = np.arange(0, len(one), -(-len(one) // SAMPLE))
            matrix, inlier = cv2.findEssentialMat(
                one[some], other[some], np.eye(3), cv2.RANSAC, 0.9999, 2.0 * limit, DRAWS
            )
            share = 0.0 if inlier is None else float(inlier.mean())
            if share >= MIN_AGREEMENT and share * len(one) > best[0]:
                best = int(share * len(one)), np.asarray(matrix[:3], dtype=np.float64)
        if not best[0]:
            return None
        people, ones, others = [], [], []
        for i, j in self._same_people(a, b, best[1]):
            one, other, _ = self._shared_joints(a, i, b, j)
            people.append((i, j))
            ones.append(one)
            others.append(other)
        if not people:
            return None
        count, rotation, way, _, space = cv2.recoverPose(
            best[1], np.concatenate(ones), np.concatenate(others), np.eye(3), distanceThresh=1e3
        )
        pose = _rigid(rotation, way)
        with np.errstate(divide="ignore", invalid="ignore"):
            points = (space[:3] / space[3]).T
        back = points - pose.inverse().translation
        cosine = (points * back).sum(axis=1) / (
            np.linalg.norm(points, axis=1) * np.linalg.norm(back, axis=1)
        )
        parallel = float(np.nanmedian(np.abs(cosine)))
        return _Pair((a, b), pose, tuple(people), count * float(np.sqrt(1.0 - parallel**2)))

    def _shared_joints(self, a: int, i: int, b: int, j: int) -> tuple[Floats, Floats, float]:
        """Return joints (n, 2) that two tracks both show, and their largest distance."""
        one, other = self.planes[a][i], self.planes[b][j]
        both = np.isfinite(one[..., 0]) & np.isfinite(other[..., 0])
        limit = 0.5 * (self.limits[a][i] + self.limits[b][j])
        return one[both], other[both], limit

    def _same_people(self, a: int, b: int, matrix: Floats) -> list[tuple[int, int]]:
        """Return the tracks of two cameras that agree, each with at most one."""
        from scipy.optimize import linear_sum_assignment

        share = np.zeros((len(self.planes[a]), len(self.planes[b])))
        for i, j in np.ndindex(share.shape):
            one, other, limit = self._shared_joints(a, i, b, j)
            if len(one) < len(JOINTS):
                continue
            left = np.column_stack([one, np.ones(len(one))]) @ matrix.T
            right = np.column_stack([other, np.ones(len(other))]) @ matrix
            product = (left[:, :2] * other).sum(axis=1) + left[:, 2]
            slope = (left[:, :2] ** 2).sum(axis=1) + (right[:, :2] ** 2).sum(axis=1)
            share[i, j] = float((np.abs(product) < 2.0 * limit * np.sqrt(slope)).mean())
        chosen = zip(*linear_sum_assignment(-share), strict=True)
        return [(int(i), int(j)) for i, j in chosen if share[i, j] >= MIN_AGREEMENT]

    def _grow(self, pair: _Pair) -> tuple[dict[int, Rigid], list[dict[int, int]]]:
        """Return the cameras that share people with a pair, and each person's tracks in them.

        They are added one by one, the one with the most joints first.
        """
        a, b = pair.cameras
        poses = {a: Rigid(np.eye(3), np.zeros(3)), b: pair.pose}
        shown = [{a: i, b: j} for i, j in pair.people]
        poses = self._refine(poses, shown)
        while len(poses) < len(self.names):
            joints = [self._joints(person, poses) for person in shown]
            rest = [c for c in range(len(self.names)) if c not in poses]
            candidates = {c: self._resect(c, joints) for c in rest}
            chosen = max(rest, key=lambda c: candidates[c][0])
            agree, pose, tracks = candidates[chosen]
            if not agree or pose is None:
                break
            poses[chosen] = pose
            for person, track in tracks.items():
                shown[person][chosen] = track
            poses = self._refine(poses, shown)
        return poses, shown

    def _start(self, poses: dict[int, Rigid], shown: list[dict[int, int]]) -> Start:
        """Return all cameras with their poses, and the joints that they see."""
        order = list(range(len(self.names)))
        cameras = self._place(order, poses)
        observed = self._observe(order, cameras, shown, poses)
        if not len(observed.image):
            raise refusal(
                self.names,
                "people whose joints lie where two cameras show them",
                "none: the cameras' lenses are other ones, or these are different people",
            )
        return Start(cameras, observed)

    def _place(self, order: list[int], poses: dict[int, Rigid]) -> Camera:
        """Return the batch of some cameras with their poses."""
        rotation = np.stack([poses[c].rotation for c in order])
        translation = np.stack([poses[c].translation for c in order])
        return replace(self.lenses[np.array(order)], cam_from_world=Rigid(rotation, translation))

    def _refine(self, poses: dict[int, Rigid], shown: list[dict[int, int]]) -> dict[int, Rigid]:
        """Return the poses adjusted to all people that these cameras show."""
        order = list(poses)
        cameras = self._place(order, poses)
        lenses = [self.records[c] for c in order]
        observed = self._observe(order, cameras, shown, poses)
        adjusted = adjust_poses(cameras, observed, lenses, KeypointNoise()).cameras.cam_from_world
        return {c: adjusted[k] for k, c in enumerate(order)}

    def _joints(self, person: dict[int, int], poses: dict[int, Rigid]) -> Floats:
        """Return a person's joints (frames, 12, 3) from all cameras; NaN with fewer than two."""
        rows = []
        for camera, track in person.items():
            at = self.planes[camera][track]
            matrix = np.column_stack([poses[camera].rotation, poses[camera].translation])
            both = at[..., None] * matrix[2] - matrix[:2]
            rows.append(np.where(np.isfinite(at[..., :1, None]), both, 0.0))
        system = np.concatenate(rows, axis=2)
        seen = (np.abs(system).sum(axis=-1) > 0.0).sum(axis=-1)
        last = np.linalg.svd(system, full_matrices=True)[2][..., -1, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            joints = last[..., :3] / last[..., 3:]
            front = seen >= 4
            for camera in person:
                depth = joints @ poses[camera].rotation[2] + poses[camera].translation[2]
                front &= depth > 0.0
        return np.where(front[..., None], joints, np.nan)

    def _resect(
        self, camera: int, joints: list[Floats]
    ) -> tuple[int, Rigid | None, dict[int, int]]:
        """Return agreeing joints, a camera's pose by people in space, and the people's tracks."""
        import cv2
        from scipy.optimize import linear_sum_assignment

        best: tuple[int, Rigid | None] = (0, None)
        shape = (len(joints), len(self.planes[camera]))
        for person, track in np.ndindex(shape):
            at, places = self._meet(camera, track, joints[person])
            if len(at) < MIN_FRAMES * len(JOINTS) // 2:
                continue
            limit = 2.0 * self.limits[camera][track]
            some = np.arange(0, len(at), -(-len(at) // SAMPLE))
            good, turn, way, inlier = cv2.solvePnPRansac(
                places[some],
                at[some],
                np.eye(3),
                np.zeros(5),
                iterationsCount=DRAWS,
                reprojectionError=limit,
            )
            share = len(inlier) / len(some) if good and inlier is not None else 0.0
            if share >= MIN_AGREEMENT and share * len(at) > best[0]:
                best = int(share * len(at)), _rigid(cv2.Rodrigues(turn)[0], way)
        if best[1] is None:
            return 0, None, {}
        near_share, total = np.zeros(shape), np.zeros(shape)
        for person, track in np.ndindex(shape):
            at, places = self._meet(camera, track, joints[person])
            if len(at) < len(JOINTS):
                continue
            there = places @ best[1].rotation.T + best[1].translation
            off = np.linalg.norm(there[:, :2] / there[:, 2:] - at, axis=1)
            near = (off < 2.0 * self.limits[camera][track]) & (there[:, 2] > 0.0)
            near_share[person, track], total[person, track] = near.mean(), near.sum()
        chosen = [
            (int(p), int(t))
            for p, t in zip(*linear_sum_assignment(-near_share), strict=True)
            if near_share[p, t] >= MIN_AGREEMENT
        ]
        return int(sum(total[pair] for pair in chosen)), best[1], dict(chosen)

    def _meet(self, camera: int, track: int, joints: Floats) -> tuple[Floats, Floats]:
        """Return where a track shows joints (n, 2), and their places (n, 3)."""
        at = self.planes[camera][track]
        both = np.isfinite(at[..., 0]) & np.isfinite(joints[..., 0])
        return at[both], joints[both]

    def _observe(
        self,
        order: list[int],
        cameras: Camera,
        shown: list[dict[int, int]],
        poses: dict[int, Rigid],
    ) -> Observations:
        """Return the keypoints of all joints that two cameras show, without gross errors."""
        gross = 20.0  # standard deviations from which a keypoint is another person's [1]
        noise_of = (1.5, 0.02)
        joints = np.stack([self._joints(person, poses) for person in shown], axis=1)
        image = np.full((*joints.shape[:-1], len(order), 2), np.nan)
        noise = np.full(image.shape[:-1], np.nan)
        for k, camera in enumerate(order):
            places = cameras[k].project(joints.reshape(-1, 3)).reshape(*joints.shape[:-1], 2)
            for p, person in enumerate(shown):
                if camera not in person:
                    continue
                track = self.pixels[camera][person[camera]]
                noise[:, p, :, k] = np.hypot(noise_of[0], noise_of[1] * _height(track) / STATURE[0])
                off = np.linalg.norm(places[:, p] - track, axis=-1)
                near = off < gross * noise[:, p, :, k]
                image[:, p, :, k] = np.where(near[..., None], track, np.nan)
        seen = np.isfinite(image[..., 0])
        seen &= (seen.sum(axis=-1) >= 2)[..., None]
        frame, person_of, joint, camera_of = np.nonzero(seen)
        used = seen.any(axis=-1)
        point = (np.cumsum(used).reshape(used.shape) - 1)[frame, person_of, joint]
        frame_of = self.rows[frame]
        return Observations(
            joints[used], point, camera_of, frame_of, person_of, joint, image[seen], noise[seen]
        )


def adjust_poses(
    cameras: Camera,
    observed: Observations,
    lenses: Sequence[LensCalibration],
    noise: KeypointNoise,
    *,
    fixed: bool = False,
    covariance: bool = False,
) -> AdjustmentSolution:
    """Return cameras and joints adjusted to the keypoints, or the joints alone.

    The first camera stays where it is, and the second one at its distance: no keypoint tells the
    world frame. Lenses are the prior of focal lengths and principal points. InputError if the
    keypoints do not determine the cameras.
    """
    fixed_information = 1e12  # a step of a micrometre costs one [1/m^2]
    count = len(lenses)
    free = np.zeros((count, 12), dtype=np.bool_)
    information = np.zeros((count, 12, 12))
    for c, lens in enumerate(lenses):
        free[c, :9] = True
        # Offsets count from the lens, also where the start has another focal length.
        known = np.diag(
            [1e-9] * 6
            + [(lens.focal_px / lens.focal_std_px) ** 2]
            + [lens.principal_point_std_px**-2.0] * 2
            + [1.0] * 3
        )
        information[c] = known
    free[0, :6] = False
    away = cameras[1].cam_from_world.rotation @ (cameras.center[0] - cameras.center[1])
    away = away / np.linalg.norm(away)
    information[1, 3:6, 3:6] += fixed_information * np.outer(away, away)
    if fixed:
        information += fixed_information * fixed_information * np.eye(12)
    names = tuple(lens.id for lens in lenses)
    problem = free_joints_problem(cameras, free, information, observed, noise, LOSS_SCALE, names)
    return solve(
        problem, SolverSettings(max_iterations=100, min_cost_change=1e-6), covariance=covariance
    )
