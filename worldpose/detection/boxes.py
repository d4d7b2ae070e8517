"""Bounding boxes of people: intersection over union, suppression and weighted boxes fusion."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.detection.interfaces import People, Poses

SUREST: Final = 12
"""Number of surest keypoints that decide whether a box holds a person: others may be hidden."""


def overlaps(a: Floats, b: Floats) -> Floats:
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


def areas(boxes: Floats) -> Floats:
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


def seen_closer(people: People, poses: Poses) -> People:
    """Return the people with the boxes of the pose estimator, where it gives any.

    Args:
        people: as a detector found them.
        poses: of each person. A score becomes its geometric mean with the expected fit and the mean
            confidence of the surest keypoints.
    """
    if poses.boxes is None or poses.fit is None:
        return people
    real = np.all(poses.boxes[:, 2:] - poses.boxes[:, :2] > 1.0, axis=1)
    boxes = np.where(real[:, None], poses.boxes, people.boxes)
    sure = np.sort(np.nan_to_num(poses.confidence), axis=1)[:, -SUREST:].mean(axis=1)
    return People(boxes, np.cbrt(people.scores * poses.fit * sure))


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
