"""Logs are bounded while their processes are at work."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

from flows.service import serving


def test_a_log_is_set_aside_while_its_process_writes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(serving, "LOG_BYTES", 1000)
    log = tmp_path / "pages.log"
    script = "import sys\nfor line in sys.stdin: print(line.strip() * 10, flush=True)"
    with log.open("ab") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=output, text=True
        )
    size = 0
    for number in range(200):
        process.stdin.write(f"{number:010d}\n")
        process.stdin.flush()
        serving.bound_log(log)
        size = max(size, log.stat().st_size)
    process.stdin.close()
    process.wait(60)
    serving.bound_log(log)
    assert size < 40_000
    assert log.stat().st_size <= 1000
    kept = (log.with_suffix(".log.1").read_bytes() + log.read_bytes()).decode()
    assert "\0" not in kept
    assert kept.endswith(f"{199:010d}" * 10 + "\n")


def test_a_part_that_no_signal_ends_is_left_behind_and_named(monkeypatch):
    """As one that waits for a disk; the parts before it are ended too."""
    monkeypatch.setattr(serving, "END_SECONDS", 0.1)
    killed, said = [], []

    def wait(seconds=None):
        assert seconds is not None, "it would wait for ever"
        raise subprocess.TimeoutExpired("part", seconds)

    supervisor = serving._Supervisor(None, None, said.append)
    for name in ("prefect", "pages"):
        process = SimpleNamespace(
            pid=9, stdin=None, wait=wait, kill=lambda it=name: killed.append(it)
        )
        supervisor.parts.append(serving._Part(name, None, Path("log"), process))
    supervisor.end()
    assert killed == ["pages", "prefect"]
    assert said[0] == "pages ends when its disk answers: process 9"
