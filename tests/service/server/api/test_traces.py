"""Traces of requests and of the steps of their jobs, as a collector gets them."""

import signal
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from service.errors import RequestError
from service.server.base import telemetry
from service.server.base.settings import Settings
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted
from tests.service.server_process import serving

PATIENCE_S = 60.0


class Collector(BaseHTTPRequestHandler):
    """Takes OTLP over HTTP as collectors do."""

    spans: list

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        assert self.path == "/v1/traces"
        for resource in ExportTraceServiceRequest.FromString(body).resource_spans:
            attributes = {pair.key: pair.value.string_value for pair in resource.resource.attributes}
            assert attributes["service.name"] == "relit"
            self.spans.extend(span for scope in resource.scope_spans for span in scope.spans)
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_arguments: object) -> None:
        """Say nothing."""


@pytest.fixture
def collector() -> Iterator[tuple[str, list]]:
    spans: list = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Collecting", (Collector,), {"spans": spans}))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", spans
    server.shutdown()
    thread.join()
    server.server_close()


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
