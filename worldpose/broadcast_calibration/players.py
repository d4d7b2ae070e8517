"""Matches of players of the static cameras with detections in the broadcast frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.evidence import PLAYER, PointEvidence, whiten_points
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou
from worldpose.geometry.optimize.losses import geman_mcclure_loss
from worldpose.ingest.clock import ImageClock, rows_at

BONES: Final = np.array(
    [
        *((5, 6), (5, 7), (7, 9), (6, 8), (8, 10), (5, 11), (6, 12), (11, 13)),
        *((13, 15), (12, 14), (14, 16), (0, 1), (0, 2), (1, 3), (2, 4), (0, 5)),
    ]
)
"""A tree over the 17 joints of COCO: J - 1 bones."""


@dataclass(frozen=True, eq=False)
class People:
    """3D joints of people and keypoints of detections, per frame.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where missing.
        keypoints: (frames, detections, 17, 2) [px]; NaN where missing.
        fps: frames per second.
        timeline: joints (match frames, persons, 17, 3) [m], and where among them `joints` are
            (frames,) [match frame]; None = frames are match frames.

    Raises:
        InputError: the frame counts differ.
    """

    joints: Floats
    keypoints: Floats
    fps: float
    timeline: tuple[Floats, Floats] | None = None

    def __post_init__(self) -> None:
        if len(self.joints) != len(self.keypoints):
            raise InputError(
                "broadcast calibration: people",
                expected="joints and keypoints of the same frames",
                found=f"{len(self.joints)} and {len(self.keypoints)}",
                todo="Give both for every frame of the clip, missing ones as NaN.",
            )

    @classmethod
    def in_images(cls, joints: Floats, keypoints: Floats, fps: float, clock: ImageClock) -> People:
        """Return people in every image of a moving camera with a clock, with joints at its time.

        Joints (frames, persons, 17, 3) [m], world, are at match frames, keypoints (frames,
        detections, 17, 2) [px] in the image of each.
        """
        seen = np.full((len(clock.images), *keypoints.shape[1:]), np.nan)
        seen[clock.image_row] = keypoints
        timeline = joints, clock.frame_row
        return cls(rows_at(*timeline), seen, fps * clock.rate, timeline)

    def later(self, frames: float, some: Integers | None = None) -> People:
        """Return these keypoints, or `some`, with joints of later match frames, linear in between.

        Joints beyond the clip's ends are missing. A shift [match frame] below zero = earlier.
        """
        some = np.arange(len(self.joints)) if some is None else some
        joints, row = self.timeline or (self.joints, np.arange(float(len(self.joints))))
        row = row[some] + frames
        return People(rows_at(joints, row), self.keypoints[some], self.fps, (joints, row))

    @property
    def rate(self) -> float:
        """Frames per match frame."""
        row = None if self.timeline is None else self.timeline[1]
        return 1.0 if row is None or len(row) < 2 else float((len(row) - 1) / (row[-1] - row[0]))

    @property
    def boxes(self) -> Floats:
        """Boxes (frames, detections, 4) about the keypoints [px]; NaN without any."""
        return boxes_of(self.keypoints)


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched pairs of persons and detections.

    Attributes:
        frame: (n,) rising.
        person: (n,) index.
        detection: (n,) index.
        similarity: (n,).
    """

    frame: Integers
    person: Integers
    detection: Integers
    similarity: Floats


@dataclass(frozen=True)
class PlayerNoise:
    """Keypoint noise of matched players, relative to the person's height in the image [1].

    So many successive frames are worth one independent frame [frame].
    """

    share: float
    frames: float


def boxes_of(keypoints: Floats) -> Floats:
    """Return boxes (..., 4) x0 y0 x1 y1 about keypoints (..., 17, 2); NaN without any."""
    known = np.isfinite(keypoints)
    low = np.where(known, keypoints, np.inf).min(axis=-2)
    high = np.where(known, keypoints, -np.inf).max(axis=-2)
    boxes = np.concatenate([low, high], axis=-1)
    return np.where(np.isfinite(boxes), boxes, np.nan)


def similarity(projected: Floats, detected: Floats) -> Floats:
    """Return the similarity of projected and detected people (persons, detections) [-1..1].

        sim(p_i, p_j) = IoU(box of p_i, box of p_j) (1 / K) sum_k cos(p_i,k, p_j,k)

    Boxes enclose all keypoints (n, 17, 2) [px]; the sum is over the K of the 16 `BONES` that both
    have. Fewer than six common joints, half a body, give 0.
    """
    overlap = box_iou(boxes_of(projected), boxes_of(detected))
    with np.errstate(invalid="ignore", divide="ignore"):
        bones = [each[:, BONES[:, 1]] - each[:, BONES[:, 0]] for each in (projected, detected)]
        unit = [bone / np.linalg.norm(bone, axis=-1, keepdims=True) for bone in bones]
        cosine = np.einsum("ibk,jbk->ijb", unit[0], unit[1])
        known = np.isfinite(cosine)
        mean = np.where(known, cosine, 0.0).sum(-1) / np.maximum(known.sum(-1), 1)
    one_seen, two_seen = (np.asarray(np.isfinite(p).all(-1)) for p in (projected, detected))
    both = one_seen[:, None] & two_seen[None]
    alike = np.where(both.sum(-1) >= 6, overlap * mean, 0.0)
    return np.where(np.isfinite(alike), alike, 0.0)


def match(camera: MovingCamera, people: People) -> Matches:
    """Return the best pairs per frame, by weighted bipartite matching."""
    frames, persons, count = people.joints.shape[:3]
    projected = camera.camera.project(people.joints.reshape(frames, -1, 3))
    projected = projected.reshape(frames, persons, count, 2)
    rows: list[tuple[int, int, int, float]] = []
    for frame in range(frames):
        alike = similarity(projected[frame], people.keypoints[frame])
        for person, detection in zip(*linear_sum_assignment(-alike), strict=True):
            # A twentieth of shared area, or random bones.
            if alike[person, detection] > 0.05:
                value = float(alike[person, detection])
                rows.append((frame, int(person), int(detection), value))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    frame, person, detection = table[:, :3].T.astype(np.int64)
    return Matches(frame, person, detection, table[:, 3])


def player_evidence(
    camera: MovingCamera, people: People, matches: Matches, settings: BroadcastCalibrationSettings
) -> tuple[PointEvidence, PlayerNoise]:
    """Return matched keypoints as evidence, and the estimated keypoint noise.

    A keypoint's deviation is a share of the person's height in the image; the clip's residuals give
    it, and the correlation time of the errors.
    """
    world = people.joints[matches.frame, matches.person]
    image = people.keypoints[matches.frame, matches.detection]
    tall = np.ptp(np.nan_to_num(boxes_of(image)).reshape(-1, 2, 2)[..., 1], axis=-1)
    projected = np.full(image.shape, np.nan)
    for frame in np.unique(matches.frame):
        mine = matches.frame == frame
        single = camera.frames(slice(int(frame), int(frame) + 1)).camera[0]
        projected[mine] = single.project(world[mine].reshape(-1, 3)).reshape(-1, *image.shape[1:])
    scaled = (projected - image) / np.maximum(tall, 1.0)[:, None, None]
    noise = _estimate_noise(scaled, matches, people.fps)
    known = np.isfinite(scaled).all(axis=-1)
    frame = np.repeat(matches.frame[:, None], image.shape[1], axis=1)[known]
    deviation = noise.share * np.repeat(tall[:, None], image.shape[1], axis=1)[known]
    evidence = PointEvidence.observe(
        PLAYER,
        frame,
        world[known],
        image[known],
        whiten_points(np.maximum(deviation, 0.5)),
        source=np.repeat(matches.person[:, None], image.shape[1], axis=1)[known],
        loss=settings.loss_scale,
    )
    return evidence, noise


def _estimate_noise(scaled: Floats, matches: Matches, fps: float) -> PlayerNoise:
    """Return spread and correlation time of residuals (n, 17, 2), relative to heights."""
    known = scaled[np.isfinite(scaled)]
    if len(known) < 100:
        return PlayerNoise(0.05, 1.0)
    share = max(1.4826 * float(np.median(np.abs(known))), 1e-3)
    bounded = np.clip(scaled, -3.0 * share, 3.0 * share)
    persons = int(matches.person.max()) + 1
    where = {
        int(key): number for number, key in enumerate(matches.frame * persons + matches.person)
    }
    power = float(np.nanmean(bounded**2))
    total = 1.0
    # Errors are correlated over one second at most.
    for lag in range(1, max(1, round(1.0 * fps)) + 1):
        later = np.array(
            [where.get(int(key), -1) for key in (matches.frame + lag) * persons + matches.person]
        )
        there = later >= 0
        products = bounded[there] * bounded[later[there]]
        if not np.isfinite(products).any():
            break
        correlation = float(np.nanmean(products)) / power
        if correlation < 0.05:
            break
        total += 2.0 * correlation
    return PlayerNoise(share, total)


_MAX_OFFSET: Final = 25.0
"""Maximum offset of the search [frame]."""


@dataclass(frozen=True, eq=False)
class FeedOffset:
    """Clock offset of a broadcast clip.

    Attributes:
        frames: the clip shows match frame t where the static cameras show t + frames; NaN where
            `determined` is false.
        standard_error: standard error of the offset [match frame]; infinite without motion.
        determined: whether the best offset lies inside the search range, with a standard error
            below half a frame.
        pairs: number of matched people, over all frames.
        rate: images per match frame.
    """

    frames: float
    standard_error: float
    determined: bool
    pairs: int
    rate: float = 1.0


def estimate_feed_offset(
    camera: MovingCamera, people: People, *, reach: float = _MAX_OFFSET
) -> FeedOffset:
    """Return the clock offset between the feed and the static cameras, up to a reach [match frame].

    For every integer offset the function matches people again and evaluates the loss of their
    keypoint residuals; a parabola through the best offset and its neighbours gives the minimum. The
    camera must be independent of these players, or it has absorbed the offset: give one fitted to
    markings alone.
    """
    whole = np.arange(-np.floor(reach), np.floor(reach) + 1.0)
    some, every = (np.arange(0, len(camera), -(-len(camera) // most)) for most in (80, 400))
    coarse = np.array([_mean_loss(camera, people, offset, some)[0] for offset in whole])
    if not np.isfinite(coarse).any():
        return FeedOffset(np.nan, np.inf, False, 0)
    best = float(whole[int(np.nanargmin(coarse))])
    # Joints between match frames are means of two, with less noise: by whole match frames, all
    # offsets have equally many of them, also where the camera has several images per frame.
    near = best + np.arange(-2.0, 3.0)
    results = [_mean_loss(camera, people, offset, every) for offset in near]
    fine = np.array([cost for cost, _ in results])
    middle = int(np.nanargmin(fine)) if np.isfinite(fine).any() else 0
    pairs = results[middle][1]
    inside = 0 < middle < len(near) - 1 and abs(near[middle]) < np.floor(reach)
    left, here, right = fine[middle - 1 : middle + 2] if inside else (np.nan,) * 3
    bend = left - 2.0 * here + right
    if not bend > 0.0:
        return FeedOffset(np.nan, np.inf, False, pairs)
    offset = float(near[middle] + 0.5 * (left - right) / bend)
    # Half a loss of one unit is one standard deviation; a person counts once per correlation time.
    stride = -(-len(camera) // len(every))
    independent = pairs / max(1.0, 0.3 * people.fps / stride)
    error = float(np.sqrt(1.0 / (0.5 * bend * independent)))
    determined = error < 0.5
    return FeedOffset(offset if determined else np.nan, error, determined, pairs, people.rate)


def _mean_loss(
    camera: MovingCamera, people: People, offset: float, frames: Integers
) -> tuple[float, int]:
    """Return the mean loss of a keypoint at an offset, and the number of pairs."""
    some = people.later(offset, frames)
    seen = camera.frames(frames)
    pairs = match(seen, some)
    if not len(pairs.frame):
        return np.nan, 0
    world = some.joints[pairs.frame, pairs.person]
    image = some.keypoints[pairs.frame, pairs.detection]
    tall = np.ptp(np.nan_to_num(boxes_of(image)).reshape(-1, 2, 2)[..., 1], axis=-1)
    single = seen.camera[pairs.frame]
    off = single.project(world) - image
    # The typical keypoint error is 3 % of a person's height.
    off = off / np.maximum(0.03 * tall, 0.5)[:, None, None]
    squared = (off**2).sum(axis=-1)
    squared = squared[np.isfinite(squared)]
    if not len(squared):
        return np.nan, 0
    return float(np.mean(geman_mcclure_loss(squared, 3.0))), len(pairs.frame)
