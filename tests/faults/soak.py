"""Minutes of random faults over a stream of matches: `python tests/faults/soak.py --minutes 30`.

Two threads run matches at the same time and restart each until it is done; meanwhile a seeded
random sequence of faults kills processes, fills the disk and cuts the network. After each round
the project must equal that of undisturbed runs. Exit code 1 if it does not, or if a run hangs.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from checker import problems_of
from machines import Machines

from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS

WORLDPOSE = [sys.executable, "-c", "from flows.cli import main; main()"]
SMALL = {"duration": 0.2, "cameras": 3, "players": 2}
LANES, MATCHES = 2, 3
"""Matches at the same time, and per round."""
STUCK_SECONDS = 420.0
"""A run without progress for this long hangs, whatever the fault was [s]."""
MAX_STARTS = 60
"""Maximum number of starts per match; one that is not done by then never will be."""
UNFORESEEN = 'File "<string>", line 1, in <module>'
"""Text of an exception that the command line did not catch."""
BETWEEN = (0.1, 0.8)
"""Minimum and maximum time from the end of one fault to the next, as a share of an undisturbed
match's time: with shorter times no machine runs for long enough."""
FAULTS = {
    "worker killed": (0.5, 10.0),
    "worker's child killed": (0.0, 0.0),
    "scheduler killed": (0.5, 10.0),
    "Prefect server killed": (0.5, 10.0),
    "run killed": (0.0, 0.0),
    "disk full": (1.0, 10.0),
    "network cut": (1.0, 40.0),
}
"""Faults by name, with minimum and maximum duration [s]."""


@dataclass
class Stream:
    """Matches that the machines process, and what went wrong."""

    machines: Machines
    folders: list
    problems: list = field(default_factory=list)
    endings: Counter = field(default_factory=Counter)
    struck: Counter = field(default_factory=Counter)
    done: int = 0
    at_work: dict = field(default_factory=dict)
    is_over: threading.Event = field(default_factory=threading.Event)

    def round(self, project):
        """Run every match until it is done, two at a time; return seconds by match."""
        self.project = project
        waiting, seconds = iter(self.folders), {}

        def lane():
            for folder in waiting:
                began = time.monotonic()
                self._until_done(folder)
                seconds[folder.name] = round(time.monotonic() - began, 1)

        lanes = [threading.Thread(target=lane, daemon=True) for _ in range(LANES)]
        for each in lanes:
            each.start()
        for each in lanes:
            each.join()
        return seconds

    def _until_done(self, folder):
        for _ in range(MAX_STARTS):
            code, said = self._run(folder)
            if UNFORESEEN in said:
                self.problems.append(said[said.index(UNFORESEEN) :][-3000:])
            if code == 0:
                self.done += 1
                return
            self.endings[code] += 1
            time.sleep(1.0)
        self.problems.append(f"{folder.name} was begun {MAX_STARTS} times and is not done: {said}")

    def _run(self, folder):
        command = ["run", str(folder), "--project", str(self.project), "--dask", self.machines.dask]
        log = self.machines.folder / f"run-{folder.name}.log"
        with log.open("wb") as said:
            given = {"stdout": said, "stderr": said, "env": self.machines.environment}
            process = subprocess.Popen([*WORLDPOSE, *command], start_new_session=True, **given)
        self.at_work[folder.name] = process
        before, since = -1, time.monotonic()
        while process.poll() is None:
            time.sleep(0.25)
            published = (self.project / "results").rglob("manifest.json")
            made = [*published, *self.project.glob("runs/*/*")]
            now = (len(made), log.stat().st_size)
            if now != before:
                before, since = now, time.monotonic()
            elif time.monotonic() - since > STUCK_SECONDS:
                self.problems.append(f"{folder.name} hung: {log.read_text()[-2000:]}")
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        del self.at_work[folder.name]
        return process.returncode, log.read_text(errors="replace")


def disturb(stream, dice, pause):
    """Faults until the stream is over."""
    machines = stream.machines

    def wait(seconds, held=()):
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and not stream.is_over.wait(min(left, 0.25)):
            machines.keep_up(held)

    while not stream.is_over.is_set():
        wait(dice.uniform(*pause))
        kind = dice.choice(list(FAULTS))
        seconds, target = dice.uniform(*FAULTS[kind]), dice.random()
        held = None if stream.is_over.is_set() else strike(stream, kind, target)
        if held is not None:
            stream.struck[kind] += 1
            wait(seconds, held)
            machines.mend()


def strike(stream, kind, target):
    """Cause the fault; return the parts that it keeps down, None if it found no target."""
    machines = stream.machines
    worker = f"worker {int(target * machines.workers)}"
    if kind == "disk full":
        machines.small.fill()
    elif kind == "network cut":
        machines.link.cut()
    elif kind == "run killed":
        running = sorted(stream.at_work.items())
        if not running:
            return None
        try:
            os.killpg(running[int(target * len(running))][1].pid, signal.SIGKILL)
        except ProcessLookupError:
            return None
    elif kind == "worker's child killed":
        return () if machines.parts[worker].kill_child() else None
    else:
        name = {"worker killed": worker, "scheduler killed": "scheduler"}.get(kind, "prefect")
        machines.parts[name].kill()
        return (name,)
    return ()


def soak(minutes, seed, folder):
    """Run matches under random faults, and return the report as plain values.

    Args:
        minutes: time during which rounds start; the last round still ends.
        seed: of the faults.
        folder: a new folder for matches and projects.
    """
    folders = [folder / f"match-{number}" for number in range(MATCHES)]
    options = MatchOptions(**SMALL, calibrated=True, stills=False, video=False)
    for number, each in enumerate(folders):
        simulate_match(SCENARIOS["tiny"], number, each, options)
    with Machines(folder / "machines") as machines:
        stream, undisturbed = Stream(machines, folders), folder / "undisturbed"
        calm = stream.round(undisturbed)
        pause = [share * min(calm.values()) for share in BETWEEN]  # others compiled kernels
        began, dice, rounds = time.monotonic(), random.Random(seed), []
        while time.monotonic() - began < 60.0 * minutes and not stream.problems:
            stream.project = project = machines.disk / f"round-{len(rounds)}"
            project.mkdir()
            stream.is_over.clear()
            trouble = threading.Thread(target=disturb, args=(stream, dice, pause), daemon=True)
            trouble.start()
            rounds.append(stream.round(project))
            stream.is_over.set()
            trouble.join()
            machines.mend()
            stream.problems += problems_of(project, undisturbed)
            shutil.rmtree(project)
            print(f"{rounds[-1]} s, {stream.struck}, problems {stream.problems}", flush=True)
    return {
        "minutes": round((time.monotonic() - began) / 60.0, 1),
        "matches_done": stream.done - MATCHES,
        "seconds_undisturbed": calm,
        "seconds": rounds,
        "faults": dict(stream.struck),
        "exit_codes": dict(stream.endings),
        "problems": stream.problems,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="A new folder that is kept, with all logs.")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # and all machines with it
    folder = given.keep or Path(tempfile.mkdtemp(prefix="worldpose-soak-"))
    report = soak(given.minutes, given.seed, folder)
    print(json.dumps(report, indent=2))
    if given.keep is None:
        shutil.rmtree(folder)
    sys.exit(1 if report["problems"] else 0)


if __name__ == "__main__":
    main()
