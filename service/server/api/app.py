"""The app: its routes, its middleware, and the service that they use."""

import threading

from fastapi import APIRouter, Depends, FastAPI
from fastapi.telemetry import TelemetryConfig
from opentelemetry.trace import TracerProvider

from service import __version__
from service.server.api import document, events, hooks, importing, intakes, jobs, middleware, operations, problems, results, tus, uploads
from service.server.api.context import Service, require_admin
from service.server.api.limits import AtOnce, RateLimiter
from service.server.api.metrics import Metrics
from service.server.api.tokens import TokenReader
from service.server.api.watch import MAX_STREAMS, Watcher
from service.server.base.settings import Settings
from service.server.database.engine import Database
from service.server.jobs.queue import JobQueue
from service.server.pages import routes as pages
from service.server.storage.objects import open_storage
from service.server.storage.upload_parts import open_upload_parts

Routes = APIRouter
"""Routes that another part of the program adds to those of the service."""
DESCRIPTION = """Captures in, durable jobs, USD assets and relit frames out. docs/service.md has a walk through it."""


def create_app(settings: Settings, database: Database, tracing: TracerProvider | None = None, *, max_streams: int = MAX_STREAMS,
               set_routes: Routes | None = None) -> FastAPI:
    """Create the app over a prepared database; `tracing` makes the spans of requests, `max_streams` bounds the event streams, by
    `set_routes` captures are taken at this machine."""
    # one span for each request; FastAPI makes no metrics and no log, since the service has its own
    telemetry: TelemetryConfig = {
        "tracer_provider": tracing, "tracing": tracing is not None, "operation_spans": False, "metrics": False, "logs": False,
        "auto_configure": False, "exclude": lambda scope: scope["path"] in middleware.QUIET}
    app = FastAPI(title="Relit", version=__version__, description=DESCRIPTION, openapi_url="/v1/openapi.json",
                  docs_url=None, redoc_url=None,  # these pages would load scripts from elsewhere
                  telemetry=telemetry, generate_unique_id_function=lambda route: route.name)
    closing = threading.Event()
    storage = open_storage(settings)
    app.state.service = Service(
        settings, database, JobQueue(database), storage, open_upload_parts(settings, database, storage),
        RateLimiter(settings.requests_per_second, settings.request_burst),
        running=AtOnce(settings.max_requests, "requests of this key are under way"),
        key_streams=AtOnce(settings.max_streams, "event streams of this key are open"),
        project_streams=AtOnce(settings.max_project_streams, "event streams of this project are open"),
        draining=threading.Event(), closing=closing, watcher=Watcher(database, closing, most=min(max_streams, MAX_STREAMS)),
        tokens=None if settings.oidc_issuer is None else TokenReader(settings))
    app.state.metrics, app.state.readiness = Metrics(settings, database), operations.Readiness()
    problems.install(app)
    document.install(app)
    for router in (intakes.captures, importing.router, intakes.environments, intakes.samples, results.environments, uploads.router,
                   uploads.listings, uploads.options, jobs.router, events.router, results.router, results.pictures, hooks.router,
                   operations.router):
        app.include_router(router)
    pages.install(app)
    app.state.has_stage = set_routes is not None
    if set_routes is not None:
        app.include_router(set_routes, dependencies=[Depends(require_admin)])
        app.include_router(pages.set_router)
    app.add_middleware(middleware.Bodies)
    app.add_middleware(tus.TusHeaders)
    app.add_middleware(middleware.RequestLog, metrics=app.state.metrics)
    return app
