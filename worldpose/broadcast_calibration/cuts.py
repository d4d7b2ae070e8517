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


def require_one_shot(followed: Sequence[Followed], share: float, where: str) -> None:
    """Refuse a clip of several shots.

    Args:
        followed: points between all neighbouring frames.
        share: as in `find_cuts`.
        where: clip or file, for the message.

    Raises:
        InputError: naming the frames at which other shots begin.
    """
    cuts = find_cuts(followed, share)
    if cuts:
        shown = ", ".join(map(str, cuts[:10])) + (" and more" if len(cuts) > 10 else "")
        raise InputError(
            where,
            expected="one shot of one camera",
            found=f"cuts before frame {shown} of {len(followed) + 1}",
            todo="Make a clip of each shot of the main camera; leave replays out.",
        )
