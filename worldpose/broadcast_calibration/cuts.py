"""Cuts: neighbouring frames that no turning and zooming camera connects."""

from __future__ import annotations

from collections.abc import Sequence

from worldpose.broadcast_calibration.optical_flow import Followed
from worldpose.errors import InputError


def find_cuts(followed: Sequence[Followed], share: float) -> list[int]:
    """Return frames that begin a new shot.

    Args:
        followed: points between all neighbouring frames.
        share: at least this much of them moves as one picture within a shot [1].
    """
    return [number + 1 for number, pair in enumerate(followed) if pair.together < share]


def require_one_shot(
    followed: Sequence[Followed], share: float, where: str, first: int = 0
) -> None:
    """Refuse a clip of several shots.

    Args:
        followed: points between all neighbouring frames.
        share: as in `find_cuts`.
        where: clip or file, for the message.
        first: number of the first picture in its video.

    Raises:
        InputError: naming the frames at which other shots begin.
    """
    cuts = find_cuts(followed, share)
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
