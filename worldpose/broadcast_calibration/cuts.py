"""Detection of cuts: neighbouring frames that no rotation and zoom of a camera relates."""

from __future__ import annotations

from collections.abc import Sequence

from worldpose.broadcast_calibration.optical_flow import Followed
from worldpose.errors import InputError


def find_cuts(followed: Sequence[Followed], share: float) -> list[int]:
    """Return the first frames of new shots.

    Args:
        followed: points between all neighbouring frames.
        share: minimum share of them consistent with one homography within a shot [1].
    """
    return [number + 1 for number, pair in enumerate(followed) if pair.together < share]


def require_one_shot(
    followed: Sequence[Followed], share: float, where: str, first: int = 0
) -> None:
    """Raise InputError if a clip has several shots.

    Args:
        followed: points between all neighbouring frames.
        share: as in `find_cuts`.
        where: clip or file, for the message.
        first: number of the first frame in its video.

    Raises:
        InputError: the clip has cuts; the message lists their frames.
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
