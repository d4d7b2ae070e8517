"""Colours of shirts, which tell people apart where places on the pitch do not.

A colour is the median over the upper body in CIELAB. How much one person's colour varies, and how
much colours differ between people, is learned from the clip: where all wear the same, or colours
are not known, they have no influence. A person in front may hide the shirt, so that no colour rules
a match out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from data_contracts.arrays import AnyFloats, Floats, Image
from data_contracts.conventions import COCO17_TORSO

LEAST_STD: Final = np.array([4.0, 2.0, 2.0])
"""Least standard deviation of one person's colour [1, CIELAB]: noise of a small image."""


def measure_shirts(
    image: Image, keypoints: AnyFloats, confidence: AnyFloats, boxes: AnyFloats
) -> Floats:
    """Return the colours of people's upper bodies (people, 3) [CIELAB]; NaN where hidden.

    Samples within the box of a person who stands nearer to the camera do not count. A person whom a
    side of the image cuts off has no colour: the trunk is not where the keypoints put it. The image
    is (height, width, 3) RGB, keypoints are (people, 17, 2) [px] with confidence (people, 17), and
    boxes (people, 4) x0, y0, x1, y1 [px]; NaN rows are no people.
    """
    import cv2  # late: it takes 0.2 s, and planning a run does not need it

    colours = np.full((len(boxes), 3), np.nan)
    there = np.flatnonzero(np.isfinite(boxes).all(axis=1))
    size = np.array([image.shape[1], image.shape[0]])
    border = 2.0  # A box so near to a side of the image is cut off by it [px].
    whole = there[(boxes[there, 0] > border) & (boxes[there, 2] < size[0] - 1.0 - border)]
    for person in whole:
        places = _sample(keypoints[person], confidence[person], boxes[person])
        cells = np.rint(places).astype(np.int64)
        kept = ((cells >= 0) & (cells < size)).all(axis=1)
        for other in there:
            if boxes[other, 3] > boxes[person, 3]:
                inside = (places >= boxes[other, :2]) & (places <= boxes[other, 2:])
                kept &= ~inside.all(axis=1)
        # Least number of samples for a colour: half of the grid, the others are hidden.
        if np.count_nonzero(kept) < 32:
            continue
        seen = image[cells[kept, 1], cells[kept, 0]].astype(np.float32) / 255.0
        colours[person] = np.median(cv2.cvtColor(seen[None], cv2.COLOR_RGB2LAB)[0], axis=0)
    return colours


def _sample(keypoints: AnyFloats, confidence: AnyFloats, box: AnyFloats) -> Floats:
    """Return places on a person's upper body (samples, 2) [px]."""
    torso = np.asarray(keypoints[list(COCO17_TORSO)], dtype=np.float64)
    # Least confidence of each of them; with less the box tells where the upper body is [1].
    known = np.asarray(confidence[list(COCO17_TORSO)]) >= 0.3
    # Shoulders, hips and width of the trunk in a box: from its top, relative to its height, and
    # relative to its width [1].
    box_torso = (0.18, 0.48, 0.35)
    if known.all() and np.isfinite(torso).all():
        top, bottom = torso[:2].mean(axis=0), torso[2:].mean(axis=0)
        length = float(np.linalg.norm(bottom - top))
        spans = np.linalg.norm(torso[[0, 2]] - torso[[1, 3]], axis=1)
        # Width of a trunk seen from the side, relative to its length [1].
        wide = max(float(spans.max()), 0.3 * length)
    else:
        left, upper, right, lower = (float(side) for side in box)
        middle, tall = 0.5 * (left + right), lower - upper
        top = np.array([middle, upper + box_torso[0] * tall])
        bottom = np.array([middle, upper + box_torso[1] * tall])
        length = float(np.linalg.norm(bottom - top))
        wide = box_torso[2] * (right - left)
    ahead = (bottom - top) / max(length, 1e-6)
    across = np.array([-ahead[1], ahead[0]])
    grid = (7, 9)  # Samples across and along the upper body.
    # Part from the shoulders to the hips that is sampled [1]: neither collar nor shorts.
    along = (0.1, 0.75)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, grid[0]), np.linspace(along[0], along[1], grid[1]))
    middle_line = top + v.reshape(-1, 1) * (bottom - top)
    # Share of the trunk's width that is sampled [1].
    return np.asarray(middle_line + 0.7 * wide * u.reshape(-1, 1) * across)


class ShirtMemory:
    """Colour of a person in a camera: the last sightings' median; one may show the background."""

    def __init__(self) -> None:
        # A person's colour is the median over so many sightings.
        self._seen: deque[Floats] = deque(maxlen=25)

    def see(self, shirt: Floats) -> None:
        """Add a colour (3,) [CIELAB]; NaN changes nothing."""
        if np.isfinite(shirt).all():
            self._seen.append(shirt)

    @property
    def colour(self) -> Floats | None:
        """Return the colour (3,) [CIELAB]; None before three sightings."""
        if len(self._seen) < 3:
            return None
        return np.asarray(np.median(self._seen, axis=0))


@dataclass(frozen=True, eq=False)
class ShirtModel:
    """Statistics of the colours in a clip.

    Attributes:
        within: (3,) standard deviation of one person's colour [CIELAB].
        anyone: (colours, 3) a sample of the colours of all people: two teams are two clusters.
    """

    within: Floats
    anyone: Floats

    @classmethod
    def learn(cls, shirts: Floats, xy: Floats) -> ShirtModel | None:
        """Return the statistics of one camera's clip; None with too few colours.

        One person's variation is that between mutual nearest neighbours of two frames in sequence.
        Colours are (frames, detections, 3) [CIELAB], places (frames, detections, 2) [m]; NaN where
        unknown.
        """
        known = np.asarray(np.isfinite(shirts).all(axis=-1) & np.isfinite(xy).all(axis=-1))
        changes = [np.empty((0, 3))]
        for frame in range(len(shirts) - 1):
            a, b = (np.flatnonzero(known[at]) for at in (frame, frame + 1))
            if not len(a) or not len(b):
                continue
            one, two = xy[frame, a], xy[frame + 1, b]
            distance, nearest = KDTree(two).query(one)
            _, back = KDTree(one).query(two)
            # Farther mutual nearest neighbours of two frames are not taken as one person [m].
            mutual = (back[nearest] == np.arange(len(a))) & (distance <= 0.5)
            changes.append(shirts[frame + 1, b[nearest[mutual]]] - shirts[frame, a[mutual]])
        change, everyone = np.concatenate(changes), shirts[known]
        # Least number of such pairs, and of colours, from which a clip's statistics are learned.
        if min(len(change), len(everyone)) < 30:
            return None
        # The difference of two colours has twice the variance of one.
        spread = 1.4826 * np.median(np.abs(change), axis=0) / np.sqrt(2.0)
        # Largest sample of a clip's colours, evenly over its frames.
        chosen = np.linspace(0, len(everyone) - 1, min(len(everyone), 300)).astype(np.int64)
        # Over the clip, front, back and light differ twice as much as between two frames.
        return cls(2.0 * np.maximum(spread, LEAST_STD), everyone[chosen])

    def same_person(self, memory: ShirtMemory | None, shirts: Floats) -> Floats:
        """Return log odds (n,) that colours (n, 3) are a person's, not anyone's; 0 if unknown."""
        result = np.zeros(len(shirts))
        known = np.isfinite(shirts).all(axis=-1)
        colour = None if memory is None else memory.colour
        if colour is None or not known.any():
            return result
        own = self._likeness(shirts[known], colour[None])[:, 0]
        others = self._likeness(shirts[known], self.anyone)
        odds = own - np.log(np.exp(others).mean(axis=1))
        # Share of colours that tell nothing [1]: of the person in front, or of another's limb.
        doubt = 0.05
        result[known] = np.logaddexp(np.log(1.0 - doubt) + odds, np.log(doubt))
        return result

    def _likeness(self, first: Floats, second: Floats) -> Floats:
        """Return log likelihoods (n, m) of colours (n, 3) and (m, 3) to be one person's.

        They are equal for all pairs that differ as one person's colours do: two players of one
        team must not be told apart by their shading.
        """
        squared = np.square((first[:, None] - second) / self.within).sum(axis=-1)
        # 95 % of one person's colours are nearer; shirts that differ by 100 are of two people.
        return np.asarray(-0.5 * np.clip(squared - 7.8, 0.0, 100.0))
