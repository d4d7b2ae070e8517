"""Messages of errors, and that a bug in worldpose is called one."""

import ast
import inspect
import pickle

import pytest

from flows.method import METHOD
from worldpose import pipeline
from worldpose.errors import InputError, InternalError, MemoryLimitError, WorldposeError


def broken():
    return {}["click"]


def test_an_unforeseen_exception_is_called_a_bug_and_names_its_line():
    with pytest.raises(KeyError) as caught:
        broken()
    error = InternalError.wrap("tracking/clip", caught.value)
    assert str(error).startswith("tracking/clip: internal error KeyError at ")
    line = broken.__code__.co_firstlineno + 1
    assert f"test_errors.py:{line} in broken: 'click'" in str(error)
    assert "This is a bug in worldpose, not in your data" in str(error)


@pytest.mark.parametrize(
    "error",
    [
        InternalError("tracking: array joints[3]", "expected finite numbers only, found nan"),
        InputError("match.yaml: fps", expected="a number", found="'x'", todo="Correct it."),
        MemoryLimitError("tracking/clip: not enough memory"),
    ],
)
def test_errors_travel_back_from_a_worker(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert isinstance(copy, WorldposeError)
    assert str(copy) == str(error)


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
