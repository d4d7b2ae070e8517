"""Segmentation of a programme into shots, and selection of main-camera clips (paper)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain

import cv2
import numpy as np

from data_contracts.arrays import Image
from worldpose.broadcast_calibration.tracking import Followed, follow
from worldpose.errors import InputError


@dataclass(frozen=True, eq=False)
class Shot:
    """Consecutive frames of one camera without a cut.

    Attributes:
        first: number of its first frame.
        count: number of its frames.
        seconds: duration [s].
        grass: median share of grass in the frame [1].
        tallest: median height of the tallest region on the grass, in image heights [1].
        pan: distance from its leftmost to its rightmost view, in image widths [1].
        pictures: small preview frames, in RGB.
        unfit: reasons against the shot as a clip; empty = proposed.
    """

    first: int
    count: int
    seconds: float
    grass: float
    tallest: float
    pan: float
    pictures: tuple[Image, ...]
    unfit: tuple[str, ...]


@dataclass
class _Course:
    """Running statistics of a shot: memory grows by two numbers per half second."""

    first: int
    last: int
    grass: list[float] = field(default_factory=list)
    tallest: list[float] = field(default_factory=list)
    pictures: list[Image] = field(default_factory=list)
    every: int = 1
    aim: float = 0.0
    left: float = 0.0
    right: float = 0.0

    def look(self, picture: Image) -> None:
        """Record one frame's grass share and tallest region."""
        grass, tallest = grass_and_people(picture)
        if len(self.grass) % self.every == 0:
            self.pictures.append(picture)
            if len(self.pictures) > 8:
                del self.pictures[1::2]
                self.every *= 2
        self.grass.append(grass)
        self.tallest.append(tallest)

    def turn(self, share: float) -> None:
        """Record a motion of the image to the right, as a share of its width."""
        self.aim -= share
        self.left, self.right = min(self.left, self.aim), max(self.right, self.aim)


def find_shots(pictures: Iterable[tuple[int, Image | None]], fps: float) -> Iterator[Shot]:
    """Yield the shots of a programme in order, each with the reasons to reject it.

    One pass in bounded memory. Simple features select shots of the main camera: grass, the size of
    people, a pan, and the wipes about replays; a person confirms the selection. Numbers rise by
    one, with small RGB frames, about 320 px wide; None for a damaged frame, which ends a shot.
    """
    min_shot_s = 1.0  # shorter parts belong to a transition between two shots
    # The stride limits the accuracy of cuts.
    stride = max(1, round(fps / 25.0))
    interval = max(1, round(0.5 * fps / stride))
    course: _Course | None = None
    before: Image | None = None
    shot: _Course | None = None
    shot_before: int | None = None
    count = 0
    for number, picture in chain(pictures, [(0, None)]):  # the end ends a shot
        if picture is not None and number % stride:
            continue
        same, moved = (False, 0.0) if before is None else _measure_motion(before, picture)
        if course is not None and not same:
            if course.last - course.first >= min_shot_s * fps:
                if shot is not None:
                    yield _shot(shot, shot_before, course.first, fps, stride)
                    shot_before = shot.last
                shot = course
            course = None
        before = picture
        if picture is None:
            continue
        if course is None:
            course, count = _Course(number, number), 0
        course.last = number
        course.turn(moved)
        if count % interval == 0:
            course.look(picture)
        count += 1
    if shot is not None:
        yield _shot(shot, shot_before, None, fps, stride)


def grass_and_people(picture: Image) -> tuple[float, float]:
    """Return the share of grass [1] and the height of the tallest region on it [1] in an RGB image.

    The height is in image heights: that of the tallest connected region that is not green within
    the convex hull of the grass.
    """
    grass_hsv = ((25, 35, 25), (95, 255, 255))  # in sun, shade and floodlight
    green = cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV), *map(np.array, grass_hsv))
    kernel = np.ones((3, 3), np.uint8)
    # Remove green specks in the stands.
    grass = cv2.morphologyEx(green, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    share = float((grass > 0).mean())
    places = cv2.findNonZero(grass)
    if places is None:
        return 0.0, 1.0
    inside = np.zeros_like(grass)
    cv2.fillConvexPoly(inside, cv2.convexHull(places), 255)
    things = cv2.morphologyEx(np.where(green > 0, np.uint8(0), inside), cv2.MORPH_OPEN, kernel)
    count, _, boxes, _ = cv2.connectedComponentsWithStats(things)
    tallest = float(boxes[1:, cv2.CC_STAT_HEIGHT].max()) if count > 1 else 0.0
    return share, tallest / len(picture)


def _measure_motion(before: Image, picture: Image | None) -> tuple[bool, float]:
    """Return whether a frame continues a shot, and its motion to the right [widths]."""
    if picture is None:
        return False, 0.0
    grey = [
        np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        for each in (before, picture)
    ]
    (followed,) = follow(grey, None, 200)
    if np.isnan(followed.inlier_share):
        change = np.abs(grey[1].astype(np.float64) - grey[0]).mean()
        return bool(change < 30.0), 0.0
    if followed.inlier_share < 0.25:
        return False, 0.0
    motion = np.median(followed.end[:, 0] - followed.start[:, 0])
    return True, float(motion) / picture.shape[1]


def _shot(course: _Course, before: int | None, after: int | None, fps: float, stride: int) -> Shot:
    """Return a finished shot; gaps to the neighbouring shots indicate wipes."""
    min_duration_s = 4.0
    count = course.last - course.first + 1
    grass, tallest = float(np.median(course.grass)), float(np.median(course.tallest))
    # The shot may last until just before the next sample.
    pan, seconds = course.right - course.left, (count + stride - 1) / fps
    # Neighbouring samples are a stride apart, in a shot and across a cut.
    wipe = 0.1 * fps + stride
    sides = (
        before is not None and course.first - before > wipe,
        after is not None and after - course.last > wipe,
    )
    # People are a tenth of the image high in a main camera, half and more in others.
    # Seven degrees at a usual focal length.
    faults = {
        f"shorter than {min_duration_s:g} s": seconds < min_duration_s,
        "too little grass": grass < 0.5,
        "people too large": tallest > 0.35,
        "hardly a pan": pan < 0.25,
        "between two wipes, as replays are": all(sides),
    }
    unfit = tuple(fault for fault, found in faults.items() if found)
    return Shot(course.first, count, seconds, grass, tallest, pan, tuple(course.pictures), unfit)


def require_one_shot(
    followed: Sequence[Followed], share: float, where: str, first: int = 0
) -> None:
    """Raise InputError, with their frames' numbers in the video, if a clip has cuts.

    A new shot begins where less than a share of points is followed.
    """
    cuts = [number + 1 for number, pair in enumerate(followed) if pair.inlier_share < share]
    if cuts:
        shown = ", ".join(str(first + cut) for cut in cuts[:10]) + (
            " and more" if len(cuts) > 10 else ""
        )
        raise InputError(
            where,
            expected="one shot of one camera",
            found=f"cuts before frame {shown} of {first} to {first + len(followed)}",
            todo="Make a clip of each shot of the main camera; leave replays out.",
        )
