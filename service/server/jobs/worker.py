"""A worker: one process, one device, one job at a time; ended by a signal it finishes its step and hands the job back."""

import os
import secrets
import signal
import socket
import threading
from multiprocessing import parent_process
from pathlib import Path

from dbos import DBOS, DBOSConfig

from service.server import log, telemetry
from service.server.database import workers
from service.server.database.engine import LONGEST_PAUSE_S, UNANSWERED, Database, connect, message_of
from service.server.jobs.heartbeat import Heartbeat
from service.server.jobs.queue import CHECKS, SERIALIZER, VERSION, WORK, JobQueue, prepare
from service.server.jobs.runner import JobRunner
from service.server.jobs.steps import WorkerContext
from service.server.jobs.takeover import Takeover
from service.server.jobs.worker_lock import LockState, open_worker_lock
from service.server.log import logger
from service.server.settings import Settings
from service.server.storage.open import open_storage

POLL_S = 0.25
"""How often a queue is asked for work."""
APPLICATION = "relit"
DEPOSED = 3
"""Exit code of a worker that lost its lock."""
NICENESS = 5
"""Of a worker, which fills every core for minutes: the API beside it answers first, and the worker alone on a machine is as fast."""


def run_worker(settings: Settings, device: str, heartbeat: Heartbeat) -> None:
    """Work until SIGTERM or the end of the parent process.

    Args:
        settings: of the service.
        device: cpu, cuda:0, …
        heartbeat: told that the worker lives, and that its steps do.
    """
    os.nice(NICENESS)
    ending = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal it comes to the supervisor too, which ends us in its order
    _end_with_parent(ending)
    log.configure(settings.log_level, settings.log_format)
    tracing = telemetry.provider(settings)
    database = connect(settings.sqlalchemy_url)
    _prepared(database, settings, ending)
    host = socket.gethostname()
    name = f"{host}-{device.replace(':', '')}-{os.getpid()}-{secrets.token_hex(4)}"
    lock = open_worker_lock(database, settings.data / "locks", name)
    if lock.hold() is LockState.REFUSED:
        raise RuntimeError(f"the lock of {name} is held by another")  # the name is random
    queue = JobQueue(database)
    context = WorkerContext(database, open_storage(settings), cache_folder(settings), device, settings.max_pixels, settings.roots)
    runner = JobRunner(context, queue, name, alive=heartbeat.step)
    config: DBOSConfig = {
        "name": APPLICATION, "system_database_url": settings.sqlalchemy_url, "system_database_engine": database.engine,
        "application_version": VERSION, "executor_id": name, "serializer": SERIALIZER, "log_level": "ERROR", "run_migrations": False,
        "use_listen_notify": False,
    }
    dbos = DBOS(config=config)
    log.adopt("dbos")
    runner.register()
    takeover = Takeover(database, queue, lock, name, every_s=settings.takeover_s, max_lost=settings.max_lost,
                        running=lambda: runner.running, beat=heartbeat.beat, deposed=_depose)
    DBOS.launch()
    for waiting in (WORK, CHECKS):
        DBOS.register_queue(waiting, worker_concurrency=1, polling_interval_sec=POLL_S)
    workers.insert(database, name, host=host, pid=os.getpid(), device=device)
    takeover.start()
    heartbeat.ready()
    logger.info("worker ready", worker=name, device=device)
    ending.wait()
    logger.info("worker drains", worker=name)
    for stop in dbos.background_thread_stop_events:  # takes nothing more from the queues
        stop.set()
    takeover.state = workers.DRAINING
    if not runner.drain(settings.drain_s):
        logger.warning("step is given up", worker=name, after_s=settings.drain_s)
    takeover.stop()
    try:
        workers.remove(database, name)
        for workflow in queue.taken_by().get(name, []):
            queue.return_job(workflow, name)
    except UNANSWERED as error:
        logger.warning("jobs are left to be taken over: the database does not answer", error=message_of(error))
    lock.close()
    telemetry.close(tracing)
    logger.info("worker ended", worker=name)
    os._exit(0)  # threads of the queue wait in steps that will not begin


def cache_folder(settings: Settings) -> Path:
    """Of this machine's stack caches."""
    return settings.data / "cache"


def _prepared(database: Database, settings: Settings, ending: threading.Event) -> None:
    """Make the tables; wait for a database that does not answer."""
    while True:
        try:
            prepare(settings, database)
            return
        except UNANSWERED as error:
            logger.warning("database does not answer", error=message_of(error))
        if ending.wait(LONGEST_PAUSE_S):
            os._exit(0)


def _depose() -> None:
    logger.error("another has taken over: this worker ends")
    os._exit(DEPOSED)


def _end_with_parent(ending: threading.Event) -> None:
    """A worker does not outlive the process that looks after it by more than a step."""
    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        ending.set()

    threading.Thread(target=watch, name="relit-parent", daemon=True).start()
