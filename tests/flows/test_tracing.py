"""Traces of a run: Prefect's spans and ours in one trace, sent to an OTLP collector."""

import pytest
from command_line import TINY, succeed

from tasks import tracing
from worldpose.store.store import Store


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
