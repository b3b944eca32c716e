"""The metrics of /metrics, for Prometheus. No label names a project, a key or a job, so that the metrics reveal none."""

import shutil
import time
from collections import Counter
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Gauge, Histogram, Info, disable_created_metrics, generate_latest
from prometheus_client import Counter as CounterMetric
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.gc_collector import GCCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from starlette.types import Scope

from service import __version__
from service.requests.states import ACTIVE, ENDED
from service.server.base.settings import Settings
from service.server.database import jobs, workers
from service.server.database.engine import UNANSWERED, Database

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
OTHER = "other"
"""Label of unknown methods and paths, so that invented names make no new metrics."""
disable_created_metrics()  # type: ignore[no-untyped-call]  # which would add a time to every metric


class Metrics(Collector):
    """The metrics of one API process, and those that it collects from the database when they are asked for."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._settings, self._database, self._registry = settings, database, CollectorRegistry()
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        Info("relit", "The program.", registry=self._registry).info({"version": __version__})
        self.running = Gauge("relit_http_requests_running", "Requests that have not been answered whole.", registry=self._registry)
        self._requests = CounterMetric("relit_http_requests", "Requests.", ("method", "route", "status"), registry=self._registry)
        self._waits = Histogram("relit_http_wait_seconds", "From a request to the beginning of its answer.", ("method", "route"),
                                registry=self._registry)
        self._received = CounterMetric("relit_http_received_bytes", "Bytes of bodies that came, uploads above all.", ("route",),
                                       registry=self._registry)
        self._registry.register(self)

    def count(self, scope: Scope, status: int, waited_s: float, received: int) -> None:
        """Count a request that has ended; status 0: without an answer."""
        method = scope["method"] if scope["method"] in METHODS else OTHER
        route = str(getattr(scope.get("route"), "path_format", OTHER))
        self._requests.labels(method, route, str(status)).inc()
        self._waits.labels(method, route).observe(waited_s)
        if received:
            self._received.labels(route).inc(received)

    def text(self) -> bytes:
        """Return all metrics in the format of Prometheus."""
        return generate_latest(self._registry)

    def describe(self) -> list[Metric]:
        """Return no metrics, so that registering asks the database nothing."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Return the metrics; if the database does not answer, only that it does not."""
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
        for state in (*ACTIVE, *ENDED):
            counted.add_metric((state,), states.get(state, 0))
        yield counted
        yield GaugeMetricFamily("relit_queue_age_seconds", "How long the job that waits for longest has waited; 0: none waits.",
                                value=0.0 if oldest is None else max(0.0, time.time() - oldest))
        yield GaugeMetricFamily("relit_job_frames", "Frames that jobs which are kept have made.", value=frames)
        seen = GaugeMetricFamily("relit_workers", "Workers that were seen lately.", labels=("device", "state"))
        for place, count in Counter((worker["device"], worker["state"]) for worker in present).items():
            seen.add_metric(place, count)
        yield seen
