"""Conversion of SoccerNet's line annotations to drawn markings.

Its "left" and "right" sides are those of the main camera's image, "top" the far and "bottom" the
near side; a goal's posts are named as seen from the pitch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from data_contracts.static_calibration import ClickedMarkings, DrawnMarking


def _names() -> dict[str, str]:
    names = {
        "Side line top": "touch_line_far",
        "Side line bottom": "touch_line_near",
        "Middle line": "halfway_line",
        "Circle central": "center_circle",
    }
    for side, left_post, right_post in (("left", "near", "far"), ("right", "far", "near")):
        names[f"Side line {side}"] = f"goal_line_{side}"
        names[f"Circle {side}"] = f"penalty_arc_{side}"
        for theirs, ours in (("Big", "penalty_area"), ("Small", "goal_area")):
            for part, place in (("main", "front"), ("top", "far"), ("bottom", "near")):
                names[f"{theirs} rect. {side} {part}"] = f"{ours}_{side}_{place}"
        names[f"Goal {side} crossbar"] = f"crossbar_{side}"
        names[f"Goal {side} post left"] = f"goal_post_{side}_{left_post}"
        names[f"Goal {side} post right"] = f"goal_post_{side}_{right_post}"
    return names


SOCCERNET_MARKINGS: Final = _names()
"""Names of the pitch template by SoccerNet's names."""


def soccernet_markings(
    lines: Mapping[str, Sequence[Sequence[float]]], image_size: tuple[int, int]
) -> ClickedMarkings:
    """Return one image's annotation as drawn markings, without unknown names.

    Args:
        lines: points along each marking as shares of the image's width and height [1].
        image_size: width, height [px].
    """
    width, height = image_size
    drawn = []
    for name, points in lines.items():
        # Annotators drag ends past the border, where nothing is visible.
        inside = [(x * width, y * height) for x, y in points if 0 <= x <= 1 and 0 <= y <= 1]
        if name in SOCCERNET_MARKINGS and inside:
            drawn.append(DrawnMarking(name=SOCCERNET_MARKINGS[name], xy=tuple(inside)))
    return ClickedMarkings(drawn=tuple(drawn))
