"""Locks that tell whether a worker lives; and who looks after workers: when it starts them again, and which it takes for hung."""

import time

import pytest
import sqlalchemy as sa

from service.server.base.settings import Settings
from service.server.database.engine import UNANSWERED
from service.server.jobs import supervisor
from service.server.jobs.takeover import KEEPALIVE, AdvisoryWorkerLock, FileWorkerLock, LockState, open_worker_lock
from tests.service.server.jobs import stand_ins
from tests.service.server.jobs.harness import harness


def pair(harness):
    return [open_worker_lock(harness.database, harness.settings.locks, name) for name in ("one", "two")]


def is_dead(lock, worker):
    with lock.dead(worker) as dead:
        return dead


def test_a_worker_is_dead_when_it_lets_go(idle_harness):
    one, two = pair(idle_harness)
    assert (one.hold(), two.hold()) == (LockState.TAKEN, LockState.TAKEN)
    assert (one.hold(), two.hold()) == (LockState.KEPT, LockState.KEPT)
    assert not is_dead(one, "two")
    assert is_dead(one, "another")  # which never was
    two.close()
    idle_harness.until(lambda: is_dead(one, "two"), "seen to have let go")  # a server takes a moment to end a session
    one.close()


def test_one_alone_takes_over_and_the_dead_does_not_come_back_meanwhile(idle_harness):
    one, two = pair(idle_harness)
    three = open_worker_lock(idle_harness.database, idle_harness.settings.locks, "three")
    one.hold()
    two.hold()
    with one.dead("three") as dead, two.dead("three") as also:
        assert dead and not also
        assert three.hold() is LockState.REFUSED
    assert three.hold() is LockState.TAKEN
    for each in (one, two, three):
        each.close()


def test_the_locks_of_the_dead_leave_no_files_and_one_that_was_removed_is_taken_anew(tmp_path):
    one, two = FileWorkerLock(tmp_path, "one"), FileWorkerLock(tmp_path, "two")
    one.hold()
    two.hold()
    two.close()
    assert is_dead(one, "two")
    one.close()
    assert list(tmp_path.iterdir()) == []
    one, two = FileWorkerLock(tmp_path, "one"), FileWorkerLock(tmp_path, "two")
    one.hold()
    two.hold()
    (tmp_path / "one.lock").unlink()
    assert one.hold() is LockState.TAKEN
    assert not is_dead(two, "one")


def test_a_session_that_ends_during_a_look_at_another_worker_is_taken_anew(on_postgres, tmp_path):
    """As a restart of the server between both does."""
    with harness(tmp_path, on_postgres) as made:
        one, two = pair(made)
        assert (one.hold(), two.hold()) == (LockState.TAKEN, LockState.TAKEN)
        with made.database.engine.connect() as other:
            other.execute(sa.text("SELECT pg_terminate_backend(l.pid) FROM pg_locks l JOIN pg_database d ON d.oid = l.database "
                                  "WHERE l.locktype = 'advisory' AND d.datname = current_database() AND l.pid <> pg_backend_pid()"))
        with pytest.raises(UNANSWERED):
            is_dead(one, "two")
        made.until(lambda: one.hold() is LockState.TAKEN, "held again")
        assert one.hold() is LockState.KEPT
        one.close()
        two.close()


@pytest.mark.long
def test_a_restart_of_the_server_takes_the_locks_and_they_are_taken_anew(server_postgres, on_postgres, tmp_path):
    with harness(tmp_path, on_postgres) as made:
        one, two = pair(made)
        one.hold()
        two.hold()
        server_postgres.restart("fast")
        assert one.hold() is LockState.TAKEN
        assert is_dead(one, "two")  # which is why nobody is given up for dead for a while after that
        assert two.hold() is LockState.TAKEN
        assert not is_dead(one, "two")
        one.close()
        two.close()


def test_the_server_soon_ends_the_session_of_a_machine_that_is_gone(on_postgres, tmp_path):
    with harness(tmp_path, on_postgres) as made:
        lock = AdvisoryWorkerLock(made.database, "one")
        lock.hold()
        assert lock._session is not None
        told = {name: int(lock._session.execute(sa.text(f"SHOW {name}")).scalar_one()) for name in KEEPALIVE}
        lock.close()
    assert told == KEEPALIVE


PAUSES_S = (0.0, 0.01, 0.02)
STALL_S = 1.0
WAIT_S = 60.0


class Log:
    """The log of a supervisor, kept as a list."""

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
