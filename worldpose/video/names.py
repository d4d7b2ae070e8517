"""Names of videos, and numbers in the names of pictures."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import PurePath, PureWindowsPath
from typing import Final

from data_contracts.records import FRAME_LIMIT

VIDEO_SUFFIXES: Final = (
    *(".3g2", ".3gp", ".asf", ".avi", ".dav", ".divx", ".dv", ".f4v", ".flv", ".gxf", ".m2t"),
    *(".m2ts", ".m2v", ".m4v", ".mj2", ".mkv", ".mod", ".mov", ".mp4", ".mpe", ".mpeg", ".mpg"),
    *(".mts", ".mxf", ".nut", ".ogm", ".ogv", ".qt", ".rm", ".rmvb", ".tod", ".trp", ".ts"),
    *(".vob", ".webm", ".wmv", ".wtv", ".y4m"),
)
"""Endings that tell a video without its content, which `holds_video` asks of others."""


def is_video(path: str | PurePath) -> bool:
    """Return whether a file's name has the ending of a video, in any case."""
    return PurePath(path).suffix.lower() in VIDEO_SUFFIXES


def frame_numbers(names: Iterable[str], *, ends: bool = False) -> dict[str, int]:
    """Return the frame in each name of a picture or its file; those without a number are left out.

    It is the number that differs from name to name and can be a frame: of `000012_cam1.png` and
    `frame12_1700000000480.png` it is 12. Of several such, it is the one with the smallest steps.
    A part that mixes letters and digits, such as 1080p or a digest, is no number; `frame12` is 12.
    The number of a camera or clip, as in `cam1`, counts in names without another. Roboflow puts a
    digest after the name: `frame_12_jpg.rf.3fa9`. In addresses, %20 stands for a space. A copy,
    `frame_12 (1)` or `frame_12 2` beside `frame_12`, has the number of that.

    With `ends`, it is the last number wherever that can be, as of key frames, which are far apart.

    The numbers of names without such a place are their last ones. So they are if the last one is
    the same in all names and a single other one differs: that may be the camera's or the clip's.
    No name has a frame if the numbers before it repeat, and it neither rises with them nor counts
    on where they change: it is a time of day, or there are several clips.
    """
    found: dict[str, list[int]] = {}
    stems = {name: PureWindowsPath(name).stem.partition(".rf.")[0] for name in names}
    known = {*stems.values()}
    for name, stem in stems.items():
        first = re.sub(r" ?\(\d+\)$| copy( \d+)?$| \d+$", "", stem)
        stem = first if first in known else stem
        words = re.split(r"(?:%[0-9A-Fa-f]{2}|[^A-Za-z0-9])+", stem)
        parts = [p for p in (re.fullmatch(r"[A-Za-z]*(\d{1,18})", word) for word in words) if p]
        sources = r"(cam|camera|clip|view)\d"
        if numbers := [p for p in parts if not re.match(sources, p[0], re.IGNORECASE)] or parts:
            found[name] = [int(p[1]) for p in numbers]
    count = min(map(len, found.values()), default=0)
    values = {place: {each[-place] for each in found.values()} for place in range(1, count + 1)}
    differing = [place for place, there in values.items() if len(there) > 1]
    distinct = [p for p in values if len(values[p]) == len(found) and max(values[p]) <= FRAME_LIMIT]
    chosen = min(distinct, key=lambda p: max(values[p]) - min(values[p]), default=1)
    if (ends and 1 in distinct) or (1 not in differing and len(differing) == 1):
        chosen = 1
    rows = sorted((numbers[-chosen], numbers[-count:-chosen]) for numbers in found.values())
    before = [part for _, part in rows]
    groups = len(set(map(tuple, before)))
    if before != sorted(before) and groups < len(found):
        steps = [b[0] - a[0] for a, b in pairwise(rows) if a[1] != b[1]]
        if len(steps) >= groups or set(steps) != {1}:  # a time begins again each second
            return {}
    return {name: numbers[-chosen] for name, numbers in found.items()}
