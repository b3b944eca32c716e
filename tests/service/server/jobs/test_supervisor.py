"""Who looks after workers: when it starts them again, and which it takes for hung."""

import time

import pytest

from service.server.base.settings import Settings
from service.server.jobs import supervisor
from tests.service.server.jobs import stand_ins

PAUSES_S = (0.0, 0.01, 0.02)
STALL_S = 1.0
WAIT_S = 60.0


class Log:
    """Of a supervisor, as a list."""

    def __init__(self):
        self.lines = []

    def warning(self, event, **facts):
        self.lines.append((event, facts))

    error = warning

    def of(self, event):
        return [facts for found, facts in self.lines if found == event]


@pytest.fixture
def log(monkeypatch):
    made = Log()
    monkeypatch.setattr(supervisor, "logger", made)
    monkeypatch.setattr(supervisor, "PAUSES_S", PAUSES_S)
    monkeypatch.setattr(supervisor, "LOOK_S", 0.05)
    return made


def watch(monkeypatch, tmp_path, worker, until, stall_s=WAIT_S):
    """Supervise one worker until something is so."""
    monkeypatch.setattr(supervisor, "run_worker", worker)
    made = supervisor.Supervisor(Settings(data=tmp_path, stall_s=stall_s), ["cpu"])
    made.start()
    try:
        deadline = time.monotonic() + WAIT_S
        while not until(made):
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        made.kill()
        made.stop()


@pytest.mark.long
@pytest.mark.parametrize(("worker", "pauses"), [
    (stand_ins.never_ready, [PAUSES_S[1], PAUSES_S[2], PAUSES_S[2], PAUSES_S[2]]), (stand_ins.ready_and_dead, [0.0] * 4)])
def test_one_that_is_never_ready_waits_longer_each_time_and_one_that_was_is_started_at_once(monkeypatch, tmp_path, log, worker, pauses):
    watch(monkeypatch, tmp_path, worker, lambda _: len(log.of("worker is gone")) == 4)
    assert [facts["again_in_s"] for facts in log.of("worker is gone")][:4] == pauses


@pytest.mark.parametrize("worker", [stand_ins.stuck_in_a_step, *(
    pytest.param(worker, marks=pytest.mark.long) for worker in (stand_ins.stuck_at_the_start, stand_ins.without_a_beat))])
def test_one_that_gives_no_sign_is_killed(monkeypatch, tmp_path, log, worker):
    watch(monkeypatch, tmp_path, worker, lambda _: log.of("worker is gone"), stall_s=STALL_S)
    assert len(log.of("worker hangs: it is killed")) == len(log.of("worker is gone")) == 1


def test_the_silence_of_a_worker_is_that_of_the_whole_or_of_its_oldest_step(monkeypatch):
    clock = iter(range(100, 200))
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: float(next(clock)))
    made = supervisor.Heartbeat()  # at 100
    assert made.silent_s == 1 and not made.was_ready
    made.beat()  # at 102
    assert made.silent_s == 1
    made.step(99.0)
    made.beat()  # at 104
    assert made.silent_s == 105 - 99
    made.step(0.0)  # none runs
    assert made.silent_s == 106 - 104
    made.ready()
    assert made.was_ready
