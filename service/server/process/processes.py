"""Signals and the start of the processes of the service; and a worker alone, without the API."""

import os
import signal
import time
from queue import SimpleQueue

from service.server.base import log, telemetry
from service.server.base.log import logger
from service.server.base.settings import Settings, unknown_variables
from service.server.database.engine import Database, open_database
from service.server.database.schema import is_current
from service.server.jobs.supervisor import Supervisor
from service.server.process import devices
from stage.colour.location import VARIABLE, location

SIGNALS = (signal.SIGTERM, signal.SIGINT)
PRIVATE = 0o027
"""Bits that new files and folders do not have: others read neither captures nor the database, and the group writes nothing."""
SAME_S = 1.0
"""Seconds within which signals count as one: terminals, `timeout` and supervisors signal a process and its group."""


def hear_signals(supervisors: list[Supervisor]) -> "SimpleQueue[int]":
    """Put the first signal into a queue; at the second, kill the workers and end this process."""
    asked: SimpleQueue[int] = SimpleQueue()  # its put may interrupt its get, in the signal handler
    heard: list[float] = []

    def hear(number: int, _frame: object) -> None:
        now = time.monotonic()
        if not heard:
            heard.append(now)
            asked.put(number)
        elif now - heard[0] > SAME_S:
            for supervisor in supervisors:
                supervisor.kill()
            os._exit(128 + number)

    for number in SIGNALS:
        signal.signal(number, hear)
    return asked


def configure(settings: Settings) -> None:
    """Set up the permissions of files and the log, and warn of settings that seem mistaken."""
    os.umask(os.umask(PRIVATE) | PRIVATE)  # a stricter mask stays
    log.configure(settings.log_level, settings.log_format)
    for name, near in unknown_variables(os.environ).items():
        logger.warning("a variable of the environment is no setting", variable=name, **({"meant": near} if near else {}))
    if not location().startswith("ocio://") and not os.path.isfile(location()):
        logger.warning("the configuration of colours is no file", variable=VARIABLE, file=location())
    for root in (*settings.roots, *(root.folder for root in settings.project_roots)):
        if not root.is_dir():
            logger.warning("a root is no folder", root=str(root))


def work(settings: Settings, device: str | None) -> None:
    """Run one worker, as a machine beside that of the API does; it is started again when it dies, until SIGTERM or SIGINT."""
    supervisors: list[Supervisor] = []
    asked = hear_signals(supervisors)
    configure(settings)
    open_database(settings, _prepare).close()
    telemetry.close(telemetry.provider(settings))  # so that a missing extra is reported here, and not by every worker
    supervisors.append(Supervisor(settings, [devices.resolve(device)]))
    supervisors[0].start()
    asked.get()
    supervisors[0].stop()


def _prepare(settings: Settings, database: Database) -> None:
    """Make or upgrade the tables where that is to do; the worker looks at those of the queue, whose library this process need not load."""
    settings.data.mkdir(parents=True, exist_ok=True)
    if not is_current(database):
        from service.server.jobs.queue import prepare

        prepare(settings, database)
