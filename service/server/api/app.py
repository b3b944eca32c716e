"""The app: its routes, and what stands between them and the world."""

import threading

from fastapi import FastAPI
from fastapi.telemetry import TelemetryConfig
from opentelemetry.trace import TracerProvider

from service import __version__
from service.server.api import document, events, intakes, jobs, operations, problems, results, trace, tus, uploads
from service.server.api.bodies import Bodies
from service.server.api.context import Service
from service.server.api.limits import Limiter
from service.server.api.metrics import Metrics
from service.server.api.watch import Watcher
from service.server.database.engine import Database
from service.server.jobs.queue import JobQueue
from service.server.settings import Settings
from service.server.storage.open import open_storage

DESCRIPTION = """Captures in, durable jobs, USD assets and relit frames out. docs/service.md has a walk through it."""


def create_app(settings: Settings, database: Database, tracing: TracerProvider | None = None) -> FastAPI:
    """The app over a prepared database.

    Args:
        settings: of the service.
        database: of the store.
        tracing: makes traces of requests; None: there are none.
    """
    app = FastAPI(title="Relit", version=__version__, description=DESCRIPTION, openapi_url="/v1/openapi.json",
                  docs_url=None, redoc_url=None,  # these pages would load scripts from elsewhere
                  telemetry=_telemetry(tracing), generate_unique_id_function=lambda route: route.name)
    closing = threading.Event()
    app.state.service = Service(
        settings, database, JobQueue(database), open_storage(settings), Limiter(settings.requests_per_second, settings.request_burst),
        draining=threading.Event(), closing=closing, watcher=Watcher(database, closing))
    app.state.metrics, app.state.readiness = Metrics(settings, database), operations.Readiness()
    problems.install(app)
    document.install(app)
    for router in (intakes.captures, intakes.environments, uploads.router, uploads.listings, uploads.options, jobs.router, events.router,
                   results.router, operations.router):
        app.include_router(router)
    app.add_middleware(Bodies)
    app.add_middleware(tus.Tus)
    app.add_middleware(trace.Trace, metrics=app.state.metrics)
    return app


def _telemetry(tracing: TracerProvider | None) -> TelemetryConfig:
    """A span a request: numbers are those of /metrics, and the log is our own."""
    return {"tracer_provider": tracing, "tracing": tracing is not None, "operation_spans": False, "metrics": False, "logs": False,
            "auto_configure": False, "exclude": lambda scope: scope["path"] in trace.QUIET}
