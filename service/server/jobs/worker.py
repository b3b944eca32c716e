"""A worker: one process on one device that does one job at a time. When it is asked to end it finishes its step and returns the job."""

import os
import secrets
import signal
import socket
import threading
from multiprocessing import parent_process

from dbos import DBOS, DBOSConfig
from dbos import error as dbos_error

from service.server.base import log, telemetry
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database import workers
from service.server.database.engine import LONGEST_PAUSE_S, UNANSWERED, Database, connect, message_of
from service.server.jobs.context import WorkerContext
from service.server.jobs.queue import CHECKS, SERIALIZER, VERSION, WORK, JobQueue, prepare
from service.server.jobs.runner import JobRunner
from service.server.jobs.supervisor import Heartbeat
from service.server.jobs.takeover import Takeover, open_worker_lock
from service.server.storage.objects import open_storage

POLL_S = 0.5
"""Seconds between two looks into a queue."""
APPLICATION = "relit"
LOCK_LOST = 3
"""Exit code of a worker that lost its lock."""
NICENESS = 5
"""Niceness of a worker, which fills every core for minutes: the API on the same machine answers first, and alone a worker is as fast."""


def run_worker(settings: Settings, device: str, heartbeat: Heartbeat) -> None:
    """Do jobs until SIGTERM or until the parent process ends, then end this process."""
    os.nice(NICENESS)
    ending = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the supervisor as well, which then ends this process
    _end_with_parent(ending)
    log.configure(settings.log_level, settings.log_format)
    tracing = telemetry.provider(settings)
    database = connect(settings.sqlalchemy_url)
    _prepared(database, settings, ending)
    host = socket.gethostname()
    name = f"{host}-{device.replace(':', '')}-{os.getpid()}-{secrets.token_hex(4)}"
    lock = open_worker_lock(database, settings.locks, name)
    lock.hold()  # nobody else has one of this name, which is random
    queue = JobQueue(database)
    context = WorkerContext(settings, database, open_storage(settings), queue, device, name)
    runner = JobRunner(context, name, alive=heartbeat.step)
    config: DBOSConfig = {
        "name": APPLICATION, "system_database_url": settings.sqlalchemy_url, "system_database_engine": database.engine,
        "application_version": VERSION, "executor_id": name, "serializer": SERIALIZER, "log_level": "ERROR", "run_migrations": False,
        "use_listen_notify": False,
    }
    dbos = DBOS(config=config)
    # DBOS reports them for every job that is cancelled, or cancelled and deleted, while it runs
    log.adopt("dbos", without=(dbos_error.DBOSAwaitedWorkflowCancelledError, dbos_error.DBOSNonExistentWorkflowError))
    runner.register()
    takeover = Takeover(database, queue, lock, name, every_s=settings.takeover_s, max_lost=settings.max_lost,
                        running=lambda: runner.running, beat=heartbeat.beat, lock_lost=_end_without_lock, asked=_obey)
    DBOS.launch()
    for waiting in (WORK, CHECKS):
        # a limit for each partition makes the queue one of partitions, which are the projects: DBOS draws the next one by lot
        DBOS.register_queue(waiting, worker_concurrency=1, partition_worker_concurrency=1, polling_interval_sec=POLL_S)
    workers.insert(database, name, host=host, pid=os.getpid(), device=device)
    takeover.start()
    heartbeat.ready()
    logger.info("worker ready", worker=name, device=device)
    ending.wait()
    logger.info("worker drains", worker=name)
    for stop in dbos.background_thread_stop_events:  # DBOS takes no more jobs from the queues
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
    os._exit(0)  # threads of DBOS are blocked before steps that do not start


def _prepared(database: Database, settings: Settings, ending: threading.Event) -> None:
    """Make the tables; wait while the database does not answer."""
    while True:
        try:
            prepare(settings, database)
            return
        except UNANSWERED as error:
            logger.warning("database does not answer", error=message_of(error))
        if ending.wait(LONGEST_PAUSE_S):
            os._exit(0)


def _obey(what: str) -> None:
    """Do what an operator asks of this worker: end after its step, or at once, as if it had died."""
    logger.warning("an operator ends this worker", how=what)
    os.kill(os.getpid(), signal.SIGKILL if what == workers.KILL else signal.SIGTERM)


def _end_without_lock() -> None:
    logger.error("another has taken over: this worker ends")
    os._exit(LOCK_LOST)


def _end_with_parent(ending: threading.Event) -> None:
    """Set `ending` when the supervisor's process ends."""
    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        ending.set()

    threading.Thread(target=watch, name="relit-parent", daemon=True).start()
