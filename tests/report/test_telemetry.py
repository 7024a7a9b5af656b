"""A collector receives what the report states: the command exports to an OTLP/HTTP server that decodes it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from mosaico_ingest.report.run import read_report

pytestmark = pytest.mark.slow
DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


@dataclass
class Collector:
    """The received exports; counters are cumulative, so the last export of each applies."""

    url: str = ""
    resources: list[dict[str, str]] = field(default_factory=list[dict[str, str]])
    points: dict[tuple[str, tuple[tuple[str, str], ...]], float] = field(default_factory=dict[Any, float])
    spans: list[Any] = field(default_factory=list[Any])
    paths: Counter[str] = field(default_factory=Counter[str])

    def metrics(self, body: bytes) -> None:
        for resource in ExportMetricsServiceRequest.FromString(body).resource_metrics:
            self.resources.append(plain(resource.resource.attributes))
            for metric in (metric for scope in resource.scope_metrics for metric in scope.metrics):
                for point in metric.sum.data_points:
                    self._keep(metric.name, point, point.as_int or point.as_double)
                for point in metric.histogram.data_points:
                    self._keep(f"{metric.name}.count", point, point.count)
                    self._keep(f"{metric.name}.sum", point, point.sum)

    def traces(self, body: bytes) -> None:
        for resource in ExportTraceServiceRequest.FromString(body).resource_spans:
            self.spans += [span for scope in resource.scope_spans for span in scope.spans]

    def total(self, name: str, **wanted: str) -> float:
        return sum(
            value
            for (known, labels), value in self.points.items()
            if known == f"mosaico_ingest.{name}" and wanted.items() <= dict(labels).items()
        )

    def _keep(self, name: str, point: Any, value: float) -> None:
        self.points[name, tuple(sorted(plain(point.attributes).items()))] = value


def plain(attributes: Any) -> dict[str, str]:
    return {one.key: getattr(one.value, str(one.value.WhichOneof("value"))) for one in attributes}


@pytest.fixture
def collector() -> Iterator[Collector]:
    actual = Collector()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            actual.paths[self.path] += 1
            (actual.metrics if self.path.endswith("/metrics") else actual.traces)(body)
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - its name in the library
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        actual.url = f"http://127.0.0.1:{server.server_address[1]}"
        try:
            yield actual
        finally:
            server.shutdown()
            thread.join(10)


def ingest(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    (folder / "in").mkdir(exist_ok=True)
    for name in ("a", "b"):
        (folder / "in" / f"{name}.mcap").write_bytes(DRIVE.read_bytes())
    (folder / "in" / "torn.mcap").write_bytes(b"torn")
    (folder / "job.yaml").write_text(
        'bag: {path: "in/*.mcap"}\nsequence: {name: "{stem}"}\ntopics: [/imu, /odom]\ntarget: {store: store}\n'
        "expect: {on_failure: warn, required: [/imu, /gps2], topics: {/imu: {rate: {min: 99 Hz}}}}\n"
    )
    command = [
        sys.executable,
        "-m",
        "mosaico_ingest",
        "run",
        "job.yaml",
        "--otel",
        "--report",
        "run.json",
        "-q",
    ]
    clean = {key: value for key, value in os.environ.items() if not key.startswith("OTEL_")}
    return subprocess.run(  # noqa: S603 - our own command
        [*command, *arguments],
        cwd=folder,
        env={**clean, **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_telemetry_exports_counts_of_report(jobs: str, collector: Collector, tmp_path: Path) -> None:
    result = ingest(tmp_path, "--jobs", jobs, OTEL_EXPORTER_OTLP_ENDPOINT=collector.url)
    assert result.returncode == 1, result.stderr
    report = read_report(tmp_path / "run.json")
    totals = [one.totals for one in report.recordings]
    for fate in ("read", "written"):
        assert collector.total("messages", fate=fate) == sum(getattr(one, fate) for one in totals) == 2400
        assert collector.total("messages", fate=fate, topic="/odom") == 400
    assert collector.total("recordings", status="completed") == 2
    assert collector.total("expectations", outcome="passed") == 4
    assert collector.total("expectations", outcome="failed", severity="error") == 2
    assert collector.total("recordings", status="failed") == 1
    assert collector.total("io", kind="stored") == sum(one.stored_bytes for one in totals)
    assert collector.total("io", kind="source") == 2 * DRIVE.stat().st_size
    assert collector.total("step.duration.sum", step="read") == pytest.approx(
        sum(one.steps.read for one in report.recordings), abs=1e-4
    )
    assert collector.resources[0]["service.name"] == "mosaico-ingest"
    spans = {plain(span.attributes)["mosaico_ingest.sequence"]: span for span in collector.spans}
    assert set(spans) == {"a", "b", "torn"}
    assert spans["torn"].status.code == 2
    assert "torn.mcap" in spans["torn"].status.message
    assert plain(spans["a"].attributes)["mosaico_ingest.written"] == 1200
    attributes = {one.key: one.value for one in spans["a"].attributes}
    assert attributes["mosaico_ingest.contract.passed"].bool_value is False
    [failure] = attributes["mosaico_ingest.contract.failures"].array_value.values
    assert "/gps2" in failure.string_value
    assert spans["a"].end_time_unix_nano > spans["a"].start_time_unix_nano


def test_telemetry_follows_standard_variables(collector: Collector, tmp_path: Path) -> None:
    ingest(
        tmp_path,
        OTEL_EXPORTER_OTLP_METRICS_ENDPOINT=f"{collector.url}/here/metrics",
        OTEL_TRACES_EXPORTER="none",
        OTEL_SERVICE_NAME="nightly",
        OTEL_RESOURCE_ATTRIBUTES="site=oslo",
    )
    assert set(collector.paths) == {"/here/metrics"}
    assert collector.resources[0]["service.name"] == "nightly"
    assert collector.resources[0]["site"] == "oslo"


def test_telemetry_unreachable_collector_prints_one_line(tmp_path: Path) -> None:
    began = time.monotonic()
    result = ingest(
        tmp_path, OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:9", OTEL_EXPORTER_OTLP_TIMEOUT="2"
    )
    assert time.monotonic() - began < 60
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "127.0.0.1" in result.stderr or "Failed to export" in result.stderr
    assert len(read_report(tmp_path / "run.json").recordings) == 3


def test_telemetry_without_extra_states_package(tmp_path: Path) -> None:
    blocked = "raise ImportError('blocked')"
    (tmp_path / "opentelemetry").mkdir()
    (tmp_path / "opentelemetry" / "__init__.py").write_text(blocked)
    paths = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    result = ingest(tmp_path, PYTHONPATH=paths)
    assert result.returncode == 1
    assert "error: OpenTelemetry is not installed — pip install 'mosaico-ingest[otel]'" in result.stderr
