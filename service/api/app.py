"""The app: its routes, and what stands between them and the world."""

from fastapi import FastAPI

from service import __version__
from service.api import intakes, jobs, problems, trace
from service.api.context import Service
from service.api.limits import Limiter
from service.jobs.queue import JobQueue
from service.settings import Settings
from service.storage.open import open_storage
from service.store.database import Database

DESCRIPTION = """Captures in, durable jobs, USD assets and relit frames out. docs/service.md has a walk through it."""


def create_app(settings: Settings, database: Database) -> FastAPI:
    """The app over a prepared database.

    Args:
        settings: of the service.
        database: of the store.
    """
    app = FastAPI(title="Relit", version=__version__, description=DESCRIPTION, openapi_url="/v1/openapi.json",
                  docs_url=None, redoc_url=None)  # these pages would load scripts from elsewhere
    app.state.service = Service(settings, database, JobQueue(database), open_storage(settings),
                                Limiter(settings.requests_per_second, settings.request_burst))
    problems.install(app)
    for router in (intakes.captures, intakes.environments, jobs.router):
        app.include_router(router)
    app.add_middleware(trace.Trace)
    return app
