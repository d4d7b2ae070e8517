"""Comparison of detections with bodies: matches, their spread, and contradictions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17, COCO17_BONES
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.filtering.settings import FilteringSettings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import MEDIAN_SQUARED

Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of keypoints, one row per detection; joints are those of the body.

    Attributes:
        frame: (n,)
        camera: (n,)
        person: (n,)
        missed: (n, 17, 2) vector from the body to the keypoint [px]; NaN = does not count.
        variance: (n, 17) variance of this vector per axis [px^2].
        repeated: rows of a person with correlated errors, which count as one.
    """

    frame: Places
    camera: Places
    person: Places
    missed: Floats
    variance: Floats
    repeated: float

    @property
    def weight(self) -> Floats:
        """(n, 17) [1/px^2]; 0 = does not count."""
        there = np.isfinite(self.missed).all(axis=-1) & np.isfinite(self.variance)
        return np.where(there, 1.0 / (np.where(there, self.variance, 1.0) * self.repeated), 0.0)

    def less(self, shift: Floats) -> Residuals:
        """Return the residuals minus a shift (n, 17, 2) [px]."""
        return replace(self, missed=self.missed - shift)


@dataclass(frozen=True, eq=False)
class BodyViews:
    """Projected bodies, (frames, cameras, persons, 17) each."""

    image: Floats
    """(..., 2) [px]; NaN without a body in front of the camera."""
    variance: Floats
    """Variance of `image` [px^2], mean over both axes."""
    scale: Floats
    """Image scale there [px/m]."""


def view_bodies(cameras: Camera, joints: Floats, covariance: Floats) -> BodyViews:
    """Return projections of bodies into all images of a batch (cameras,).

    The detector's joints (frames, persons, 17, 3) [m], world, NaN without a body, have a covariance
    (frames, persons, 17, 3, 3) [m^2].
    """
    frames, persons = joints.shape[:2]
    count = cameras.batch_shape[0]
    shape = (frames, count, persons, joints.shape[2])
    image = cameras.project(joints.reshape(frames, 1, -1, 3)).reshape(*shape, 2)
    ahead = cameras.cam_from_world.rotation[:, 2]
    depth = np.einsum("ca,fpja->fcpj", ahead, joints)
    depth += cameras.cam_from_world.translation[:, 2, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = cameras.focal.mean(axis=-1)[:, None, None] / depth
    total = np.einsum("...aa", covariance)[:, None]
    along = np.einsum("ca,fpjab,cb->fcpj", ahead, covariance, ahead)
    # The optical axis replaces each line of sight of the image: the relative error of the variance
    # is the squared sine of the angle between them.
    variance = 0.5 * (total - along) * scale**2
    return BodyViews(image, variance, scale)


LEAST: Final = 0.05
"""Smallest factor: bodies that follow their keypoints exactly must not create outliers."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Factors on the stated variance of keypoints about their bodies.

    Attributes:
        joint: (17,) factor per joint.
        knots: (bins - 1,) confidences that separate the classes.
        confidence: (bins,) factor per class of confidence.
    """

    joint: Floats
    knots: Floats
    confidence: Floats

    def factor(self, confidence: NDArray[np.floating]) -> Floats:
        """Return the factors of keypoints with these confidences (..., 17)."""
        place = np.searchsorted(self.knots, confidence, side="right")
        return np.asarray(self.confidence[place] * self.joint)


def learn_spread(squared: Floats, stated: Floats, known: Floats, confidence: Floats) -> Spread:
    """Return the spread of keypoints about bodies, from medians, which outliers hardly move.

    Keypoints have a squared distance (n, 17) [px^2] to their body, NaN = none, and a stated
    variance (n, 17) per axis [px^2]. `known` (n, 17) [px^2] is that of the body's joint per axis.
    The confidence is (n, 17).
    """
    seen = np.isfinite(squared) & np.isfinite(known)
    sure = confidence[seen]
    if not len(sure):
        return Spread(np.ones(squared.shape[1]), np.empty(0), np.ones(1))
    # Confidence classes.
    knots = np.unique(np.quantile(sure, np.linspace(0.0, 1.0, 8 + 1)[1:-1]))
    bins = np.searchsorted(knots, sure, side="right")
    joints = np.broadcast_to(np.arange(squared.shape[1]), squared.shape)[seen]
    squares, base, given = squared[seen], stated[seen], known[seen]
    by_bin, by_joint = np.ones(len(knots) + 1), np.ones(squared.shape[1])
    members = [
        [(each, np.flatnonzero(of == each)) for each in np.unique(of)] for of in (bins, joints)
    ]
    # Iterations; the last changes a factor by less than a hundredth.
    for _ in range(6):
        for groups, factor in zip(members, (by_bin, by_joint), strict=True):
            expected = by_bin[bins] * by_joint[joints] * base
            ratio, shares = squares / (expected + given), expected / (expected + given)
            for each, mine in groups:
                median = float(np.median(ratio[mine])) / MEDIAN_SQUARED
                # The factor excludes the variance of the body.
                share = float(np.median(shares[mine]))
                factor[each] = max(LEAST, factor[each] * (1.0 + (median - 1.0) / max(share, 0.3)))
    return Spread(by_joint, knots, by_bin)


_BONES: Final = np.array(COCO17_BONES)
_PARTS: Final = tuple(EXCHANGED_PARTS.values())


@dataclass(frozen=True, eq=False)
class TriangulatedDetections:
    """Tracked detections in some frames, with the results of their triangulation.

    Attributes:
        detections: (frames, cameras, detections) detections of tracked people.
        offsets: (frames, cameras, persons, 2) [px], offset of a person's detection in an image from
            the person's position by all cameras.
        exchanged: (frames, cameras, persons, 3), body parts with a corrected left-right swap.
        dropped: (frames, cameras, detections), boxes that the previous iteration dropped.
        noise: stated standard deviation of keypoints, [px] and [m].
    """

    detections: KeypointDetections
    offsets: Floats
    exchanged: Flags
    dropped: Flags
    noise: tuple[float, float]

    def subtract(self, shift: Floats) -> TriangulatedDetections:
        """Return the detections with the systematic errors of their keypoints subtracted.

        The shift (frames, cameras, persons, 17, 2) [px] is of the bodies' joints; NaN = unknown.
        """
        keypoints = self.detections.keypoints - self.assign_to_detections(shift)
        return replace(self, detections=replace(self.detections, keypoints=keypoints))

    def subtract_clock_offsets(
        self, clock_offsets: Floats, image_motion: Floats
    ) -> TriangulatedDetections:
        """Return the detections with the effect of clock offsets subtracted from `offsets`.

        Clock offsets are (cameras,) [frame]; `image_motion` (frames, cameras, persons, 17, 2) [px]
        is that of joints per frame; NaN = unknown.
        """
        part = clock_offsets[:, None, None] * np.nan_to_num(image_motion.mean(axis=-2))
        return replace(self, offsets=self.offsets - part)

    def assign_to_detections(self, shift: Floats) -> Floats:
        """Return the shift of each detection (frames, cameras, detections, 17, 2) [px].

        It is 0 for a detection of no person, and where it is unknown. In a left-right swap, a
        keypoint gets the shift of the joint that it shows. The shift (frames, cameras, persons, 17,
        2) [px] is of the bodies' joints; NaN = unknown.
        """
        frame, camera, person = np.nonzero(self.detections.detection_index >= 0)
        order = _order_joints(self.exchanged[frame, camera, person])
        own = np.zeros((len(frame), *shift.shape[3:]))
        np.put_along_axis(own, order[..., None], shift[frame, camera, person], axis=1)
        out = np.zeros(self.detections.keypoints.shape)
        place = self.detections.detection_index[frame, camera, person]
        out[frame, camera, place] = np.nan_to_num(own)
        return out


@dataclass(frozen=True, eq=False)
class Judgement:
    """Comparison of every detection with the bodies; (frames, cameras, detections) each.

    Attributes:
        fits: int16, index of the person whose body it fits; -1 = none, or not judged.
        similarity: float32, mean cosine between its bones and that body's, or its tracked person's
            if it fits none; NaN where not judged.
        mahalanobis_distance: (..., 17) float32, distance of keypoints to that body in standard
            deviations; NaN where not judged.
        rejected: (..., 17) bool, keypoints to leave out.
        dropped: bool, boxes without a single accepted keypoint: a person had them, now or in an
            earlier iteration, and they fit no body.
    """

    fits: NDArray[np.int16]
    similarity: NDArray[np.float32]
    mahalanobis_distance: NDArray[np.float32]
    rejected: Flags
    dropped: Flags


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a detection and a body, with the keypoints in the body's order."""

    image: Floats
    """(n, 17, 2) projected joints of the body [px]."""
    pixels: Floats
    """(n, 17, 2) keypoints without left-right swaps and offsets [px]."""
    stated: Floats
    """(n, 17) stated variance of the keypoints per axis [px^2]."""
    known: Floats
    """(n, 17) variance of the body's joints per axis [px^2]."""
    confidence: Floats
    """(n, 17)"""

    @property
    def squared(self) -> Floats:
        return np.asarray(((self.pixels - self.image) ** 2).sum(-1))

    def mahalanobis_distance(self, spread: Spread) -> Floats:
        variance = spread.factor(self.confidence) * self.stated + self.known
        return np.asarray(np.sqrt(self.squared / variance))

    def similarity(self) -> Floats:
        """Return the mean cosine between bones (n,); NaN without any."""
        detected, projected = (
            each[:, _BONES[:, 1]] - each[:, _BONES[:, 0]] for each in (self.pixels, self.image)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = (detected * projected).sum(-1)
            cosine /= np.linalg.norm(detected, axis=-1) * np.linalg.norm(projected, axis=-1)
        there = np.isfinite(cosine)
        count = there.sum(-1)
        total = np.where(there, cosine, 0.0).sum(-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def learn_keypoint_spread(views: BodyViews, suspects: TriangulatedDetections) -> Spread:
    """Return the spread of keypoints around the bodies of their tracked persons."""
    rows, _, _ = _pair_with_bodies(views, suspects)
    return learn_spread(rows.squared, rows.stated, rows.known, rows.confidence)


def body_residuals(
    views: BodyViews,
    suspects: TriangulatedDetections,
    judged: Judgement,
    spread: Spread,
    repeated: float,
) -> Residuals:
    """Return the residuals of keypoints against the bodies of their tracked persons, if these fit.

    The offsets of people in an image are not subtracted, because they contain clock offsets.
    """
    unshifted = replace(suspects, offsets=np.zeros_like(suspects.offsets))
    rows, (frame, camera, person), order = _pair_with_bodies(views, unshifted)
    place = suspects.detections.detection_index[frame, camera, person]
    wrong = np.take_along_axis(judged.rejected[frame, camera, place], order, axis=1)
    wrong |= (judged.fits[frame, camera, place] != person)[:, None]
    missed = np.where(wrong[..., None], np.nan, rows.pixels - rows.image)
    variance = spread.factor(rows.confidence) * rows.stated + rows.known
    return Residuals(frame, camera, person, missed, variance, repeated)


def judge_detections(
    views: BodyViews, suspects: TriangulatedDetections, spread: Spread, settings: FilteringSettings
) -> Judgement:
    """Return the comparison of detections with bodies in an interval of frames.

    A detection is judged by the body of its tracked person, unless it does not fit that body and
    fits another. A detection of a tracked person that fits no body is dropped, and stays dropped
    until it fits one. A detection of no tracked person is judged only if it fits a body.

    Note:
        Paper, supplement, "SMPL Fitting", last paragraph; its similarity of bones.
    """
    shape = suspects.detections.confidence.shape
    fits = np.full(shape[:3], -1, dtype=np.int16)
    similarity = np.full(shape[:3], np.nan, dtype=np.float32)
    distance = np.full(shape, np.nan, dtype=np.float32)
    dropped = np.zeros(shape[:3], dtype=np.bool_)

    rows, (frame, camera, person), order = _pair_with_bodies(views, suspects)
    place = suspects.detections.detection_index[frame, camera, person].astype(np.int64)
    away = rows.mahalanobis_distance(spread)
    alike = rows.similarity()
    count, fitting = _count_fitting(away, settings)
    judged = count >= settings.min_keypoints
    good = judged & _is_fit(count, fitting, alike, settings)
    at = frame, camera, place
    fits[at] = np.where(good, person, -1)
    similarity[at] = alike
    np.put_along_axis(ordered := np.full(away.shape, np.nan), order, away, axis=1)
    distance[at] = ordered
    dropped[at] = judged & ~good

    taken = np.zeros(shape[:3], dtype=np.bool_)
    taken[at] = True
    open_ = dropped | ~taken
    open_ &= np.isfinite(suspects.detections.keypoints[..., 0]).sum(-1) >= settings.min_keypoints
    for n in np.unique(np.nonzero(open_)[0]):
        where, *best = _find_best_bodies(n, open_[n], views, suspects, spread, settings)
        at = n, *where
        fits[at], similarity[at], distance[at] = best
    dropped = (dropped | suspects.dropped) & (fits < 0)
    with np.errstate(invalid="ignore"):
        rejected = distance > settings.max_deviation
    rejected |= dropped[..., None] & np.isfinite(suspects.detections.confidence)
    return Judgement(fits, similarity, distance, rejected, dropped)


def _pair_with_bodies(
    views: BodyViews, suspects: TriangulatedDetections
) -> tuple[_Pairs, tuple[Places, Places, Places], Places]:
    """Return detections with the bodies of their tracked persons, and the order of their joints."""
    frame, camera, person = np.nonzero(suspects.detections.detection_index >= 0)
    place = suspects.detections.detection_index[frame, camera, person]
    order = _order_joints(suspects.exchanged[frame, camera, person])
    pixels = (
        suspects.detections.keypoints[frame, camera, place]
        - suspects.offsets[frame, camera, person, None]
    )
    confidence = suspects.detections.confidence[frame, camera, place]
    pixels = np.take_along_axis(pixels, order[..., None], axis=1)
    confidence = np.take_along_axis(confidence, order, axis=1)
    at = frame, camera, person
    return _compare(views, at, pixels, confidence, suspects.noise), at, order


def _compare(
    views: BodyViews,
    at: tuple[Places, Places, Places],
    pixels: Floats,
    confidence: Floats,
    noise: tuple[float, float],
) -> _Pairs:
    stated = noise[0] ** 2 + (views.scale[at] * noise[1]) ** 2
    return _Pairs(views.image[at], pixels, stated, views.variance[at], confidence)


def _order_joints(exchanged: Flags) -> Places:
    """Return the index of the keypoint that shows each joint (n, 17), swaps undone."""
    order = np.tile(np.arange(len(COCO17)), (len(exchanged), 1))
    for part, names in enumerate(_PARTS):
        for name in names:
            left, right = COCO17.index(f"left_{name}"), COCO17.index(f"right_{name}")
            mine = exchanged[:, part]
            order[mine, left], order[mine, right] = right, left
    return order


def _count_fitting(distance: Floats, settings: FilteringSettings) -> tuple[Places, Places]:
    """Return the numbers of keypoints, and of those within the limit (n,)."""
    with np.errstate(invalid="ignore"):
        fitting = (distance <= settings.max_deviation).sum(-1)
    return np.isfinite(distance).sum(-1), fitting


def _is_fit(
    count: Places, fitting: Places, similarity: Floats, settings: FilteringSettings
) -> Flags:
    with np.errstate(invalid="ignore"):
        alike = similarity >= settings.min_similarity
    enough = (count >= settings.min_keypoints) & (fitting >= settings.min_inlier_share * count)
    return np.asarray(enough & alike)


def _find_best_bodies(
    n: int,
    open_: Flags,
    views: BodyViews,
    suspects: TriangulatedDetections,
    spread: Spread,
    settings: FilteringSettings,
) -> tuple[tuple[Places, Places], Places, Floats, Floats]:
    """Return the bodies that a frame's open detections (cameras, detections) fit best.

    Returned are cameras and indices (n,) of the detections that fit a body, and of each: the index
    of the person, the similarity of bones [1], and distances (n, 17) in standard deviations.
    """
    camera, place = np.nonzero(open_)
    persons = views.image.shape[2]
    if not persons:
        none = np.empty(0, dtype=np.int64)
        return (none, none), none, np.empty(0), np.empty((0, len(COCO17)))
    cameras, people = np.repeat(camera, persons), np.tile(np.arange(persons), len(camera))
    places = np.repeat(place, persons)
    rows = _compare(
        views,
        (np.full(len(people), n), cameras, people),
        suspects.detections.keypoints[n, cameras, places],
        suspects.detections.confidence[n, cameras, places],
        suspects.noise,
    )
    away, alike = rows.mahalanobis_distance(spread), rows.similarity()
    count, fitting = _count_fitting(away, settings)
    good = _is_fit(count, fitting, alike, settings).reshape(-1, persons)
    share = (fitting / np.maximum(count, 1)).reshape(-1, persons)
    best = np.where(good, share + 1e-3 * alike.reshape(-1, persons), -np.inf).argmax(axis=1)
    found = np.flatnonzero(good.any(axis=1))
    row = found * persons + best[found]
    return (camera[found], place[found]), best[found], alike[row], away[row]
