"""Runs one case in its own process, and classifies its outcome."""

import contextlib
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

CPU_SECONDS = 60
"""Of a case; the clock of a loaded machine says little."""
WALL_SECONDS = 300
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
DEFECTS = (
    "traceback",
    "internal",
    "contract",
    "message",
    "hang",
    "crash",
    "nonsense",
    "half-written",
)
"""Classes of defects: an error that is none of worldpose's; one that says that worldpose is wrong;
an array contract's; a refusal without its parts; too slow; a dead process; a wrong result that
nothing tells of; leftovers in the store."""


def forked(work, *arguments):
    """Return the dict of `work` in a forked process, or one of class hang or crash."""
    read, write = os.pipe()
    started = time.monotonic()
    child = os.fork()
    if not child:
        os.close(read)
        status = 1
        try:
            _limit()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                answer = work(*arguments)
            with os.fdopen(write, "wb") as pipe:
                pipe.write(json.dumps(answer, default=str).encode())
            status = 0
        except BaseException:
            with contextlib.suppress(OSError), os.fdopen(write, "wb", closefd=False) as pipe:
                problem = traceback.format_exc()
                pipe.write(json.dumps({"class": "harness", "message": problem}).encode())
        finally:
            os._exit(status)
    os.close(write)
    return _answer_of(child, read, started)


def _stack_file(process):
    return Path(tempfile.gettempdir()) / f"worldpose-fuzz-stack-{process}"


def _limit():
    os.setpgid(0, 0)
    os.close(0)
    log = Path("/dev/null").open("w")  # noqa: SIM115 - lives as long as the process
    os.dup2(log.fileno(), 1)
    trace = _stack_file(os.getpid()).open("w")
    os.dup2(trace.fileno(), 2)
    faulthandler.enable(trace)
    faulthandler.register(signal.SIGXCPU, trace, all_threads=False, chain=True)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 5))
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, mapped + MEMORY))


def _answer_of(child, read, started):
    os.set_blocking(read, False)
    content, killed = b"", False
    while True:
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(read, 1 << 16):
                content += piece
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() - started > WALL_SECONDS:
            killed = True
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.02)
    with contextlib.suppress(BlockingIOError):
        while piece := os.read(read, 1 << 16):
            content += piece
    os.close(read)
    trace = _stack_file(child)
    stack = trace.read_text(errors="replace") if trace.exists() else ""
    trace.unlink(missing_ok=True)
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if killed or number == signal.SIGXCPU:
        answer = {"class": "hang", "message": _place(stack)}
    elif number or not content:
        answer = {"class": "crash", "message": f"signal {number}: {stack[-2000:]}"}
    else:
        answer = json.loads(content)
    answer["seconds"] = round(time.monotonic() - started, 2)
    answer["cpu_seconds"] = round(usage.ru_utime + usage.ru_stime, 2)
    answer["megabytes"] = usage.ru_maxrss >> 10
    return answer


def _place(stack):
    return " < ".join(
        line.strip().replace("File ", "") for line in stack.splitlines() if "File" in line
    )[:1500]


def failure_class(error):
    """Return the class of an exception, refused or a defect, and its message."""
    from worldpose.errors import DegenerateError, InputError, StoreError, WorldposeError

    message = f"{type(error).__name__}: {error}"
    if not isinstance(error, WorldposeError):
        if isinstance(error, OSError) and error.filename:
            return "refused", message
        return "traceback", message + "\n" + "".join(traceback.format_exception(error)[-6:])
    if type(error).__name__ == "InternalError":
        return "internal", message + "\n" + "".join(traceback.format_exception(error)[-6:])
    if "finite numbers only" in message or ": array " in message:
        return "contract", message
    if isinstance(error, InputError):
        parts = (error.where, error.expected, error.found, error.todo)
        if not all(isinstance(part, str) and part.strip() for part in parts):
            return "message", message
        if len(message) > 3000:
            return "message", message
        return "refused", message
    if isinstance(error, DegenerateError | StoreError):
        is_plain = len(message) > 40 and "Traceback" not in message
        return ("refused" if is_plain else "message"), message
    return "refused", message


def run_match(folder, project, until=None):
    """Run a match's stages without Prefect; return store, match, record and failed units.

    Raises:
        WorldposeError: the match or a setting is refused.
    """
    from flows.match import task_of
    from flows.registering import register
    from flows.run_record import RunLog
    from flows.settings import parse_overrides, selected_stages
    from worldpose.store.store import Store

    _open_results_once(Store)
    stages = selected_stages(None, until)
    settings = parse_overrides([], stages)
    store = Store.open_or_new(str(project))
    match, _ = register(store, Path(folder))
    log = RunLog.begin(store, match, stages, settings, "never")
    failures = []

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


def _open_results_once(store_kind):
    """Keep opened results for the rest of this process: a third of a case's time is to open them.

    Results never change; cases by the command line open them each time.
    """
    opened, open_result = {}, store_kind.open_result
    if hasattr(open_result, "of_fuzz"):
        return

    def open_once(store, *place, **options):
        key = (store.url, *place, *options.items())
        if key not in opened:
            opened[key] = open_result(store, *place, **options)
        return opened[key].copy(deep=False)

    open_once.of_fuzz = True
    store_kind.open_result = open_once


def warnings_said(record, match):
    """Return the warnings that `worldpose run` prints after a run."""
    from flows.review.advice import clock_advice

    said = [*record.warnings, *clock_advice(record.figures, match.folder.spec)]
    for name, figures in record.figures.items():
        if figures.get("joints") == 0:
            said.append(f"{name} found no person")
    return said


def score(store, match_id, record, truth):
    """Return how a result compares with the truth.

    Returns:
        Share of people found, mean error of their joints [m], people that are not there, and the
        mean of what the result states for that error [m].
    """
    joints, frames, stated = None, None, None
    for stage in ("body_fitting", "retriangulation", "triangulation"):
        names = [name for name in record.results if name.startswith(f"{stage}/")]
        if names:
            parts = [
                store.open_result(match_id, stage, n.split("/")[1], record.results[n])
                for n in names
            ]
            joints = [part["joints"].values.astype(float) for part in parts]
            frames = [part["frame"].values for part in parts]
            # Of an isotropic error of this covariance the mean length is 0.92 of the root.
            stated = [
                0.92 * np.sqrt(np.trace(part["covariance"].values, axis1=-2, axis2=-1))
                for part in parts
            ]
            break
    if joints is None:
        return 0.0, None, 0, None
    expected, found, errors, extra, known = 0, 0, [], 0, []
    for there, numbers, deviation in zip(joints, frames, stated, strict=True):
        for row, frame in enumerate(numbers):
            true = truth.get(int(frame), np.empty((0, 17, 3)))
            expected += len(true)
            whole = np.isfinite(there[row][..., 0]).sum(axis=-1) >= MIN_JOINTS
            people = there[row][whole]
            if not len(people):
                continue
            extra += len(people)
            if not len(true):
                continue
            distance = np.nanmean(np.linalg.norm(people[:, None] - true[None], axis=-1), axis=-1)
            rows, columns = linear_sum_assignment(np.minimum(distance, 1e3))
            near = distance[rows, columns]
            found += int((near < NEAR).sum())
            extra -= int((near < NEAR).sum())
            errors += near[near < NEAR].tolist()
            known += np.nanmean(deviation[row][whole][rows], axis=-1)[near < NEAR].tolist()
    mean = [float(np.mean(values)) if values else None for values in (errors, known)]
    return found / max(expected, 1), mean[0], extra, mean[1]


def visible_truth(draft):
    """Frame to joints (people, 17, 3) [m] of people that two cameras see."""
    truth = {}
    views = np.zeros(draft.people.shape[:2], dtype=int)
    for name, camera in draft.cameras.items():
        if name in draft.seen:
            seen = np.isfinite(camera.pixels(draft.people)[..., 0]).sum(axis=-1)
            views += seen >= MIN_JOINTS
    for frame in range(len(draft.people)):
        truth[frame] = draft.truth[frame][views[frame] >= 2]
    return truth


def judge(draft, store, match, record, failures):
    """The outcome of a run that was recorded."""
    said = warnings_said(record, match)
    answer = {"state": record.state, "warnings": said[:5]}
    if failures:
        classes = [(name, *failure_class(error)) for name, error in failures]
        worst = next((each for each in classes if each[1] in DEFECTS), None)
        if worst is not None:
            return answer | {"class": worst[1], "message": f"{worst[0]}: {worst[2]}"}
        answer["message"] = f"{classes[0][0]}: {classes[0][2]}"
        if record.state in ("failed", "partial"):
            return answer | {"class": REFUSED}
    if draft.truth is None:
        return answer | {"class": WARNED if said else UNJUDGED}
    truth = visible_truth(draft)
    frames = {
        frame
        for clip in match.folder.spec.clips
        for frame in range(clip.first_frame, min(clip.first_frame + clip.frame_count, 10**6))
    }
    truth = {frame: people for frame, people in truth.items() if frame in frames}
    coverage, error, extra, stated = score(store, match.match_id, record, truth)
    answer |= {"coverage": round(coverage, 3), "error_m": error, "extra": extra}
    answer["stated_error_m"] = stated
    people = sum(map(len, truth.values()))
    is_found = (coverage >= COVERAGE or not people) and extra <= 0.3 * max(people, 1)
    if is_found and (error or 0.0) < MEAN_ERROR:
        return answer | {"class": RIGHT}
    if said:
        return answer | {"class": WARNED}
    if is_found and error <= STATED_ERROR * (stated or 0.0):
        return answer | {"class": STATED}
    return answer | {
        "class": "nonsense",
        "message": f"coverage {coverage:.2f}, error {error}, {extra} extra",
    }


def leftovers(project):
    """Leftovers that a finished or refused run must not have in a project."""
    root = Path(project)
    found = [str(path) for path in (root / "staging").rglob("*") if path.is_file()]
    found += [str(path) for path in root.glob("runs/*/*.open.json")]
    keys = {path.parent for path in root.glob("results/*/*/*/*/manifest.json")}
    found += [str(path) for path in root.glob("results/*/*/*/*") if path not in keys]
    return found
