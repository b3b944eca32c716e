"""Looks after workers: starts them by spawn, starts them again when they die, kills them when they hang."""

import multiprocessing
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess

from service.server.jobs.heartbeat import Heartbeat
from service.server.jobs.worker import run_worker
from service.server.log import logger
from service.server.settings import Settings

LOOK_S = 0.5
PAUSES_S = (0.0, 1.0, 5.0, 15.0, 60.0)
"""Before a worker is started again, by how often in a row it died before it was ready; the last one for ever after. One that had been
ready is started again at once: what killed it was its work or somebody, and a job that kills workers is ended by `max_lost`."""
KILL_AFTER_S = 10.0
"""Beyond the time to drain, before a worker that does not end is killed."""


@dataclass
class _Place:
    """A device and the worker on it."""

    device: str
    process: SpawnProcess | None = None
    heartbeat: Heartbeat | None = None
    failures: int = 0
    """Starts in a row that came to nothing."""
    start_at: float = field(default_factory=time.monotonic)


class Supervisor:
    """The workers of this process."""

    def __init__(self, settings: Settings, devices: list[str]) -> None:
        """Args: settings: of the service. devices: one worker on each."""
        self._settings = settings
        self._spawn = multiprocessing.get_context("spawn")  # a forked process cannot use CUDA
        self._places = [_Place(device) for device in devices]
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relit-supervisor", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Ask the workers to finish their steps, and wait for them."""
        self._ended.set()
        self._thread.join()
        running = [place.process for place in self._places if place.process is not None and place.process.is_alive()]
        for process in running:
            process.terminate()
        deadline = time.monotonic() + self._settings.drain_s + KILL_AFTER_S
        for process in running:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()

    def kill(self) -> None:
        """End the workers at once; what they do is taken over."""
        for place in self._places:
            if (process := place.process) is not None:
                process.kill()

    def _run(self) -> None:
        while not self._ended.wait(LOOK_S):
            for place in self._places:
                try:
                    self._look(place)
                except OSError as error:  # no memory or no process left: at the next look there may be
                    logger.error("worker cannot be started", device=place.device, error=str(error))

    def _look(self, place: _Place) -> None:
        now = time.monotonic()
        if place.process is None:
            if now >= place.start_at:
                heartbeat = Heartbeat()
                process = self._spawn.Process(target=run_worker, args=(self._settings, place.device, heartbeat),
                                              name=f"relit-worker-{place.device}")
                process.start()
                place.process, place.heartbeat = process, heartbeat
            return
        assert place.heartbeat is not None, "it has been started"
        if not place.process.is_alive():
            place.failures = 0 if place.heartbeat.was_ready else place.failures + 1
            pause = PAUSES_S[min(place.failures, len(PAUSES_S) - 1)]
            logger.warning("worker is gone", device=place.device, exit_code=place.process.exitcode, again_in_s=pause)
            place.process.close()
            place.process, place.start_at = None, now + pause
        elif place.heartbeat.silent_s > self._settings.stall_s:
            logger.error("worker hangs: it is killed", device=place.device, silent_s=round(place.heartbeat.silent_s))
            place.process.kill()
            place.process.join()
