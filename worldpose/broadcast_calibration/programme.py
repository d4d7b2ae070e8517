"""Shots of a whole programme, and which of them are clips of the main camera (paper, rule X1)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.records import Record
from worldpose.broadcast_calibration.optical_flow import follow

Picture = NDArray[np.uint8]

_POINTS: Final = 200
"""Followed between two pictures, about [1]."""
_GREEN: Final = ((25, 35, 25), (95, 255, 255))
"""Hue [2 deg], saturation and value [1/255] of grass in sun, shade and floodlight."""
_LOOK: Final = 0.5
"""Between pictures whose grass and people are looked at [s]."""
_SETTLED: Final = 1.0
"""What is shorter is part of a transition between two shots [s]."""
_PICTURES: Final = 8
"""Of a shot that are kept to be shown, at most [1]."""
_UNLIKE: Final = 30.0
"""Mean change of brightness that parts two shots where nothing can be followed [1/255]."""


class ProgrammeSettings(Record):
    """What a shot of a programme must be to be proposed as a clip."""

    rate: float = Field(default=25.0, ge=1e-6, le=10000)
    """Pictures a second that are looked at, about [1/s]; a cut is found to one of them."""
    cut_share: float = Field(default=0.25, gt=0, lt=1)
    """As in calibration: within a shot at least this share of the points moves together [1]."""
    transition: float = Field(default=0.1, ge=1e-6, le=10)
    """Between two shots without a cut, such as a wipe or a dissolve, at least [s]: a shot between
    two of them is a replay."""
    shortest: float = Field(default=4.0, ge=1e-6, le=1000)
    """Of a clip [s]."""
    grass: float = Field(default=0.5, gt=0, lt=1)
    """Least share of grass in the picture of a main camera, in the median [1]."""
    tallest: float = Field(default=0.35, ge=1e-6, le=100)
    """Of what stands on the grass there, in heights of the picture, in the median [1]: people of a
    main camera are a tenth, those of other cameras half and more."""
    pan: float = Field(default=0.25, ge=0, le=100)
    """Least pan of a clip, in widths of the picture [1]: 7 degrees at a usual focal length."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Pictures of one camera without a cut.

    Attributes:
        first: number of its first picture.
        count: of its pictures.
        seconds: how long it lasts [s].
        grass: share of the picture, median [1].
        tallest: of what stands on the grass, in heights of the picture, median [1].
        pan: from its leftmost to its rightmost view, in widths of the picture [1].
        pictures: some of it, small, in RGB.
        unfit: why it is not proposed; empty = it is.
    """

    first: int
    count: int
    seconds: float
    grass: float
    tallest: float
    pan: float
    pictures: tuple[Picture, ...]
    unfit: tuple[str, ...]


@dataclass
class _Course:
    """A shot while it lasts: memory grows by two numbers for half a second of it."""

    first: int
    last: int
    grass: list[float] = field(default_factory=list)
    tallest: list[float] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    every: int = 1
    aim: float = 0.0
    left: float = 0.0
    right: float = 0.0

    def look(self, picture: Picture) -> None:
        """Take in how much grass there is and what stands on it."""
        grass, tallest = grass_and_people(picture)
        if len(self.grass) % self.every == 0:
            self.pictures.append(picture)
            if len(self.pictures) > _PICTURES:
                del self.pictures[1::2]
                self.every *= 2
        self.grass.append(grass)
        self.tallest.append(tallest)

    def turn(self, share: float) -> None:
        """Take in by how much of its width the picture moved to the right."""
        self.aim -= share
        self.left, self.right = min(self.left, self.aim), max(self.right, self.aim)


def find_shots(
    pictures: Iterable[tuple[int, Picture | None]],
    fps: float,
    settings: ProgrammeSettings = ProgrammeSettings(),  # noqa: B008
) -> Iterator[Shot]:
    """Yield the shots of a programme in order, each with what speaks against it as a clip.

    One pass in bounded memory. Whether a shot is of the main camera is told by cheap evidence:
    grass, the size of who stands on it, a pan, and the wipes about replays; a person confirms.

    Args:
        pictures: numbers, rising by one, and small RGB pictures, about 320 px wide; None where a
            picture is damaged, which ends a shot.
        fps: pictures a second.
        settings: limits.
    """
    stride = max(1, round(fps / settings.rate))
    looked = max(1, round(_LOOK * fps / stride))
    course: _Course | None = None
    before: Picture | None = None
    waiting: _Course | None = None
    ended: int | None = None
    count = 0
    for number, picture in pictures:
        if number % stride:
            continue
        same, moved = (False, 0.0) if before is None else _moved(before, picture, settings)
        if course is not None and not same:
            if course.last - course.first >= _SETTLED * fps:
                if waiting is not None:
                    yield _shot(waiting, ended, course.first, fps, stride, settings)
                    ended = waiting.last
                waiting = course
            course = None
        before = picture
        if picture is None:
            continue
        if course is None:
            course, count = _Course(number, number), 0
        course.last = number
        course.turn(moved)
        if count % looked == 0:
            course.look(picture)
        count += 1
    if course is not None and course.last - course.first >= _SETTLED * fps:
        if waiting is not None:
            yield _shot(waiting, ended, course.first, fps, stride, settings)
            ended = waiting.last
        waiting = course
    if waiting is not None:
        yield _shot(waiting, ended, None, fps, stride, settings)


def grass_and_people(picture: Picture) -> tuple[float, float]:
    """Return the share of grass [1] and the height of the tallest thing on it [1].

    The latter in heights of the picture: of the highest connected region that is not green within
    the convex hull of what is.

    Args:
        picture: RGB (height, width, 3), small.
    """
    green = cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV), *map(np.array, _GREEN))
    kernel = np.ones((3, 3), np.uint8)
    # Green specks in the stands are no grass.
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


def _moved(
    before: Picture, picture: Picture | None, settings: ProgrammeSettings
) -> tuple[bool, float]:
    """Return whether a picture goes on with a shot, and its motion to the right [widths]."""
    if picture is None:
        return False, 0.0
    grey = [
        np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        for each in (before, picture)
    ]
    (followed,) = follow(grey, None, _POINTS)
    if np.isnan(followed.together):
        change = np.abs(grey[1].astype(np.float64) - grey[0]).mean()
        return bool(change < _UNLIKE), 0.0
    if followed.together < settings.cut_share:
        return False, 0.0
    motion = np.median(followed.end[:, 0] - followed.start[:, 0])
    return True, float(motion) / picture.shape[1]


def _shot(
    course: _Course,
    before: int | None,
    after: int | None,
    fps: float,
    stride: int,
    settings: ProgrammeSettings,
) -> Shot:
    """Return a shot that is over; the neighbours' last and first pictures tell wipes."""
    count = course.last - course.first + 1
    grass, tallest = float(np.median(course.grass)), float(np.median(course.tallest))
    pan, seconds = course.right - course.left, count / fps
    # Two neighbours in one shot are a stride apart, and so are they across a cut.
    wipe = settings.transition * fps + stride
    sides = (
        before is not None and course.first - before > wipe,
        after is not None and after - course.last > wipe,
    )
    unfit = (
        *((f"shorter than {settings.shortest:g} s",) if seconds < settings.shortest else ()),
        *(("too little grass",) if grass < settings.grass else ()),
        *(("people too large",) if tallest > settings.tallest else ()),
        *(("hardly a pan",) if pan < settings.pan else ()),
        *(("between two wipes, as replays are",) if all(sides) else ()),
    )
    return Shot(course.first, count, seconds, grass, tallest, pan, tuple(course.pictures), unfit)
