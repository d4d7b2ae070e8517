"""Background image of a clip: the median of its frames."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from data_contracts.arrays import Image
from worldpose.errors import InputError

_BAND: Final = 64
"""Rows per median computation: sorting copies them."""


def median_picture(frames: Iterable[Image], most: int = 64) -> Image:
    """Return the median of a clip's frames, which shows no moving people.

    At most `most` frames are in memory, evenly spread over the clip: when the limit is reached, the
    function drops every second frame and doubles the stride.

    Args:
        frames: (height, width) or (height, width, 3) each, of one camera that does not move.
        most: maximum number of frames in memory, two or more.

    Raises:
        InputError: there are no frames, their sizes differ, or `most` is below two.

    Note:
        C4.
    """
    if most < 2:
        raise InputError(
            "median_picture: most",
            expected="two frames or more",
            found=f"{most}",
            todo="Give for example 64.",
        )
    kept: list[Image] = []
    stride = 1
    for index, frame in enumerate(frames):
        if kept and frame.shape != kept[0].shape:
            raise _sizes(f"{kept[0].shape} and, in frame {index}, {frame.shape}")
        if index % stride:
            continue
        if len(kept) == most:
            kept, stride = kept[::2], 2 * stride
            if index % stride:
                continue
        kept.append(frame.copy())  # readers may fill the same buffer again
    if not kept:
        raise _sizes("no frames")
    median = np.empty_like(kept[0])
    for top in range(0, len(median), _BAND):
        band = np.stack([frame[top : top + _BAND] for frame in kept])
        # The lower of the two middle values: levels stay integers.
        middle = (len(kept) - 1) // 2
        median[top : top + _BAND] = np.partition(band, middle, axis=0)[middle]
    return median


def _sizes(found: str) -> InputError:
    return InputError(
        "median_picture",
        expected="one or more frames of one size",
        found=found,
        todo="Give frames of one camera's clip.",
    )
