"""OpenTelemetry metrics during a run, and a span for each recording."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field

from mosaico_ingest.errors import IngestError
from mosaico_ingest.report.events import (
    DOWNSAMPLING,
    ContractEvaluated,
    Event,
    Rejected,
    RunFinished,
    RunStarted,
    Timed,
    TopicClosed,
    TopicProgress,
)
from mosaico_ingest.report.parts import ContractResult, Step
from mosaico_ingest.version import __version__

try:
    from opentelemetry.exporter.otlp.proto.http.metric_exporter import OTLPMetricExporter
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.sdk.metrics.export import PeriodicExportingMetricReader
    from opentelemetry.sdk.resources import OTELResourceDetector, Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor
    from opentelemetry.trace import Status, StatusCode
except ImportError as missing:
    raise IngestError(
        "OpenTelemetry is not installed", hint="pip install 'mosaico-ingest[otel]'"
    ) from missing

_NAME = "mosaico_ingest"
_MAX_FAILURES = 20
"""Failed expectations in the attributes of a span."""
_SERVICE = "mosaico-ingest"


@dataclass(slots=True)
class _Recording:
    sequence: str = ""
    destination: str = ""
    source_bytes: int = 0
    seconds: dict[Step, float] = field(default_factory=dict[Step, float])
    read: int = 0
    rejected: int = 0
    contract: ContractResult | None = None
    written: dict[str, int] = field(default_factory=lambda: defaultdict[str, int](int))
    sharing: frozenset[str] = frozenset()
    """The topics that share their messages with another topic."""


class Telemetry:
    """A batch observer that sends to the collector in OpenTelemetry's standard environment variables (`OTEL_…`).

    Written rows are counted when their recording ends, because an early end may discard them.
    """

    def __init__(self, *, metrics: bool = True, traces: bool = True) -> None:
        resource = Resource.create({"service.name": _SERVICE, "service.version": __version__})
        # Attributes from the environment take precedence.
        resource = resource.merge(OTELResourceDetector().detect())
        readers = [PeriodicExportingMetricReader(OTLPMetricExporter())] if metrics else []
        self._meters = MeterProvider(readers, resource)
        self._tracers = TracerProvider(resource=resource)
        if traces:
            self._tracers.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = self._tracers.get_tracer(_NAME, __version__)
        self._recordings: dict[int, _Recording] = defaultdict(_Recording)
        meter = self._meters.get_meter(_NAME, __version__)
        self._ended = meter.create_counter(f"{_NAME}.recordings", "{recording}", "Recordings by status.")
        self._messages = meter.create_counter(
            f"{_NAME}.messages", "{message}", "Messages by topic and outcome."
        )
        self._bytes = meter.create_counter(
            f"{_NAME}.io", "By", "Bytes of opened recordings, read messages and stored rows."
        )
        self._expectations = meter.create_counter(
            f"{_NAME}.expectations", "{expectation}", "Expectations by outcome and severity."
        )
        self._duration = meter.create_histogram(
            f"{_NAME}.recording.duration", "s", "Duration of a recording."
        )
        self._steps = meter.create_histogram(
            f"{_NAME}.step.duration", "s", "Duration of a recording by step."
        )

    def __call__(self, position: int, event: Event) -> None:
        """Count an event."""
        match event:
            case RunStarted():
                self._begin(position, event)
            case TopicProgress():
                self._progress(self._recordings[position], event)
            case Rejected():
                self._recordings[position].rejected += event.count
                self._count(event.target, "rejected", event.count)
            case TopicClosed():
                self._bytes.add(event.stored_bytes or 0, {"kind": "stored", "topic": event.target})
            case ContractEvaluated():
                self._recordings[position].contract = event.result
                for result in event.result.results:
                    labels = {"outcome": result.outcome.value, "severity": result.severity.value}
                    self._expectations.add(1, labels)
            case Timed():
                self._recordings[position].seconds = dict(event.seconds)
            case RunFinished():
                self._finish(self._recordings.pop(position, _Recording()), event)
            case _:
                pass

    def close(self) -> None:
        """Send the remaining data; a collector that does not respond is logged."""
        self._meters.shutdown()
        self._tracers.shutdown()

    def _begin(self, position: int, event: RunStarted) -> None:
        recording = _Recording(event.sequence, event.destination, event.source_bytes)
        recording.sharing = frozenset(topic.target for topic in event.topics if topic.shares_messages)
        self._recordings[position] = recording
        self._bytes.add(event.source_bytes, {"kind": "source"})

    def _progress(self, recording: _Recording, event: TopicProgress) -> None:
        if event.target in recording.sharing:
            return
        recording.read += event.read
        recording.written[event.target] += event.written
        self._count(event.target, "read", event.read)
        for rule, count in event.dropped.items():
            self._count(event.target, "downsampled" if rule in DOWNSAMPLING else "filtered", count)
        if event.payload_bytes:
            self._bytes.add(event.payload_bytes, {"kind": "payload", "topic": event.target})

    def _count(self, topic: str, fate: str, count: int) -> None:
        if count:
            self._messages.add(count, {"topic": topic, "fate": fate})

    def _finish(self, recording: _Recording, event: RunFinished) -> None:
        status = {"status": event.status.value}
        duration_s = sum(spent for step, spent in recording.seconds.items() if step is not Step.WRITE)
        self._ended.add(1, status)
        self._duration.record(duration_s, status)
        for step, spent in recording.seconds.items():
            self._steps.record(spent, {"step": step.value})
        for topic, count in recording.written.items():
            self._count(topic, "written", count)
        self._trace(recording, event, duration_s)

    def _trace(self, recording: _Recording, event: RunFinished, duration_s: float) -> None:
        end_ns = time.time_ns()
        span = self._tracer.start_span("ingest recording", start_time=end_ns - int(duration_s * 1e9))
        span.set_attributes(
            {
                f"{_NAME}.sequence": recording.sequence,
                f"{_NAME}.destination": recording.destination,
                f"{_NAME}.status": event.status.value,
                f"{_NAME}.source_bytes": recording.source_bytes,
                f"{_NAME}.read": recording.read,
                f"{_NAME}.written": sum(recording.written.values()),
                f"{_NAME}.rejected": recording.rejected,
                **{f"{_NAME}.step.{step.value}": spent for step, spent in recording.seconds.items()},
            }
        )
        if recording.contract is not None:
            failed = (*recording.contract.errors, *recording.contract.warnings)
            span.set_attributes(
                {
                    f"{_NAME}.contract.passed": recording.contract.passed,
                    f"{_NAME}.contract.expectations": len(recording.contract.results),
                    f"{_NAME}.contract.failures": [one.line for one in failed[:_MAX_FAILURES]],
                }
            )
        if event.error is not None:
            span.set_status(Status(StatusCode.ERROR, event.error))
        span.end(end_ns)
