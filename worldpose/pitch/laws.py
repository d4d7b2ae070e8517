"""Points and markings of Law 1 of the Game."""

from __future__ import annotations

import math

from data_contracts.pitch import ArcSpec, LineSpec

PENALTY_AREA = (16.5, 40.32)
"""Depth from the goal line, width along it [m]: 16.5 m to either side of the goal of 7.32 m."""
PENALTY_MARK_DISTANCE = 11.0
"""Distance from the goal line [m]."""
CIRCLE_RADIUS = 9.15
"""Radius of the centre circle, and of the penalty arcs around the penalty marks [m]."""

SIDES = {"left": -1.0, "right": 1.0}
ENDS = {"near": -1.0, "far": 1.0}

# Half the opening of a penalty arc, where the circle crosses the line of the penalty area.
_ARC_HALF_ANGLE = math.acos((PENALTY_AREA[0] - PENALTY_MARK_DISTANCE) / CIRCLE_RADIUS)

Place = tuple[float, float, float]


def law_points(length: float, width: float) -> dict[str, Place]:
    """Return the named points as (x, y, height above the surface) [m], world.

    Args:
        length: length of the pitch [m].
        width: width of the pitch [m].
    """
    goal = (2.44, 7.32)  # height of the crossbar's lower edge, width between the posts [m]
    x_goal, y_touch = 0.5 * length, 0.5 * width
    points: dict[str, Place] = {"center_mark": (0.0, 0.0, 0.0)}
    for end, toward in ENDS.items():
        points[f"halfway_{end}"] = (0.0, toward * y_touch, 0.0)
        points[f"center_circle_{end}"] = (0.0, toward * CIRCLE_RADIUS, 0.0)
    for side, out in SIDES.items():
        points[f"penalty_mark_{side}"] = (out * (x_goal - PENALTY_MARK_DISTANCE), 0.0, 0.0)
        for end, toward in ENDS.items():
            points[f"corner_{side}_{end}"] = (out * x_goal, toward * y_touch, 0.0)
            for area, (depth, across) in (("penalty", PENALTY_AREA), ("goal", (5.5, 18.32))):
                y = toward * 0.5 * across
                points[f"{area}_area_{side}_{end}_back"] = (out * x_goal, y, 0.0)
                points[f"{area}_area_{side}_{end}_front"] = (out * (x_goal - depth), y, 0.0)
            points[f"penalty_arc_{side}_{end}"] = (
                out * (x_goal - PENALTY_AREA[0]),
                toward * CIRCLE_RADIUS * math.sin(_ARC_HALF_ANGLE),
                0.0,
            )
            y = toward * 0.5 * goal[1]
            points[f"goal_post_{side}_{end}_bottom"] = (out * x_goal, y, 0.0)
            points[f"goal_post_{side}_{end}_top"] = (out * x_goal, y, goal[0])
    return points


def law_lines() -> dict[str, LineSpec]:
    """Return the straight markings by name."""
    lines = {"halfway_line": LineSpec(start="halfway_near", end="halfway_far")}
    for end in ENDS:
        lines[f"touch_line_{end}"] = LineSpec(start=f"corner_left_{end}", end=f"corner_right_{end}")
    for side in SIDES:
        lines[f"goal_line_{side}"] = LineSpec(start=f"corner_{side}_near", end=f"corner_{side}_far")
        for area in ("penalty_area", "goal_area"):
            corner = f"{area}_{side}"
            lines[f"{corner}_front"] = LineSpec(
                start=f"{corner}_near_front", end=f"{corner}_far_front"
            )
            for end in ENDS:
                lines[f"{corner}_{end}"] = LineSpec(
                    start=f"{corner}_{end}_back", end=f"{corner}_{end}_front"
                )
    return lines


def law_goals() -> dict[str, LineSpec]:
    """Return the goals' posts and crossbars by name: straight and white, but not painted."""
    frames = {}
    for side in SIDES:
        for end in ENDS:
            post = f"goal_post_{side}_{end}"
            frames[post] = LineSpec(start=f"{post}_bottom", end=f"{post}_top")
        frames[f"crossbar_{side}"] = LineSpec(
            start=f"goal_post_{side}_near_top", end=f"goal_post_{side}_far_top"
        )
    return frames


def law_arcs() -> dict[str, ArcSpec]:
    """Return the curved markings by name."""
    arcs = {
        "center_circle": ArcSpec(
            center="center_mark", radius=CIRCLE_RADIUS, start_angle=0.0, end_angle=2.0 * math.pi
        )
    }
    # Each begins at the angle at which it enters the pitch, in the direction from x towards y.
    quarters = (("left_near", 0), ("right_near", 1), ("right_far", 2), ("left_far", 3))
    for corner, quarter in quarters:
        arcs[f"corner_arc_{corner}"] = ArcSpec(
            center=f"corner_{corner}",
            radius=1.0,
            start_angle=quarter * 0.5 * math.pi,
            end_angle=(quarter + 1) * 0.5 * math.pi,
        )
    for side, middle in (("left", 0.0), ("right", math.pi)):
        arcs[f"penalty_arc_{side}"] = ArcSpec(
            center=f"penalty_mark_{side}",
            radius=CIRCLE_RADIUS,
            start_angle=middle - _ARC_HALF_ANGLE,
            end_angle=middle + _ARC_HALF_ANGLE,
        )
    return arcs
