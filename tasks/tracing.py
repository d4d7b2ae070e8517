"""OpenTelemetry traces of runs, exported as the usual OTEL_* variables say.

Prefect makes a span of each flow and task, and carries the trace from the flow to the workers. Our
spans lie below the flow's: one for each stage, and one for each computed unit. Unless one of
these variables names an exporter, tracing is disabled and its packages are not imported.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime, timedelta
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from opentelemetry import trace
    from opentelemetry.context import Context

LOG: Final = logging.getLogger("worldpose.run")
ENDPOINTS: Final = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
PROTOCOLS: Final = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
FLUSH_MS: Final = 5000
"""Maximum time for sending the last spans of a process [ms]."""


def is_traced() -> bool:
    """Return whether the environment names an exporter of traces."""
    exporter = os.environ.get("OTEL_TRACES_EXPORTER", "")
    if exporter == "none" or os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true":
        return False
    return bool(exporter) or any(os.environ.get(name) for name in ENDPOINTS)


def start_tracing() -> None:
    """Export the spans of this process from now on; a second call does nothing."""
    if not is_traced():
        return
    from opentelemetry import trace

    try:
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        LOG.warning("no traces: OTEL_* names an exporter, but the extra `tracing` is not installed")
        return
    if isinstance(trace.get_tracer_provider(), TracerProvider):
        return
    os.environ.setdefault("OTEL_SERVICE_NAME", "worldpose")
    provider = TracerProvider()
    get_tracer = provider.get_tracer

    def get_flow_tracer(
        name: str,
        version: str | None = None,
        schema_url: str | None = None,
        attributes: dict[str, Any] | None = None,
    ) -> Any:  # noqa: ANN401 - it stands for a tracer
        return _FlowTracer(get_tracer(name, version, schema_url, attributes))

    provider.get_tracer = get_flow_tracer
    for name in os.environ.get("OTEL_TRACES_EXPORTER", "otlp").split(","):
        asked = name.strip() or "otlp"
        if asked == "otlp":
            protocols = [os.environ[each] for each in PROTOCOLS if os.environ.get(each)]
            asked = "otlp_proto_grpc" if protocols[:1] == ["grpc"] else "otlp_proto_http"
        found = list(entry_points(group="opentelemetry_traces_exporter", name=asked))
        if not found:
            LOG.warning("no traces to %s: its exporter is not installed", asked)
            continue
        provider.add_span_processor(BatchSpanProcessor(found[0].load()()))
    trace.set_tracer_provider(provider)


class _FlowTracer:
    """Tracer that puts a span without a parent below the flow run of the current context.

    On a worker, Prefect takes a task for its own parent, and would begin a trace for each.
    """

    def __init__(self, tracer: trace.Tracer) -> None:
        self._tracer = tracer

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the tracer has
        return getattr(self._tracer, name)

    def start_span(
        self,
        name: str,
        context: Context | None = None,
        **given: Any,  # noqa: ANN401
    ) -> trace.Span:
        """Start a span."""
        from opentelemetry import propagate, trace
        from prefect.context import FlowRunContext

        flow = FlowRunContext.get()
        has_parent = context is not None or trace.get_current_span().get_span_context().is_valid
        if not has_parent and flow is not None and flow.flow_run is not None:
            label = flow.flow_run.labels.get("__OTEL_TRACEPARENT")
            if label is not None:
                context = propagate.extract({"traceparent": str(label)})
        return self._tracer.start_span(name, context=context, **given)


def flush_spans() -> None:
    """Send the spans of this process that are not sent yet."""
    if not is_traced():
        return
    from opentelemetry import trace

    flush = getattr(trace.get_tracer_provider(), "force_flush", None)
    if flush is not None:
        flush(FLUSH_MS)


@contextmanager
def stage_span(stage: str, units: int) -> Iterator[None]:
    """Make a span of the enclosed stage, below the current one."""
    if not is_traced():
        yield
        return
    from opentelemetry import trace

    tracer = trace.get_tracer("worldpose")
    given: dict[str, str | int] = {"worldpose.stage": stage, "worldpose.units": units}
    with tracer.start_as_current_span(f"stage {stage}", attributes=given):
        yield


def add_unit_span(
    unit: str, key: str, end: datetime, seconds: float, figures: Mapping[str, float]
) -> None:
    """Add the span of a computed unit, `stage/unit`, below the current one.

    It was published at its end, after these seconds [s]; metrics of single cameras are left out.
    """
    if not is_traced():
        return
    from opentelemetry import trace

    metrics = {f"worldpose.figure.{name}": value for name, value in figures.items()}
    span = trace.get_tracer("worldpose").start_span(
        unit,
        attributes={
            "worldpose.unit": unit,
            "worldpose.key": key,
            **{name: value for name, value in metrics.items() if name.count(".") == 2},
        },
        start_time=_nanoseconds(end - timedelta(seconds=seconds)),
    )
    span.end(_nanoseconds(end))


def _nanoseconds(at: datetime) -> int:
    return round(at.timestamp() * 1e9)
