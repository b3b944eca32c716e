"""Found by Python at its start where this folder is on PYTHONPATH: makes the frames of a worker's jobs do what SABOTAGE says.

kill  end the process by SIGKILL, as want of memory would      hang  stand still      slow  take a tenth of a second for each frame
"""

import os
import signal
import threading
import time

import service.server.jobs.steps as steps

relight = steps._relight


def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def hang(*_):
    threading.Event().wait()


class Slow:
    def __init__(self, inner):
        self._inner = inner

    def stage(self, name, total):
        self._inner.stage(name, total)

    def advance(self, done):
        time.sleep(0.1)
        self._inner.advance(done)


def slow(job, request, only, context, progress):
    relight(job, request, only, context, Slow(progress))


if "SABOTAGE" in os.environ:
    steps._relight = {"kill": kill, "hang": hang, "slow": slow}[os.environ["SABOTAGE"]]
