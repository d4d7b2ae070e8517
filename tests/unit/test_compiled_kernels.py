"""Kernels kept on disk are those of the source as it is now."""

import shutil
import subprocess
import sys

import worldpose.compiled

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
    shutil.copy(worldpose.compiled.__file__, package / "compiled.py")
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
    (package / "others" / "other.py").write_text(CALLEE.format(value=30))
    assert result(10) == 11
    assert kernels() == kept, "compiled again, although nothing that they import has changed"
