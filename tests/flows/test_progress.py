"""Progress reports of a running run."""

import io
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import TINY, WORLDPOSE, succeed, worldpose
from rich.console import Console

from data_contracts.review import DeletedDetection
from flows import progress, run_record
from flows.cli import console
from flows.match_state import match_state
from flows.method import METHOD
from flows.progress import Reporter
from flows.registering import open_match
from flows.results import timings
from flows.review.verdicts import correct
from flows.run_plan import plan_run
from flows.run_record import UNIT_SECONDS, AtWorkError, alone_with, expected_work, latest_run
from flows.service import plan
from flows.service.plan import parse_schedules
from flows.settings import DEFAULT_MINUTES, parse_time_limits, seconds_of
from flows.web.app_context import read_progress
from tasks import tracing
from worldpose.errors import UsageError
from worldpose.store.documents import seal
from worldpose.store.runs import alone, identify_process
from worldpose.store.store import Store


@pytest.fixture
def clock(monkeypatch):
    """The monotonic clock, which a test sets."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_percent_and_time_left_of_stage_and_run_follow_the_expected_work(clock):
    heard = Reporter()
    heard.run_planned({"ingest": 10.0, "tracking": 30.0})
    heard.stage_started("registration", "all there", units=2, missing=0)
    assert str(heard.run_progress) == "0 %"  # nothing was to be computed so far
    heard.stage_started("ingest", "take in", units=4, missing=4)
    assert heard.run_progress.share == 0.0 and heard.run_progress.seconds_left is None
    clock[0] += 1.0  # of the 2.5 s of the first unit
    assert heard.run_progress.share == pytest.approx(1.0 / 40.0)
    clock[0] += 4.0  # it is late
    assert heard.run_progress.share == pytest.approx(2.0 / 40.0)
    assert heard.run_progress.seconds_left == pytest.approx(38.0 * 65.0 / 62.0)
    heard.unit_done("ingest/a", 5.0, {})
    assert (heard.stage_progress.share, heard.stage_progress.seconds_left) == (0.25, 15.0)
    assert heard.run_progress.share == pytest.approx(2.5 / 40.0)
    # 2.5 s of expected work took 5 s: 60 s of the same would count as much as the expectation.
    assert heard.run_progress.seconds_left == pytest.approx(37.5 * 65.0 / 62.5)
    for unit in "bcd":
        heard.unit_done(f"ingest/{unit}", 5.0, {})
    heard.stage_started("static_calibration", "all there", units=3, missing=0)
    assert heard.run_progress.share == 0.25
    clock[0] += 15.0
    heard.stage_started("tracking", "who is who", units=2, missing=2)
    heard.unit_failed("tracking/a", "why")
    assert heard.run_progress.share == pytest.approx(25.0 / 40.0)
    assert heard.run_progress.seconds_left == pytest.approx(15.0 * 80.0 / 85.0)
    assert str(heard.run_progress) == "62 % 14 s"
    heard.unit_done("tracking/b", 5.0, {})
    assert str(heard.run_progress) == str(heard.stage_progress) == "100 %"


def test_expected_work_comes_from_the_latest_run(store):
    match, latest = open_match(store, TINY), latest_run(store, TINY)
    units = [
        each
        for each in plan_run(store, match, {"tracking": {"gate_m": 0.7}})
        if each.name.startswith("tracking/")
    ]
    key = latest.results["tracking/clip"]
    seconds = store.manifest(TINY, "tracking", "clip", key).seconds
    assert expected_work(store, match, units, latest) == {"tracking": pytest.approx(seconds)}
    first = UNIT_SECONDS["tracking"] * 1.2 / 20.0 * 6.0 / 16.0  # 1.2 s in six cameras
    expected = {"tracking": pytest.approx(3.0 * first)}
    assert expected_work(store, match, units * 3, None) == expected


def test_a_second_run_of_a_match_at_work_is_refused_at_once(project_copy):
    store = Store.open(str(project_copy))
    other = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    run_id = store.reserve_run(TINY)
    (mine,) = store.unfinished_runs(TINY)
    with alone_with(store, TINY):
        pass  # it is this process's own
    path = next(project_copy.rglob(f"{run_id}.open.json"))
    said = f"found run {run_id}, process {other.pid}, since"
    try:
        path.unlink()
        named = {"pid": other.pid, "process": identify_process(other.pid)}
        theirs = mine.model_copy(update={**named, "started_at": datetime.now(UTC)})
        store.blobs.put_new(str(path.relative_to(project_copy)), seal(theirs))
        answer = worldpose("run", TINY, "--project", project_copy)
        assert (answer.code, answer.err.count("\n"), said in answer.err) == (1, 1, True), answer.err
        deleted = DeletedDetection(camera="cam01", frame=5, detection=0)
        correct(store, open_match(store, TINY), [deleted], who="Ada", why="a shadow")
        answer = worldpose("reprocess", TINY, "--project", project_copy)
        assert (answer.code, answer.out.count(f"{TINY}: at work")) == (0, 1)
        assert said in " ".join(answer.out.split())
        # A later run ended meanwhile, as two could once begin together.
        later = store.run(TINY).model_copy(update={"run_id": store.reserve_run(TINY)})
        store.finish_run(later)
        assert match_state(store, open_match(store, TINY)).name == "running"
    finally:
        other.communicate(b"\n")
    with alone_with(store, TINY):
        pass  # its process has ended


@pytest.mark.timeout(60)
@pytest.mark.parametrize("is_known", [False, True])
def test_a_wait_for_another_run_ends_and_names_who_runs_it(is_known, tmp_path, monkeypatch):
    store, since = Store.create(tmp_path / "project"), datetime(2026, 1, 2, 3, 4, tzinfo=UTC)
    others = (SimpleNamespace(run_id="0003", pid=7, started_at=since),) * is_known
    monkeypatch.setattr(run_record, "MOST_SECONDS", 0.1, raising=False)
    monkeypatch.setattr(run_record, "LOOK_SECONDS", 0.02)
    monkeypatch.setattr(run_record, "runs_at_work", lambda *_: others)
    said = r"0003, process 7, since 2026-01-02 03:04:00 UTC" if is_known else r"since before 2.*UTC"
    wait = alone_with(store, "m", wait=True)
    with alone(store.blobs, "match-m", wait=False), pytest.raises(AtWorkError, match=said):
        wait.__enter__()


def test_ctrl_c_says_what_is_kept_and_leaves_neither_warning_nor_traceback(server, tiny, tmp_path):
    main, end = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    environment.pop("PREFECT_API_URL")
    command = [*WORLDPOSE, "run", str(tiny), "--project", str(tmp_path / "project")]
    process = subprocess.Popen(
        command, stdin=end, stdout=end, stderr=end, env=environment, start_new_session=True
    )
    os.close(end)
    said = b""
    try:
        while b"ingest/cam00" not in said:
            said += os.read(main, 65536)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: all processes of the group
        while True:
            try:
                said += os.read(main, 65536)
            except OSError:  # every process that had the terminal has ended
                break
        assert process.wait(60) == 130
    finally:
        process.kill()
        os.close(main)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said.decode())
    last = text.replace("\r", "\n").rstrip().splitlines()[-1]
    told = r"interrupted: \d+ new results? (is|are) kept; the same command continues"
    assert re.fullmatch(told, last), text
    kept = int(last.split()[1])
    found = [path.parent.name for path in (tmp_path / "project").rglob("manifest.json")]
    assert len(found) >= kept >= 1
    assert "working" not in last and "Traceback" not in text and "leaked" not in text
    succeed("run", tiny, "--project", tmp_path / "project", "--until", "ingest")


def test_pages_read_what_the_command_line_prints(clock, monkeypatch):
    printed = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=printed, width=80))
    reporter = console.ConsoleReporter()
    reporter.run_planned({"static_calibration": 10.0, "tracking": 30.0})
    assert read_progress(printed.getvalue()) == {"lines": [], "percent": 0.0, "stage": ""}
    reporter.stage_started("static_calibration", "find cameras", units=2, missing=2)
    assert read_progress(printed.getvalue())["lines"] == ["static calibration"]
    for unit in "ab":
        clock[0] += 5.0
        reporter.unit_done(f"static_calibration/cam0{unit}", 5.0, {})
    reporter.stage_started("tracking", "who is who", units=2, missing=2)
    clock[0] += 15.0
    reporter.unit_done("tracking/clip", 15.0, {})
    reporter.unit_waits("tracking/clip", ["50 % of 3.0 s are beyond the limit 5 %"])
    progress = {"lines": ["tracking, 15 s left of the run"], "percent": 62.0, "stage": "tracking"}
    assert read_progress(printed.getvalue()) == progress
    reporter.unit_done("tracking/other", 15.0, {})
    progress = {"lines": ["tracking"], "percent": 100.0, "stage": "tracking"}
    assert read_progress(printed.getvalue()) == progress


BEGUN = datetime(2026, 5, 1, 12, tzinfo=UTC)


UNITS = {
    "ingest/a": (12.0, 2.0),
    "ingest/b": (13.0, 2.0),
    "tracking/c1": (20.0, 5.0),
    "tracking/c2": (20.0, 4.0),
}
"""End time since the run's start, and duration [s]."""


class Told:
    """A store of one run of these units."""

    def run(self, match, run):
        about = {"match_id": match, "run_id": run, "seconds": 22.0, "started_at": BEGUN}
        return SimpleNamespace(**about, executed=tuple(UNITS), results=dict.fromkeys(UNITS, "key"))

    def manifest(self, match, stage, unit, key):
        end, seconds = UNITS[f"{stage}/{unit}"]
        at = BEGUN + timedelta(seconds=end)
        return SimpleNamespace(created_at=at, seconds=seconds, files=(SimpleNamespace(size=50),))


def test_what_elapsed_counts_units_side_by_side_once():
    found = timings.run_time(Told(), "m", "0001")
    ingest, tracking = found.stages
    assert (ingest.stage, ingest.units, ingest.work, ingest.longest) == ("ingest", 2, 4.0, 2.0)
    # 10 to 13 s of the run; then 15 to 20 s.
    assert (ingest.elapsed, tracking.elapsed) == (3.0, 5.0)
    assert (tracking.work, found.start) == (9.0, 10.0)
    # 13 to 15 s, and 20 to 22 s.
    assert found.between == pytest.approx(4.0)
    assert found.seconds == found.start + found.between + ingest.elapsed + tracking.elapsed


def test_a_number_is_for_every_stage_and_one_with_a_name_for_that():
    assert seconds_of("tracking", {}) == 60.0 * DEFAULT_MINUTES
    limits = parse_time_limits(["30", "detection=120"])
    assert {stage.name for stage in METHOD} == limits.keys()
    assert (seconds_of("tracking", limits), seconds_of("detection", limits)) == (1800.0, 7200.0)
    assert parse_time_limits(["ingest=0.5"]) == {"ingest": 0.5}


@pytest.mark.parametrize("text", ["-3", "nan", "soon", "tracks=3", "=3", "tracking="])
def test_what_is_no_limit_is_refused(text):
    with pytest.raises(UsageError, match="--time-limit"):
        parse_time_limits([text])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reprocess=0 3 * *", "Invalid cron string"),
        ("reprocess=0 3 * * * Mars/X", "Invalid timezone"),
        ("match=0 3 * * *", "'match'"),
        ("0 3 * * *", "'0 3"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused_before_anything_starts(text, said):
    with pytest.raises(UsageError, match=re.escape(said)):
        parse_schedules([text])


def test_a_schedule_without_a_zone_has_that_of_the_machine_or_is_refused(tmp_path, monkeypatch):
    zones = Path("/usr/share/zoneinfo/Europe")
    if not zones.exists():
        pytest.skip("no time zones are installed")
    local, told = tmp_path / "localtime", tmp_path / "timezone"
    monkeypatch.setattr(plan, "LOCALTIME", local)
    monkeypatch.setattr(plan, "TIMEZONE", told)
    monkeypatch.delenv("TZ", raising=False)

    def zone():
        return parse_schedules(["reprocess=0 3 * * *"])["reprocess"].timezone

    assert zone() == "UTC"  # a slim image
    shutil.copy(zones / "Berlin", local)
    for wrong in (None, "Etc/UTC\n", "no zone\n"):
        if wrong:
            told.write_text(wrong)
        with pytest.raises(UsageError, match=re.escape("`0 3 * * * Europe/Berlin`")):
            zone()
    told.write_text("Europe/Berlin\n")
    assert zone() == "Europe/Berlin"
    told.unlink()
    local.unlink()
    local.symlink_to(zones / "Lisbon")
    assert zone() == os.path.realpath(zones / "Lisbon").partition("zoneinfo/")[2]


@pytest.mark.slow
def test_spans_of_prefect_and_of_units_are_one_trace(webhook, tiny, tmp_path):
    pytest.importorskip("opentelemetry.sdk")
    service = pytest.importorskip("opentelemetry.proto.collector.trace.v1.trace_service_pb2")
    asked = {"OTEL_EXPORTER_OTLP_ENDPOINT": webhook.base, "OTEL_SERVICE_NAME": "lab"}
    succeed("run", tiny, "--project", tmp_path / "project", environment=asked)
    found = [
        (scope.scope.name, span)
        for _, body in webhook.posted
        for resource in service.ExportTraceServiceRequest.FromString(body).resource_spans
        for scope in resource.scope_spans
        for span in scope.spans
    ]
    record = Store.open(str(tmp_path / "project")).run(TINY)
    assert len({span.trace_id for _, span in found}) == 1
    own = {span.name: span for scope, span in found if scope == "worldpose"}
    prefect = [span for scope, span in found if scope == "prefect"]
    units = {name for name in own if not name.startswith("stage ")}
    assert units == set(record.executed)
    (flow,) = [span for span in prefect if not span.parent_span_id]
    for unit in units:
        stage = own[f"stage {unit.partition('/')[0]}"]
        assert own[unit].parent_span_id == stage.span_id
        assert stage.parent_span_id == flow.span_id
        assert flow.start_time_unix_nano <= own[unit].start_time_unix_nano
        assert own[unit].end_time_unix_nano <= flow.end_time_unix_nano
    tasks = [span for span in prefect if span is not flow]
    assert len(tasks) == len(units)
    assert {span.parent_span_id for span in tasks} == {flow.span_id}


def test_a_missing_exporter_is_one_line_and_stops_nothing(monkeypatch, caplog):
    monkeypatch.setenv("OTEL_TRACES_EXPORTER", "of_nobody")
    tracing.start_tracing()
    with tracing.stage_span("ingest", 1):
        pass
    (line,) = caplog.messages
    assert line.startswith("no traces")
