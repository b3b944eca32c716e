"""What the processes of the service have in common: their signals, and how they begin."""

import os
import signal
import time
from queue import SimpleQueue

from service.server import log
from service.server.jobs.supervisor import Supervisor
from service.server.log import logger
from service.server.permissions import keep_private
from service.server.settings import Settings, unknown_variables

SIGNALS = (signal.SIGTERM, signal.SIGINT)
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
    keep_private()
    log.configure(settings.log_level, settings.log_format)
    for name, near in unknown_variables(os.environ).items():
        logger.warning("a variable of the environment is no setting", variable=name, **({"meant": near} if near else {}))
    for root in (*settings.roots, *(root.folder for root in settings.project_roots)):
        if not root.is_dir():
            logger.warning("a root is no folder", root=str(root))
