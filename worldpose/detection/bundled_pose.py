"""The pose estimator that ships with the project, small and fast on a CPU.

Its training data are rendered matches and real frames of one stadium (infra/embedded_detector). On
other real footage fine-tuned or larger models may serve better. The net takes crops with maps of
the target box and its neighbours. People who occlude one another share out candidate joints, and
the estimator also finds occluded people in crops shifted to the side of detected ones. Needs torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor

from data_contracts.arrays import Flags, Floats, Image, Singles
from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.bundled_nets import (
    CROP,
    JOINTS,
    MAP_COUNT,
    KeypointNet,
    Seen,
    decode_candidates,
)
from worldpose.detection.interfaces import People
from worldpose.detection.net_inference import CROPS, QuantizedNet, placed_net
from worldpose.detection.suppression import nms_indices, suppress, surest_confidence
from worldpose.geometry.boxes import box_iou

MAP_CELL: Final = 4
"""Pixels of the crop per cell of the maps of boxes [px]."""
SAME_PERSON_IOU: Final = 0.6
"""A box that overlaps the target box more is the same person's [1, intersection over union]."""
CANDIDATES: Final = 4
"""Candidate positions per joint [1]."""
KNOWN_PERSON_IOU: Final = 0.7
"""A box that overlaps a detected person more is that person [1, intersection over union]."""


class BundledPoseEstimator:
    """A net that estimates the joints of the person in a crop."""

    def __init__(
        self, net: KeypointNet | QuantizedNet, device: str = "cpu", half: bool = False
    ) -> None:
        self._net = placed_net(net, device, half, _decode, batch=CROPS)

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box; confidence is the probability that a keypoint is correct.

        A correct keypoint is within a twentieth of the box's longer side, about a fifth of a torso.
        If the estimated box differs from the given one, a second crop shows the estimated box.
        """
        estimates = self._estimate_crops(image, boxes, [np.empty((0, 4))] * len(boxes))
        seen = estimates.boxes
        another = np.all(seen[:, 2:] - seen[:, :2] > 1.0, axis=1)
        # A crop is computed again if the given and the estimated box overlap less [1, intersection
        # over union].
        another &= np.diagonal(box_iou(seen, boxes)) < 0.8
        asked = np.where(another[:, None], seen, boxes)
        score = estimates.score
        # A product of fit and surest keypoints from which a person is certain [1].
        min_certain_score = 0.25
        known = suppress(
            People(seen[score >= min_certain_score], score[score >= min_certain_score]),
            SAME_PERSON_IOU,
        ).boxes
        shares = box_iou(asked, known)
        others = [known[row <= SAME_PERSON_IOU] for row in shares]
        # A person that overlaps a neighbour more gets a second crop [1, intersection over union].
        again = ((shares > 0.05) & (shares <= SAME_PERSON_IOU)).any(axis=1) & (
            # Below this product no crop is computed again [1].
            score >= 0.1
        )
        again |= another
        around = [others[index] for index in np.flatnonzero(again)]
        estimates.update(again, self._estimate_crops(image, asked[again], around))
        return estimates.poses(assign_joints(estimates.places, estimates.mass, estimates.boxes))

    def find_occluded(self, image: Image, people: People) -> KeypointDetections:
        """Return people partly occluded by the detected ones, with their poses."""
        return find_occluded_people(
            lambda boxes, others: self._estimate_crops(image, boxes, others), people
        )

    def _estimate_crops(
        self, image: Image, boxes: Floats, others: Sequence[Floats]
    ) -> CropEstimates:
        """Return the net's output for a crop around each box."""
        shape = (len(boxes), JOINTS, CANDIDATES)
        estimates = CropEstimates(
            places=np.full((*shape, 2), np.nan),
            mass=np.full(shape, np.nan),
            sure=np.full(shape, np.nan),
            boxes=np.full((len(boxes), 4), np.nan),
            fit=np.full(len(boxes), np.nan),
        )
        for batch in cut_crops(image, boxes, others):
            count, rows = len(batch.crops), batch.rows
            pixels, corners, mass, sure, fit = (
                each[:count].double().numpy() for each in self._net(batch.crops, batch.surroundings)
            )
            scale, corner = batch.mappings[:, :, :2], batch.mappings[:, None, :, 2]
            estimates.places[rows] = np.einsum("njcx,nyx->njcy", pixels, scale) + corner[:, None]
            sides = np.einsum("nsx,nyx->nsy", corners.reshape(count, 2, 2), scale) + corner
            estimates.boxes[rows] = sides.reshape(count, 4)
            # PyTorch rounds the last numbers of an array otherwise than the others.
            estimates.mass[rows], estimates.fit[rows] = mass, expit(fit)
            estimates.sure[rows] = np.clip(expit(sure), 1e-3, 1.0)
        height, width = image.shape[:2]
        limits = np.array([width, height, width, height]) - 0.5
        np.clip(estimates.boxes, -0.5, limits, out=estimates.boxes)
        return estimates


def _decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return candidate positions, boxes, the probability around each position, and logits.

    The last two are logits that positions are correct, and of the fit of boxes.
    """
    seen = Seen._make(outputs)
    at, mass = decode_candidates(seen.maps, CANDIDATES)
    return at, seen.boxes, mass, seen.sureness(mass.double()), seen.fit


@dataclass(frozen=True, eq=False)
class CropEstimates:
    """Candidate joints, boxes and scores from crops around boxes.

    Attributes:
        places: (people, 17, count, 2) candidate positions of each joint, the likeliest first [px].
        mass: (people, 17, count) probability around each position.
        sure: (people, 17, count) probability that a position is correct.
        boxes: (people, 4) [px].
        fit: (people,) expected intersection over union of these and the true boxes [1].
    """

    places: Floats
    mass: Floats
    sure: Floats
    boxes: Floats
    fit: Floats

    def select(self, which: Flags | NDArray[np.intp]) -> CropEstimates:
        """Return the output for some people."""
        return CropEstimates(*(getattr(self, field.name)[which] for field in fields(self)))

    def update(self, which: Flags, other: CropEstimates) -> None:
        """Overwrite the estimates of some people with those of another crop."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)

    @property
    def score(self) -> Floats:
        """Return the confidence that a box holds a person (people,): fit times surest keypoints."""
        return np.asarray(self.fit * surest_confidence(self.sure[..., 0]))

    def poses(self, taken: NDArray[np.intp]) -> KeypointDetections:
        """Return the poses whose joints are at the chosen candidates (people, 17)."""
        one = taken[..., None]
        return KeypointDetections(
            np.take_along_axis(self.places, one[..., None], axis=2)[:, :, 0],
            np.take_along_axis(self.sure, one, axis=2)[:, :, 0],
            self.boxes,
            self.fit,
        )


def assign_joints(places: Floats, mass: Floats, boxes: Floats) -> NDArray[np.intp]:
    """Return the index of the chosen candidate for each joint (people, 17).

    A map often shows the joints of a neighbour too. People choose their likeliest candidates in
    turn, the most certain person first. A candidate costs more, the more certainly a neighbour has
    the same joint, of either side, there.

    Args:
        places: (people, 17, count, 2) [px], the likeliest first.
        mass: (people, 17, count) probabilities.
        boxes: (people, 4) [px].

    Note:
        Li et al., CrowdPose, 2019: assigns candidate joints to people in crowds.
    """
    people, joints, _ = mass.shape
    taken = np.zeros((people, joints), dtype=np.intp)
    price = -np.log(np.maximum(mass, 1e-9))
    # Candidates of less probability are dropped, except the first [1].
    price[..., 1:][mass[..., 1:] < 0.01] = np.inf
    # People whose boxes overlap more are rivals [1, intersection over union].
    near = box_iou(boxes, boxes) > 0.02
    np.fill_diagonal(near, False)
    longer = np.max(boxes[:, 2:] - boxes[:, :2], axis=1)
    order = np.argsort(-mass[..., 0].mean(axis=1), kind="stable")
    other_side = np.array(COCO17_FLIP)
    paired = other_side != np.arange(joints)
    # Passes of assignment; few joints change after the second.
    for _ in range(4):
        before = taken.copy()
        for person in order[near[order].any(axis=1)]:
            rivals = np.flatnonzero(near[person])
            rival_joints = np.take_along_axis(
                places[rivals], taken[rivals][..., None, None], axis=2
            )
            rival_mass = np.take_along_axis(mass[rivals], taken[rivals][..., None], axis=2)
            # Standard deviation of the distance between two estimates of one joint, as a share of
            # the longer side of the smaller box [1].
            spread = 0.03 * np.minimum(longer[rivals], longer[person])[:, None, None]
            rival = _rivalry(places[person], rival_joints, rival_mass, spread)
            rival += paired[:, None] * _rivalry(
                places[person], rival_joints[:, other_side], rival_mass[:, other_side], spread
            )
            # Cost of a candidate that certainly is another person's joint [nats].
            taken[person] = np.argmin(price[person] + 2.0 * rival, axis=1)
        if np.array_equal(before, taken):
            break
    return taken


def _rivalry(places: Floats, at: Floats, sure: Floats, spread: Floats) -> Floats:
    """Return the overlap (17, count) [1] of candidates with joints `at` (neighbours, 17, 1, 2)."""
    apart = np.square(places - at).sum(axis=-1)
    return np.asarray((sure * np.exp(-0.5 * apart / spread**2)).sum(axis=0))


def find_occluded_people(
    estimate: Callable[[Floats, Sequence[Floats]], CropEstimates], people: People
) -> KeypointDetections:
    """Return occluded people next to detected ones that the detector missed, with their poses.

    The net takes a target box and the boxes of its neighbours. It first runs on boxes a step to
    either side of every detected person, then a second time on the boxes that it returned.

    Args:
        estimate: returns the net's output for boxes (people, 4) [px], given the boxes of the
            neighbours of each.
        people: detected people, with the estimator's boxes.

    Note:
        Iterative detection conditioned on earlier detections: Rukhovich et al., IterDet, 2020.
    """
    # Score of a detection from which on its neighbourhood is searched [1].
    sure = people.scores >= 0.25
    known = suppress(people.select(sure), KNOWN_PERSON_IOU).boxes
    # Shift to either side, as a share of the box's width [1], for people who are half occluded.
    step = 0.35 * (known[:, 2] - known[:, 0])[:, None] * [1.0, 0.0, 1.0, 0.0]
    asked = np.concatenate([known - step, known + step])
    shares = box_iou(asked, known)
    shares[np.tile(np.eye(len(known), dtype=np.bool_), (2, 1))] = 0.0
    # If another detection overlaps the shifted box more, there is no room for a further person [1,
    # intersection over union].
    asked = asked[shares.max(axis=1, initial=0.0) <= 0.6]
    seen = estimate(asked, [known[row > 0.0] for row in box_iou(asked, known)])
    # Minimum product of fit and surest keypoints at which a result gets a second crop [1].
    boxes = seen.boxes[_show_others(seen, known, 0.15)]
    seen = estimate(boxes, [known[row <= KNOWN_PERSON_IOU] for row in box_iou(boxes, known)])
    # Minimum product at which a result counts as a person [1].
    seen = seen.select(_show_others(seen, known, 0.4))
    # Two occluded people that overlap more are one [1, intersection over union].
    seen = seen.select(nms_indices(People(seen.boxes, seen.score), 0.5))
    likeliest = np.zeros(seen.places.shape[:2], dtype=np.intp)
    # Replaces the score of the detector, which does not see these people [1].
    return replace(seen.poses(likeliest), score=np.cbrt(0.3 * seen.score))


def _show_others(seen: CropEstimates, known: Floats, least: float) -> Flags:
    """Return whether a result shows a person other than the known ones (people,)."""
    real = np.all(seen.boxes[:, 2:] - seen.boxes[:, :2] > 1.0, axis=1)
    apart = box_iou(seen.boxes, known).max(axis=1, initial=0.0) < KNOWN_PERSON_IOU
    return np.asarray(real & apart & (seen.score >= least))


def crops_around(boxes: Floats) -> Floats:
    """Return the crops (people, 3) that show boxes whole: centre x, y [px], frame px per crop px.

    Args:
        boxes: (people, 4) x0, y0, x1, y1 [px].
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    # Size of a crop over that of its box [1]: keypoints may lie outside of a box.
    scale = 1.25 * np.max(sides / np.array(CROP), axis=1)
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    return np.column_stack([middle, np.maximum(scale, 1e-3)])


def frame_from_crop(
    crop: Floats, size: tuple[int, int], turn: float = 0.0, mirrored: bool = False
) -> Floats:
    """Return the affine map (2, 3) from pixels of a crop to pixels of the frame.

    Args:
        crop: (3,) crop from `crops_around`.
        size: width, height of the crop [px].
        turn: rotation of the crop within the frame, from x to y [rad].
        mirrored: whether the crop is mirrored left to right.
    """
    x, y, scale = crop
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    if mirrored:
        linear[:, 0] *= -1.0
    middle = 0.5 * (np.array(size) - 1.0)
    return np.column_stack([linear, np.array([x, y]) - linear @ middle])


@dataclass(frozen=True, eq=False)
class CropBatch:
    """Crops around people, as the nets take them.

    Attributes:
        rows: of the boxes.
        mappings: (crops, 2, 3) affine maps from pixels of the crops to pixels of the frame.
        crops: (crops, height, width, 3).
        surroundings: (crops, 3, rows, columns) maps of the boxes.
    """

    rows: slice
    mappings: Floats
    crops: Image
    surroundings: Singles


def cut_crops(image: Image, boxes: Floats, others: Sequence[Floats]) -> Iterator[CropBatch]:
    """Yield a crop around each box, `CROPS` at a time.

    Args:
        image: the whole frame.
        boxes: (people, 4) [px].
        others: boxes (others, 4) of the neighbours of each person [px].
    """
    mappings = [frame_from_crop(crop, CROP) for crop in crops_around(boxes)]
    for start in range(0, len(mappings), CROPS):
        rows = slice(start, min(start + CROPS, len(mappings)))
        each = list(zip(boxes[rows], others[rows], mappings[rows], strict=True))
        yield CropBatch(
            rows,
            np.array(mappings[rows]),
            np.stack([cut_crop(image, mapping, CROP) for _, _, mapping in each]),
            np.stack([surroundings(box, near, mapping, CROP) for box, near, mapping in each]),
        )


def cut_crop(image: Image, mapping: Floats, size: tuple[int, int], outside: int = 115) -> Image:
    """Return a crop (height, width, 3), grey outside of the frame.

    Args:
        image: (height, width, 3).
        mapping: (2, 3) affine map from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
        outside: grey level outside of the frame [of 255].
    """
    shrink = np.sqrt(abs(np.linalg.det(mapping[:, :2])))
    if shrink > 2.0:
        # Bilinear interpolation alone would skip pixels.
        image, mapping = _shrink(image, mapping, int(shrink), size)
    return np.asarray(
        cv2.warpAffine(
            image,
            mapping,
            size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(outside, outside, outside),
        ),
        dtype=np.uint8,
    )


def _shrink(
    image: Image, mapping: Floats, factor: int, size: tuple[int, int]
) -> tuple[Image, Floats]:
    """Return the part of a frame that a crop shows, shrunk by a whole number, and its map."""
    corners = np.array([[0.0, 0.0], [size[0], 0.0], [0.0, size[1]], [*size]])
    seen = corners @ mapping[:, :2].T + mapping[:, 2]
    high = np.array([image.shape[1], image.shape[0]])
    low = np.clip(np.floor(seen.min(axis=0)) - factor, 0, high - 1).astype(int)
    end = np.clip(np.ceil(seen.max(axis=0)) + factor, low + 1, high).astype(int)
    cells = -(-(end - low) // factor)
    part = image[low[1] : end[1], low[0] : end[0]]
    if part.shape[1] < factor or part.shape[0] < factor:
        return part, np.column_stack([mapping[:, :2], mapping[:, 2] - low])
    below, right = cells[::-1] * factor - part.shape[:2]
    whole = np.pad(part, ((0, below), (0, right), (0, 0)), mode="edge")
    small = np.asarray(cv2.resize(whole, cells.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    moved = (mapping[:, 2] - low - 0.5 * (factor - 1)) / factor
    return small, np.column_stack([mapping[:, :2] / factor, moved])


def surroundings(box: Floats, others: Floats, mapping: Floats, size: tuple[int, int]) -> Singles:
    """Return the share of each cell of a crop that boxes cover (3, rows, columns) [1].

    The person whose box ends lower in the frame stands nearer to the camera.

    Args:
        box: (4,) box of the target person x0, y0, x1, y1 [px].
        others: (people, 4) boxes of others [px].
        mapping: (2, 3) affine map from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
    """
    columns, rows = size[0] // MAP_CELL, size[1] // MAP_CELL
    x, y = (MAP_CELL * np.arange(n) + 0.5 * (MAP_CELL - 1) for n in (columns, rows))
    (xx, xy), (yx, yy) = mapping[:, :2]
    if xy == yx == 0.0:
        # Columns show the box's width, rows its height: far fewer numbers than cells.
        places = (xx * x + mapping[0, 2])[None], (yy * y + mapping[1, 2])[:, None]
    else:
        x, y = np.meshgrid(x, y)
        places = xx * x + xy * y + mapping[0, 2], yx * x + yy * y + mapping[1, 2]
    cell = MAP_CELL * float(np.sqrt(abs(np.linalg.det(mapping[:, :2]))))
    boxes = np.concatenate([box[None], others])[:, :, None, None]
    across, down = (
        np.clip((at - boxes[:, axis]) / cell + 0.5, 0.0, 1.0)
        * np.clip((boxes[:, axis + 2] - at) / cell + 0.5, 0.0, 1.0)
        for axis, at in enumerate(places)
    )
    covered = across * down
    before = others[:, 3] > box[3]
    maps = np.zeros((MAP_COUNT, rows, columns), dtype=np.float32)
    maps[0] = covered[0]
    maps[1] = covered[1:][before].max(axis=0, initial=0.0)
    maps[2] = covered[1:][~before].max(axis=0, initial=0.0)
    return maps
