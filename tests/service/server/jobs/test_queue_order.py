"""In which order jobs are done: projects take turns, and those of one project go by priority and by time.

These tests fail where DBOS names or uses the columns otherwise that service.server.jobs.queue writes.
"""

import time

import pytest

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import SolveJob
from service.server.database import jobs
from service.server.jobs.queue import job_and_attempt
from tests.service.server.jobs.harness import harness

MANY = 16


@pytest.mark.long
def test_workers_take_jobs_by_priority_and_time_and_projects_take_turns(tmp_path):
    """The next project is drawn by lot, so that the job of `willow` is the last of all once in 2**16 runs."""
    with harness(tmp_path) as made:
        def submit(project, priority=0):
            time.sleep(0.002)  # DBOS orders jobs by the millisecond
            request = SolveJob(kind="solve", capture=new_id(CAPTURE), priority=priority)  # of no capture: it fails at once
            return made.database.transact(lambda connection: made.queue.submit(connection, project=project, request=request))

        urgent = [submit("larch", 100) for _ in range(MANY)]
        ordinary = submit("willow")
        first, second, raised = (submit("alder") for _ in range(3))
        made.database.transact(lambda connection: made.queue.set_priority(connection, raised, 1, 1))
        made.start()
        ended = {job: made.ended(job) for job in (*urgent, ordinary, first, second, raised)}
        assert {row["state"] for row in ended.values()} == {jobs.FAILED}
        assert sorted(urgent, key=lambda job: ended[job]["finished_at"]) == urgent
        assert ended[ordinary]["finished_at"] < ended[urgent[-1]]["finished_at"]
        assert sorted((first, second, raised), key=lambda job: ended[job]["finished_at"]) == [raised, first, second]


def test_a_changed_priority_is_that_of_the_queue(idle_harness):
    """Without another attempt, and among equal priorities the job keeps its place."""
    first, second, third = (idle_harness.two_steps() for _ in range(3))
    before = idle_harness.row(second)

    def change(connection, job, priority):
        assert jobs.set_priority(connection, job, priority) == 1
        idle_harness.queue.set_priority(connection, job, 1, priority)

    def order():
        sorted_as_dbos_does = sorted((idle_harness.workflow(job) for job in (first, second, third)),
                                     key=lambda status: (status.priority, status.created_at))
        return [job_and_attempt(status.workflow_id)[0] for status in sorted_as_dbos_does]

    assert order() == [first, second, third]
    idle_harness.database.transact(lambda connection: change(connection, third, before["priority"] + 1))
    assert order() == [third, first, second]
    idle_harness.database.transact(lambda connection: change(connection, second, before["priority"] + 1))
    assert order() == [second, third, first]
    row = idle_harness.row(second)
    assert (row["attempt"], row["revision"], row["state"]) == (1, before["revision"] + 1, jobs.QUEUED)
    idle_harness.claim(second, "one")
    assert idle_harness.database.transact(lambda connection: jobs.set_priority(connection, second, 1)) is None  # it runs
