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
from recoveries import Fault, by_kind, reason_in, summary_of

from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS

WORLDPOSE = [sys.executable, "-c", "from flows.cli import main; main()"]
SMALL = {"duration": 0.2, "cameras": 3, "players": 2}
LANES = 2
MATCHES = 3
"""Number per round."""
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
    """Matches that the machines process, and what went wrong.

    Attributes:
        machines: the machines that compute.
        folders: match folders.
        problems: descriptions of what went wrong.
    """

    machines: Machines
    folders: list
    problems: list = field(default_factory=list)
    endings: Counter = field(default_factory=Counter)
    tracebacks: list = field(default_factory=list)
    done: int = 0
    begun: int = 0
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

    def progress(self):
        """How much is published and recorded."""
        found = 0
        for place, _, names in os.walk(self.project):
            below = Path(place).relative_to(self.project).parts
            if below[:1] in (("results",), ("runs",)):
                found += sum(each == "manifest.json" or below[0] == "runs" for each in names)
        return found

    def _until_done(self, folder):
        for _ in range(MAX_STARTS):
            code, said = self._run(folder)
            self.begun += 1
            if code == 0:
                self.done += 1
                return
            self.endings["killed" if code == -signal.SIGKILL else reason_in(said)] += 1
            if UNFORESEEN in said:
                self.tracebacks.append(said[said.index(UNFORESEEN) :][-3000:])
            time.sleep(1.0)
        self.problems.append(f"{folder.name} was begun {MAX_STARTS} times and is not done: {said}")

    def _run(self, folder):
        command = ["run", str(folder), "--project", str(self.project), "--dask", self.machines.dask]
        log = self.machines.folder / f"run-{folder.name}.log"
        with log.open("wb") as said:
            process = subprocess.Popen(
                [*WORLDPOSE, *command],
                stdout=said,
                stderr=said,
                env=self.machines.environment,
                start_new_session=True,
            )
        self.at_work[folder.name] = process
        before, since = -1, time.monotonic()
        while process.poll() is None:
            time.sleep(0.25)
            now = (self.progress(), log.stat().st_size)
            if now != before:
                before, since = now, time.monotonic()
            elif time.monotonic() - since > STUCK_SECONDS:
                self.problems.append(f"{folder.name} hung: {log.read_text()[-2000:]}")
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        del self.at_work[folder.name]
        return process.returncode, log.read_text(errors="replace")


def disturb(stream, dice, pause, faults):
    """Faults until the stream is over."""
    machines = stream.machines

    def wait(seconds, held=()):
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and not stream.is_over.wait(min(left, 0.25)):
            machines.keep_up(held)
            done = stream.progress()
            for fault in faults:
                if fault.recovered is None and fault.lifted is not None and done > fault.done:
                    fault.recovered = time.monotonic() - fault.lifted

    while not stream.is_over.is_set():
        wait(dice.uniform(*pause))
        kind = dice.choice(list(FAULTS))
        seconds, target = dice.uniform(*FAULTS[kind]), dice.random()
        held = None if stream.is_over.is_set() else _strike(stream, kind, target)
        if held is None:
            continue
        fault = Fault(kind, seconds)
        faults.append(fault)
        wait(seconds, held)
        machines.small.free()
        machines.link.heal()
        machines.keep_up()
        fault.done, fault.lifted = stream.progress(), time.monotonic()


def _strike(stream, kind, target):
    """Cause the fault; return the parts that it keeps down, None if it found no target."""
    machines = stream.machines
    if kind == "disk full":
        machines.small.fill()
        return ()
    if kind == "network cut":
        machines.link.cut()
        return ()
    if kind == "run killed":
        running = sorted(stream.at_work.items())
        if not running:
            return None
        _, process = running[int(target * len(running))]
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return None
        return ()
    worker = f"worker {int(target * machines.workers)}"
    if kind == "worker's child killed":
        return () if machines.parts[worker].kill_child() else None
    name = {"worker killed": worker, "scheduler killed": "scheduler"}.get(kind, "prefect")
    machines.parts[name].kill()
    return (name,)


def soak(minutes, seed, folder):
    """Run matches under random faults, and return the report as plain values.

    Args:
        minutes: time during which rounds start; the last round still ends.
        seed: of the faults.
        folder: a new folder for matches and projects.
    """
    folders = []
    for number in range(MATCHES):
        folders.append(folder / f"match-{number}")
        options = {**SMALL, "calibrated": True, "stills": False, "video": False}
        simulate_match(SCENARIOS["tiny"], number, folders[-1], MatchOptions(**options))
    faults, rounds, problems = [], [], []
    with Machines(folder / "machines") as machines:
        stream = Stream(machines, folders)
        undisturbed = folder / "undisturbed"
        calm = stream.round(undisturbed)
        problems += [f"undisturbed: {each}" for each in stream.problems]
        stream.problems.clear()
        began = time.monotonic()
        dice = random.Random(seed)
        while time.monotonic() - began < 60.0 * minutes and not problems:
            project = machines.disk / f"round-{len(rounds)}"
            project.mkdir()
            stream.project = project
            stream.is_over.clear()
            struck = []
            pause = [share * min(calm.values()) for share in BETWEEN]  # others compiled kernels
            trouble = threading.Thread(
                target=disturb, args=(stream, dice, pause, struck), daemon=True
            )
            trouble.start()
            seconds = stream.round(project)
            stream.is_over.set()
            trouble.join()
            machines.small.free()
            machines.link.heal()
            problems += stream.problems
            stream.problems.clear()
            problems += problems_of(project, undisturbed)
            rounds.append(seconds)
            faults += struck
            shutil.rmtree(project)
            told = f"endings {dict(stream.endings)}, problems {problems}"
            print(f"round {len(rounds)}: {seconds}, {len(struck)} faults, {told}", flush=True)
        took = time.monotonic() - began
    return {
        "seed": seed,
        "minutes": round(took / 60.0, 1),
        "rounds": len(rounds),
        "matches_done": stream.done - MATCHES,
        "runs_begun": stream.begun - MATCHES,
        "seconds_a_match_undisturbed": calm,
        "seconds_a_match": summary_of([each for round_ in rounds for each in round_.values()]),
        "faults": by_kind(faults),
        "endings": dict(stream.endings.most_common()),
        "tracebacks": stream.tracebacks,
        "problems": problems,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--report", type=Path, help="Also written to this file, as JSON.")
    parser.add_argument("--keep", type=Path, help="A new folder that is kept, with all logs.")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # and all machines with it
    folder = given.keep or Path(tempfile.mkdtemp(prefix="worldpose-soak-"))
    report = soak(given.minutes, given.seed, folder)
    text = json.dumps(report, indent=2)
    print(text)
    if given.report:
        given.report.write_text(text + "\n")
    if given.keep is None:
        shutil.rmtree(folder)
    sys.exit(1 if report["problems"] else 0)


if __name__ == "__main__":
    main()
