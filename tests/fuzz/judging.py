"""Runs a case in its own process, and classifies its outcome."""

import faulthandler
import json
import os
import resource
import signal
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from flows.match import task_of
from flows.registering import register
from flows.review.advice import clock_advice
from flows.run_record import RunLog
from flows.settings import parse_overrides, selected_stages
from worldpose.errors import DegenerateError, InputError, InternalError, StoreError, WorldposeError
from worldpose.store.store import Store

CPU_SECONDS, WALL_SECONDS = 60, 300
"""Of a case; the clock of a loaded machine says little."""
MEMORY = 6 << 30
"""Address space of a case [byte], in addition to that of its parent."""
NEAR = 0.5
"""A person is found within this distance [m]."""
COVERAGE, MEAN_ERROR = 0.85, 0.12
"""Least share of people found, and largest mean error of their joints [m], of a right result."""
STATED_ERROR = 2.0
"""Largest mean error in stated standard deviations of a joint's place: what the result says itself
that it does not know is no silent error [1]."""
MIN_JOINTS = 10

RIGHT, WARNED, STATED = "right", "warned", "stated"
REFUSED, UNJUDGED = "refused", "unjudged"
DEFECTS = ("traceback", "internal", "contract", "message", "hang", "crash", "nonsense")
DEFECTS += ("half-written", "harness")
"""Classes of defects: an error that is none of worldpose's; one that says that worldpose is wrong;
an array contract's; a refusal without its parts; too slow; a dead process; a wrong result that
nothing tells of; leftovers in the store; a fault of these tests."""


def forked(work, *arguments):
    """Return the dict of `work` in a forked process, or one of class hang or crash."""
    with tempfile.TemporaryDirectory(prefix="worldpose-fuzz-") as place:
        answer, stack = Path(place) / "answer.json", Path(place) / "stack"
        child = os.fork()
        if not child:
            try:
                _limit(stack)
                answer.write_text(json.dumps(work(*arguments), default=str))
            except BaseException:
                content = {"class": "harness", "message": traceback.format_exc()}
                answer.write_text(json.dumps(content))
            finally:
                os._exit(0)
        deadline, status = time.monotonic() + WALL_SECONDS, None
        while status is None:
            time.sleep(0.02)
            done, found = os.waitpid(child, os.WNOHANG)
            status = found if done else None
            if time.monotonic() > deadline:
                os.killpg(child, signal.SIGKILL)
        said = stack.read_text(errors="replace")[-2000:] if stack.exists() else ""
        if time.monotonic() > deadline or os.WTERMSIG(status) == signal.SIGXCPU:
            return {"class": "hang", "message": said}
        if not answer.exists():
            return {"class": "crash", "message": f"signal {os.WTERMSIG(status)}: {said}"}
        return json.loads(answer.read_text())


def _limit(stack):
    warnings.simplefilter("ignore")
    os.setpgid(0, 0)
    silence, trace = os.open(os.devnull, os.O_RDWR), stack.open("w")
    for number, file in enumerate((silence, silence, trace.fileno())):
        os.dup2(file, number)
    faulthandler.enable(trace)
    faulthandler.register(signal.SIGXCPU, trace, all_threads=False, chain=True)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 5))
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, mapped + MEMORY))


def failure_class(error):
    """Return the class of an exception, refused or a defect, and its message."""
    message = f"{type(error).__name__}: {error}"
    if not isinstance(error, WorldposeError) or isinstance(error, InternalError):
        if isinstance(error, OSError) and error.filename:
            return REFUSED, message
        kind = "internal" if isinstance(error, InternalError) else "traceback"
        return kind, message + "\n" + "".join(traceback.format_exception(error)[-6:])
    if "finite numbers only" in message or ": array " in message:
        return "contract", message
    is_clear = True
    if isinstance(error, InputError):
        parts = (error.where, error.expected, error.found, error.todo)
        is_clear = all(isinstance(part, str) and part.strip() for part in parts)
        is_clear &= len(message) <= 3000
    elif isinstance(error, DegenerateError | StoreError):
        is_clear = len(message) > 40 and "Traceback" not in message
    return (REFUSED if is_clear else "message"), message


def run_match(folder, project, until=None):
    """Run a match's stages without Prefect; return store, match, record and failed units.

    Raises:
        WorldposeError: the match or a setting is refused.
    """
    _open_results_once()
    stages = selected_stages(None, until)
    store = Store.open_or_new(str(project))
    match, _ = register(store, Path(folder))
    log, failures = RunLog.begin(store, match, stages, parse_overrides([], stages), "never"), []

    def compute(stage, units):
        for unit in (each for each in units if not each.published):
            failure = None
            try:
                task_of(stage).fn(unit.work(store.url, match, log.run_id))
            except Exception as error:
                failure = error
                failures.append((unit.name, error))
            yield unit, failure

    return store, match, log.run_stages(compute), failures


def _open_results_once():
    """Keep opened results, which never change: a third of a case's time is to open them."""
    opened, open_result = {}, Store.open_result
    if hasattr(open_result, "of_fuzz"):
        return

    def open_once(store, *place, **options):
        key = (store.url, *place, *options.items())
        if key not in opened:
            opened[key] = open_result(store, *place, **options)
        return opened[key].copy(deep=False)

    open_once.of_fuzz = True
    Store.open_result = open_once


def score(store, match_id, record, truth):
    """Return how a result compares with the truth.

    Returns:
        Share of people found, mean error of their joints [m], people that are not there, and the
        mean of what the result states for that error [m].
    """
    stages = ("body_fitting", "retriangulation", "triangulation")
    last = next((s for s in stages if any(n.startswith(f"{s}/") for n in record.results)), "none")
    expected, found, errors, extra, known = 0, 0, [], 0, []
    for name, key in record.results.items():
        if not name.startswith(f"{last}/"):
            continue
        part = store.open_result(match_id, last, name.split("/")[1], key)
        # Of an isotropic error of this covariance the mean length is 0.92 of the root.
        deviation = 0.92 * np.sqrt(np.trace(part["covariance"].values, axis1=-2, axis2=-1))
        joints = part["joints"].values.astype(float)
        for row, frame in enumerate(part["frame"].values):
            true = truth.get(int(frame), np.empty((0, 17, 3)))
            whole = np.isfinite(joints[row][..., 0]).sum(axis=-1) >= MIN_JOINTS
            expected, extra = expected + len(true), extra + whole.sum()
            if not (whole.any() and len(true)):
                continue
            apart = np.linalg.norm(joints[row][whole][:, None] - true[None], axis=-1)
            distance = np.nanmean(apart, axis=-1)
            rows, columns = linear_sum_assignment(np.minimum(distance, 1e3))
            near = distance[rows, columns] < NEAR
            found, extra = found + near.sum(), extra - near.sum()
            errors += distance[rows, columns][near].tolist()
            known += np.nanmean(deviation[row][whole][rows], axis=-1)[near].tolist()
    mean = [float(np.mean(values)) if values else None for values in (errors, known)]
    return found / max(expected, 1), mean[0], int(extra), mean[1]


def visible_truth(draft, clips):
    """Frame to joints (people, 17, 3) [m] of people that two cameras see, in the clips."""
    views = np.zeros(draft.people.shape[:2], dtype=int)
    for name, camera in draft.cameras.items():
        if name in draft.seen:
            seen = np.isfinite(camera.pixels(draft.people)[..., 0]).sum(axis=-1)
            views += seen >= MIN_JOINTS
    return {
        frame: draft.truth[frame][views[frame] >= 2]
        for frame in range(len(draft.people))
        if any(c.first_frame <= frame < c.first_frame + c.frame_count for c in clips)
    }


def judge(draft, store, match, record, failures):
    """The outcome of a run that was recorded."""
    said = [*record.warnings, *clock_advice(record.figures, match.folder.spec)]
    empty = [name for name, figures in record.figures.items() if figures.get("joints") == 0]
    said += [f"{name} found no person" for name in empty]
    answer = {"state": record.state, "warnings": said[:5]}
    classes = [(name, *failure_class(error)) for name, error in failures]
    for name, kind, message in sorted(classes, key=lambda each: each[1] not in DEFECTS):
        if kind in DEFECTS or record.state in ("failed", "partial"):
            return answer | {"class": kind, "message": f"{name}: {message}"}
    if draft.truth is None:
        return answer | {"class": WARNED if said else UNJUDGED}
    truth = visible_truth(draft, match.folder.spec.clips)
    coverage, error, extra, stated = score(store, match.match_id, record, truth)
    answer["message"] = f"coverage {coverage:.2f}, error {error}, {extra} extra, stated {stated}"
    people = sum(map(len, truth.values()))
    is_found = (coverage >= COVERAGE or not people) and extra <= 0.3 * max(people, 1)
    if is_found and (error or 0.0) < MEAN_ERROR:
        return answer | {"class": RIGHT}
    if said:
        return answer | {"class": WARNED}
    is_stated = is_found and error <= STATED_ERROR * (stated or 0.0)
    return answer | {"class": STATED if is_stated else "nonsense"}


def leftovers(project):
    """Leftovers that a finished or refused run must not have in a project."""
    found = [str(path) for path in (project / "staging").rglob("*") if path.is_file()]
    found += map(str, project.glob("runs/*/*.open.json"))
    keys = {path.parent for path in project.glob("results/*/*/*/*/manifest.json")}
    return found + [str(path) for path in project.glob("results/*/*/*/*") if path not in keys]
