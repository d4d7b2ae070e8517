"""How long units take and may take, and what a run tells a tracer."""

import os
import re
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import TINY, succeed

from flows.method import METHOD
from flows.results import timings
from flows.service import plan
from flows.service.plan import parse_schedules
from flows.settings import DEFAULT_MINUTES, parse_time_limits, seconds_of
from tasks import tracing
from worldpose.errors import UsageError
from worldpose.store.store import Store

BEGUN = datetime(2026, 5, 1, 12, tzinfo=UTC)


class Told:
    """A store of one run: unit to end time since the run's start, and duration [s]."""

    units = {
        "ingest/a": (12.0, 2.0),
        "ingest/b": (13.0, 2.0),
        "tracking/c1": (20.0, 5.0),
        "tracking/c2": (20.0, 4.0),
    }

    def run(self, match, run):
        results = dict.fromkeys(self.units, "key")
        executed = tuple(self.units)
        return SimpleNamespace(
            match_id=match,
            run_id=run,
            seconds=22.0,
            started_at=BEGUN,
            executed=executed,
            results=results,
        )

    def manifest(self, match, stage, unit, key):
        end, seconds = self.units[f"{stage}/{unit}"]
        files = (SimpleNamespace(size=700), SimpleNamespace(size=50))
        at = BEGUN + timedelta(seconds=end)
        return SimpleNamespace(created_at=at, seconds=seconds, files=files)


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


@pytest.mark.parametrize("text", ["0", "-3", "inf", "nan", "soon", "tracks=3", "=3", "tracking="])
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
    with pytest.raises(UsageError, match="twice"):
        parse_schedules(["reprocess=0 3 * * * UTC", "reprocess=0 4 * * * UTC"])


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
    shutil.copy(zones.parent / "UTC", local)
    assert zone() == "UTC"
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


@pytest.fixture
def collector(webhook):
    """A server that takes OTLP over HTTP, and the spans that it got."""
    pytest.importorskip("opentelemetry.sdk")
    service = pytest.importorskip("opentelemetry.proto.collector.trace.v1.trace_service_pb2")

    def spans():
        for _, body in webhook.posted:
            for resource in service.ExportTraceServiceRequest.FromString(body).resource_spans:
                for scope in resource.scope_spans:
                    yield from ((scope.scope.name, span) for span in scope.spans)

    return webhook.base, spans


@pytest.mark.slow
def test_spans_of_prefect_and_of_units_are_one_trace(collector, tiny, tmp_path):
    base, spans = collector
    asked = {"OTEL_EXPORTER_OTLP_ENDPOINT": base, "OTEL_SERVICE_NAME": "lab"}
    succeed("run", tiny, "--project", tmp_path / "project", environment=asked)
    found = list(spans())
    record = Store.open(str(tmp_path / "project")).run(TINY)
    assert len({span.trace_id for _, span in found}) == 1
    own = {span.name: span for scope, span in found if scope == "worldpose"}
    prefect = {span.name: span for scope, span in found if scope == "prefect"}
    units = {name for name in own if not name.startswith("stage ")}
    assert units == set(record.executed)
    (flow,) = [span for span in prefect.values() if not span.parent_span_id]
    for unit in units:
        stage = own[f"stage {unit.partition('/')[0]}"]
        assert own[unit].parent_span_id == stage.span_id
        assert stage.parent_span_id == flow.span_id
        assert flow.start_time_unix_nano <= own[unit].start_time_unix_nano
        assert own[unit].end_time_unix_nano <= flow.end_time_unix_nano
    tasks = [span for span in prefect.values() if span is not flow]
    assert len(tasks) == len(units)
    assert {span.parent_span_id for span in tasks} == {flow.span_id}


def test_a_missing_exporter_is_one_line_and_stops_nothing(monkeypatch, caplog):
    monkeypatch.setenv("OTEL_TRACES_EXPORTER", "of_nobody")
    tracing.start_tracing()
    with tracing.stage_span("ingest", 1):
        pass
    (line,) = caplog.messages
    assert line.startswith("no traces")
