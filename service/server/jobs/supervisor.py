"""The supervisor starts worker processes, starts them again when they die, and kills them when they hang.

It shares memory with each, in which the worker leaves signs of life. The memory has no lock: a worker that is killed while it holds one
would stop the supervisor for ever. Each sign is one aligned double.
"""

import multiprocessing
import time
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import RawArray
from typing import Any

from service.server.base.log import logger
from service.server.base.rounds import Rounds
from service.server.base.settings import Settings

LOOK_S = 0.5
PAUSES_S = (0.0, 1.0, 5.0, 15.0, 60.0)
"""Pause before a worker is started again, by how often in a row it died before it was ready. A worker that was ready is started again at
once: a job or a person killed it, and `max_lost` ends a job that kills workers."""
KILL_AFTER_S = 10.0
"""Seconds beyond `drain_s` before a worker that does not end is killed."""

READY, BEAT, STEP = range(3)


class Heartbeat:
    """Times of the last signs of one worker process, in monotonic seconds, which are the same in all processes of a machine."""

    def __init__(self) -> None:
        self._signs: Any = RawArray("d", 3)
        self._signs[BEAT] = time.monotonic()

    def ready(self) -> None:
        """Record that the worker has started and takes jobs."""
        self._signs[READY] = time.monotonic()

    @property
    def was_ready(self) -> bool:
        """Return whether the worker ever took jobs."""
        return bool(self._signs[READY] > 0)

    def beat(self) -> None:
        """Record that the worker is alive, whether or not a step runs."""
        self._signs[BEAT] = time.monotonic()

    def step(self, oldest: float) -> None:
        """Record the time of the oldest last sign of progress of the running steps; 0: no step runs."""
        self._signs[STEP] = oldest

    @property
    def silent_s(self) -> float:
        """Seconds for which the worker or a running step has given no sign."""
        return float(time.monotonic() - min(self._signs[BEAT], self._signs[STEP] or self._signs[BEAT]))


def run_worker(settings: Settings, device: str, heartbeat: Heartbeat) -> None:
    """Run a worker in this process, which alone imports what jobs need; the arguments are those of `worker.run_worker`."""
    from service.server.jobs import worker

    worker.run_worker(settings, device, heartbeat)


@dataclass
class _Slot:
    device: str
    process: SpawnProcess | None = None
    heartbeat: Heartbeat = field(default_factory=Heartbeat)
    failures: int = 0
    """Starts in a row after which the worker died before it was ready."""
    start_at: float = field(default_factory=time.monotonic)


class Supervisor(Rounds):
    """Starts and watches one worker process for each device."""

    def __init__(self, settings: Settings, devices: list[str]) -> None:
        super().__init__("relit-supervisor", LOOK_S, self._round)
        self._settings = settings
        self._spawn = multiprocessing.get_context("spawn")  # a forked process cannot use CUDA
        self._slots = [_Slot(device) for device in devices]

    def stop(self) -> None:
        """Ask the workers to finish their steps, and wait until they end."""
        super().stop()
        running = [slot.process for slot in self._slots if slot.process is not None and slot.process.is_alive()]
        for process in running:
            process.terminate()
        deadline = time.monotonic() + self._settings.drain_s + KILL_AFTER_S
        for process in running:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()

    def kill(self) -> None:
        """Kill the workers; others take their jobs over."""
        for slot in self._slots:
            if (process := slot.process) is not None:
                process.kill()

    def _round(self) -> None:
        for slot in self._slots:
            try:
                self._look(slot)
            except OSError as error:  # there is no memory or no process left; at the next look there may be
                logger.error("worker cannot be started", device=slot.device, error=str(error))

    def _look(self, slot: _Slot) -> None:
        now = time.monotonic()
        if slot.process is None:
            if now >= slot.start_at:
                slot.heartbeat = Heartbeat()
                process = self._spawn.Process(target=run_worker, args=(self._settings, slot.device, slot.heartbeat),
                                              name=f"relit-worker-{slot.device}")
                process.start()
                slot.process = process
            return
        if not slot.process.is_alive():
            slot.failures = 0 if slot.heartbeat.was_ready else slot.failures + 1
            pause = PAUSES_S[min(slot.failures, len(PAUSES_S) - 1)]
            logger.warning("worker is gone", device=slot.device, exit_code=slot.process.exitcode, again_in_s=pause)
            slot.process.close()
            slot.process, slot.start_at = None, now + pause
        elif slot.heartbeat.silent_s > self._settings.stall_s:
            logger.error("worker hangs: it is killed", device=slot.device, silent_s=round(slot.heartbeat.silent_s))
            slot.process.kill()
            slot.process.join()
