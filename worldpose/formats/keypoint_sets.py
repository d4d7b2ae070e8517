"""Sets of keypoints of pose estimators, and one rule for what their files say.

A file's own words decide the order of its points: the names of `categories`, or the name of a
model. Where it is silent, the number of points decides, and lengths in the images decide between
two sets of one size. Points that worldpose does not use are left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats
from data_contracts.conventions import COCO17, FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.body.keypoints import BODY25
from worldpose.errors import InputError, describe_value
from worldpose.video.names import frame_numbers

MAX_CONFIDENCE: Final = 2.0
"""Largest confidence that counts as 1 [1]: peaks of heat maps and of SimCC exceed 1; a larger one
belongs to another scale."""
ARRAY_BYTES: Final = 4 << 30
"""Maximum size of one file's arrays [byte]; two hours of 25 people at 50 Hz are 2 GB."""
PEOPLE_LIMIT: Final = 1000
"""Maximum people per frame of one camera; a stadium's stands in one image have a few hundred."""
COORDINATE_LIMIT: Final = 1e6
"""Maximum absolute coordinate of a keypoint or box corner [px]."""


def describe_fault(name: object, numbers: Mapping[Any, int], otherwise: str) -> tuple[str, str]:
    """Return what is expected, perhaps `otherwise`, and found in a name without a frame."""
    if isinstance(name, str) and name not in numbers and frame_numbers([name]):
        expected = "one number that rises by image through all files"
        return expected, f"{describe_value(name)} and others: several clips or times of day"
    return otherwise, describe_value(name)


class PointOrder(NamedTuple):
    """The order of points in an estimator's files."""

    name: str
    joints: tuple[int, ...]
    """(17,) places of COCO-17's joints; -1 = the set lacks it."""
    feet: tuple[int, ...] = ()
    """(6,) places of `FEET`; none if it has no feet."""

    def select(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return COCO-17 and perhaps `FEET` of points (people, points, 3); 0 = missing."""
        places = np.array([*self.joints, *self.feet])
        return np.where(places[:, None] >= 0, points[:, places], np.float32(0.0))


def _order(name: str, points: Sequence[str]) -> PointOrder:
    feet = tuple(map(points.index, FEET)) if set(FEET) <= set(points) else ()
    joints = tuple(points.index(joint) if joint in points else -1 for joint in COCO17)
    return PointOrder(name, joints, feet)


_COCO18: Final = (*BODY25[:8], *BODY25[9:19])  # OpenPose's BODY_25 without mid-hip and feet
_FIRST17: Final = tuple(range(17))
_HALPE_FEET: Final = (20, 22, 24, 21, 23, 25)
_SETS: Final = {
    15: (PointOrder("MPI-15", (*[-1] * 5, 5, 2, 6, 3, 7, 4, 11, 8, 12, 9, 13, 10)),),
    17: (PointOrder("COCO-17", _FIRST17),),
    18: (_order("COCO-18", _COCO18),),
    25: (_order("BODY_25", BODY25), PointOrder("BODY_25B", _FIRST17, tuple(range(19, 25)))),
    26: (PointOrder("HALPE-26", _FIRST17, _HALPE_FEET),),
    33: (PointOrder("BlazePose", (0, 2, 5, 7, 8, *range(11, 17), *range(23, 29))),),
    68: (PointOrder("HALPE-68", _FIRST17, _HALPE_FEET),),
    133: (PointOrder("COCO-WholeBody", _FIRST17, tuple(range(17, 23))),),
    135: (PointOrder("BODY_135", _FIRST17, tuple(range(19, 25))),),
    136: (PointOrder("HALPE-136", _FIRST17, _HALPE_FEET),),
}
"""Sets that are read, by their number of points; the first is the usual one."""
SIZES: Final = tuple(_SETS)
"""Numbers of points that are read."""
KNOWN_SETS: Final = ", ".join(
    f"{size} ({' or '.join(order.name for order in orders)})" for size, orders in _SETS.items()
)
MODELS: Final = {
    "body_with_feet": "HALPE-26",
    "halpe_26": "HALPE-26",
    "halpe_68": "HALPE-68",
    "halpe_136": "HALPE-136",
    "whole_body": "COCO-WholeBody",
    "whole_body_wrist": "COCO-WholeBody",
    "coco_133": "COCO-WholeBody",
    "coco_133_wrist": "COCO-WholeBody",
    "body": "COCO-17",
    "coco_17": "COCO-17",
    "coco": "COCO-18",
    "body_25": "BODY_25",
    "body_25b": "BODY_25B",
    "body_135": "BODY_135",
    "blazepose": "BlazePose",
    "mpii": "MPI-15",
}
"""Pose2Sim's names of models and the sets that they give."""

_BONES: Final = {
    "thigh": ((11, 13), (12, 14)),
    "shank": ((13, 15), (14, 16)),
    "upper arm": ((5, 7), (6, 8)),
    "forearm": ((7, 9), (8, 10)),
    "eye to nose": ((0, 1), (0, 2)),
}
"""Pairs of COCO-17's joints, left and right, whose lengths tell an order."""
_LENGTHS: Final = np.array([0.43, 0.42, 0.29, 0.26, 0.045])
"""Usual lengths of these [m], of which only ratios count."""
_HUMAN36M: Final = (4, 5, 1, 2, 5, 6, 2, 3, 11, 12, 14, 15, 12, 13, 15, 16, 9, 10, 9, 10)
"""The same pairs in Human3.6M's 17 points; it has no eyes, so nose to head stands for them."""
_HUMAN36M_LENGTHS: Final = np.array([0.43, 0.42, 0.29, 0.26, 0.115])
_MARGIN: Final = 0.3
"""How much better another order must explain the lengths [log]. Right orders of recordings and of
the simulation miss by 0.03 to 0.15, wrong ones by 0.5 or more."""


def order_by_names(where: str, names: Sequence[str]) -> PointOrder:
    """Return the order of points by names in any spelling; only face joints may be missing."""
    plain = [_plain(str(name)) for name in names]
    if "left_ankle" not in plain:  # Human3.6M calls them feet
        plain = [re.sub(r"^(left|right)_foot$", r"\1_ankle", name) for name in plain]
    face_joints = 5  # of COCO-17, the first ones
    missing = [joint for joint in COCO17[face_joints:] if joint not in plain]
    if missing or any(plain.count(joint) > 1 for joint in (*COCO17, *FEET)):
        unknown = [str(n) for n, one in zip(names, plain, strict=True) if one not in COCO17]
        raise InputError(
            where,
            expected="the names of COCO's joints, each once, perhaps without those of the face: "
            + ", ".join(COCO17),
            found=f"{', '.join(unknown) or ', '.join(map(str, names))}; missing are "
            + (", ".join(missing) or "none"),
            todo="Export the points of COCO-17, or name them so.",
        )
    return _order("COCO-17" if tuple(plain) == COCO17 else "named points", plain)


def _plain(name: str) -> str:
    """Return `left_shoulder` for Left Shoulder, LShoulder, shoulder-left or l_shoulder."""
    words = re.sub(r"([a-z])([A-Z])", r"\1 \2", re.sub(r"^([LR])([A-Z])", r"\1 \2", name.strip()))
    tokens = [token for token in re.findall(r"[a-z0-9]+", words.lower()) if not token.isdigit()]
    if len(tokens) == 1:
        parts = "eye|ear|shoulder|elbow|wrist|hip|knee|ankle"
        joined = re.fullmatch(rf"(left|right|l|r)({parts})", tokens[0])
        tokens = list(joined.groups()) if joined else tokens
    sides = {"l": "left", "left": "left", "r": "right", "right": "right"}
    side = [sides[token] for token in tokens if token in sides]
    part = [token for token in tokens if token not in sides]
    if any("toe" in token for token in part):
        part = ["small" if any("small" in token for token in part) else "big", "toe"]
    return "_".join([*side[:1], *part])


def order_by_points(where: str, points: AnyFloats, stated: str | None = None) -> PointOrder:
    """Return the order of points (people, points, 3) x, y [px] and confidence, 0 = missing.

    Their number alone is known, and perhaps a name in `MODELS`, which counts if it has this number.
    InputError if no set has it, or the lengths are those of another set or of none.
    """
    plausible = 0.3  # largest misfit of the order that explains them [log]
    # Least misfit of people, as many as these, that no view explains [log]: seen from right above,
    # people in a right order miss by 0.37, and other orders of 17 points by 0.45 and more.
    fewest, wrong = 20, 0.4
    size = points.shape[1]
    orders = _SETS.get(size, ())
    if not orders:
        raise unknown_size(where, size)
    named = MODELS.get((stated or "").strip().lower())
    for order in orders:
        if order.name == named:
            return order
    pairs = np.array(list(_BONES.values()))
    misfits = [_misfit(order.select(points), pairs, _LENGTHS) for order in orders]
    # Limbs that are hidden in all frames: a few others tell, of which a right order misses less.
    few = [_misfit(order.select(points), pairs, _LENGTHS, 4) for order in orders]
    are_few = bool(np.isnan(misfits).all())
    compared = few if are_few else misfits
    seen = [np.asarray((order.select(points)[..., 2] > 0.0).any(axis=0)) for order in orders]
    # The border of an image hides both sides of people: an order that has one alone is another.
    is_odd = [are_few and bool((each[1:17:2] != each[2:17:2]).any()) for each in seen]
    chosen = orders[0]
    for order, misfit, odd in zip(orders, compared, is_odd, strict=True):
        # An order that lacks the limbs, of NaN, explains nothing. Where the first one lacks them,
        # they may be hidden: there is no comparison, and the other has to fit well.
        most = plausible if np.isnan(misfits[0]) else wrong
        is_better = not compared[0] - misfit < _MARGIN or (is_odd[0] and not odd)
        if misfit <= most and is_better:
            chosen = order
    if size == len(COCO17):
        human = (points, np.reshape(_HUMAN36M, (5, 2, 2)), _HUMAN36M_LENGTHS)
        other, by_few = _misfit(*human), _misfit(*human, 4)
        is_other = other <= plausible and not misfits[0] - other < _MARGIN
        if np.isnan(misfits[0]):
            is_other |= by_few <= plausible and few[0] - by_few > _MARGIN
        # Arms without shoulders are those of people who are cut at the chest, without a face.
        is_cut = not seen[0][:5].any() and few[0] <= np.fmin(plausible, by_few)
        is_armless = seen[0][7:11].any() and not seen[0][5:7].any()
        if is_other or (is_armless and not is_cut):
            found = "thighs, shanks and arms as in the order of Human3.6M"
            todo = "Estimate poses with a model of COCO, or write COCO's joints."
            raise InputError(where, "the 17 joints in COCO's order", found, todo)
        if _is_posetrack(points):
            return PointOrder("PoseTrack18", (*[-1] * 5, *range(5, 17)))
    misfit = misfits[orders.index(chosen)]
    is_doubtful = chosen.name == "MPI-15" or (named is None and (stated or "").strip() != "")
    # Landmarks of a face, such as 300-W's, are 68 points too, of which none is hidden.
    most = plausible if is_doubtful or chosen.name == "HALPE-68" else wrong
    is_unknown = is_doubtful and np.isnan(misfit)
    people = np.count_nonzero((points[..., 2] > 0.0).any(axis=1))
    if (is_unknown and people) or (
        misfit > most and people >= (1 if most == plausible else fewest)
    ):
        model = f" of model {stated.strip()!r:.40}" if stated and named is None else ""
        found = f"others: the points{model} have another order"
        raise InputError(
            where,
            expected=f"limbs of usual lengths in the order of {chosen.name}",
            found=f"too few limbs to tell the points{model}" if is_unknown else found,
            todo="Name the points in `categories` of COCO's JSON, or in Pose2Sim state pose_model: "
            + ", ".join(MODELS),
        )
    return chosen


def _is_posetrack(points: AnyFloats) -> bool:
    """Return whether neck and top of the head (people, 17, 3) are in the place of COCO's eyes.

    PoseTrack18 has no ears, and its two are far from the nose, on opposite sides.
    """
    place = points[(points[:, [0, 1, 2, 5, 6, 11, 12], 2] > 0.0).all(axis=1), :, :2]
    if not len(place) or (points[:, 3:5, 2] > 0.0).any():
        return False
    one, two = (place[:, [1, 2]] - place[:, :1]).swapaxes(0, 1)
    length = np.linalg.norm([one, two], axis=-1)
    trunk = np.linalg.norm(place[:, 5:7].mean(axis=1) - place[:, 11:13].mean(axis=1), axis=-1)
    cosine = (one * two).sum(axis=-1) / np.maximum(length.prod(axis=0), 1e-9)
    # An eye is a tenth of the trunk from the nose; seen from above, the trunk is short.
    is_far = np.median(length.mean(axis=0) / np.maximum(trunk, 1e-9)) > 0.2
    return bool(is_far and np.median(cosine) < -0.5)


def unknown_size(where: str, size: int) -> InputError:
    """Return the error of a set of points that no known estimator has."""
    expected = f"x, y and confidence of each point, of {KNOWN_SETS} points"
    todo = "Estimate poses with one of these sets (Pose2Sim: pose_model = 'Body_with_feet')."
    return InputError(where, expected, f"{size} points", todo)


def _misfit(points: AnyFloats, pairs: NDArray[np.int64], lengths: Floats, least: int = 8) -> float:
    """Return the mean deviation of people's lengths [log] from the usual ones; NaN if unknown.

    Points are (people, points, 3), pairs (bones, 2, 2) the places of the ends of the left and right
    bone. Only ratios of the usual lengths (bones,) count, and with 8 of 10 the face may be hidden.
    """
    sample = 2000  # people whose lengths are compared; more add nothing
    some = points[:: max(1, len(points) // sample)]
    there = (some[..., 2:] > 0.0) & some[..., :2].any(axis=-1, keepdims=True)  # as `clean_points`
    place = np.where(there, some[..., :2], np.nan).astype(np.float64)
    span = np.linalg.norm(place[:, pairs[..., 0]] - place[:, pairs[..., 1]], axis=-1)
    known = np.isfinite(span).any(axis=0)
    if known.sum() < least:
        return float("nan")
    typical = np.nanmedian(span[:, known], axis=0)
    usual = np.broadcast_to(lengths[:, None], known.shape)[known]
    ratio = np.log(np.maximum(typical, 1e-9) / usual)
    return float(np.abs(ratio - np.median(ratio)).mean())


class Changes(NamedTuple):
    """How often a file's points were changed to be read."""

    clamped: int = 0
    """Confidences above 1, which count as 1."""
    nobody: int = 0
    """Entries without a known joint, which are no people."""
    empty: int = 0
    """Empty files of frames."""
    pointless: int = 0
    """Annotations of a data set that have no points, such as of the ball."""
    foreign: int = 0
    """Annotations with points, of another category than the people."""


class PeopleFile(NamedTuple):
    """People of one camera in a file or folder."""

    people: KeypointDetections
    """COCO-17, and `FEET` if the set has them; other points are left out."""
    kind: str | None
    """Name of the set of points; None without people."""
    changes: Changes


def clean_points(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], Changes]:
    """Return points (people, points, 3) with confidences of at most 1, and what was changed.

    A point that is not finite is missing, as one of confidence 0 is: x, y and confidence are 0.
    So is one at exactly 0, 0: programs write missing points so, with a confidence or not.
    """
    there = np.isfinite(points).all(axis=-1) & (points[..., 2] > 0.0)
    there &= (points[..., :2] != 0.0).any(axis=-1)
    clean = np.where(there[..., None], points, np.float32(0.0))
    clamped = int((clean[..., 2] > 1.0).sum())
    clean[..., 2] = np.minimum(clean[..., 2], 1.0)
    return clean, Changes(clamped)


def people_by_frame(
    path: Path,
    frames: NDArray[np.int64],
    points: NDArray[np.float32],
    boxes: Floats | None = None,
    scores: Floats | None = None,
    limit: int = ARRAY_BYTES,
) -> tuple[KeypointDetections, int]:
    """Return people by rising frame, and the number of entries that are nobody.

    An entry has a frame (n,), points (n, 17 or 23, 3) of COCO-17 and perhaps `FEET`, with
    confidence 0 = missing. Boxes (n, 4) are x, y, width, height [px], or else those of the joints;
    scores (n,) are the joints' mean where NaN or None. InputError beyond `limit` bytes or people of
    a frame.
    """
    found: Flags = np.asarray(points[..., 2] > 0)
    if found.sum() >= len(COCO17) and float(np.abs(points[found, :2]).max()) < 2.0:
        raise InputError(
            str(path),
            expected="keypoints in pixels",
            found=f"none beyond {float(np.abs(points[found, :2]).max()):.3g}: shares of the image?",
            todo="Export pixels (Ultralytics: normalize=False).",
        )
    seen: Flags = np.asarray(found[:, : len(COCO17)].any(axis=1))
    boxed: Flags = np.zeros(len(seen), np.bool_)
    if boxes is not None:
        boxed = np.asarray(np.isfinite(boxes).all(axis=1))
    kept = seen | boxed
    points, found, seen = points[kept], found[kept], seen[kept]
    boxed, frames = boxed[kept], frames[kept]
    found &= seen[:, None]
    values = np.where(found[..., None], points, np.float32(np.nan))
    joints = values[:, : len(COCO17)]
    corners = np.full((len(values), 4), np.nan)
    corners[seen, :2] = np.nanmin(joints[seen, :, :2], axis=1)
    corners[seen, 2:] = np.nanmax(joints[seen, :, :2], axis=1)
    if boxes is not None:
        given = boxes[kept][boxed]
        corners[boxed] = np.concatenate([given[:, :2], given[:, :2] + given[:, 2:]], axis=1)
    score = np.full(len(values), np.nan)
    score[seen] = np.nanmean(joints[seen, :, 2], axis=1)
    if scores is not None:
        score = np.where(np.isnan(scores[kept]), score, scores[kept])

    order = np.argsort(frames, kind="stable")
    frame, first, count = np.unique(frames[order], return_index=True, return_counts=True)
    most = int(count.max(initial=0))
    fullest = frame[np.argmax(count)] if len(count) else 0
    if most > PEOPLE_LIMIT:
        expected = f"at most {PEOPLE_LIMIT} people per frame"
        todo = "Check image_id, or keep the detections of each image with the highest scores."
        raise InputError(str(path), expected, f"{most} in frame {fullest}", todo)
    limit = min(limit, ARRAY_BYTES)
    if len(frame) * most * 4 * (3 * points.shape[1] + 5) > limit:
        expected = f"frames and people that fit into {limit} bytes"
        todo = "Check image_id."
        raise InputError(str(path), expected, f"{most} people in frame {fullest}", todo)
    row = np.repeat(np.arange(len(frame)), count)
    slot = np.arange(len(frames)) - np.repeat(first, count)

    def pad(given: NDArray[np.floating]) -> NDArray[np.float32]:
        dense = np.full((len(frame), most, *given.shape[1:]), np.nan, dtype=np.float32)
        dense[row, slot] = given[order]
        return dense

    people = KeypointDetections(
        keypoints=pad(joints[..., :2]),
        confidence=pad(joints[..., 2]),
        boxes=pad(corners),
        score=pad(score),
        frame=frame,
    )
    if points.shape[1] > len(COCO17):
        feet = pad(values[:, len(COCO17) :])
        people = replace(
            people, points=FEET, extra_keypoints=feet[..., :2], extra_confidence=feet[..., 2]
        )
    return people, int((~kept).sum())
