"""Messages of errors, and that a bug in worldpose is called one."""

import ast
import inspect
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
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


def test_the_pipeline_calibrates_with_a_given_lens(monkeypatch):
    camera = CameraSpec(id="a", width=64, height=48)
    monkeypatch.setattr(pipeline, "calibrate_camera", lambda *_, lens, **__: lens)
    match = SimpleNamespace(
        spec=SimpleNamespace(static_cameras=[camera]), clicked={"a": 1}, stills={}, lenses={"a": 2}
    )
    assert pipeline.calibrate_static_cameras(match, None) == [2]


@pytest.mark.parametrize(("fps", "images"), [(25.0, [900, 919]), (50.0, [1800, 1838])])
def test_people_of_a_video_are_placed_on_match_frames(monkeypatch, fps, images):
    """Camera b has a video; its pictures are (their number,), and so is what our nets find."""

    class Video:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        index = SimpleNamespace(shown=lambda number, fps, where: number)

    def read(video, numbers):
        assert [numbers[0], numbers[-1]] == images
        return (np.float32(n) for n in numbers)

    def find(pictures):
        shown = np.array(list(pictures))
        points = np.broadcast_to(shown[:, None, None, None], (len(shown), 1, 17, 2))
        frame = np.arange(len(shown))
        return KeypointDetections.from_keypoints(points, points[..., 0] > 0, frame=frame)

    size = {"width": 64, "height": 48}
    spec = MatchSpec(
        match_id="m",
        fps=25.0,
        cameras=[CameraSpec(id="a", **size), CameraSpec(id="b", fps=fps, **size)],
        clips=[ClipSpec(id="c", first_frame=900, frame_count=20)],
    )
    given = find(range(900, 920))
    monkeypatch.setattr(pipeline, "open_video", lambda _: Video())
    monkeypatch.setattr(pipeline, "pictures_at", read)
    monkeypatch.setattr(pipeline, "detect_people", find)
    monkeypatch.setattr(
        pipeline, "read_unit", lambda *_: (replace(given, frame=np.arange(900, 920)), None)
    )
    match = SimpleNamespace(spec=spec, detections={"a": 1}, videos={"b": Path("b.mp4")})
    found = pipeline.find_people(match, "c")
    assert found.frame.tolist() == list(range(900, 920))
    shown = found.keypoints[:, :, 0, 0, 0]
    np.testing.assert_array_equal(shown[:, 1], shown[:, 0] * fps / 25.0)
