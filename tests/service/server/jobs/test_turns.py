"""Projects take turns, whatever the priority of their jobs."""

from service.requests.identifiers import CAPTURE, new_id
from service.requests.jobs import SolveJob
from service.server.database import jobs
from tests.service.server.jobs.harness import harness

MANY = 16


def test_a_project_with_many_urgent_jobs_does_not_keep_another_waiting(tmp_path):
    """The next project is drawn by lot, so that the other one's job is the last of all once in 2**16 runs."""
    with harness(tmp_path) as made:
        def submit(project, priority):
            request = SolveJob(kind="solve", capture=new_id(CAPTURE), priority=priority)  # of no capture: it fails at once
            return made.database.transact(lambda connection: made.queue.submit(
                connection, project=project, key=None, request=request, chunk_frames=1, inputs=[]))

        urgent = [submit("larch", 100) for _ in range(MANY)]
        ordinary = submit("willow", 0)
        made.start()
        ended = [made.ended(job) for job in (*urgent, ordinary)]
        assert {row["state"] for row in ended} == {jobs.FAILED}
        finished = [row["finished_at"] for row in ended]
        assert finished[-1] < max(finished)
