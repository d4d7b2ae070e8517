"""The detector and the pose estimator that ship with the project, small and fast on a CPU.

Their training data are rendered matches alone (infra/embedded_detector). On real footage they are
a fallback; fine-tuned or larger models serve better.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.boxes import overlaps, suppress
from worldpose.detection.bundled_crops import crops_of_boxes, cut, picture_from_crop
from worldpose.detection.bundled_looks import Look
from worldpose.detection.bundled_surroundings import CELL, MAPS, SAME, surroundings
from worldpose.detection.bundled_weights import load_weights
from worldpose.detection.groups import groups
from worldpose.detection.interfaces import LEAST_SCORE, Detector, People, PoseEstimator
from worldpose.detection.occluded_people import find_occluded_people
from worldpose.detection.rival_joints import shared_out
from worldpose.errors import InputError

if TYPE_CHECKING:
    import torch

    from worldpose.detection.bundled_nets import KeypointNet, PeopleNet

Net = TypeVar("Net", bound="torch.nn.Module")

EMBEDDED: Final = (
    Path(__file__).with_name("embedded_people.safetensors"),
    Path(__file__).with_name("embedded_keypoints.safetensors"),
)
"""Shipped weights of the detector and of the pose estimator."""
MOST_PEOPLE: Final = 300
"""Most people per frame."""
OVERLAP: Final = 0.7
"""Boxes with a larger intersection over union are of one person [1]."""
CLOSE: Final = 0.8
"""A crop is computed again if the given and the estimated box overlap less [1, intersection over
union]."""
KNOWN: Final = 0.25
"""A product of fit and surest keypoints from which a person is certain [1]."""
WORTH: Final = 0.1
"""Below this product no crop is computed again [1]."""
NEIGHBOUR: Final = 0.05
"""A person that overlaps a neighbour more gets a second crop [1, intersection over union]."""
PLACES: Final = 4
"""Candidate positions per joint [1]."""
BATCH: Final = 16
"""Crops per batch, always the same number: kernels for other numbers round differently."""


def embedded_detector(
    weights: Path | None = None, device: str = "cpu", half: bool = False
) -> Detector:
    """Return the embedded detector.

    Args:
        weights: a file of a fine-tuned version; the shipped one if None.
        device: `cpu` or `cuda`.
        half: compute in half precision, on a GPU only.

    Raises:
        InputError: the file holds other weights than this detector's, or torch is not installed.
    """
    nets = _nets()
    net = load_weights(weights or EMBEDDED[0], nets.PeopleNet())
    return EmbeddedDetector(net, device, half)


def embedded_pose(
    weights: Path | None = None, device: str = "cpu", half: bool = False
) -> PoseEstimator:
    """Return the embedded pose estimator; `embedded_detector` describes arguments and errors."""
    nets = _nets()
    net = load_weights(weights or EMBEDDED[1], nets.KeypointNet())
    return EmbeddedPose(net, device, half)


class EmbeddedDetector:
    """A net that detects the centres of people and the sides of their boxes.

    The detector runs a second time on enlarged crops of groups of people who occlude one another.
    """

    def __init__(self, net: PeopleNet, device: str = "cpu", half: bool = False) -> None:
        self._net, self._device, self._half = _placed(net, device), device, half

    @property
    def view_size(self) -> None:
        """None: the detector takes whole frames of any size."""
        return

    def detect(self, pictures: Sequence[Image]) -> list[People]:
        """Return the people in each frame, computed one by one."""
        return [self._people(picture) for picture in pictures]

    def _people(self, picture: Image) -> People:
        whole = self._look(picture)
        looks = [
            whole,
            *(
                group.in_picture(self._look(group.shown(picture)))
                for group in groups(whole, picture.shape)
            ),
        ]
        boxes = np.concatenate([people.boxes for people in looks])
        scores = np.concatenate([people.scores for people in looks])
        return suppress(People(boxes, scores), OVERLAP)

    def _look(self, picture: Image) -> People:
        """Return the detections in an image; the same person may be there twice."""
        import torch

        from worldpose.detection.bundled_nets import COARSEST, normalised
        from worldpose.detection.bundled_peaks import boxes_at_peaks

        height, width = picture.shape[:2]
        tall, wide = (-(-side // COARSEST) * COARSEST for side in (height, width))
        padded = np.full((1, tall, wide, 3), 115, dtype=np.uint8)
        padded[0, :height, :width] = picture
        with torch.inference_mode(), _precision(self._device, self._half):
            given = normalised(torch.from_numpy(padded).to(self._device))
            logits, sides = self._net(given)
            boxes, scores = boxes_at_peaks(logits[0], sides[0], LEAST_SCORE, MOST_PEOPLE)
        found = boxes.double().cpu().numpy()
        found = np.clip(found, -0.5, np.array([width, height, width, height]) - 0.5)
        real = np.all(found[:, 2:] - found[:, :2] > 1.0, axis=1)
        return People(found[real], scores.double().cpu().numpy()[real])


class EmbeddedPose:
    """A net that estimates the joints of the person in a crop."""

    def __init__(self, net: KeypointNet, device: str = "cpu", half: bool = False) -> None:
        self._net, self._device, self._half = _placed(net, device), device, half

    def estimate(self, picture: Image, boxes: NDArray[np.float64]) -> KeypointDetections:
        """Return the pose in each box; confidence is the probability that a keypoint is correct.

        A correct keypoint is within a twentieth of the box's longer side, about a fifth of a torso.
        If the estimated box differs from the given one, a second crop shows the estimated box.
        People with neighbours also get a second crop, because the positions of the neighbours are
        then known. Candidate joints that the maps of two people share are assigned to one of them.
        """
        looked = self._look(picture, boxes, [np.empty((0, 4))] * len(boxes))
        seen = looked.boxes
        another = np.all(seen[:, 2:] - seen[:, :2] > 1.0, axis=1)
        another &= np.diagonal(overlaps(seen, boxes)) < CLOSE
        asked = np.where(another[:, None], seen, boxes)
        score = looked.score
        known = suppress(People(seen[score >= KNOWN], score[score >= KNOWN]), SAME).boxes
        shares = overlaps(asked, known)
        others = [known[row <= SAME] for row in shares]
        again = ((shares > NEIGHBOUR) & (shares <= SAME)).any(axis=1) & (score >= WORTH)
        again |= another
        around = [others[index] for index in np.flatnonzero(again)]
        looked.replace(again, self._look(picture, asked[again], around))
        return looked.poses(shared_out(looked.places, looked.mass, looked.boxes))

    def beside(self, picture: Image, people: People) -> KeypointDetections:
        """Return people partly occluded by the detected ones, with their poses."""
        return find_occluded_people(
            lambda boxes, others: self._look(picture, boxes, others), people
        )

    def _look(self, picture: Image, boxes: Floats, others: Sequence[Floats]) -> Look:
        """Return the net's output for a crop around each box.

        Args:
            picture: the whole frame.
            boxes: (people, 4) [px].
            others: boxes (others, 4) of the neighbours of each person [px].
        """
        import torch

        from worldpose.detection.bundled_nets import CROP, JOINTS, normalised
        from worldpose.detection.bundled_places import likely_places

        shape = (len(boxes), JOINTS, PLACES)
        looked = Look(
            places=np.full((*shape, 2), np.nan),
            mass=np.full(shape, np.nan),
            sure=np.full(shape, np.nan),
            boxes=np.full((len(boxes), 4), np.nan),
            fit=np.full(len(boxes), np.nan),
        )
        maps = [picture_from_crop(crop, CROP) for crop in crops_of_boxes(boxes, CROP)]
        for start in range(0, len(maps), BATCH):
            part = maps[start : start + BATCH]
            end = start + len(part)
            crops = np.zeros((BATCH, CROP[1], CROP[0], 3), dtype=np.uint8)
            around = np.zeros((BATCH, MAPS, CROP[1] // CELL, CROP[0] // CELL), dtype=np.float32)
            for index, mapping in enumerate(part):
                crops[index] = cut(picture, mapping, CROP)
                who = start + index
                around[index] = surroundings(boxes[who], others[who], mapping, CROP)
            with torch.inference_mode(), _precision(self._device, self._half):
                given = normalised(torch.from_numpy(crops).to(self._device))
                seen = self._net(given, torch.from_numpy(around).to(self._device))
                at, mass = likely_places(seen.maps, PLACES)
                sure = torch.sigmoid(self._net.sureness(seen.doubt, mass))
            pixels, corners = at.double().cpu().numpy(), seen.boxes.double().cpu().numpy()
            for index, mapping in enumerate(part):
                scale, corner = mapping[:, :2], mapping[:, 2]
                looked.places[start + index] = pixels[index] @ scale.T + corner
                sides = corners[index].reshape(2, 2) @ scale.T + corner
                looked.boxes[start + index] = sides.ravel()
            looked.mass[start:end] = mass.double().cpu().numpy()[: len(part)]
            looked.sure[start:end] = np.clip(sure.double().cpu().numpy()[: len(part)], 1e-3, 1.0)
            looked.fit[start:end] = torch.sigmoid(seen.fit).double().cpu().numpy()[: len(part)]
        height, width = picture.shape[:2]
        limits = np.array([width, height, width, height]) - 0.5
        np.clip(looked.boxes, -0.5, limits, out=looked.boxes)
        return looked


def _nets() -> ModuleType:
    """Return the module of the nets, which needs torch."""
    try:
        from worldpose.detection import bundled_nets
    except ImportError as error:
        raise InputError(
            "embedded detector",
            expected="torch and safetensors",
            found=str(error),
            todo="Install worldpose[detectors].",
        ) from error
    return bundled_nets


def _placed(net: Net, device: str) -> Net:
    """Return the net on a device, its batch normalisations folded into convolutions."""
    import torch

    from worldpose.detection.bundled_nets import folded

    placed = folded(net.eval()).to(device)
    placed.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return placed


def _precision(device: str, half: bool) -> AbstractContextManager[torch.autocast]:
    import torch

    return torch.autocast(device, torch.float16, enabled=half)
