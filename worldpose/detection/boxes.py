"""Boxes of people: how much they overlap, and one box from several of a person."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.detection.interfaces import People, Poses

Floats = NDArray[np.float64]

SUREST: Final = 12
"""Keypoints that tell whether somebody is there: of many people some are hidden."""


def overlaps(a: Floats, b: Floats) -> Floats:
    """Intersection over union of every pair of boxes (n, m), 0 where they are apart.

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
    """Area of boxes (n,) [px^2]."""
    return np.asarray(np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1))


def best_of(people: People, overlap: float) -> NDArray[np.intp]:
    """Places of the people whose boxes overlap no better one by more than `overlap`, best first.

    Args:
        people: of one picture.
        overlap: [1].
    """
    order = _best_first(people)
    boxes = people.boxes[order]
    close = overlaps(boxes, boxes) > overlap
    kept = np.zeros(len(boxes), dtype=np.bool_)
    for number in range(len(boxes)):
        kept[number] = not close[number, :number][kept[:number]].any()
    return order[kept]


def suppress(people: People, overlap: float) -> People:
    """The people without boxes that overlap a better one by more than `overlap`, best first."""
    best = best_of(people, overlap)
    return People(people.boxes[best], people.scores[best])


def seen_closer(people: People, poses: Poses) -> People:
    """The same people with the boxes of who looked closer, where there are some.

    Args:
        people: as a detector found them.
        poses: of each. A score becomes its geometric mean with the expected fit and the mean
            confidence of the surest keypoints.
    """
    if poses.boxes is None or poses.fit is None:
        return people
    real = np.all(poses.boxes[:, 2:] - poses.boxes[:, :2] > 1.0, axis=1)
    boxes = np.where(real[:, None], poses.boxes, people.boxes)
    sure = np.sort(np.nan_to_num(poses.confidence), axis=1)[:, -SUREST:].mean(axis=1)
    return People(boxes, np.cbrt(people.scores * poses.fit * sure))


def fuse(members: list[People], overlap: float) -> People:
    """One box a person from what the members of an ensemble found, best first.

    Weighted boxes fusion: boxes join the best scored cluster that they overlap; a cluster's box is
    the mean of its boxes weighted by score, and its score their sum over the number of members, so
    that whom only one of them saw counts less. Each member's own doubles go first.

    Args:
        members: what each detector found in one picture.
        overlap: above which two boxes are of one person [1].

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
        shared[[who in cluster for cluster in joined]] = 0.0  # a member sees a person once
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
    """Order by falling score, and by place where scores are equal: it must not depend on luck."""
    return np.lexsort((people.boxes[:, 1], people.boxes[:, 0], -people.scores))
