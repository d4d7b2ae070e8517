"""One detection per person: suppression by box or pose overlap, and fusion of an ensemble."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.conventions import COCO17_SIGMAS
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People
from worldpose.geometry.boxes import box_areas, box_iou


def nms_indices(people: People, overlap: float) -> NDArray[np.intp]:
    """Return the indices of boxes that pass non-maximum suppression, best first.

    A better box with an intersection over union above `overlap` [1] suppresses a box.
    """
    order = _best_first(people)
    boxes = people.boxes[order]
    close = np.tril(box_iou(boxes, boxes) > overlap, -1)
    kept = np.ones(len(boxes), dtype=np.bool_)
    for number in np.flatnonzero(close.any(axis=1)).tolist():
        kept[number] = not (close[number] & kept).any()
    return order[kept]


def suppress(people: People, overlap: float) -> People:
    """Return the people after non-maximum suppression at `overlap` [1], best first."""
    return people.select(nms_indices(people, overlap))


def surest_confidence(confidence: AnyFloats) -> Floats:
    """Return the mean of a person's twelve surest confidences (people, 17); others may be hidden.

    A keypoint that was not found, NaN, counts as 0.
    """
    return np.asarray(np.sort(np.nan_to_num(confidence), axis=1)[:, -12:].mean(axis=1))


def combine_boxes(people: People, poses: KeypointDetections) -> KeypointDetections:
    """Return the poses with the estimator's boxes, where it gives any, else the detector's."""
    real = np.all(poses.boxes[:, 2:] - poses.boxes[:, :2] > 1.0, axis=1)
    boxes = np.where(real[:, None], poses.boxes, people.boxes)
    sure = surest_confidence(poses.confidence)
    joint_score = np.cbrt(people.scores * poses.score * sure)
    score = np.where(np.isnan(poses.score), people.scores, joint_score)
    return replace(poses, boxes=boxes, score=score)


def fuse(members: list[People], overlap: float) -> People:
    """Return one box per person from the detections of an ensemble in one frame, best first.

    Weighted boxes fusion (Solovyev et al., 2021): a box joins the best scored cluster that it
    overlaps, by an intersection over union above `overlap` [1]. A cluster's box is the mean of its
    boxes weighted by score. Its score is the sum of their scores over the number of members, so a
    person that only one member detects scores less.
    """
    each = [suppress(member, overlap) for member in members]
    if len(each) == 1:
        return each[0]
    pooled = People.concatenate(each)
    order = _best_first(pooled)
    member = np.concatenate([np.full(len(p.scores), m) for m, p in enumerate(each)])[order]
    boxes, scores = pooled.boxes[order], pooled.scores[order]
    fused, weight = np.empty((0, 4)), np.empty(0)
    joined: list[set[int]] = []
    for box, score, who in zip(boxes, scores, member, strict=True):
        shared = box_iou(box[None], fused)[0]
        shared[[who in cluster for cluster in joined]] = 0.0  # one box per member and person
        best = int(np.argmax(shared)) if len(shared) else -1
        if best >= 0 and shared[best] > overlap:
            total = weight[best] + score
            fused[best] = (fused[best] * weight[best] + box * score) / total
            weight[best] = total
            joined[best].add(int(who))
        else:
            fused, weight = np.vstack([fused, box]), np.append(weight, score)
            joined.append({int(who)})
    result = People(fused, weight / len(each))
    return result.select(_best_first(result))


def _best_first(people: People) -> NDArray[np.intp]:
    """Return the order by falling score, then by position, so that ties have a fixed order."""
    return np.lexsort((people.boxes[:, 1], people.boxes[:, 0], -people.scores))


def object_keypoint_similarity(keypoints: AnyFloats, area: AnyFloats) -> Floats:
    """Return COCO's object keypoint similarity of every pair of poses (people, people) [1].

    Keypoints are (people, 17, 2) [px], NaN where not found; the smaller area (people,) [px^2] of a
    pair's boxes counts.
    """
    x, y = np.moveaxis(keypoints, -1, 0)
    apart = np.square(x[:, None] - x) + np.square(y[:, None] - y)
    scale = 2.0 * np.minimum(area[:, None], area[None])[..., None]
    alike = np.exp(-apart / (scale * (2.0 * np.array(COCO17_SIGMAS)) ** 2))
    both = np.isfinite(apart)
    count = both.sum(axis=2)
    total = np.where(both, alike, 0.0).sum(axis=2)
    return np.asarray(np.divide(total, count, out=np.zeros_like(total), where=count > 0))


def suppress_poses(
    detections: KeypointDetections, least_keypoint: float, same_pose: float
) -> KeypointDetections:
    """Return an image's people (people,) with another pose than that of every better box.

    The more a pose resembles that of a better box, the lower its score falls (soft suppression,
    Bodla, 2017): a person behind another stays, a duplicate ranks last. A keypoint below a
    confidence of `least_keypoint` was not found; poses more similar than `same_pose` are of one
    person [1].
    """
    with np.errstate(invalid="ignore"):
        found = detections.confidence >= least_keypoint
        found &= np.isfinite(detections.keypoints).all(axis=2)
    detections = detections.without(~found)
    alike = object_keypoint_similarity(detections.keypoints, box_areas(detections.boxes))
    kept, shown = np.zeros(len(detections.score), dtype=np.bool_), np.asarray(found.any(axis=1))
    score = detections.score.copy()
    for row in np.argsort(-detections.score, kind="stable"):
        most = alike[row, kept].max(initial=0.0)
        kept[row] = shown[row] and most <= same_pose
        # Share of its score that a box with the pose of a better box loses [1].
        score[row] *= 1.0 - 0.5 * most**2
    return replace(detections, score=score).select(kept)
