"""Kernels kept on disk are those of the source as it is now, and only this user's; items ahead."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import worldpose.compiled
from worldpose.cache_folder import own_temporary_folder
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
