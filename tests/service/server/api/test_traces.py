"""Traces of requests and of the steps of their jobs, as a collector gets them."""

import signal
import sys
from collections.abc import Iterator

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from service.errors import RequestError
from service.server.base import telemetry
from service.server.base.settings import Settings
from tests.service.answering import Asked, answering
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted
from tests.service.server_process import serving

PATIENCE_S = 60.0


@pytest.fixture
def collector() -> Iterator[tuple[str, list]]:
    """The address of a collector, which takes OTLP over HTTP, and the spans that came."""
    spans: list = []

    def take(asked: Asked) -> tuple[int, bytes]:
        assert asked.path == "/v1/traces"
        for resource in ExportTraceServiceRequest.FromString(asked.body).resource_spans:
            assert {pair.key: pair.value.string_value for pair in resource.resource.attributes}["service.name"] == "relit"
            spans.extend(span for scope in resource.scope_spans for span in scope.spans)
        return 200, b""

    with answering(take) as address:
        yield address, spans


@pytest.mark.long
def test_a_request_and_the_steps_of_its_job_are_one_trace(collector, tmp_path):
    address, spans = collector
    with serving(tmp_path, "--anonymous", "--device", "cpu", roots=str(SAMPLES), otel_endpoint=address) as server, \
            server.client() as client:
        ours = "4bf92f3577b34da6a3ce929d0e0e4736"
        client.headers["traceparent"] = f"00-{ours}-00f067aa0ba902b7-01"
        admitted(server, client, SAMPLES / "owl")
        client.get("/healthz")
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(PATIENCE_S) == 0
    found = {span.name: span for span in spans}
    asked, step = found["POST /v1/captures"], found["check"]
    assert asked.trace_id.hex() == step.trace_id.hex() == ours
    assert step.parent_span_id == asked.span_id
    assert {pair.key: pair.value.string_value for pair in step.attributes}["relit.job"].startswith("job_")
    assert "GET /v1/captures/{capture}" in found and "GET /healthz" not in found


def test_traces_without_the_extra_are_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    with pytest.raises(RequestError, match="otel_endpoint: the extra otel is not installed"):
        telemetry.provider(Settings(otel_endpoint="http://127.0.0.1:4318"))
    assert telemetry.provider(Settings()) is None
