"""The method on one page has the stages of the factory in their order."""

import ast
import inspect

from flows.method import METHOD
from worldpose import pipeline

STAGES = {
    "calibrate_static_cameras": ["static_calibration"],
    "find_people": ["detection"],
    "track_people": ["tracking"],
    "reconstruct_joints": ["triangulation", "retriangulation"],
    "adjust_cameras": ["bundle_adjustment"],
    "fit_bodies": ["body_fitting"],
    "calibrate_moving_camera": ["broadcast_calibration"],
}
"""Stages of each step, in the order of its calls."""


def test_the_pipeline_has_the_order_of_the_method():
    tree = ast.parse(inspect.getsource(pipeline.reconstruct))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    calls.sort(key=lambda call: (call.lineno, call.col_offset))
    names = [call.func.id for call in calls if isinstance(call.func, ast.Name)]
    left = {name: list(stages) for name, stages in STAGES.items()}
    order = [left[name].pop(0) for name in names if name in left]
    assert not any(left.values())
    assert order == [stage.name for stage in METHOD if stage.name in order]
