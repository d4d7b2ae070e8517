"""Kernels kept on disk are those of the source as it is now."""

import shutil
import subprocess
import sys
from pathlib import Path

import worldpose.compiled

CALLER = """
from worldpose.compiled import compiled
from worldpose.kernels.callee import callee

@compiled
def caller():
    return callee() + 1

print(caller())
"""

CALLEE = """
from worldpose.compiled import compiled

@compiled
def callee():
    return {value}
"""


def test_an_edit_in_another_file_reaches_a_kernel_on_disk(tmp_path):
    package = tmp_path / "worldpose"
    (package / "kernels").mkdir(parents=True)
    shutil.copy(worldpose.compiled.__file__, package / "compiled.py")
    (package / "__init__.py").touch()
    (package / "kernels" / "__init__.py").touch()
    (package / "kernels" / "caller.py").write_text(CALLER)

    def result(value):
        (package / "kernels" / "callee.py").write_text(CALLEE.format(value=value))
        command = [sys.executable, "-m", "worldpose.kernels.caller"]
        return int(subprocess.check_output(command, cwd=tmp_path))

    assert result(10) == 11
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert kept, "kernels are not kept on disk"
    # The file of the kernel that is called stays as it was; numba alone would keep 11.
    assert result(20) == 21
    assert result(10) == 11
    assert {path: Path(path).stat().st_mtime_ns for path in kept} == kept, "compiled twice"
