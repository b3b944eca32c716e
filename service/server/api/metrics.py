"""What /metrics counts, for Prometheus. No label names a project, a key or a job: who may read the numbers learns of none."""

import shutil
import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, disable_created_metrics, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.gc_collector import GCCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from starlette.types import Scope

from service import __version__
from service.server.database import jobs, workers
from service.server.database.engine import UNANSWERED, Database
from service.server.settings import Settings
from service.views.states import ACTIVE, ENDED

CONTENT_TYPE = CONTENT_TYPE_LATEST
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
OTHER = "other"
"""Label of methods and paths that are none of ours: whoever makes names up makes no numbers."""
disable_created_metrics()  # type: ignore[no-untyped-call]  # a time beside every number, which nobody asks for
STATES = (*ACTIVE, *ENDED)


class Metrics:
    """The numbers of one API process, and of the database behind it."""

    def __init__(self, settings: Settings, database: Database) -> None:
        """Args: settings: of the service. database: of the store."""
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        Info("relit", "The program.", registry=self._registry).info({"version": __version__})
        self.running = Gauge("relit_http_requests_running", "Requests that have not been answered whole.", registry=self._registry)
        self._requests = Counter("relit_http_requests", "Requests.", ("method", "route", "status"), registry=self._registry)
        self._waits = Histogram("relit_http_wait_seconds", "From a request to the beginning of its answer.", ("method", "route"),
                                registry=self._registry)
        self._received = Counter("relit_http_received_bytes", "Bytes of bodies that came, uploads above all.", ("route",),
                                 registry=self._registry)
        self._registry.register(_Store(settings, database))

    def count(self, scope: Scope, status: int, waited_s: float, received: int) -> None:
        """A request has ended; status 0: without an answer."""
        method = scope["method"] if scope["method"] in METHODS else OTHER
        route = str(getattr(scope.get("route"), "path_format", OTHER))
        self._requests.labels(method, route, str(status)).inc()
        self._waits.labels(method, route).observe(waited_s)
        if received:
            self._received.labels(route).inc(received)

    def text(self) -> bytes:
        """All of them as Prometheus reads them."""
        return generate_latest(self._registry)


class _Store(Collector):
    """Numbers of the store, asked for when they are read."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._settings, self._database = settings, database

    def describe(self) -> list[Metric]:
        """Nothing is asked when it is registered."""
        return []

    def collect(self) -> Iterator[Metric]:
        """What the database says now; where it does not answer, that alone."""
        yield GaugeMetricFamily("relit_storage_free_bytes", "Space left where the data folder is.",
                                value=shutil.disk_usage(self._settings.data).free)
        try:
            states, oldest, frames = jobs.counts(self._database), jobs.oldest_queued(self._database), jobs.frames(self._database)
            present = workers.seen_lately(self._database)
        except UNANSWERED:
            yield GaugeMetricFamily("relit_database_up", "Whether the database answers.", value=0)
            return
        yield GaugeMetricFamily("relit_database_up", "Whether the database answers.", value=1)
        counted = GaugeMetricFamily("relit_jobs", "Jobs that are kept.", labels=("state",))
        for state in STATES:
            counted.add_metric((state,), states.get(state, 0))
        yield counted
        yield GaugeMetricFamily("relit_queue_age_seconds", "How long the job that waits for longest has waited; 0: none waits.",
                                value=0.0 if oldest is None else max(0.0, time.time() - oldest))
        yield GaugeMetricFamily("relit_job_frames", "Frames that jobs which are kept have made.", value=frames)
        seen = GaugeMetricFamily("relit_workers", "Workers that were seen lately.", labels=("device", "state"))
        devices: dict[tuple[str, str], int] = {}
        for worker in present:
            place = worker["device"], worker["state"]
            devices[place] = devices.get(place, 0) + 1
        for place, count in devices.items():
            seen.add_metric(place, count)
        yield seen
