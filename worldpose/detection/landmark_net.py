"""The net that ships with the project for landmarks of the body's surface, heels and toes.

It takes the crops and maps of the bundled keypoint net and has that net's features, but other
heads: a map of each landmark's position, its standard deviation, and whether it is visible. It
learned from renderings of the body model alone (infra/embedded_detector). Needs torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor, nn
from torch.nn import functional

from data_contracts.arrays import Floats, Image
from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.body.keypoints import LANDMARKS
from worldpose.detection.bundled_nets import CELL, Block, Pyramid, peaks
from worldpose.detection.bundled_pose import SAME_PERSON_IOU
from worldpose.detection.crops import MAP_COUNT
from worldpose.detection.net_inference import CROPS, PlacedNet, QuantizedNet
from worldpose.detection.sampling import sample_crops
from worldpose.geometry.boxes import box_iou

POINTS: Final = (*LANDMARKS, *FEET)
"""Points of the net in order: landmarks of the surface, then heels and toes."""
MIN_SQUARE: Final = 1e-3
"""Added to the mean square distance, whose logarithm is taken [px^2]."""


class SeenLandmarks(NamedTuple):
    """Output of the net for crops.

    Attributes:
        maps: logits of each point's position (batch, points, rows, columns).
        doubt: logarithm of the standard deviation from the crop as a whole (batch, points).
        visible: logits that points are visible (batch, points).
        trust: weight (points,) of the logarithm of a map's extent in that of the deviation.
    """

    maps: Tensor
    doubt: Tensor
    visible: Tensor
    trust: Tensor

    def decode(self) -> tuple[Tensor, Tensor]:
        """Return positions (batch, points, 2) and standard deviations per axis [px of the crop]."""
        places, square = _measure(self.maps)
        # PyTorch rounds the last numbers of an array otherwise, which double precision makes
        # harmless.
        extent = 0.5 * torch.log(square.double() + MIN_SQUARE)
        return places, torch.exp(self.doubt + self.trust * extent)


def locate(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and the logarithms of the extents of maps around them.

    Of logits (batch, points, rows, columns), positions are (batch, points, 2) [px of the crop]. The
    logarithm of the root mean square distance per axis of a map's probability from there is (batch,
    points) [log px].
    """
    places, square = _measure(maps)
    return places, 0.5 * torch.log(square + MIN_SQUARE)


def _measure(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions, and the mean square distance per axis [px^2] of a map from there."""
    places, _ = peaks(maps)
    rows, columns = maps.shape[-2:]
    chance = functional.softmax(maps.flatten(2), dim=-1).view_as(maps)
    x, y = (CELL * torch.arange(n, device=maps.device) + 0.5 * (CELL - 1) for n in (columns, rows))
    across = (chance.sum(dim=2) * (x - places[..., :1]).square()).sum(dim=-1)
    down = (chance.sum(dim=3) * (y - places[..., 1:]).square()).sum(dim=-1)
    return places, 0.5 * (across + down)


class LandmarkNet(nn.Module):
    """Net for points of the body's surface of the person in a crop."""

    def __init__(self) -> None:
        super().__init__()
        stem = nn.Sequential(Block(3, 16, stride=2), Block(16, 32, stride=2))
        self.pyramid = Pyramid(stem, (32, 64, 128), (2, 2, 2))
        self.around = nn.Conv2d(MAP_COUNT, 32, 3, padding=1, bias=False)
        self.head = nn.Sequential(Block(32, 96), nn.Conv2d(96, CELL**2 * len(POINTS), 1))
        self.doubt = nn.Linear(128, len(POINTS))
        self.trust = nn.Parameter(torch.ones(len(POINTS)))
        self.visible = nn.Sequential(nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, len(POINTS)))

    def forward(self, crops: Tensor, surroundings: Tensor) -> SeenLandmarks:
        """Return the net's output for crops; arguments as of `bundled_nets.KeypointNet`."""
        features, coarsest = self.pyramid(crops, self.around(surroundings))
        maps = functional.pixel_shuffle(self.head(features), CELL)
        whole = coarsest.float().mean(dim=(2, 3))
        # The uncertainty of a point must not change the features that find it.
        return SeenLandmarks(
            maps.float(), self.doubt(whole.detach()), self.visible(whole), self.trust
        )


class LandmarkEstimator:
    """Estimates points of the surface of people whose boxes are known.

    Attributes:
        points: names of the points.
    """

    points = POINTS

    def __init__(
        self, net: LandmarkNet | QuantizedNet, device: str = "cpu", half: bool = False
    ) -> None:
        self._net = PlacedNet(net, device, half, _decode, fill=CROPS)

    def add_points(
        self, images: Sequence[Image], people: Sequence[KeypointDetections]
    ) -> list[KeypointDetections]:
        """Return the people (people,) of whole frames of one size, with boxes, with `POINTS`.

        Confidence is the probability that a point is correct, from its standard deviation: within a
        twentieth of the box's longer side, as for joints. Points that are probably not visible are
        missing.
        """
        boxes = [np.asarray(each.boxes, dtype=np.float64) for each in people]
        more = []
        for each, box, found in zip(people, boxes, self.estimate(images, boxes), strict=True):
            # Largest error of a correct point, as a share of the box's longer side [1]; as for
            # joints.
            tolerance = 0.05 * (box[:, 2:] - box[:, :2]).max(axis=1, initial=0.0)[:, None]
            sure = np.clip(-np.expm1(-0.5 * (tolerance / found.std) ** 2), 1e-3, 1.0)
            # Points that are less probably visible are missing [1].
            shown = found.visible >= 0.5
            more.append(
                each.add_points(
                    POINTS,
                    np.where(shown[..., None], found.places, np.nan),
                    np.where(shown, sure, np.nan),
                )
            )
        return more

    def estimate(self, images: Sequence[Image], boxes: Sequence[Floats]) -> list[Landmarks]:
        """Return points of boxes (people, 4) x0, y0, x1, y1 [px] in whole frames of one size."""
        others = [each[row <= SAME_PERSON_IOU] for each in boxes for row in box_iou(each, each)]
        shape = (len(others), len(POINTS))
        places, std, visible = np.empty((*shape, 2)), np.empty(shape), np.empty(shape)
        if others:
            mappings, *given = sample_crops(images, boxes, others, self._net.device)
            places, std, visible = (each.double().cpu().numpy() for each in self._net(*given))
            scale = mappings[:, None, [0, 1], [0, 1]]
            places = places * scale + mappings[:, None, :, 2]
            std, visible = std * scale[..., 0], expit(visible)
        ends = pairwise(np.cumsum([0, *map(len, boxes)]))
        return [Landmarks(places[a:b], std[a:b], visible[a:b]) for a, b in ends]


def _decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return positions, standard deviations, and logits that points are visible."""
    seen = SeenLandmarks._make(outputs)
    return (*seen.decode(), seen.visible)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points of the surface of people in one frame.

    Attributes:
        places: (people, points, 2) [px].
        std: (people, points) standard deviation per axis [px].
        visible: (people, points) probability that the surface there is visible [1].
    """

    places: Floats
    std: Floats
    visible: Floats
