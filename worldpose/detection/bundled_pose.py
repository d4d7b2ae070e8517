"""The pose estimator that ships with the project, small and fast on a CPU.

Its training data are rendered matches and real frames of one stadium (infra/embedded_detector). On
other real footage fine-tuned or larger models may serve better. The net takes crops with maps of
the target box and its neighbours. People who occlude one another share out candidate joints, and
the estimator also finds occluded people in crops shifted to the side of detected ones. Needs torch.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor

from data_contracts.arrays import Flags, Floats, Image
from data_contracts.conventions import COCO17, COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.bundled_nets import KeypointNet, Seen, decode_candidates
from worldpose.detection.interfaces import People
from worldpose.detection.net_inference import CROPS, PlacedNet, QuantizedNet, run_together
from worldpose.detection.sampling import sample_crops
from worldpose.detection.suppression import nms_indices, suppress, surest_confidence
from worldpose.geometry.boxes import box_iou

SAME_PERSON_IOU: Final = 0.6
"""A box that overlaps the target box more is the same person's [1, intersection over union]."""
CANDIDATES: Final = 4
"""Candidate positions per joint [1]."""
KNOWN_PERSON_IOU: Final = 0.7
"""A box that overlaps a detected person more is that person [1, intersection over union]."""


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

    def select(self, which: slice | Flags | NDArray[np.intp]) -> CropEstimates:
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
        chosen = (*np.ogrid[: len(taken), : len(COCO17)], taken)
        return KeypointDetections(self.places[chosen], self.sure[chosen], self.boxes, self.fit)


Crops = tuple[Floats, Sequence[Floats]]
"""Boxes (people, 4) [px], and the boxes of the neighbours of each."""
Steps = Generator[Crops, CropEstimates, KeypointDetections]
"""Yields crops that the net shall see of a frame, gets what it saw, and returns the people."""


class BundledPoseEstimator:
    """A net that estimates the joints of the person in a crop."""

    def __init__(
        self, net: KeypointNet | QuantizedNet, device: str = "cpu", half: bool = False
    ) -> None:
        self._net = PlacedNet(net, device, half, _decode, fill=CROPS)

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box; confidence is the probability that a keypoint is correct.

        A correct keypoint is within a twentieth of the box's longer side, about a fifth of a torso.
        If the estimated box differs from the given one, a second crop shows the estimated box.
        """
        return self.estimate_frames([image], [boxes])[0]

    def estimate_frames(
        self, images: Sequence[Image], boxes: Sequence[Floats]
    ) -> list[KeypointDetections]:
        """Return the poses of frames of one size, as `estimate` does."""
        return self._run(images, [_find_poses(each) for each in boxes])

    def find_occluded(
        self, images: Sequence[Image], people: Sequence[People]
    ) -> list[KeypointDetections]:
        """Return people partly occluded by the detected ones of each frame, with their poses."""
        return self._run(images, [find_occluded_people(each) for each in people])

    def _run(self, images: Sequence[Image], steps: Sequence[Steps]) -> list[KeypointDetections]:
        def see(numbers: list[int], asked: list[Crops]) -> list[CropEstimates]:
            ends = np.cumsum([0, *(len(boxes) for boxes, _ in asked)])
            seen = self._estimate_crops([images[number] for number in numbers], asked)
            return [seen.select(slice(*each)) for each in pairwise(ends)]

        return run_together(steps, see)

    def _estimate_crops(self, images: Sequence[Image], asked: Sequence[Crops]) -> CropEstimates:
        """Return the net's output for the crops of some frames."""
        others = [one for _, each in asked for one in each]
        if not others:
            shape = (0, len(COCO17), CANDIDATES)
            flat = np.empty(shape)
            return CropEstimates(np.empty((*shape, 2)), flat, flat, np.empty((0, 4)), np.empty(0))
        boxes = [each for each, _ in asked]
        mappings, *given = sample_crops(images, boxes, others, self._net.device)
        places, corners, mass, sure, fit = (
            each.double().cpu().numpy() for each in self._net(*given)
        )
        scale, corner = mappings[:, [0, 1], [0, 1]], mappings[:, :, 2]
        height, width = images[0].shape[:2]
        sides = corners.reshape(-1, 2, 2) * scale[:, None] + corner[:, None]
        return CropEstimates(
            places=places * scale[:, None, None] + corner[:, None, None],
            # PyTorch rounds the last numbers of an array otherwise than the others.
            mass=mass,
            sure=np.clip(expit(sure), 1e-3, 1.0),
            boxes=np.clip(sides, -0.5, np.array([width, height]) - 0.5).reshape(-1, 4),
            fit=expit(fit),
        )


def _find_poses(boxes: Floats) -> Steps:
    """Find the pose in each box, and search again where people overlap."""
    estimates = yield boxes, [np.empty((0, 4))] * len(boxes)
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
        People(seen[score >= min_certain_score], score[score >= min_certain_score]), SAME_PERSON_IOU
    ).boxes
    shares = box_iou(asked, known)
    # A person that overlaps a neighbour more gets a second crop [1, intersection over union].
    again = ((shares > 0.05) & (shares <= SAME_PERSON_IOU)).any(axis=1) & (
        # Below this product no crop is computed again [1].
        score >= 0.1
    )
    again |= another
    around = [known[row <= SAME_PERSON_IOU] for row in shares[again]]
    estimates.update(again, (yield asked[again], around))
    return estimates.poses(assign_joints(estimates.places, estimates.mass, estimates.boxes))


def _decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return candidate positions, boxes, the probability around each position, and logits.

    The last two are logits that positions are correct, and of the fit of boxes.
    """
    seen = Seen._make(outputs)
    at, mass = decode_candidates(seen.maps, CANDIDATES)
    return at, seen.boxes, mass, seen.sureness(mass.double()), seen.fit


def assign_joints(places: Floats, mass: Floats, boxes: Floats) -> NDArray[np.intp]:
    """Return the index of the chosen candidate for each joint (people, 17).

    A map often shows the joints of a neighbour too. People choose their likeliest candidates in
    turn, the most certain person first. A candidate costs more, the more certainly a neighbour has
    the same joint, of either side, there (Li et al., CrowdPose, 2019). Places (people, 17, count,
    2) [px] are the likeliest first, with probabilities `mass` (people, 17, count); boxes are
    (people, 4).
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
    joint, other_side = np.arange(joints), np.array(COCO17_FLIP)
    paired = (other_side != joint)[:, None]
    # Passes of assignment; few joints change after the second.
    for _ in range(4):
        before = taken.copy()
        for person in order[near[order].any(axis=1)]:
            rivals = np.flatnonzero(near[person])
            chosen = rivals[:, None], joint, taken[rivals]
            at, sure = places[chosen][:, :, None], mass[chosen][:, :, None]
            # Standard deviation of the distance between two estimates of one joint, as a share of
            # the longer side of the smaller box [1].
            spread = 0.03 * np.minimum(longer[rivals], longer[person])[:, None, None]
            rival = _rivalry(places[person], at, sure, spread)
            other = _rivalry(places[person], at[:, other_side], sure[:, other_side], spread)
            rival += paired * other
            # Cost of a candidate that certainly is another person's joint [nats].
            taken[person] = np.argmin(price[person] + 2.0 * rival, axis=1)
        if np.array_equal(before, taken):
            break
    return taken


def _rivalry(places: Floats, at: Floats, sure: Floats, spread: Floats) -> Floats:
    """Return the overlap (17, count) [1] of candidates with joints `at` (neighbours, 17, 1, 2)."""
    apart = np.square(places[..., 0] - at[..., 0]) + np.square(places[..., 1] - at[..., 1])
    return np.asarray((sure * np.exp(-0.5 * apart / spread**2)).sum(axis=0))


def find_occluded_people(people: People) -> Steps:
    """Find occluded people next to detected ones that the detector missed, with their poses.

    The net takes a target box and the boxes of its neighbours. It first runs on boxes a step to
    either side of every detected person, with the estimator's box. A second time it runs on the
    boxes that it returned (Rukhovich et al., IterDet, 2020).
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
    seen = yield asked, [known[row > 0.0] for row in box_iou(asked, known)]
    # Minimum product of fit and surest keypoints at which a result gets a second crop [1].
    boxes = seen.boxes[_show_others(seen, known, 0.15)]
    seen = yield boxes, [known[row <= KNOWN_PERSON_IOU] for row in box_iou(boxes, known)]
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
