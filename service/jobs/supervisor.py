"""Looks after workers: starts them by spawn, starts them again when they die, kills them when they hang."""

import multiprocessing
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import Synchronized

from service.jobs.worker import run_worker
from service.log import logger
from service.settings import Settings

LOOK_S = 0.5
PAUSES_S = (0.0, 1.0, 5.0, 15.0, 60.0)
"""Before a worker that died soon after its start is started again; the last one for ever after."""
SOON_S = 60.0
KILL_AFTER_S = 10.0
"""Beyond the time to drain, before a worker that does not end is killed."""


@dataclass
class _Place:
    """A device and the worker on it."""

    device: str
    alive: "Synchronized[float]"
    process: SpawnProcess | None = None
    started_at: float = 0.0
    deaths: int = 0
    start_at: float = field(default_factory=time.monotonic)


class Supervisor:
    """The workers of this process."""

    def __init__(self, settings: Settings, devices: list[str]) -> None:
        """Args: settings: of the service. devices: one worker on each."""
        self._settings = settings
        self._spawn = multiprocessing.get_context("spawn")  # a forked process cannot use CUDA
        self._places = [_Place(device, self._spawn.Value("d", 0.0)) for device in devices]
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

    def _run(self) -> None:
        while not self._ended.wait(LOOK_S):
            for place in self._places:
                self._look(place)

    def _look(self, place: _Place) -> None:
        now = time.monotonic()
        if place.process is None:
            if now >= place.start_at:
                place.alive.value = 0.0
                place.process = self._spawn.Process(target=run_worker, args=(self._settings, place.device, place.alive),
                                                    name=f"relit-worker-{place.device}")
                place.process.start()
                place.started_at = now
            return
        if not place.process.is_alive():
            place.deaths = place.deaths + 1 if now - place.started_at < SOON_S else 0
            pause = PAUSES_S[min(place.deaths, len(PAUSES_S) - 1)]
            logger.warning("worker is gone", device=place.device, exit_code=place.process.exitcode, again_in_s=pause)
            place.process, place.start_at = None, now + pause
            return
        sign = place.alive.value
        if sign > 0 and now - sign > self._settings.stall_s:
            logger.error("worker hangs: it is killed", device=place.device, silent_s=round(now - sign))
            place.process.kill()
            place.process.join()
