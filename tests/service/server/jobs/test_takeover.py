"""What becomes of a dead worker's jobs, and who may change a job; without processes, so that each moment can be set up."""

import pytest

from service.requests.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.server.jobs.presence import Held, presence
from service.server.jobs.queue import workflow_id
from service.server.jobs.takeover import FORGOTTEN_ROUNDS, GRACE_ROUNDS, Takeover
from service.server.store import jobs
from service.server.store.jobs import Claim, Progress

MAX_LOST = 3


@pytest.fixture
def job(still_yard):
    """A job that the worker `gone`, which is not there any more, has begun."""
    job = still_yard.relight(new_id(CAPTURE), new_id(ENVIRONMENT), 10, chunk_frames=5)
    still_yard.take(job, "gone")
    assert jobs.begin(still_yard.database, Claim(job, 1, "gone"))
    return job


def takeover(yard, name, *, running=frozenset(), deposed=lambda: None):
    lock = presence(yard.database, yard.settings.data / "locks", name)
    assert lock.hold() is Held.ANEW
    return lock, Takeover(yard.database, yard.queue, lock, name, every_s=1, max_lost=MAX_LOST, running=lambda: frozenset(running),
                          beat=lambda: None, deposed=deposed)


def let_go(yard, lock, name):
    """Close a lock, and wait until the server, too, has ended the session."""
    lock.close()
    other = presence(yard.database, yard.settings.data / "locks", name)
    yard.until(lambda: other.hold() is not Held.REFUSED, "let go")
    return other


def test_a_dead_workers_job_waits_for_another(still_yard, job):
    lock, one = takeover(still_yard, "one")
    one.round()
    row = still_yard.row(job)
    assert (row["state"], row["worker"], row["lost"]) == (jobs.QUEUED, None, 1)
    assert still_yard.in_queue(job) == ("ENQUEUED", "work")
    lock.close()


def test_a_living_workers_job_stays(still_yard, job):
    gone, _ = takeover(still_yard, "gone")
    lock, one = takeover(still_yard, "one")
    one.round()
    assert still_yard.row(job)["worker"] == "gone"
    assert still_yard.in_queue(job)[0] == "PENDING"
    lock.close()
    gone.close()


def test_nobody_is_given_up_for_dead_soon_after_the_own_lock_was_lost(still_yard, job, monkeypatch):
    lock, one = takeover(still_yard, "one")
    found = iter([Held.REFUSED, Held.ANEW])
    monkeypatch.setattr(lock, "hold", lambda: next(found, Held.KEPT))
    for _ in range(1 + GRACE_ROUNDS):
        one.round()
        assert still_yard.row(job)["worker"] == "gone"
    one.round()
    assert still_yard.row(job)["worker"] is None
    lock.close()


def test_a_worker_that_was_given_up_for_dead_changes_nothing_any_more(still_yard, job):
    gone = Claim(job, 1, "gone")
    lock, one = takeover(still_yard, "one")
    one.round()
    before = dict(still_yard.row(job))
    assert not jobs.begin(still_yard.database, Claim(job, 2, "gone"))
    assert not jobs.advance(still_yard.database, gone, Progress("frames", 3, 10, None))
    assert not jobs.finish_step(still_yard.database, gone, ["frames 1-5"])
    assert not jobs.end(still_yard.database, gone, jobs.FAILED, "it says")
    assert not jobs.is_wanted(still_yard.database, gone)
    assert dict(still_yard.row(job)) == before
    still_yard.take(job, "two")
    assert jobs.begin(still_yard.database, Claim(job, 1, "two"))
    assert not jobs.begin(still_yard.database, gone)  # it had taken the job, and wakes up only now
    assert not still_yard.database.transact(lambda connection: jobs.hand_back(connection, gone))
    assert still_yard.row(job)["worker"] == "two"
    lock.close()


def test_a_worker_is_lost_once_whoever_finds_it_and_however_often(still_yard, job):
    gone = Claim(job, 1, "gone")
    for _ in range(2):  # one who died between the two halves of taking over leaves them to the next
        still_yard.database.transact(lambda connection: jobs.lose_worker(connection, gone, MAX_LOST, "lost"))
    assert still_yard.row(job)["lost"] == 1
    lock, one = takeover(still_yard, "one")
    one.round()
    assert still_yard.row(job)["lost"] == 1
    assert still_yard.in_queue(job)[0] == "ENQUEUED"
    lock.close()


def test_a_second_reaper_finds_nothing_to_do(still_yard, job, monkeypatch):
    first_lock, first = takeover(still_yard, "one")
    second_lock, second = takeover(still_yard, "two")
    before = still_yard.queue.taken_by()
    first.round()
    still_yard.take(job, "one")
    jobs.begin(still_yard.database, Claim(job, 1, "one"))
    looks = iter([before])  # the second had looked before the first was there
    taken_by = still_yard.queue.taken_by
    monkeypatch.setattr(still_yard.queue, "taken_by", lambda: next(looks, None) or taken_by())
    second.round()
    row = still_yard.row(job)
    assert (row["worker"], row["state"], row["lost"]) == ("one", jobs.RUNNING, 1)
    assert still_yard.in_queue(job)[0] == "PENDING"
    first_lock.close()
    second_lock.close()


def test_a_job_that_loses_too_many_workers_fails(still_yard, job):
    lock, one = takeover(still_yard, "one")
    jobs.advance(still_yard.database, Claim(job, 1, "gone"), Progress("open", 0, 1, None))
    for lost in range(1, MAX_LOST + 2):
        one.round()
        assert still_yard.row(job)["lost"] == lost
        if lost <= MAX_LOST:
            still_yard.take(job, "gone")
            jobs.begin(still_yard.database, Claim(job, 1, "gone"))
    row = still_yard.row(job)
    assert (row["state"], row["error"]) == (jobs.FAILED, "lost 4 workers in one step (open): it may need more memory than they have")
    assert still_yard.in_queue(job)[0] == "CANCELLED"
    lock.close()


def test_more_frames_than_ever_before_count_as_a_finished_step(still_yard, job):
    database, gone = still_yard.database, Claim(job, 1, "gone")
    lock, one = takeover(still_yard, "one")

    def lose():
        one.round()
        still_yard.take(job, "gone")
        jobs.begin(database, gone)

    lose()
    jobs.advance(database, gone, Progress("frames", 4, 10, None))
    assert still_yard.row(job)["lost"] == 0
    lose()
    jobs.advance(database, gone, Progress("frames", 4, 10, None))  # the next worker comes as far, and no further
    assert still_yard.row(job)["lost"] == 1
    jobs.advance(database, gone, Progress("normals", 9, 10, None))  # stages that begin at their beginning again are no progress
    assert still_yard.row(job)["lost"] == 1
    jobs.finish_step(database, gone, ["frames 1-5"])
    assert still_yard.row(job)["lost"] == 0
    lock.close()


def test_a_cancelled_job_of_a_dead_worker_is_called_off(still_yard, job):
    still_yard.database.transact(lambda connection: jobs.cancel(connection, job))
    lock, one = takeover(still_yard, "one")
    one.round()
    assert still_yard.row(job)["state"] == jobs.CANCELLED
    assert still_yard.in_queue(job)[0] == "CANCELLED"
    lock.close()


def test_what_a_worker_took_and_knows_nothing_of_goes_back(still_yard, job):
    lock, gone = takeover(still_yard, "gone")
    for _ in range(FORGOTTEN_ROUNDS - 1):
        gone.round()
    assert still_yard.in_queue(job)[0] == "PENDING"
    gone.round()
    assert still_yard.in_queue(job)[0] == "ENQUEUED"
    row = still_yard.row(job)
    assert (row["state"], row["worker"], row["lost"]) == (jobs.QUEUED, None, 0)
    lock.close()


def test_what_a_worker_goes_on_with_stays(still_yard, job):
    lock, gone = takeover(still_yard, "gone", running={workflow_id(job, 1)})
    for _ in range(2 * FORGOTTEN_ROUNDS):
        gone.round()
    assert still_yard.row(job)["worker"] == "gone"
    lock.close()


def test_a_worker_whose_lock_is_another_s_for_good_ends(still_yard, job):
    ends = []
    lock, one = takeover(still_yard, "one", deposed=lambda: ends.append("one"))
    other = let_go(still_yard, lock, "one")
    for _ in range(GRACE_ROUNDS):
        one.round()
    assert ends == []
    one.round()
    assert ends == ["one"]
    other.close()
