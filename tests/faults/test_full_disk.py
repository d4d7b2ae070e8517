"""A run on a disk that is full ends with one clear line, and is completed when there is room."""

import errno
import os
import shutil
import subprocess

import pytest
from command_line import worldpose

from flows.orchestration import prefect_environment
from flows.orchestration.local_cluster import require_room
from flows.orchestration.prefect_environment import begin_database
from worldpose.errors import MemoryLimitError, StoreError, require_memory
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS


@pytest.fixture
def small_disk(tmp_path):
    """A function that gives a folder on a disk of so many kilobytes, or another size later."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(kilobytes):
        again = ["remount,"] if folder.is_mount() else [""]
        options = f"{again[0]}size={kilobytes}k"
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if subprocess.run(command, capture_output=True).returncode != 0:
            pytest.skip("this user may not mount")
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def match(tmp_path):
    small = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
    simulate_match(SCENARIOS["tiny"], 0, tmp_path / "match", MatchOptions(**small))
    return tmp_path / "match"


@pytest.mark.faults
@pytest.mark.slow
@pytest.mark.parametrize(("kilobytes", "code"), [(200, 1), (600, 4)])
def test_a_run_on_a_full_disk_says_so_and_goes_on_when_there_is_room(
    match, small_disk, kilobytes, code, monkeypatch
):
    """No room for any camera, and room for some of the three."""
    monkeypatch.delenv("PREFECT_API_URL", raising=False)  # its own server, on this disk
    folder = small_disk(kilobytes)
    arguments = ("run", match, "--project", folder / "project", "--until", "static_calibration")
    answer = worldpose(*arguments, environment={})
    assert answer.code == code
    told = [line for line in answer.err.splitlines() if " failed: " in line]
    assert f"{folder}/project" in told[-1]
    assert "No space left on device. Free space there and run again." in told[-1]
    assert "Traceback" not in answer.err
    assert "Error logging to API" not in answer.err
    small_disk(100_000)
    assert worldpose(*arguments, environment={}).code == 0
    assert worldpose("verify", "--project", folder / "project").code == 0


def test_a_full_disk_names_the_project_and_not_the_kept_database(tmp_path, monkeypatch):
    kept = tmp_path / "kept.db"
    kept.write_bytes(b"empty")
    monkeypatch.setattr(prefect_environment, "kept_database", lambda: kept)

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source, None, target)

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(StoreError, match="No space left on device") as caught:
        begin_database(tmp_path / "project" / "prefect")
    assert str(caught.value).startswith(f"{tmp_path}/project/prefect/prefect.db: ")
    assert "kept.db" not in str(caught.value)


def test_what_prefect_raises_is_the_disk_only_where_that_is_full(tmp_path, monkeypatch):
    failure = ValueError("500 Internal Server Error")
    require_room(failure, str(tmp_path))
    require_room(failure, "s3://bucket/project")
    usage = shutil.disk_usage(tmp_path)._replace(free=4096)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    said = r"No space left on device \(4096 bytes are free\), where "
    with pytest.raises(StoreError, match=f"{said}results are written"):
        require_room(failure, str(tmp_path))
    with pytest.raises(StoreError, match=f"{said}Prefect keeps its database"):
        require_room(failure, "s3://bucket/project")


@pytest.mark.parametrize(
    "failure",
    [
        MemoryError("Unable to allocate 8.00 GiB for an array"),
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
    ],
)
def test_too_little_memory_is_named(failure):
    with pytest.raises(MemoryLimitError, match=r"^not enough memory \(.+\).*ulimit -v"):
        require_memory(failure)
