"""Bounding boxes of people: intersection over union, suppression and weighted boxes fusion."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People

SUREST: Final = 12
"""Number of surest keypoints that decide whether a box holds a person: others may be hidden."""


def overlaps(a: AnyFloats, b: AnyFloats) -> Floats:
    """Return the intersection over union of every pair of boxes (n, m), 0 for disjoint boxes.

    Args:
        a: (n, 4) x0, y0, x1, y1 [px].
        b: (m, 4).
    """
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    union = areas(a)[:, None] + areas(b)[None, :] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))


def areas(boxes: AnyFloats) -> Floats:
    """Return the areas of boxes (n,) [px^2]."""
    return np.asarray(np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1))


def best_of(people: People, overlap: float) -> NDArray[np.intp]:
    """Return the indices of boxes that pass non-maximum suppression, best first.

    Args:
        people: of one frame.
        overlap: a better box with a larger intersection over union suppresses a box [1].
    """
    order = _best_first(people)
    boxes = people.boxes[order]
    close = overlaps(boxes, boxes) > overlap
    kept = np.zeros(len(boxes), dtype=np.bool_)
    for number in range(len(boxes)):
        kept[number] = not close[number, :number][kept[:number]].any()
    return order[kept]


def suppress(people: People, overlap: float) -> People:
    """Return the people after non-maximum suppression at `overlap` [1], best first."""
    best = best_of(people, overlap)
    return People(people.boxes[best], people.scores[best])


def surest_confidence(confidence: AnyFloats) -> Floats:
    """Return the mean confidence of the `SUREST` keypoints with the highest; 0 without any.

    Args:
        confidence: (people, 17); NaN where not found.
    """
    return np.asarray(np.sort(np.nan_to_num(confidence), axis=1)[:, -SUREST:].mean(axis=1))


def combine_boxes(people: People, poses: KeypointDetections) -> KeypointDetections:
    """Return the poses with the estimator's boxes, where it gives any, else the detector's.

    Args:
        people: as a detector found them.
        poses: the estimate for each person. Its score, the expected fit of its box, becomes the
            geometric mean of the detector's score, the fit and the mean confidence of the surest
            keypoints; without a fit the detector's score stays.
    """
    real = np.all(poses.boxes[:, 2:] - poses.boxes[:, :2] > 1.0, axis=1)
    boxes = np.where(real[:, None], poses.boxes, people.boxes)
    sure = surest_confidence(poses.confidence)
    joint_score = np.cbrt(people.scores * poses.score * sure)
    score = np.where(np.isnan(poses.score), people.scores, joint_score)
    return replace(poses, boxes=boxes, score=score)


def fuse(members: list[People], overlap: float) -> People:
    """Return one box per person from the detections of an ensemble, best first.

    Weighted boxes fusion: a box joins the best scored cluster that it overlaps. A cluster's box is
    the mean of its boxes weighted by score. Its score is the sum of their scores over the number of
    members, so a person that only one member detects scores less. Each member's duplicates are
    suppressed first.

    Args:
        members: detections of each detector in one frame.
        overlap: boxes with a larger intersection over union are of one person [1].

    Note:
        D3. Solovyev et al., Weighted boxes fusion, 2021.
    """
    each = [suppress(member, overlap) for member in members]
    if len(each) == 1:
        return each[0]
    everybody = People(
        np.concatenate([member.boxes for member in each]),
        np.concatenate([member.scores for member in each]),
    )
    order = _best_first(everybody)
    member = np.concatenate([np.full(len(p.scores), m) for m, p in enumerate(each)])[order]
    boxes, scores = everybody.boxes[order], everybody.scores[order]
    fused, weight = np.empty((0, 4)), np.empty(0)
    joined: list[set[int]] = []
    for box, score, who in zip(boxes, scores, member, strict=True):
        shared = overlaps(box[None], fused)[0]
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
    order = _best_first(result)
    return People(result.boxes[order], result.scores[order])


def _best_first(people: People) -> NDArray[np.intp]:
    """Return the order by falling score, then by position, so that ties have a fixed order."""
    return np.lexsort((people.boxes[:, 1], people.boxes[:, 0], -people.scores))
