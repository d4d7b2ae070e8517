"""The same cases by `worldpose run`, in a process of its own, judged by what it prints."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from .cases import base_of, build
from .judging import (
    COVERAGE,
    DEFECTS,
    MEAN_ERROR,
    REFUSED,
    RIGHT,
    STATED,
    STATED_ERROR,
    UNJUDGED,
    WARNED,
    score,
    visible_truth,
)
from .scene import write

SECONDS = 600


def run_by_command_line(names, seed, template, keep=None):
    """Run a case's match by the command line, and return the outcome."""
    if base_of(names) == "stored":
        return {"class": "not built", "message": "a store's, or a page's"}
    work = Path(tempfile.mkdtemp(prefix="worldpose-fuzz-", dir=keep))
    began = time.monotonic()
    try:
        try:
            draft, base, is_harmless = build(names, seed)
            write(draft, work / "match")
        except Exception as error:
            return {"class": "not built", "message": f"{type(error).__name__}: {error}"}
        command = [sys.executable, "-c", "from flows.cli import main; main()", "run"]
        command += [str(work / "match"), "--project", str(work / "project"), "--workers", "1"]
        command += ["--json", *(["--until", "ingest"] if base == "filmed" else [])]
        for each in draft.overrides:
            command += ["--set", each]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=SECONDS, env=os.environ
            )
        except subprocess.TimeoutExpired:
            return {"class": "hang", "message": " ".join(command)}
        except ValueError as error:  # a NUL cannot be an argument
            return {"class": "not built", "message": str(error)}
        answer = _judge(draft, work, done)
        return answer | {
            "harmless": is_harmless,
            "base": base,
            "seconds": round(time.monotonic() - began, 1),
        }
    finally:
        if keep is None:
            shutil.rmtree(work, ignore_errors=True)


def _judge(draft, work, done):
    said = done.stderr
    message = said[-1500:]
    answer = {"code": done.returncode, "message": message}
    if "Traceback" in said or "Traceback" in done.stdout:
        return answer | {"class": "traceback"}
    if "bug in worldpose" in said:
        return answer | {"class": "internal"}
    if "finite numbers only" in said:
        return answer | {"class": "contract"}
    if done.returncode not in (0, 1, 2, 3, 4):
        return answer | {"class": "crash"}
    if done.returncode in (1, 2):
        stated = re.search(r"(error:|failed|Usage:).*", said, re.S)
        return answer | {"class": REFUSED if stated else "message"}
    warned = "warning:" in said or done.returncode == 4
    if draft.truth is None:
        return answer | {"class": WARNED if warned else UNJUDGED}
    try:
        ended = json.loads(done.stdout)
    except ValueError:
        return answer | {"class": "message", "message": f"no JSON: {done.stdout[-300:]}"}
    coverage, error, _, stated = _score(draft, work, ended["run"])
    answer |= {"coverage": coverage, "error_m": error, "stated_error_m": stated}
    if coverage >= COVERAGE and (error or 0.0) < MEAN_ERROR:
        return answer | {"class": RIGHT}
    if warned:
        return answer | {"class": WARNED}
    is_stated = coverage >= COVERAGE and error <= STATED_ERROR * (stated or 0.0)
    return answer | {"class": STATED if is_stated else "nonsense"}


def _score(draft, work, run_id):
    from worldpose.store.store import Store

    store = Store.open(str(work / "project"))
    (match_id,) = store.matches()
    record = store.run(match_id, run_id)
    spec = store.registration(match_id).spec
    frames = {
        frame
        for clip in spec.clips
        for frame in range(clip.first_frame, clip.first_frame + min(clip.frame_count, 1000))
    }
    truth = {f: people for f, people in visible_truth(draft).items() if f in frames}
    return score(store, match_id, record, truth)


assert not {RIGHT, REFUSED} & set(DEFECTS)
