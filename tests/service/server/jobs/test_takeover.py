"""What becomes of a dead worker's jobs, and who may change a job; without processes, so that each moment can be set up."""

import threading

import pytest
import sqlalchemy as sa

from service.server.database import jobs, workers
from service.server.database.jobs import Claim
from service.server.jobs.progress import JobProgress
from service.server.jobs.queue import workflow_id
from service.server.jobs.takeover import FORGOTTEN_ROUNDS, GRACE_ROUNDS, LockState, Takeover, open_worker_lock
from tests.service.server.jobs.harness import harness

MAX_LOST = 3


@pytest.fixture
def job(idle_harness):
    """A job that the worker `gone`, which is not there any more, has begun."""
    job = idle_harness.two_steps()
    idle_harness.claim(job, "gone")
    return job


@pytest.fixture
def takeover(idle_harness):
    """Make the takeover of a worker of this name, whose lock is held to the end of the test."""
    locks = []

    def make(name, *, running=frozenset(), lock_lost=lambda: None, asked=lambda what: None):
        locks.append(open_worker_lock(idle_harness.database, idle_harness.settings.locks, name))
        assert locks[-1].hold() is LockState.TAKEN
        return locks[-1], Takeover(idle_harness.database, idle_harness.queue, locks[-1], name, every_s=1, max_lost=MAX_LOST,
                                   running=lambda: frozenset(running), beat=lambda: None, lock_lost=lock_lost, asked=asked)

    yield make
    for lock in locks:
        lock.close()


@pytest.mark.parametrize("cancelled", [False, pytest.param(True, marks=pytest.mark.long)], ids=["going on", "cancelled"])
def test_a_dead_workers_job_waits_for_another_or_is_called_off(idle_harness, takeover, job, cancelled):
    if cancelled:
        idle_harness.database.transact(lambda connection: jobs.cancel(connection, job))
    _, one = takeover("one")
    one.round()
    row = idle_harness.row(job)
    if cancelled:
        assert row["state"] == jobs.CANCELLED and idle_harness.in_queue(job)[0] == "CANCELLED"
    else:
        assert (row["state"], row["worker"], row["lost"]) == (jobs.QUEUED, None, 1)
        assert idle_harness.in_queue(job) == ("ENQUEUED", "work")


def test_a_living_workers_job_stays(idle_harness, takeover, job):
    takeover("gone")
    _, one = takeover("one")
    one.round()
    assert idle_harness.row(job)["worker"] == "gone"
    assert idle_harness.in_queue(job)[0] == "PENDING"


def test_nobody_is_given_up_for_dead_soon_after_the_own_lock_was_lost(idle_harness, takeover, job, monkeypatch):
    lock, one = takeover("one")
    found = iter([LockState.REFUSED, LockState.TAKEN])
    monkeypatch.setattr(lock, "hold", lambda: next(found, LockState.KEPT))
    for _ in range(1 + GRACE_ROUNDS):
        one.round()
        assert idle_harness.row(job)["worker"] == "gone"
    one.round()
    assert idle_harness.row(job)["worker"] is None


def test_a_worker_that_was_given_up_for_dead_changes_nothing_any_more(idle_harness, takeover, job):
    gone = Claim(job, 1, "gone")
    _, one = takeover("one")
    one.round()
    before = dict(idle_harness.row(job))
    assert not jobs.begin(idle_harness.database, Claim(job, 2, "gone"))
    assert not jobs.advance(idle_harness.database, gone, "frames", 3, 10, None)
    assert not jobs.finish_step(idle_harness.database, gone, ["frames 1-5"])
    assert not jobs.end(idle_harness.database, gone, jobs.FAILED, "it says")
    assert not jobs.is_claimed(idle_harness.database, gone)
    assert dict(idle_harness.row(job)) == before
    idle_harness.claim(job, "two")
    assert not jobs.begin(idle_harness.database, gone)  # it had taken the job, and wakes up only now
    assert not idle_harness.database.transact(lambda connection: jobs.release(connection, gone))
    assert idle_harness.row(job)["worker"] == "two"


def test_a_change_that_waits_for_the_takeover_changes_nothing(on_postgres, tmp_path):
    """Why the worker stands in the job's row: PostgreSQL looks again at the row that it waited for, and at no other."""
    with harness(tmp_path, on_postgres) as made:
        job = made.two_steps()
        gone = made.claim(job, "gone")
        ended = []
        late = threading.Thread(target=lambda: ended.append(jobs.end(made.database, gone, jobs.SUCCEEDED)))
        with made.database.engine.begin() as connection:
            assert jobs.record_lost_worker(connection, gone, MAX_LOST) == jobs.QUEUED
            late.start()
            made.until(lambda: made.database.row(sa.select(sa.text("1")).select_from(sa.text("pg_locks")).where(
                sa.text("NOT granted"))), "waiting for the row")
        late.join()
        assert ended == [False]
        assert made.row(job)["state"] == jobs.QUEUED


@pytest.mark.long
def test_a_worker_is_lost_once_whoever_finds_it_and_however_often(idle_harness, takeover, job):
    gone = Claim(job, 1, "gone")
    for _ in range(2):  # one who died between the two halves of taking over leaves them to the next
        idle_harness.database.transact(lambda connection: jobs.record_lost_worker(connection, gone, MAX_LOST))
    assert idle_harness.row(job)["lost"] == 1
    _, one = takeover("one")
    one.round()
    assert idle_harness.row(job)["lost"] == 1
    assert idle_harness.in_queue(job)[0] == "ENQUEUED"


def test_a_second_reaper_finds_nothing_to_do(idle_harness, takeover, job, monkeypatch):
    _, first = takeover("one")
    _, second = takeover("two")
    before = idle_harness.queue.taken_by()
    first.round()
    idle_harness.claim(job, "one")
    looks = iter([before])  # the second had looked before the first was there
    taken_by = idle_harness.queue.taken_by
    monkeypatch.setattr(idle_harness.queue, "taken_by", lambda: next(looks, None) or taken_by())
    second.round()
    row = idle_harness.row(job)
    assert (row["worker"], row["state"], row["lost"]) == ("one", jobs.RUNNING, 1)
    assert idle_harness.in_queue(job)[0] == "PENDING"


def test_a_job_that_loses_too_many_workers_fails(idle_harness, takeover, job):
    _, one = takeover("one")
    jobs.advance(idle_harness.database, Claim(job, 1, "gone"), "open", 0, 1, None)
    for lost in range(1, MAX_LOST + 2):
        one.round()
        assert idle_harness.row(job)["lost"] == lost
        if lost <= MAX_LOST:
            idle_harness.claim(job, "gone")
    row = idle_harness.row(job)
    assert row["state"] == jobs.FAILED and row["error"].startswith("lost 4 workers without progress (open): ")
    assert idle_harness.in_queue(job)[0] == "CANCELLED"


def test_more_frames_than_ever_before_count_as_a_finished_step(idle_harness, takeover, job):
    database, gone = idle_harness.database, Claim(job, 1, "gone")
    _, one = takeover("one")

    def lose():
        one.round()
        idle_harness.claim(job, "gone")

    lose()
    jobs.advance(database, gone, "frames", 4, 10, None)
    assert idle_harness.row(job)["lost"] == 0
    lose()
    jobs.advance(database, gone, "frames", 4, 10, None)  # the next worker comes as far, and no further
    assert idle_harness.row(job)["lost"] == 1
    jobs.advance(database, gone, "normals", 9, 10, None, repeating=False)  # a stage that begins again is no progress
    assert idle_harness.row(job)["lost"] == 1
    jobs.finish_step(database, gone, ["frames 1-5"])
    assert idle_harness.row(job)["lost"] == 0


@pytest.mark.long
def test_a_worker_that_dies_before_the_furthest_stage_is_not_held_against_the_job(idle_harness, takeover, job):
    """The job came through that stage once, so that something else kills the workers; but not without end."""
    database, gone = idle_harness.database, Claim(job, 1, "gone")
    _, one = takeover("one")

    def come_to(*stages):
        row = idle_harness.row(job)
        step = JobProgress(database, gone, alive=lambda: None, frame_count=10, begun=row["stages_begun"])
        step.begin("frames")
        for stage in stages:
            step.stage(stage, 5)

    def lose():
        one.round()
        if idle_harness.row(job)["state"] == jobs.QUEUED:
            idle_harness.claim(job, "gone")
        row = idle_harness.row(job)
        return row["lost"], row["lost_repeating"]

    come_to("open", "frames")
    assert lose() == (1, 0)
    assert lose() == (1, 1)  # before its first sign
    come_to()
    assert lose() == (1, 2)
    come_to("open")
    assert lose() == (1, 3)
    come_to("open", "frames")
    assert lose() == (2, 3)
    come_to("open", "frames", "sheet")  # a stage that no worker came to
    assert lose() == (1, 0)
    for repeated in range(1, jobs.REPEATED * MAX_LOST + 1):
        come_to("open")
        assert lose() == (1, repeated)
    assert idle_harness.row(job)["state"] == jobs.RUNNING
    lose()
    row = idle_harness.row(job)
    assert (row["state"], row["error"].partition(":")[0]) == (jobs.FAILED, "lost 32 workers without progress (open)")


def test_what_a_worker_took_and_knows_nothing_of_goes_back(idle_harness, takeover, job):
    _, gone = takeover("gone")
    for _ in range(FORGOTTEN_ROUNDS - 1):
        gone.round()
    assert idle_harness.in_queue(job)[0] == "PENDING"
    gone.round()
    assert idle_harness.in_queue(job)[0] == "ENQUEUED"
    row = idle_harness.row(job)
    assert (row["state"], row["worker"], row["lost"]) == (jobs.QUEUED, None, 0)


def test_what_a_worker_goes_on_with_stays(idle_harness, takeover, job):
    _, gone = takeover("gone", running={workflow_id(job, 1)})
    for _ in range(2 * FORGOTTEN_ROUNDS):
        gone.round()
    assert idle_harness.row(job)["worker"] == "gone"


def test_a_worker_whose_lock_is_another_s_for_good_ends(idle_harness, takeover, job):
    ends = []
    lock, one = takeover("one", lock_lost=lambda: ends.append("one"))
    lock.close()
    other = open_worker_lock(idle_harness.database, idle_harness.settings.locks, "one")
    idle_harness.until(lambda: other.hold() is not LockState.REFUSED, "let go")  # until the server, too, has ended the session
    for _ in range(GRACE_ROUNDS):
        one.round()
    assert ends == []
    one.round()
    assert ends == ["one"]
    other.close()


def test_a_worker_hears_what_an_operator_asks_of_it(idle_harness, takeover):
    asked = []
    _, one = takeover("one", asked=asked.append)
    workers.insert(idle_harness.database, "one", host="here", pid=1, device="cpu")
    one.round()
    assert idle_harness.database.transact(lambda connection: workers.ask(connection, "one", workers.DRAIN))
    assert not idle_harness.database.transact(lambda connection: workers.ask(connection, "two", workers.DRAIN))
    one.round()
    assert asked == [workers.DRAIN]
