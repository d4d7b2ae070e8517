"""Errors, digests of sources, compiled kernels, and benchmarks."""

import ast
import importlib
import inspect
import os
import pickle
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import run
from registry import REGISTRY
from run_records import match_spec

import worldpose.compiled
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec
from flows.method import METHOD
from worldpose import pipeline
from worldpose.cache_folder import own_temporary_folder
from worldpose.errors import InputError, InternalError, MemoryLimitError, WorldposeError
from worldpose.sources import _read_module, _source_cache, code_version


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


def test_the_pipeline_calibrates_with_a_given_lens_and_a_stated_side(monkeypatch):
    camera = CameraSpec(id="a", width=64, height=48, side="left")
    monkeypatch.setattr(pipeline, "calibrate_camera", lambda *_, lens, start, **__: [lens, *start])
    match = SimpleNamespace(
        spec=SimpleNamespace(static_cameras=[camera]), clicked={"a": 1}, stills={}, lenses={"a": 2}
    )
    assert pipeline.calibrate_static_cameras(match, None) == [[2, -99.0, 0.0, 0.0]]


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

    clips = {"c": {"first_frame": 900, "frame_count": 20}}
    spec = match_spec({"a": {}, "b": {"fps": fps}}, clips, (64, 48))
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


TREE = {
    "tasks/__init__.py": "",
    "tasks/tracking.py": '''
        """Docstring."""
        import os
        import numpy as np
        from tasks import other
        from worldpose.tracking import track
        def run():
            from worldpose.late import slow  # inside a function
            import worldpose.store
    ''',
    "tasks/other.py": "",
    "worldpose/__init__.py": "from worldpose.unrelated import x",
    "worldpose/tracking/__init__.py": "from worldpose.tracking.tracker import track",
    "worldpose/tracking/tracker.py": '''
        """Docstring."""
        from data_contracts import arrays
        from worldpose.tracking import affinity
        from worldpose.geometry.rigid import Rigid
        def track(x):
            """Docstring."""
            return x + 1  # comment
    ''',
    "worldpose/tracking/affinity.py": "from worldpose.tracking.tracker import track",
    "worldpose/tracking/unused.py": "",
    "worldpose/geometry/__init__.py": "from worldpose.unrelated import x",
    "worldpose/geometry/rigid.py": "class Rigid:\n    '''Only a docstring.'''",
    "worldpose/late.py": "import worldpose.deep.module as m",
    "worldpose/deep/__init__.py": "",
    "worldpose/deep/module.py": "",
    "worldpose/unrelated.py": "x = 1",
    "worldpose/store/__init__.py": "import worldpose.unrelated",
    "data_contracts/__init__.py": "",
    "data_contracts/arrays.py": "",
}


@pytest.fixture
def tree(tmp_path):
    for name, text in TREE.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = text.strip("\n").splitlines()
        indent = len(lines[0]) - len(lines[0].lstrip()) if lines else 0
        path.write_text("\n".join(line[indent:] for line in lines))
    return tmp_path


def version_of(tree):
    """Read sources again, as a new process would."""
    for cache in (code_version, _read_module, _source_cache):
        cache.cache_clear()
    return code_version("tasks.tracking", (tree,))


def edited(tree, name, old, new):
    """The modules whose digest an edit of `name` changes."""
    before = version_of(tree)
    text = (tree / name).read_text()
    assert old in text
    (tree / name).write_text(text.replace(old, new))
    after = version_of(tree)
    return {module for module, version in after.items() if before.get(module) != version}


def test_nothing_is_executed(tree):
    path = tree / "worldpose/tracking/affinity.py"
    path.write_text("raise SystemExit('executed')\nimport sys\n")
    assert "worldpose.tracking.affinity" in version_of(tree)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# comment", "# another comment"),
        ("  # comment", ""),
        ('"""Docstring."""', '"""Another."""'),
        ('    """Docstring."""\n', ""),
        ("x + 1", "(x  +  1)"),
        ("def track", "\n\n\ndef track"),
    ],
)
def test_edit_that_computes_the_same_changes_nothing(tree, old, new):
    assert edited(tree, "worldpose/tracking/tracker.py", old, new) == set()


@pytest.mark.parametrize(
    ("module", "old", "new", "changed"),
    [
        ("tracking/tracker", "x + 1", "x + 2", {"worldpose.tracking.tracker"}),
        ("unrelated", "x = 1", "x = 2", set()),
    ],
)
def test_edit_that_computes_something_else_changes_its_module_only(tree, module, old, new, changed):
    assert edited(tree, f"worldpose/{module}.py", old, new) == changed


ROOT = Path(worldpose.compiled.__file__).parents[1]

CALLER = """
from worldpose.compiled import compile_kernel
from worldpose.callees.callee import callee

@compile_kernel
def caller():
    return callee() + 1

print(caller())
"""

CALLEE = """
from worldpose.compiled import compile_kernel

@compile_kernel
def callee():
    return {value}
"""


def test_an_edit_in_another_file_reaches_the_kernels_that_can_depend_on_it(tmp_path):
    package = tmp_path / "worldpose"
    for folder in ("callers", "callees", "others"):
        (package / folder).mkdir(parents=True)
        (package / folder / "__init__.py").touch()
    for module in ("cache_folder.py", "compiled.py", "errors.py", "parsing.py", "sources.py"):
        shutil.copy(Path(worldpose.compiled.__file__).with_name(module), package)
    (package / "__init__.py").touch()
    (package / "callers" / "caller.py").write_text(CALLER)

    def result(value):
        (package / "callees" / "callee.py").write_text(CALLEE.format(value=value))
        # Python takes bytecode for fresh if the source has the same size and second: write none.
        command = [sys.executable, "-B", "-m", "worldpose.callers.caller"]
        return int(subprocess.check_output(command, cwd=tmp_path))

    def kernels():
        return {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}

    assert result(10) == 11
    kept = kernels()
    assert kept, "kernels are not kept on disk"
    # The file of the kernel that is called stays as it was; numba alone would keep 11.
    assert result(20) == 21
    assert kept.items() < kernels().items()
    kept = kernels()
    for folder in ("others", "callers", "callees"):
        (package / folder / "other.py").write_text(CALLEE.format(value=30))
    assert result(10) == 11
    assert kernels() == kept, "compiled again, although nothing that they import has changed"


def test_the_modules_whose_change_compiles_a_kernel_again_include_all_that_it_uses():
    kernels = 0
    for path in sorted((ROOT / "worldpose").rglob("*.py")):
        if "\n@compile_kernel\n" not in path.read_text():
            continue
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        reached = code_version(name)
        for kernel in vars(importlib.import_module(name)).values():
            if getattr(kernel, "py_func", None) is None or kernel.py_func.__module__ != name:
                continue
            kernels += 1
            for used in kernel.py_func.__code__.co_names:
                value = kernel.py_func.__globals__.get(used)
                value = getattr(value, "py_func", value)
                origin = getattr(value, "__module__", None) or getattr(value, "__name__", "")
                if str(origin).startswith(("worldpose.", "data_contracts.")):
                    assert origin in reached, f"{name} uses {used} of {origin}"
    assert kernels > 100


@pytest.mark.parametrize("planted", ["link", "of another user", "writable by others"])
def test_a_temporary_folder_that_another_user_can_change_is_not_used(
    tmp_path, monkeypatch, planted
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    user = os.getuid()
    assert own_temporary_folder() == tmp_path / f"worldpose-{user}"
    if planted == "link":
        (tmp_path / f"worldpose-{user}").rename(tmp_path / "theirs")
        (tmp_path / f"worldpose-{user}").symlink_to(tmp_path / "theirs")
    elif planted == "of another user":
        (tmp_path / f"worldpose-{user + 1}").mkdir(mode=0o700)
        monkeypatch.setattr(os, "getuid", lambda: user + 1)
    else:
        (tmp_path / f"worldpose-{user}").chmod(0o777)
    assert own_temporary_folder() is None


BENCHMARKS = Path(__file__).parents[2]


def test_every_benchmark_has_a_line_in_the_list(capsys):
    run.main(["--list"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(REGISTRY)
    assert all(len(line.split()) > 3 for line in lines)
    sources = (file.read_text() for file in (BENCHMARKS / "benchmarks").glob("*.py"))
    registered = re.findall(r'@benchmark\(\s*"(\w+)"', "\n".join(sources))
    assert sorted(registered) == sorted(REGISTRY)


def test_an_unknown_benchmark_and_missing_data_are_clear_errors(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run.main(["no_such_benchmark"])
    assert ended.value.code == 2
    assert "invalid choice: 'no_such_benchmark'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        run.main(["real", str(tmp_path)])
    assert str(ended.value).startswith(f"error: {tmp_path}: expected a folder with")
