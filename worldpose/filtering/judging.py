"""Detections beside the bodies: what fits whom, and which keypoints do not belong (R2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats
from data_contracts.conventions import COCO17, COCO17_BONES
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.filtering.residuals import Residuals
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.spread import Spread, learn_spread
from worldpose.filtering.views import BodyViews

Places = NDArray[np.int64]

_BONES: Final = np.array(COCO17_BONES)
_PARTS: Final = tuple(EXCHANGED_PARTS.values())


@dataclass(frozen=True, eq=False)
class Suspects:
    """What a stretch of frames holds to be judged.

    Attributes:
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17).
        index: (frames, cameras, persons), place among the detections; -1 = not seen.
        offsets: (frames, cameras, persons, 2) [px], by how much the camera sees a person beside
            where all cameras put him.
        exchanged: (frames, cameras, persons, 3), parts whose left and right were put right.
        dropped: (frames, cameras, detections), boxes that the iteration before dropped.
        noise: what keypoints are stated to err by, [px] and [m].
    """

    keypoints: AnyFloats
    confidence: AnyFloats
    index: NDArray[np.integer]
    offsets: Floats
    exchanged: Flags
    dropped: Flags
    noise: tuple[float, float]

    def without(self, shift: Floats) -> Suspects:
        """Return the same with the keypoints of people less what they are beside their bodies by.

        Args:
            shift: (frames, cameras, persons, 17, 2) [px], of the bodies' joints; NaN = unknown.
        """
        return replace(self, keypoints=self.keypoints - self.by_detection(shift))

    def less_clocks(self, late: Floats, way: Floats) -> Suspects:
        """Return the same with offsets less what of them is a camera's lateness.

        Args:
            late: (cameras,) [frame].
            way: (frames, cameras, persons, 17, 2) [px], of joints in a frame; NaN = unknown.
        """
        part = late[:, None, None] * np.nan_to_num(way.mean(axis=-2))
        return replace(self, offsets=self.offsets - part)

    def by_detection(self, shift: Floats) -> Floats:
        """Return the same shift (frames, cameras, detections, 17, 2) [px]; 0 = of nobody, unknown.

        Where sides are exchanged, that of the joint which the keypoint is.
        """
        frame, camera, person = np.nonzero(self.index >= 0)
        order = _order(self.exchanged[frame, camera, person])
        own = np.zeros((len(frame), *shift.shape[3:]))
        np.put_along_axis(own, order[..., None], shift[frame, camera, person], axis=1)
        out = np.zeros(self.keypoints.shape)
        out[frame, camera, self.index[frame, camera, person]] = np.nan_to_num(own)
        return out


@dataclass(frozen=True, eq=False)
class Judgement:
    """What the bodies say of every detection; (frames, cameras, detections) each.

    Attributes:
        fits: int16, place among the persons of the body that it fits; -1 = none, or not judged.
        similarity: float32, mean cosine between its bones and that body's, or its person's where
            it fits none; NaN where not judged.
        surprise: (..., 17) float32, distance of keypoints to that body in standard deviations; NaN
            where not judged.
        rejected: (..., 17) bool, keypoints to leave out.
        dropped: bool, boxes all of whose keypoints are rejected, for they were taken for somebody,
            now or in an iteration before, and fit nobody.
    """

    fits: NDArray[np.int16]
    similarity: NDArray[np.float32]
    surprise: NDArray[np.float32]
    rejected: Flags
    dropped: Flags


@dataclass(frozen=True, eq=False)
class _Rows:
    """Detections beside one body each, as it would see them."""

    image: Floats
    """(n, 17, 2) where the body should be seen [px]."""
    pixels: Floats
    """(n, 17, 2) where it was seen, sides and offsets put right [px]."""
    stated: Floats
    """(n, 17) variance that keypoints are stated to have per axis [px^2]."""
    known: Floats
    """(n, 17) variance of the body's joints per axis [px^2]."""
    confidence: Floats
    """(n, 17)"""

    @property
    def squared(self) -> Floats:
        return np.asarray(((self.pixels - self.image) ** 2).sum(-1))

    def surprise(self, spread: Spread) -> Floats:
        variance = spread.factor(self.confidence) * self.stated + self.known
        return np.asarray(np.sqrt(self.squared / variance))

    def similarity(self) -> Floats:
        """Mean cosine between bones; NaN without any."""
        seen, meant = (
            each[:, _BONES[:, 1]] - each[:, _BONES[:, 0]] for each in (self.pixels, self.image)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = (seen * meant).sum(-1)
            cosine /= np.linalg.norm(seen, axis=-1) * np.linalg.norm(meant, axis=-1)
        there = np.isfinite(cosine)
        count = there.sum(-1)
        total = np.where(there, cosine, 0.0).sum(-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def learn_from(views: BodyViews, suspects: Suspects) -> Spread:
    """Return the spread of keypoints about the bodies of those they were taken for."""
    rows, _, _ = _own(views, suspects)
    return learn_spread(rows.squared, rows.stated, rows.known, rows.confidence)


def body_residuals(
    views: BodyViews, suspects: Suspects, judged: Judgement, spread: Spread, repeated: float
) -> Residuals:
    """Return by how much keypoints miss the bodies of those they were taken for, if these fit.

    What a camera sees people beside of is not taken off: clocks are in it.

    Args:
        views: the bodies in all pictures.
        suspects: what was detected there.
        judged: the same, judged; what is rejected does not count.
        spread: of keypoints about bodies.
        repeated: detections of a person that err alike, so that they count as one.
    """
    whole = replace(suspects, offsets=np.zeros_like(suspects.offsets))
    rows, (frame, camera, person), order = _own(views, whole)
    place = suspects.index[frame, camera, person]
    wrong = np.take_along_axis(judged.rejected[frame, camera, place], order, axis=1)
    wrong |= (judged.fits[frame, camera, place] != person)[:, None]
    missed = np.where(wrong[..., None], np.nan, rows.pixels - rows.image)
    variance = spread.factor(rows.confidence) * rows.stated + rows.known
    return Residuals(frame, camera, person, missed, variance, repeated)


def judge_detections(
    views: BodyViews, suspects: Suspects, spread: Spread, settings: FilteringSettings
) -> Judgement:
    """Return what the bodies say of a stretch of frames.

    A detection is judged by the body of the person it was taken for, unless it does not fit that
    and does fit another. One that was taken for somebody and fits nobody is dropped, and stays so
    until it fits somebody; another that was taken for nobody is judged only where it fits a body.

    Args:
        views: the bodies in all pictures.
        suspects: what was detected there.
        spread: of keypoints about bodies, learned in the same clip.
        settings: what counts as a contradiction.

    Note:
        Paper, supplement, "SMPL Fitting", last paragraph; its similarity of bones (M4).
    """
    shape = suspects.confidence.shape
    fits = np.full(shape[:3], -1, dtype=np.int16)
    similarity = np.full(shape[:3], np.nan, dtype=np.float32)
    surprise = np.full(shape, np.nan, dtype=np.float32)
    dropped = np.zeros(shape[:3], dtype=np.bool_)

    rows, (frame, camera, person), order = _own(views, suspects)
    place = suspects.index[frame, camera, person].astype(np.int64)
    away = rows.surprise(spread)
    alike = rows.similarity()
    count, fitting = _counts(away, settings)
    judged = count >= settings.min_keypoints
    good = judged & _is_fit(count, fitting, alike, settings)
    at = frame, camera, place
    fits[at] = np.where(good, person, -1)
    similarity[at] = alike
    np.put_along_axis(ordered := np.full(away.shape, np.nan), order, away, axis=1)
    surprise[at] = ordered
    dropped[at] = judged & ~good

    taken = np.zeros(shape[:3], dtype=np.bool_)
    taken[at] = True
    open_ = dropped | ~taken
    open_ &= np.isfinite(suspects.keypoints[..., 0]).sum(-1) >= settings.min_keypoints
    for n in np.unique(np.nonzero(open_)[0]):
        _look_for_others(n, open_[n], views, suspects, spread, settings, fits, similarity, surprise)
    dropped = (dropped | suspects.dropped) & (fits < 0)
    with np.errstate(invalid="ignore"):
        rejected = surprise > settings.max_deviation
    rejected |= dropped[..., None] & np.isfinite(suspects.confidence)
    return Judgement(fits, similarity, surprise, rejected, dropped)


def _own(
    views: BodyViews, suspects: Suspects
) -> tuple[_Rows, tuple[Places, Places, Places], Places]:
    """Detections beside the bodies of those they were taken for, and the order of their joints."""
    frame, camera, person = np.nonzero(suspects.index >= 0)
    place = suspects.index[frame, camera, person]
    order = _order(suspects.exchanged[frame, camera, person])
    pixels = (
        suspects.keypoints[frame, camera, place] - suspects.offsets[frame, camera, person, None]
    )
    confidence = suspects.confidence[frame, camera, place]
    pixels = np.take_along_axis(pixels, order[..., None], axis=1)
    confidence = np.take_along_axis(confidence, order, axis=1)
    at = frame, camera, person
    return _rows(views, at, pixels, confidence, suspects.noise), at, order


def _rows(
    views: BodyViews,
    at: tuple[Places, Places, Places],
    pixels: Floats,
    confidence: Floats,
    noise: tuple[float, float],
) -> _Rows:
    stated = noise[0] ** 2 + (views.scale[at] * noise[1]) ** 2
    return _Rows(views.image[at], pixels, stated, views.variance[at], confidence)


def _order(exchanged: Flags) -> Places:
    """Which of a detection's joints each joint of a body is (n, 17), sides put right."""
    order = np.tile(np.arange(len(COCO17)), (len(exchanged), 1))
    for part, names in enumerate(_PARTS):
        for name in names:
            left, right = COCO17.index(f"left_{name}"), COCO17.index(f"right_{name}")
            mine = exchanged[:, part]
            order[mine, left], order[mine, right] = right, left
    return order


def _counts(surprise: Floats, settings: FilteringSettings) -> tuple[Places, Places]:
    with np.errstate(invalid="ignore"):
        fitting = (surprise <= settings.max_deviation).sum(-1)
    return np.isfinite(surprise).sum(-1), fitting


def _is_fit(
    count: Places, fitting: Places, similarity: Floats, settings: FilteringSettings
) -> Flags:
    with np.errstate(invalid="ignore"):
        alike = similarity >= settings.min_similarity
    enough = (count >= settings.min_keypoints) & (fitting >= settings.min_inlier_share * count)
    return np.asarray(enough & alike)


def _look_for_others(
    n: int,
    open_: Flags,
    views: BodyViews,
    suspects: Suspects,
    spread: Spread,
    settings: FilteringSettings,
    fits: NDArray[np.int16],
    similarity: NDArray[np.float32],
    surprise: NDArray[np.float32],
) -> None:
    """Give a frame's open detections (cameras, detections) to the bodies that they fit best."""
    camera, place = np.nonzero(open_)
    persons = views.image.shape[2]
    if not persons:
        return
    cameras, people = np.repeat(camera, persons), np.tile(np.arange(persons), len(camera))
    places = np.repeat(place, persons)
    rows = _rows(
        views,
        (np.full(len(people), n), cameras, people),
        suspects.keypoints[n, cameras, places],
        suspects.confidence[n, cameras, places],
        suspects.noise,
    )
    away, alike = rows.surprise(spread), rows.similarity()
    count, fitting = _counts(away, settings)
    good = _is_fit(count, fitting, alike, settings).reshape(-1, persons)
    share = (fitting / np.maximum(count, 1)).reshape(-1, persons)
    best = np.where(good, share + 1e-3 * alike.reshape(-1, persons), -np.inf).argmax(axis=1)
    found = np.flatnonzero(good.any(axis=1))
    row = found * persons + best[found]
    at = n, camera[found], place[found]
    fits[at], similarity[at], surprise[at] = best[found], alike[row], away[row]
