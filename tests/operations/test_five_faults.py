"""A served project under five faults at once: others are served, and the log says each in a line.

At the same time: a match in the inbox that ends the process that reads it, 1,100 slow connections
to the pages and to Prefect's server each, a journal of 20,000 corrections, a match folder without
permission, and a full disk, which gets room again in the end.
"""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import time
import urllib.error
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from statistics import quantiles

import pytest
from command_line import WORLDPOSE
from long_journal import write_corrections
from service import Browser, Served, wait_until
from test_slow_connections import open_many, send_first, still_open

from flows.registering import register
from worldpose.store.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.faults, pytest.mark.timeout(3600)]

CORRECTIONS = 20_000
CONNECTIONS = 1100
SECONDS = 45.0
"""Duration of each measurement [s]."""
LIMIT = 1.0
"""Maximum 99th percentile of the response times [s]."""
UNPRIVILEGED = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]
"""Prefix of a command: root without the right to ignore file permissions."""


@pytest.fixture
def disk(tmp_path):
    """A folder on a small disk of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=600m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("this user may not mount")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def matches(small_match, tmp_path):
    """A function that makes a copy of the small match with an id and content of its own."""

    def copy(name, folder):
        shutil.copytree(small_match, folder)
        text = (folder / "match.yaml").read_text()
        (folder / "match.yaml").write_text(re.sub("match_id: .*", f"match_id: {name}", text))
        pitch = folder / "pitch.json"
        pitch.write_text(pitch.read_text() + "\n" * len(name))
        return folder

    return copy


@contextmanager
def crowd(ports):
    """Run a process that holds connections to `ports` open, each with half a request."""
    context = get_context("spawn")
    is_over = context.Event()
    process = context.Process(target=press, args=[ports, is_over])
    process.start()
    try:
        yield
    finally:
        is_over.set()
        process.join(60)
    assert process.exitcode == 0


def press(ports, is_over):
    """Hold connections open; every 0.5 s reopen at most 100 per port that the server closed."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (8192, 8192))
    opened = {port: open_many(port, CONNECTIONS) for port in ports}
    while not is_over.wait(0.5):
        for port, pairs in opened.items():
            send_first(pairs)
            lost = [place for place, pair in enumerate(pairs) if not still_open([pair])]
            for place in lost[:100]:
                pairs[place][0].close()
                pairs[place] = open_many(port, 1)[0]


def measure(asked, seconds):
    """Send the requests in turn for `seconds`; return the response times [s] of each."""
    took = {name: [] for name in asked}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for name, ask in asked.items():
            began = time.monotonic()
            ask()
            took[name].append(time.monotonic() - began)
            time.sleep(0.02)
    return took


def refused(ask):
    """Send a request that a full disk must refuse; return the status code and the error."""
    try:
        ask()
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())["error"]
    raise AssertionError("a full disk took a correction")


def status_of(project):
    """Return the output of `worldpose status` and its processor time [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*UNPRIVILEGED, *WORLDPOSE, "status", "--project", str(project)],
        capture_output=True,
        text=True,
        timeout=480,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)
    assert done.returncode == 0, done.stderr
    return done.stdout, spent


def test_others_are_served_under_five_faults_at_once(disk, matches, tmp_path, webhook, capsys):
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv is not installed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (8192, 8192))
    served = Served(disk, webhook.address)
    served.launcher = UNPRIVILEGED
    here = Path(__file__).parent
    served.environment["PYTHONPATH"] = f"{here / 'poisoned'}:{os.environ.get('PYTHONPATH', '')}"
    store = Store.create(served.project)
    locked, corrected = "without-permission", "corrected"
    for name in (locked, corrected):
        register(store, matches(name, tmp_path / name))
    write_corrections(store, corrected, CORRECTIONS)
    (tmp_path / locked).chmod(0)
    lines = []
    try:
        under_faults(lines, served, disk, matches, corrected, locked)
    finally:
        (tmp_path / locked).chmod(0o755)
        if served.process.poll() is None:
            served.end()
        with capsys.disabled():
            print("", *lines, sep="\n", file=sys.stderr)
    assert not [line for line in lines if line.endswith("TOO SLOW")]


def under_faults(lines, served, disk, matches, corrected, locked):
    """Cause the five faults, check the service, and add the measurements to `lines`."""
    began = time.monotonic()
    served.begin()
    browser = Browser(served)
    browser.ask("/api/matches")
    lines.append(f"the first list of matches came {time.monotonic() - began:.1f} s after the start")
    match = f"/api/matches/{corrected}"
    camera = browser.ask(match)["cameras"][0]["id"]
    points = browser.ask(f"{match}/pictures/{camera}")["points"]
    (name, at), *_ = sorted(points.items())
    # Kernels are loaded once, at the start, and hold up all else meanwhile.
    clicked = {"points": points, "drawn": {}, "refine": False}
    browser.ask(f"{match}/pictures/{camera}/preview", clicked)
    lines.append(f"the first camera was estimated {time.monotonic() - began:.1f} s after the start")
    number = 0

    def correct():
        nonlocal number, at
        number += 1
        to = [at[0] + (0.25 if number % 2 else -0.25), at[1]]
        edit = {"kind": "moved_point", "camera": camera, "marking": name, "was": at, "xy": to}
        said = {"edits": [{"id": f"moved_point.{1 << 40 | number:016x}", "edit": edit}]}
        browser.ask(f"{match}/corrections", said)
        at = to

    reads = {
        "list of matches": lambda: browser.ask("/api/matches"),
        "page of the match": lambda: browser.ask(match),
        "status page": lambda: browser.ask("/status"),
        "status as JSON": lambda: browser.ask("/api/status"),
        "Prefect's health": lambda: served.ask("/health"),
    }
    logs = served.project / "operations" / "logs"
    sizes = {log: log.stat().st_size for log in logs.glob("*.log")}
    with crowd([served.ports["pages"], served.ports["prefect"]]):
        matches("poisoned", served.project / "inbox" / "poisoned")
        lines += shown("four faults", measure({**reads, "a correction": correct}, SECONDS))
        filler = disk / "filler"
        with filler.open("wb", buffering=0) as file:
            fill(file)
        code, said = refused(correct)
        assert code == 507, said
        assert "No space left on device" in said
        lines.append(f"a correction on a full disk: {code} {said}")
        lines += shown("five faults", measure(reads, SECONDS))
        text, spent = status_of(served.project)
        assert any(line.startswith("corrected ") for line in text.splitlines()), text
        (problem,) = [line for line in text.splitlines() if line.startswith(f"{locked}: ")]
        lines += [f"worldpose status: {spent:.1f} s of processor", problem]
        filler.unlink()
        matches("good", served.project / "inbox" / "good")
        wait_until(lambda: works(correct), served.explain)

        def arrived():
            found = {each["name"]: each for each in browser.ask("/api/status")["arrivals"]}
            states = {name: found[name]["state"] for name in ("good", "poisoned") if name in found}
            return states == {"good": "taken", "poisoned": "refused"} and found

        found = wait_until(arrived, served.explain)
        assert "died 2 times" in found["poisoned"]["reason"]
        lines.append(f"poisoned: {found['poisoned']['reason']}")

        def is_asked():
            runs = served.runs("good")
            assert not runs or runs[0]["state_name"] != "Failed", served.explain()
            return runs and runs[0]["state_name"] in ("Suspended", "Completed")

        wait_until(is_asked, served.explain)
        lines.append("good: taken, and its run came to its first question or its end")
    assert served.process.poll() is None
    lines += log_lines(sizes)
    for match_id, problem in ((corrected, None), (locked, "Permission denied")):
        (found,) = [
            each for each in browser.ask("/api/matches")["matches"] if each["match"] == match_id
        ]
        assert (problem or "") in (found["problem"] or "")


def fill(file):
    """Write zeros until the disk is full, to the last byte."""
    for size in (1 << 20, 4096, 1):
        try:
            while True:
                file.write(bytes(size))
        except OSError:
            continue


def works(ask):
    try:
        ask()
    except urllib.error.HTTPError:
        return False
    return True


def shown(what, took):
    """One line for each kind of request."""
    lines = [f"{what}:"]
    for name, seconds in took.items():
        parts = quantiles(seconds, n=100, method="inclusive")
        is_slow = " TOO SLOW" * (parts[98] >= LIMIT)
        lines.append(
            f"  {name:20s} {len(seconds):4d} requests, p50 {1e3 * parts[49]:4.0f} ms, "
            f"p99 {1e3 * parts[98]:4.0f} ms, most {1e3 * max(seconds):4.0f} ms "
            f"(request {seconds.index(max(seconds)) + 1}){is_slow}"
        )
    return lines


def log_lines(sizes):
    """Return new log lines, each different one once; fails if a fault fills the logs."""
    lines = []
    for log, size in sorted(sizes.items()):
        with log.open(errors="replace") as file:
            file.seek(min(size, log.stat().st_size))
            text = file.read()
        # Prefect's server and worker tell at length what a full disk did to their database.
        assert log.name in ("prefect.log", "worker.log") or "Traceback" not in text, text[-3000:]
        assert len(text) < 200_000, text[-3000:]
        kinds = {}
        for line in text.splitlines():
            kinds.setdefault(re.sub(r"[0-9a-f-]{8,}|[0-9.:]+", "#", line), []).append(line)
        lines.append(f"{log.name}: {len(text)} bytes, {len(text.splitlines())} lines")
        lines += [f"  {len(each)} x {each[0][:200]}" for each in kinds.values()]
    return lines
