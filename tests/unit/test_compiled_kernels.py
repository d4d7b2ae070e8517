"""Kernels kept on disk are those of the source as it is now, and only this user's; items ahead."""

import importlib
import os
import shutil
import subprocess
import sys
from itertools import islice
from pathlib import Path

import pytest

import worldpose.compiled
from worldpose.cache_folder import find_cache_folder, own_temporary_folder
from worldpose.sources import code_version

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
        command = [sys.executable, "-m", "worldpose.callers.caller"]
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


LIST_SCENARIOS = """
import sys
from pathlib import Path

import worldpose.cache_folder

worldpose.cache_folder._PACKAGE = Path("/dev/null")  # no folder can be created in it, even by root
from flows.cli import main
from worldpose.compiled import load_compiler

load_compiler()
sys.argv = ["worldpose", "simulate", "--scenario", "list", "--out", "unused"]
main()
"""


def test_kernels_of_a_user_without_a_home_are_kept_in_a_temporary_folder(tmp_path):
    around = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    told = subprocess.run(
        [sys.executable, "-c", LIST_SCENARIOS],
        env={**around, "HOME": "/dev/null"},
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    folder = tmp_path / f"worldpose-{os.getuid()}"
    assert told.count("warning: ") == 1
    assert f"compiled code is kept in {folder}. Set NUMBA_CACHE_DIR" in told
    assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.rglob("*.nbc"))


def test_items_read_ahead_come_in_order_and_no_further_than_asked():
    taken = []

    def source():
        for number in range(20):
            taken.append(number)
            yield number

    items = worldpose.compiled.read_ahead(source(), 3)
    assert next(items) == 0
    assert list(islice(items, 4)) == [1, 2, 3, 4]
    items.close()
    # One more may be asked for when an item is handed out.
    assert 5 <= len(taken) <= 9
    assert list(worldpose.compiled.read_ahead(iter([]), 3)) == []
    assert list(worldpose.compiled.read_ahead(range(2), 3)) == [0, 1]


def test_an_error_ahead_is_raised_in_its_turn():
    def source():
        yield from (1, 2)
        raise ValueError("the third")

    found = []
    with pytest.raises(ValueError, match="the third"):
        for item in worldpose.compiled.read_ahead(source(), 8):
            found.append(item)
    assert found == [1, 2]


def test_without_a_writable_package_compiled_code_is_kept_at_home(tmp_path, monkeypatch):
    monkeypatch.setattr("worldpose.cache_folder._PACKAGE", Path("/dev/null"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    expected = tmp_path / ".cache" / "worldpose" / "__pycache__"
    assert find_cache_folder.__wrapped__() == (expected, True)
    assert expected.is_dir()


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
