"""OpenTelemetry traces of requests and of the steps of their jobs, sent if the settings name a collector."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from opentelemetry import trace
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from service import __version__
from service.errors import RequestError
from service.server.base.settings import Settings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

PARENT = "traceparent"
PROPAGATOR = TraceContextTextMapPropagator()


def provider(settings: Settings) -> "TracerProvider | None":
    """Create what makes and sends the spans of this process, or nothing if the settings name no collector; call it once."""
    if settings.otel_endpoint is None:
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        raise RequestError("otel_endpoint: the extra otel is not installed: pip install 'relit[otel]'") from None
    made = TracerProvider(resource=Resource.create({"service.name": "relit", "service.version": __version__}))
    made.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=f"{settings.otel_endpoint.rstrip('/')}/v1/traces")))
    trace.set_tracer_provider(made)
    return made


def close(made: "TracerProvider | None") -> None:
    """Send the remaining spans."""
    if made is not None:
        made.shutdown()


def current() -> str | None:
    """Return the current span as a W3C traceparent; None: there is none."""
    carrier: dict[str, str] = {}
    PROPAGATOR.inject(carrier)
    return carrier.get(PARENT)


@contextmanager
def span(name: str, parent: str | None, **attributes: str | int) -> Iterator[None]:
    """Open a span below that of a traceparent."""
    above = None if parent is None else PROPAGATOR.extract({PARENT: parent})
    with trace.get_tracer("relit", __version__).start_as_current_span(
            name, context=above, attributes={f"relit.{key}": value for key, value in attributes.items()}):
        yield
