"""Redetection of people at the predicted projections of their bodies.

Input: bodies of the previous iteration in one camera's frames, its detections, a pose estimator.
Output: the people searched for, the estimator's results, and the accepted ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats, Image
from data_contracts.conventions import COCO17_BONES, COCO17_TORSO
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People, PoseEstimator
from worldpose.detection.pipeline import Place, on_pitch
from worldpose.detection.settings import RedetectionSettings
from worldpose.detection.suppression import (
    combine_boxes,
    object_keypoint_similarity,
    surest_confidence,
)
from worldpose.filtering.judging import BodyViews, Spread, TriangulatedDetections, judge_detections
from worldpose.filtering.settings import FilteringSettings
from worldpose.geometry.boxes import box_areas, box_iou


def _capsules() -> tuple[NDArray[np.int64], Floats]:
    """Return pairs of joints at the ends of a body's solid parts, and their radii [m]."""
    left_shoulder, right_shoulder, left_hip, right_hip = COCO17_TORSO
    trunk = set(COCO17_TORSO)
    ends = [*COCO17_BONES, (left_shoulder, right_hip), (right_shoulder, left_hip), (3, 4)]
    radius = [0.12 if a < 5 and b < 5 else 0.11 if {a, b} <= trunk else 0.06 for a, b in ends]
    return np.array(ends), np.array(radius)


_ENDS, _RADIUS = _capsules()


@dataclass(frozen=True, eq=False)
class Expected:
    """Bodies in view of one camera, (frames, persons, 17) each; NaN without a body.

    Attributes:
        image: (..., 2) expected detections of joints [px].
        variance: variance of `image` per axis [px^2], from the uncertainty of the bodies.
        scale: pixels per metre there [px/m].
        depth: along the camera's optical axis [m].
    """

    image: Floats
    variance: Floats
    scale: Floats
    depth: Floats

    @classmethod
    def of(cls, views: BodyViews, offset: Floats, focal: float) -> Expected:
        """Return the expected image of bodies in the one camera of `views`, of a focal length [px].

        The offset (frames, persons, 17, 2) [px] of keypoints from the joints is the expected one.
        """
        scale = views.scale[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(scale > 0.0, focal / scale, np.nan)
        return cls(views.image[:, 0] + np.nan_to_num(offset), views.variance[:, 0], scale, depth)

    @property
    def boxes(self) -> Floats:
        """Return bodies' boxes (frames, persons, 4) [px]: x0, y0, x1, y1; NaN if incomplete."""
        # Margins of a person beyond the joints: left, up to the top of the head, right,
        # and down to the soles [m].
        box_margins = (0.12, 0.20, 0.12, 0.10)
        left, up, right, down = (side * self.scale for side in box_margins)
        x, y = self.image[..., 0], self.image[..., 1]
        sides = [(x - left).min(-1), (y - up).min(-1), (x + right).max(-1), (y + down).max(-1)]
        return np.stack(sides, axis=-1)

    @property
    def unsure(self) -> Floats:
        """Return median standard deviations of joints across the view (frames, persons) [m]."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.median(np.sqrt(self.variance) / self.scale, axis=-1))

    def hidden_joints(self, frame: int) -> NDArray[np.bool_]:
        """Return which joints (persons, 17) of a frame another person's body occludes."""
        # A body occludes joints that are farther away than it by more than this [m].
        occlusion_m = 0.2
        image, scale, depth = self.image[frame], self.scale[frame], self.depth[frame]
        begin, end = image[:, _ENDS[:, 0]], image[:, _ENDS[:, 1]]
        along = end - begin
        radius = _RADIUS * scale[:, _ENDS].mean(-1)
        near = depth[:, _ENDS].mean(-1)
        off = image[:, :, None, None] - begin  # (persons, joints, others, capsules, 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            part = (off * along).sum(-1) / np.square(along).sum(-1)
            away = off - np.clip(np.nan_to_num(part), 0.0, 1.0)[..., None] * along
            covered = np.square(away).sum(-1) < radius**2
            covered &= near + occlusion_m < depth[:, :, None, None]
        persons = np.arange(len(image))
        covered[persons, :, persons] = False
        return np.asarray(covered.any(axis=(2, 3)))


Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MissingPeople:
    """People to search for, one per row, by rising frames.

    Attributes:
        frame: (n,) index of the frame.
        person: (n,) index of the person.
        boxes: (n, 4) predicted boxes [px].
        hidden: number of further people, left out because others occlude them.
    """

    frame: Places
    person: Places
    boxes: Floats
    hidden: int


def select_missing_people(
    expected: Expected,
    seen: Flags,
    size: tuple[int, int],
    settings: RedetectionSettings,
    place: Place | None = None,
    margin: float = 0.0,
) -> MissingPeople:
    """Return the people that should be visible and have no detection.

    `seen` (frames, persons) is whether the person was detected there, `size` the width, height of
    the frames [px]. Where there is a pitch, a place up to `margin` [m] outside of the lines is on
    it.
    """
    boxes = expected.boxes
    with np.errstate(invalid="ignore"):
        tall = boxes[..., 3] - boxes[..., 1] >= settings.min_height_px
        wanted = ~seen & tall & (expected.unsure <= settings.max_uncertainty_m)
        within = (expected.image >= -0.5) & (expected.image <= np.array(size) - 0.5)
    shown = np.asarray(within.all(axis=-1))
    wanted &= shown.mean(axis=-1) >= settings.min_visible_share
    frame, person = np.nonzero(wanted)
    if place is not None and place.pitch is not None and len(frame):
        cut = np.minimum(boxes[frame, person], np.array([*size, *size]) - 0.5)
        inside = on_pitch(cut, place.camera, size, place.pitch, margin)
        frame, person = frame[inside], person[inside]
    bare = np.ones(len(frame), dtype=np.bool_)
    for each in np.unique(frame):
        rows = np.flatnonzero(frame == each)
        there = shown[each, person[rows]] & ~expected.hidden_joints(int(each))[person[rows]]
        bare[rows] = there.mean(axis=-1) >= settings.min_visible_share
    frame, person = frame[bare], person[bare]
    return MissingPeople(frame, person, boxes[frame, person], int(np.count_nonzero(~bare)))


def find_detected_people(
    index: NDArray[np.integer], fits: NDArray[np.integer], dropped: Flags
) -> Flags:
    """Return which people have detections (frames, persons) that fit or could not be judged.

    `index` (frames, persons) is that of the camera's detection, -1 = not seen. Detections fit,
    (frames, detections), a person's body, -1 = none, or are dropped as they fit no body.
    """
    detections = fits.shape[1]
    seen = np.zeros(index.shape, dtype=np.bool_)
    frame, detection = np.nonzero(fits >= 0)
    seen[frame, fits[frame, detection]] = True
    frame, person = np.nonzero((index >= 0) & (index < detections))
    at = frame, index[frame, person]
    unjudged = (fits[at] < 0) & ~dropped[at]
    seen[frame[unjudged], person[unjudged]] = True
    return seen


MIN_KEYPOINTS: Final = 8
"""Least number of keypoints of a result [1]: half a body."""
MAX_DISTANCE_M: Final = 0.3
"""Cap on the distance between a joint and a keypoint [m]."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Classification of results; each is of one kind.

    Attributes:
        found: (n,) the pose is the person's.
        unsure: (n,) the pose has low confidence, or there was no frame.
        elsewhere: (n,) the pose is not where the body is.
        another: (n,) the pose is another person's, or a duplicate.
        rejected: (n, 17) keypoints of the pose that are not where the body is.
    """

    found: Flags
    unsure: Flags
    elsewhere: Flags
    another: Flags
    rejected: Flags


def search_missing_people(
    pictures: Iterable[tuple[int, Image | None]],
    sought: MissingPeople,
    estimator: PoseEstimator,
    least_keypoint: float,
    detected: AnyFloats | None = None,
) -> KeypointDetections:
    """Return the poses that an estimator finds in predicted boxes.

    The detections are those of the rows of `sought` (n,); they are missing where there was no
    image, and scores are comparable with those of a detector. A keypoint below a confidence of
    `least_keypoint` was not found [1]. An estimator may separate people by the boxes of their
    neighbours, `detected` (frames, detections, 4) [px].
    """
    shape = (len(sought.frame), 17)
    found = KeypointDetections(
        keypoints=np.full((*shape, 2), np.nan),
        confidence=np.full(shape, np.nan),
        boxes=np.full((shape[0], 4), np.nan),
        score=np.full(shape[0], np.nan),
    )
    for frame, picture in pictures:
        rows = np.flatnonzero(sought.frame == frame)
        if picture is None or not len(rows):
            continue
        people = People(sought.boxes[rows], np.ones(len(rows)))
        neighbours = np.empty((0, 4)) if detected is None else detected[frame].astype(np.float64)
        neighbours = neighbours[np.isfinite(neighbours).all(axis=1)]
        neighbours = neighbours[(box_iou(people.boxes, neighbours) > 0.0).any(axis=0)]
        estimated = estimator.estimate(picture, np.concatenate([people.boxes, neighbours]))
        poses = combine_boxes(people, estimated.select(slice(len(rows))))
        with np.errstate(invalid="ignore"):
            there = (poses.confidence >= least_keypoint) & np.isfinite(poses.keypoints).all(axis=2)
        for name, values in poses.without(~there).arrays().items():
            found.arrays()[name][rows] = values
    plain = found.score >= 1.0  # of an estimator without boxes and fit
    found.score[plain] = np.clip(surest_confidence(found.confidence[plain]), 1e-3, 1.0)
    return found


def judge_search_results(
    results: KeypointDetections,
    sought: MissingPeople,
    expected: Expected,
    detected: KeypointDetections,
    spread: Spread,
    noise: tuple[float, float],
    settings: RedetectionSettings,
) -> Verdicts:
    """Return the classification of results.

    A result is accepted if the estimator is confident, if it agrees with the body within the
    uncertainty of both, and if it is no other person's: no other body explains it better, and
    neither a detection in the frame nor a better result has that pose already. `expected` are all
    bodies in view of the camera, `detected` (frames, detections) all of its detections; the noise
    of keypoints is [px] and [m].
    """
    agrees, rejected = _compare_with_bodies(results, sought, expected, spread, noise, settings)
    unsure = ~(surest_confidence(results.confidence) >= settings.min_confidence)
    away = _distances(results, sought, expected)
    rows = np.arange(len(away))
    own = away[rows, sought.person]
    nearer = (away < own[:, None]).any(axis=1)
    elsewhere = ~unsure & ~agrees & ~nearer
    another = ~unsure & nearer
    open_ = ~unsure & ~elsewhere & ~another
    for frame in np.unique(sought.frame[open_]):
        here = np.flatnonzero(open_ & (sought.frame == frame))
        here = here[np.argsort(own[here], kind="stable")]
        boxes = np.concatenate([results.boxes[here], detected.boxes[frame]])
        pose = np.concatenate([results.keypoints[here], detected.keypoints[frame]])
        alike = object_keypoint_similarity(pose, np.nan_to_num(box_areas(boxes)))[: len(here)]
        same = np.asarray(alike > settings.oks_nms)
        for k, row in enumerate(here):
            before = same[k, :k] & ~another[here[:k]]
            another[row] = before.any() or same[k, len(here) :].any()
    return Verdicts(open_ & ~another, unsure, elsewhere, another, rejected)


def _compare_with_bodies(
    results: KeypointDetections,
    sought: MissingPeople,
    expected: Expected,
    spread: Spread,
    noise: tuple[float, float],
    settings: RedetectionSettings,
) -> tuple[Flags, Flags]:
    """Return which results (n,) agree with their bodies, and which of their keypoints do not."""
    count = len(sought.frame)
    at = sought.frame, sought.person
    image, variance, scale = (
        each[at][:, None, None] for each in (expected.image, expected.variance, expected.scale)
    )
    suspects = TriangulatedDetections(
        KeypointDetections.from_keypoints(
            results.keypoints[:, None, None],
            results.confidence[:, None, None],
            np.zeros((count, 1, 1), dtype=np.int64),
        ),
        offsets=np.zeros((count, 1, 1, 2)),
        exchanged=np.zeros((count, 1, 1, 3), dtype=np.bool_),
        dropped=np.zeros((count, 1, 1), dtype=np.bool_),
        noise=noise,
    )
    rules = FilteringSettings(
        max_deviation=settings.max_deviation,
        min_inlier_share=settings.min_inlier_share,
        min_similarity=settings.min_similarity,
        min_keypoints=MIN_KEYPOINTS,
    )
    judged = judge_detections(BodyViews(image, variance, scale), suspects, spread, rules)
    return judged.fits[:, 0, 0] == 0, judged.rejected[:, 0, 0]


def _distances(results: KeypointDetections, sought: MissingPeople, expected: Expected) -> Floats:
    """Return mean distances (n, persons) of a result's keypoints to bodies of its frame [m]."""
    image, scale = expected.image[sought.frame], expected.scale[sought.frame]
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(results.keypoints[:, None] - image, axis=-1) / scale
    there = np.asarray(np.isfinite(results.keypoints).all(axis=-1))
    away = np.where(there[:, None], np.fmin(away, MAX_DISTANCE_M), 0.0)
    return np.asarray(away.sum(axis=-1) / np.maximum(there.sum(axis=-1), 1)[:, None])
